"""A seed that breaks stops no other, keeps what it had learned, and the cause is named."""

from __future__ import annotations

import dataclasses
import math
import pathlib
import re
import shutil
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pmt_jax import load_config, make_setup
from pmt_jax.learning.debug import SEEDS, NotFinite, check_finite, checked, watched
from pmt_jax.training import health, trainer
from pmt_jax.training.metrics import LOSSES
from pmt_jax.training.workers import WorkerLost
from runs import ARGUMENTS, STEPS, rows, saved


def breaking(monkeypatch: pytest.MonkeyPatch, updates: dict[int, int]) -> None:
    """Training in which a weight of seed i becomes nan with update number updates[i]."""
    compile_run = trainer.compile_run

    def compile_breaking(*arguments: Any) -> Any:
        state, programs = compile_run(*arguments)

        def chunk(state: Any, number: int) -> Any:
            state, metrics = programs.chunk(state, number)
            bad = np.array([updates.get(i, 10**9) <= n for i, n in enumerate(np.asarray(state.update))])
            params = jax.tree.map(
                lambda x: jnp.where(bad.reshape(-1, *[1] * (x.ndim - 1)), jnp.nan, x), state.actor.params
            )
            state = dataclasses.replace(state, actor=dataclasses.replace(state.actor, params=params))
            return state, metrics | {"finite": ~bad}

        return state, programs._replace(chunk=chunk)

    monkeypatch.setattr(trainer, "compile_run", compile_breaking)


@pytest.mark.full
def test_one_seed_breaks_and_the_other_trains_on(whole: pathlib.Path, tmp_path: pathlib.Path, cli, monkeypatch):
    breaking(monkeypatch, {1: 10})
    out = tmp_path / "run"
    command = ("train", *ARGUMENTS, "--steps", STEPS, "--out", out)
    code, text, err = cli(*command)
    assert (
        code == 1 and not err and "stopped: a weight of seed 1 at step 1,000 is not finite; training diverged" in text
    )
    assert f"seed(s) 1 broke; the last finite state and the best of every seed are saved in {out}" in text

    ours, theirs = ([row | {"seconds": 0} for row in rows(folder)] for folder in (out, whole))
    assert ours[0::2] == theirs[0::2]  # seed 0
    assert ours[1:9:2] == theirs[1:9:2]  # seed 1 before it broke
    assert all(row["broken"].startswith("a weight of seed 1") for row in ours[9::2])
    assert ours[9]["critic/loss"] == theirs[9]["critic/loss"] and ours[11]["critic/loss"] is None
    first, second = saved(out), saved(whole)
    for path, x in first.items():
        assert np.isfinite(x).all() or not np.isfinite(second[path]).all()  # an unknown best cost is inf
        assert np.array_equal(x[0], second[path][0])
    assert first["['last'].update"].tolist() == [16, 8]

    code, again, _ = cli(*command, "--resume")
    assert code == 1 and "stopped: a weight of seed 1 at step 1,000" in again
    shutil.rmtree(out / "checkpoints" / str(STEPS))


def test_a_seed_that_an_evaluation_broke_does_not_train_on(tmp_path: pathlib.Path, cli, monkeypatch):
    """Its state is whole and has no update less."""
    monkeypatch.setattr(health, "diagnose_evaluation", lambda setup, row: "too much" if row["step"] >= 400 else None)
    command = ("train", *ARGUMENTS, "--steps", STEPS, "--out", tmp_path / "run")
    for more in ((), ("--resume",)):
        code, text, _ = cli(*command, *more)
        assert code == 1 and "stopped: too much" in text
        assert [(row["step"], row["broken"]) for row in rows(tmp_path / "run")[-2:]] == [(400, "too much")] * 2


def test_a_worker_that_is_lost_after_a_seed_broke_costs_one_chunk(tmp_path: pathlib.Path, cli, monkeypatch):
    breaking(monkeypatch, {1: 3})
    evaluate = trainer.Trainer.evaluate

    def evaluate_until_lost(self: trainer.Trainer, rows: Any) -> None:
        if self.step == 800:
            raise WorkerLost("a worker died")
        evaluate(self, rows)

    monkeypatch.setattr(trainer.Trainer, "evaluate", evaluate_until_lost)
    code, text, err = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", tmp_path / "run")
    assert code == 1 and not err and "stopped: a worker died; saved as of step 600" in text
    assert saved(tmp_path / "run")["['last'].update"].tolist() == [6, 2]


