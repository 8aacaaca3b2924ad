"""The peers: each is a function that trains until its time is up, and reports every update."""

from __future__ import annotations

import importlib.util
import itertools
import pathlib
import sys
import types
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.interpreters import xla

from envs import adapters
from envs.base import Env
from pmt_jax import Config, make_setup
from pmt_jax.errors import UsageError
from pmt_jax.training.compile import compile_run
from pmt_jax.training.run_folder import MATMUL_PRECISION

from ..cases import Case
from ..plain import plain_loop
from .report import Report

TASK = "ant_2x4"
FOREVER = 100_000_000  # environment steps; the clock ends training long before
IPPO = "baselines/IPPO/ippo_ff_mabrax.py"


class Arguments(NamedTuple):
    """What a peer trains with: our settings of the task, and the folder of a clone of JaxMARL."""

    config: Config
    jaxmarl: pathlib.Path | None


def task(config: Config) -> Env:
    """The task with the settings' options, as training makes it."""
    return make_setup(config).vector.env


def ours(arguments: Arguments, report: Report) -> None:
    """What `pmt train` does between the rows that it writes."""
    jax.config.update("jax_default_matmul_precision", MATMUL_PRECISION)
    setup = make_setup(arguments.config)
    report.about(physics=setup.vector.env.engine)
    state, programs = compile_run(setup, lambda _: None)
    for update in itertools.count(1):
        state, metrics = programs.chunk(state, 1)
        report(update * setup.config.batch_size, *(metrics[f"episode_{what}"].mean() for what in ("reward", "cost")))


def plain(arguments: Arguments, report: Report) -> None:
    """Python loops over C MuJoCo, one on each CPU, with random actions."""
    del arguments
    program = plain_loop(Case("plain loop", TASK))()
    report.about(physics="mujoco", threads=program.facts["threads"])
    for call in itertools.count(1):
        program.call()
        report(call * program.steps)


def brax(arguments: Arguments, report: Report) -> None:
    """brax's PPO with its own settings of its ant, on our batch: one controller for the team, no costs."""
    from brax.training.agents.ppo import networks, train

    if not hasattr(jax, "device_put_replicated"):  # gone in jax 0.10; brax 0.14 calls it

        def replicated(tree: Any, devices: list[Any]) -> Any:
            return jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)

        jax.device_put_replicated = replicated  # pyright: ignore[reportAttributeAccessIssue]
    config = arguments.config
    env = task(config)
    report.about(physics=env.engine)

    def make_networks(*shapes: Any, **how: Any) -> Any:
        sizes = {"policy_hidden_layer_sizes": config.hidden, "value_hidden_layer_sizes": config.hidden}
        return networks.make_ppo_networks(*shapes, **sizes, **how)

    train.train(
        adapters.to_brax(env),
        num_timesteps=FOREVER,
        num_envs=config.num_envs,
        episode_length=env.spec.horizon,
        unroll_length=config.rollout_length,
        batch_size=config.num_envs // config.minibatches,
        num_minibatches=config.minibatches,
        num_updates_per_batch=config.epochs,
        learning_rate=3e-4,
        entropy_cost=1e-2,
        discounting=0.97,
        reward_scaling=10,
        normalize_observations=True,
        network_factory=make_networks,
        seed=config.seed,
        run_evals=False,
        log_training_metrics=True,
        progress_fn=lambda steps, found: report(steps, found.get("episode/sum_reward"), found.get("episode/cost")),
    )


def ippo(arguments: Arguments, report: Report) -> None:
    """JaxMARL's IPPO with its own settings, on our task and batch."""
    env = task(arguments.config)
    report.about(physics=env.engine)
    _jaxmarl(arguments, report, lambda *_: adapters.to_jaxmarl(env))


def ippo_mabrax(arguments: Arguments, report: Report) -> None:
    """The same on JaxMARL's own ant."""
    report.about(physics="brax, positional")
    _jaxmarl(arguments, report, None)


def _jaxmarl(arguments: Arguments, report: Report, env: Callable[..., Any] | None) -> None:
    """Runs the trainer of a clone of JaxMARL; its package holds the environments only.

    Raises:
      UsageError: there is no clone.
    """
    if arguments.jaxmarl is None or not (file := arguments.jaxmarl / IPPO).is_file():
        raise UsageError(f"needs {IPPO} of a clone of github.com/FLAIROx/JaxMARL: name its folder with --jaxmarl")
    config, done = arguments.config, itertools.count(1)

    def log(found: dict[str, Any], **_: Any) -> None:
        cost = found["cost"] * found["returned_episode_lengths"] if "cost" in found else None  # of a mean step
        report(next(done) * config.batch_size, found["returned_episode_returns"], cost)

    sys.modules["wandb"] = types.ModuleType("wandb")
    sys.modules["wandb"].log = log  # pyright: ignore[reportAttributeAccessIssue]  # all that training does with it
    if not hasattr(xla, "pytype_aval_mappings"):  # gone in jax 0.11; the trainer's TensorFlow Probability reads it
        xla.pytype_aval_mappings = jax.core.pytype_aval_mappings  # pyright: ignore[reportAttributeAccessIssue]
    spec = importlib.util.spec_from_file_location("ippo", file)
    assert spec and spec.loader
    trainer: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(trainer)
    settings = trainer.OmegaConf.to_container(trainer.OmegaConf.load(file.parent / "config" / f"{file.stem}.yaml"))
    settings |= {"NUM_ENVS": config.num_envs, "NUM_STEPS": config.rollout_length, "TOTAL_TIMESTEPS": FOREVER}
    settings |= {"UPDATE_EPOCHS": config.epochs, "NUM_MINIBATCHES": config.minibatches}
    if env:
        trainer.jaxmarl = types.SimpleNamespace(make=env)
        wrapper = trainer.LogWrapper
        trainer.LogWrapper = lambda env, replace_info: wrapper(env)  # which keeps our costs
    keys = jax.random.split(jax.random.PRNGKey(config.seed))
    jax.block_until_ready(jax.jit(trainer.make_train(settings, keys[0]))(keys[1]))


def torch(arguments: Arguments, report: Report) -> None:
    """MAPPO-Lagrangian in PyTorch on our gymnasium vector environment."""
    from . import lagrangian

    lagrangian.train(arguments.config, task(arguments.config), report)
