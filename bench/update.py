"""Where the time of one gradient step of a network goes, part by part, by XLA and by the learner's compiled code."""

from __future__ import annotations

import dataclasses
import functools
import re
import statistics
import time
from typing import Any

import jax
import jax.numpy as jnp
import optax

from pmt_jax import load_config, make_setup
from pmt_jax.learning import critics, fused, policies, schedules
from pmt_jax.learning.optimise import Loss, descend, fit, init_train_state
from pmt_jax.learning.setup import Setup
from pmt_jax.learning.types import Params, PolicySamples

from .cases import Case
from .records import Record

TURNS = 15
Fit = tuple[Params, Loss, Any]


def update(case: Case) -> Record:
    """Seconds of a step: of its parts, each as the difference that it makes to a loop, and of `fit` as it is.

    On a GPU also the kernels of each loop, counted in its compiled program. The case's `what` is a network (critic or
    actor) and what computes it (xla or fused).
    """
    network, way = case.what.split()
    if (way == "fused") != fused.available():
        if way == "fused":
            raise RuntimeError("there is no compiled code of networks here")
        with _without_code():
            return _row(case, network)
    return _row(case, network)


class _without_code:
    """Inside, XLA computes everything."""

    def __enter__(self) -> None:
        self._available, fused.available = fused.available, lambda: False

    def __exit__(self, *_: object) -> None:
        fused.available = self._available


def _row(case: Case, network: str) -> Record:
    config = load_config(case.task, method=case.method, num_envs=case.num_envs, rollout_length=case.rollout_length)
    setup = make_setup(config)
    setup = dataclasses.replace(setup, nets=setup.nets.fast)
    steps = config.epochs * config.minibatches
    loops = {name: loop.lower().compile() for name, loop in _loops(setup, network).items()}
    turns: dict[str, list[float]] = {name: [] for name in loops}
    for turn in range(TURNS + 1):
        for name, loop in loops.items():
            begin = time.perf_counter()
            jax.block_until_ready(loop())
            if turn:  # the first one warms up
                turns[name].append((time.perf_counter() - begin) / steps)
    seconds = {name: statistics.median(values) for name, values in turns.items()}
    row: Record = {"minibatch": config.batch_size // config.minibatches, "step_seconds": seconds.pop("fit")}
    before = 0.0
    for name, value in seconds.items():
        row[f"{name}_seconds"], before = value - before, value
    if jax.default_backend() == "gpu":
        row["kernels"] = {name: kernels(loop.as_text()) for name, loop in loops.items()}
    return row


def _loops(setup: Setup, network: str) -> dict[str, Any]:
    """Jitted functions of nothing that do every step of a fit up to a part, and `fit`."""
    params, loss, samples = _critic(setup) if network == "critic" else _actor(setup)
    config, count = setup.config, jax.tree.leaves(samples)[0].shape[0]
    start, key = init_train_state(params), jax.random.key(1)
    order = jax.random.permutation(key, jnp.arange(config.epochs * count) % count)
    limits = {"learning_rate": 1e-3, "max_grad_norm": 10.0}

    def step(last: str, net: Any, index: jax.Array) -> tuple[Any, Any]:
        minibatch = jax.lax.optimization_barrier(jax.tree.map(lambda x: x[index], samples))
        if last == "gather":
            return net, _first(minibatch)
        if last == "forward":
            return net, _first(loss(net.params, minibatch)[0])
        gradient = jax.lax.optimization_barrier(jax.grad(loss, has_aux=True)(net.params, minibatch)[0])
        if last == "backward":
            return net, _first(gradient)
        if last == "norm":
            return net, optax.tree.norm(gradient)
        return descend(net, gradient, **limits)

    def loop(last: str) -> Any:
        return jax.lax.scan(functools.partial(step, last), start, order.reshape(config.epochs * config.minibatches, -1))

    parts = ["gather", "forward", "backward", *(["adam"] if fused.available() and fused.on_cpu() else ["norm", "adam"])]
    whole = functools.partial(
        fit, start, loss, samples, key, epochs=config.epochs, minibatches=config.minibatches, **limits
    )
    return {"fit": jax.jit(whole)} | {part: jax.jit(functools.partial(loop, part)) for part in parts}


def _first(tree: Any) -> jax.Array:
    """A number that depends on the whole of every leaf, because of the barrier before it."""
    return sum(x.ravel()[0] for x in jax.tree.leaves(tree))  # pyright: ignore[reportReturnType] (never empty)


def _draw(*shapes: tuple[int, ...]) -> list[jax.Array]:
    keys = jax.random.split(jax.random.key(0), len(shapes))
    return [jax.random.normal(key, shape) for key, shape in zip(keys, shapes, strict=True)]


def _critic(setup: Setup) -> Fit:
    count = setup.config.batch_size
    state, old, target = _draw((count, setup.nets.state_dim), (count,), (count,))
    loss = critics.loss_of(setup.nets.value, setup.hyper.clip)
    return setup.nets.init_critic(jax.random.key(2)), loss, (state, old, target)


def _actor(setup: Setup) -> Fit:
    count, spec = setup.config.batch_size, setup.vector.spec
    wide, one = (count, spec.action_dim), (count,)
    obs, action, mean, advantage, cost = _draw((count, spec.obs_dim), wide, wide, one, (count, spec.num_costs))
    full, zero = jnp.ones(wide), jnp.zeros(one)
    samples = PolicySamples(obs, action, full, zero, mean, full / 3, advantage, cost, zero, zero + 1)
    params = jax.tree.map(lambda x: x[0], setup.nets.init_actor(jax.random.key(2)))
    now = schedules.at(setup.config, setup.hyper, jnp.int32(0))
    return params, policies.policy_loss(setup, setup.hyper, now, samples, jnp.zeros(1)), samples


# What a loop's body names besides what it launches.
_NOT_LAUNCHED = ("parameter", "tuple", "get-tuple-element", "bitcast", "constant", "after-all", "partition-id")


def kernels(program: str) -> int:
    """How many kernels a turn of a program's longest loop launches: its body's instructions but for bookkeeping."""
    found = [0]
    for body in re.findall(r"while\(.*body=%?([\w.\-]+)", program):
        text = re.search(rf"^%?{re.escape(body)} .*?\{{\n(.*?)^\}}", program, re.MULTILINE | re.DOTALL)
        lines = text[1].splitlines() if text else []
        kinds = [match[1] for line in lines if (match := re.search(r"= (?:\(.*?\)|\S+) ([\w\-]+)\(", line))]
        found.append(sum(kind not in _NOT_LAUNCHED and not kind.endswith("-done") for kind in kinds))
    return max(found)