def test_all_seeds_break_and_the_run_stops(tmp_path: pathlib.Path, cli, monkeypatch):
    breaking(monkeypatch, {0: 3, 1: 5})
    code, text, _ = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", tmp_path / "run")
    assert code == 1 and "seed 0 at step 400" in text and "seed 1 at step 600" in text and "done" not in text
    assert rows(tmp_path / "run")[-1]["step"] == 600
    assert saved(tmp_path / "run")["['last'].update"].tolist() == [2, 4]
    # With --debug they go on from there, to be looked at; here by a program without its checks.
    monkeypatch.undo()
    unchecked = trainer.compile_run
    monkeypatch.setattr(
        trainer, "compile_run", lambda setup, say: unchecked(dataclasses.replace(setup, debug=False), say)
    )
    code, text, _ = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", tmp_path / "run", "--resume", "--debug")
    assert code == 0 and saved(tmp_path / "run")["['last'].update"].tolist() == [12, 14]


def row(**changes: float) -> dict[str, Any]:
    """A row of a seed that is well, but for `changes`; `/` is written `__`."""
    well = dict.fromkeys(LOSSES, 0.5) | {
        "step": 100,
        "seed": 3,
        "task": "lane",
        "non_finite": 0,
        "cost_out_of_range": 0,
    }
    well |= {"step_reward": 0.1, "step_cost": 0.1}
    well |= {f"{c}/return_{m}": 5.0 for c in ("critic", "cost_critic") for m in ("mean", "std")}
    return well | {name.replace("__", "/"): x for name, x in changes.items()}


@pytest.mark.parametrize(
    ("changes", "settings", "says"),
    [
        ({}, {}, None),
        ({"non_finite": 51}, {}, "51% of the environment steps of seed 3 at step 100 were not finite; check the obs"),
        ({"non_finite": 40}, {}, None),
        ({"non_finite": 40, "actor__loss": math.nan}, {}, "40.0% of the environment steps were not finite: check"),
        ({"actor__loss": math.inf}, {}, "actor/loss of seed 3 at step 100 is inf; training diverged: try smaller lea"),
        ({"critic__loss": math.nan}, {"critic_lr": 1e38}, "single precision cannot train with critic_lr = 1e+38"),
        ({"critic__loss": math.nan}, {"lambda_max": 1e38}, "single precision cannot train with lambda_max = 1e+38"),
        (
            {"critic__return_std": 2e8},
            {},
            "the critic of seed 3 at step 100 diverged: its returns are 5 +- 2e+08, where",
        ),
        ({"critic__return_std": 2e8, "step_reward": -1e7}, {}, None),
        ({"cost_critic__return_mean": -2e10}, {}, "the cost_critic of seed 3 at step 100 diverged"),
        ({"cost_critic__return_mean": 2e8}, {}, None),  # a cost of 1 is 25 / 0.8 limits
        ({"cost_critic__return_std": 2e12}, {"cost_limit": 1e-9}, None),
        ({"cost_critic__return_std": 4e18}, {"cost_limit": 1e-9}, "diverged: its returns are 5 +- 4e+18, where a step"),
        ({"actor__loss": math.nan}, {"cost_limit": 1e-20}, "single precision cannot train with cost_limit = 1e-20"),
        ({"actor__loss": math.nan, "non_finite": 20}, {"cost_limit": 1e-37}, "cannot train with cost_limit = 1e-37"),
        ({"actor__loss": math.nan}, {"cost_limit": 0.0}, "training diverged: try smaller learning rates"),
    ],
)
def test_the_cause_is_told_apart(changes: dict[str, float], settings: dict[str, float], says: str | None):
    setup = make_setup(load_config("lane", num_envs=4, rollout_length=25, minibatches=1, log_interval=1, **settings))
    found = health.diagnose(setup, 0, row(**changes), finite=True, steps=100)
    assert found is None if says is None else says in str(found)


NAN_REWARDS = """
import dataclasses
import jax.numpy as jnp
from envs.toys import Lane

class Broken(Lane):  # finite for actions of -1, 0 and 1, with which a task is checked before training
    def step(self, state, action):
        after = super().step(state, action)
        reward = jnp.where((action * (1 - action**2)).any(), jnp.nan, after.reward)
        return dataclasses.replace(after, reward=reward)
"""


