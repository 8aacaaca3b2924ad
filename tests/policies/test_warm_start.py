"""A run that starts from what another has learned."""

from __future__ import annotations

import dataclasses
import pathlib
import shutil
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pmt_jax import load_config, make_train
from pmt_jax.errors import UsageError
from pmt_jax.learning import learner
from pmt_jax.learning.setup import Setup, Trials, make_setup
from pmt_jax.learning.types import LearnerState
from pmt_jax.policies import load, warm_start
from runs import ARGUMENTS, STEPS, rows

SIZES = {"num_envs": 4, "rollout_length": 25, "hidden": (8,), "minibatches": 1}


def first(task: str = "lane", fill: float = 0.5, **changes: Any) -> tuple[Setup, LearnerState]:
    """A run's setup, and a state of its shapes, filled."""
    setup = make_setup(load_config(task, **({"method": "f4sg"} | SIZES | changes)))
    hyper, keys, axes = setup.vmap_arguments
    shapes = jax.eval_shape(jax.vmap(lambda h, key: learner.init(setup, h, key), axes), hyper, keys)

    def filled(x: jax.ShapeDtypeStruct) -> jax.Array:
        return keys if x.dtype == keys.dtype else jnp.full(x.shape, fill, x.dtype)

    return setup, jax.tree.map(filled, shapes)


def started(setup: Setup, state: LearnerState) -> LearnerState:
    change = warm_start.prepare(setup)
    assert change
    return change(state)


def test_networks_and_moments_are_the_other_runs_and_all_else_is_new(whole: pathlib.Path):
    _, other = load.load_run(whole)
    assert isinstance(other, LearnerState)
    setup, fresh = first(seeds=3, init=str(whole))
    state = started(setup, fresh)
    turn = np.array([0, 1, 0])
    for name in ("actor", "fear"):
        learned, before, now = (getattr(x, name) for x in (other, fresh, state))
        chex.assert_trees_all_equal(now.params, jax.tree.map(lambda x: x[turn], learned.params))
        chex.assert_trees_all_equal(now.opt_state, before.opt_state)
    chex.assert_trees_all_equal(state.critic.returns, jax.tree.map(lambda x: x[turn], other.critic.returns))
    chex.assert_trees_all_equal(state.state_moments, jax.tree.map(lambda x: x[turn], other.state_moments))
    for name in ("constraint", "rollout", "key", "update"):
        chex.assert_trees_all_equal(getattr(state, name), getattr(fresh, name))


def test_each_point_of_a_sweep_begins_with_the_same_seeds(whole: pathlib.Path):
    """However many of one program come before it."""
    _, other = load.load_run(whole)
    assert isinstance(other, LearnerState)
    setup, fresh = first(seeds=3, init=str(whole))
    trials = Trials(setup.hyper, jnp.arange(3), index=jnp.zeros(3, int))  # three points of a seed
    state = started(dataclasses.replace(setup, trials=trials), fresh)
    chex.assert_trees_all_equal(state.actor.params, jax.tree.map(lambda x: x[np.zeros(3, int)], other.actor.params))


@pytest.mark.full
def test_a_pretrained_policy_brings_what_acts():
    setup, fresh = first("ant_2x4", hidden=(128, 128), init="hub:ant_2x4/f4sg")
    state, (_, pretrained) = started(setup, fresh), load.load_run(pathlib.Path("hub:ant_2x4/f4sg"))
    chex.assert_trees_all_equal(state.actor.params, pretrained.actor.params)
    chex.assert_trees_all_equal(state.critic, fresh.critic)


@pytest.mark.full
def test_a_run_begins_there_and_says_so_in_its_settings(whole: pathlib.Path, tmp_path: pathlib.Path, cli):
    out = tmp_path / "run"
    assert cli("train", *ARGUMENTS, "--steps", STEPS, "--init", whole, "--out", out)[0] == 0
    assert load_config(out / "config.toml").init == str(whole)
    assert rows(out)[0]["fear/loss"] != rows(whole)[0]["fear/loss"]


@pytest.mark.full
def test_a_run_that_was_killed_before_its_first_checkpoint_begins_there_again(
    whole: pathlib.Path, tmp_path: pathlib.Path, cli
):
    out = tmp_path / "run"
    words = ("train", *ARGUMENTS, "--steps", STEPS, "--init", whole, "--out", out)
    assert cli(*words)[0] == 0
    before = rows(out)
    shutil.rmtree(out / "checkpoints")
    code, text, _ = cli(*words, "--resume")
    assert code == 0 and "the run starts over" in text
    assert [row | {"seconds": 0} for row in rows(out)] == [row | {"seconds": 0} for row in before]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"init": "nowhere"}, "nowhere is not a run folder"),
        (
            {"init": "{whole}", "activation": "relu"},
            "= 'tanh', this run's do not; add --activation tanh",
        ),
        ({"init": "{whole}", "obs_norm": "none"}, "this run's do not; add --obs-norm "),
        ({"init": "{whole}", "hidden": "16"}, "actor of {whole} has other shapes than this run's"),
        ({"init": "{whole}", "method": "f4sg_letter"}, "fear of {whole} has other shapes than this run's"),
    ],
)
def test_mistakes(changes: dict[str, object], said: str, whole: pathlib.Path):
    words: dict[str, Any] = {name: str(value).format(whole=whole) for name, value in changes.items()}
    with pytest.raises(UsageError, match=said.format(whole=whole)):
        warm_start.prepare(first(**words)[0])


def test_pure_training_knows_no_folders():
    with pytest.raises(UsageError, match="make_train"):
        make_train(load_config("lane", init="hub:ant_2x4/f4sg"))