@pytest.mark.full
def test_a_task_whose_reward_is_never_finite_stops(tmp_path: pathlib.Path, cli):
    file = tmp_path / "broken.py"
    file.write_text(NAN_REWARDS)
    sizes = ("--num-envs", 4, "--rollout-length", 25, "--hidden", 8, "--minibatches", 1, "--epochs", 1)
    code, text, err = cli("train", file, *sizes, "--steps", 1000, "--out", tmp_path / "run", "--no-cache")
    assert code == 1 and not err
    assert "stopped: 100% of the environment steps of seed 0 at step 100 were not finite; check the obs" in text


DEBUG = {"num_envs": 2, "rollout_length": 25, "hidden": (4,), "minibatches": 1, "epochs": 1, "log_interval": 2}


def test_debug_names_the_first_tensor_that_is_not_finite():
    setup = dataclasses.replace(make_setup(load_config("lane", seed=5, **DEBUG)), debug=True)

    def program(x: jax.Array) -> jax.Array:
        batch = {"cost": jnp.arange(3), "obs": x, "reward": jnp.log(x - 2)}
        check_finite(setup, jnp.int32(7), batch=batch, advantage=x / 0)
        return x

    run = checked(jax.jit(jax.vmap(program, axis_name=SEEDS)))
    with pytest.raises(NotFinite, match=r"^batch\['reward'\] of seed 6 is not finite in update 7$"):
        run(jnp.array([3.0, 1.0]))


def test_debug_looks_at_what_comes_out_of_loops_under_a_vmap():
    """checkify knows no loop that was vmapped, and tasks and trust regions have some."""

    def program(x: jax.Array, most: jax.Array) -> jax.Array:
        start = (x, jnp.int32(0))
        doubled, _ = jax.lax.while_loop(
            lambda at: (at[0] < most) & (at[1] < 5), lambda at: (at[0] * 2, at[1] + 1), start
        )
        chex.assert_tree_all_finite(doubled, custom_message="doubled")
        return doubled

    both = jax.vmap(jax.vmap(program, (0, None)), (None, 0))
    run, x, most = checked(jax.jit(both)), jnp.array([1.0, 2.0, 3.0]), jnp.array([10.0, 1e9])
    np.testing.assert_array_equal(run(x, most), [[16, 16, 12], [32, 64, 96]])
    with pytest.raises(NotFinite, match="^doubled$"):
        run(x.at[1].set(jnp.inf), most)


@pytest.mark.full
@pytest.mark.parametrize("arguments", [("lane", "--method", "macpo"), ("voltage_33",), ("multi_goal_point_1",)])
def test_debug_knows_the_loops_of_methods_and_tasks(arguments, tmp_path, cli):
    sizes = ("--num-envs", 2, "--rollout-length", 4, "--hidden", 4, "--minibatches", 1, "--epochs", 1, "--steps", 8)
    code, text, _ = cli("train", *arguments, *sizes, "--debug", "--out", tmp_path / "run")
    assert code == 0 and "done: 8 steps" in text


def test_debug_adds_nothing_where_it_is_off():
    setup = make_setup(load_config("lane", **DEBUG))
    traced = jax.make_jaxpr(lambda x: check_finite(setup, x, batch=x))(jnp.zeros(3))
    assert not traced.eqns and watched(setup, jnp.zeros(())) is setup.vector


@pytest.mark.full
def test_debug_computes_the_same_run(whole, tmp_path, cli):
    out = tmp_path / "run"
    assert cli("train", *ARGUMENTS, "--steps", STEPS, "--debug", "--out", out)[0] == 0
    assert rows(out) == [{**row, "seconds": mine["seconds"]} for row, mine in zip(rows(whole), rows(out), strict=True)]


UNSOUND = """
import dataclasses
import jax.numpy as jnp
from envs.toys import Lane

class Unsound(Lane):
    def step(self, state, action):
        after = super().step(state, action)
        return dataclasses.replace(after, reward=jnp.where(after.carry.time > 9, jnp.nan, after.reward))
"""


@pytest.mark.full
def test_debug_looks_at_what_the_task_returns_and_saves_where_it_stopped(tmp_path, cli):
    (tmp_path / "unsound.py").write_text(UNSOUND)
    out, words = tmp_path / "run", (*ARGUMENTS[1:], "--method", "mappo", "--eval-interval", 0, "--debug")
    code, said, _ = cli("train", tmp_path / "unsound.py:Unsound", *words, "--out", out)
    assert code == 1 and re.search(
        r"stopped: task\.step\.reward of seed [01] is not finite in update \d+; saved as", said
    )
    assert list((out / "checkpoints").iterdir())
