"""Evaluations during training, and the best policy that they choose."""

from __future__ import annotations

import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from pmt_jax import tasks
from pmt_jax.learning.evaluation import interval, is_better, play
from pmt_jax.policies import evaluate
from runs import rows


def test_evaluations_during_training(whole: pathlib.Path, cli):
    table = rows(whole)
    names = [name for name in table[0] if name.startswith("eval/")]
    assert {"eval/episode_reward", "eval/episode_cost", "eval/violation_rate", "eval/info/position"} <= set(names)
    assert {f"{name}/ci95" for name in names if not name.endswith("/ci95")} <= set(names)
    for row in table:
        due = row["step"] % 400 == 0
        assert all((row[name] is not None) == due for name in names)
    text = cli("eval", whole, "--episodes", 4, "--deterministic")[1]
    for row in table[-2:]:
        assert f"{row['eval/episode_reward']:12.4f} +- {row['eval/episode_reward/ci95']:.4f}" in text


def test_the_best_is_the_best_of_the_evaluations(whole: pathlib.Path, cli):
    expected = []
    for seed in (0, 1):
        known = [row for row in rows(whole) if row["seed"] == seed and row["eval/episode_reward"] is not None]
        safe = [row for row in known if row["eval/episode_cost"] <= row["cost_limit"]]
        by_cost = min(known, key=lambda row: row["eval/episode_cost"])
        expected.append(max(safe, key=lambda row: row["eval/episode_reward"]) if safe else by_cost)
    text = cli("eval", whole, "--episodes", 4, "--deterministic", "--which", "best")[1]
    assert "mean actions of the best policy" in text
    for row in expected:
        assert f"seed {row['seed']} after {row['step']:,} steps" in text
        assert f"{row['eval/episode_reward']:12.4f} +-" in text
    assert "unknown checkpoint 'bset'; did you mean 'best'?" in cli("eval", whole, "--which", "bset")[2]


@pytest.mark.full
def test_every_step_of_an_evaluation_can_be_saved(whole: pathlib.Path, tmp_path: pathlib.Path, cli):
    file = tmp_path / "episodes.npz"
    code, text, _ = cli("eval", whole, "--episodes", 3, "--save", file)
    assert code == 0 and text == cli("eval", whole, "--episodes", 3)[1] + f"wrote every step to {file}\n"
    steps = np.load(file)
    assert steps["seed"].tolist() == [0, 1] and (steps["length"] == 25).all()
    shapes = {"obs": (2, 3, 25, 2, 8), "action": (2, 3, 25, 2, 2), "reward": (2, 3, 25), "cost": (2, 3, 25, 2, 1)}
    assert {name: steps[name].shape for name in shapes} == shapes
    assert f"{steps['reward'][0].sum(1).mean():12.4f}" in text and steps["truncated"][..., -1].all()
    now, after = (steps["info/position"][..., at] for at in (slice(0, -1), slice(1, None)))
    push = np.clip(steps["action"][..., 1:, :, :], -1, 1)
    np.testing.assert_allclose(after, 0.8 * now + 0.1 * push.sum((-1, -2)), atol=1e-5)  # the task's own dynamics
    refused = cli("eval", whole, "--save", "x.csv")
    assert refused[::2] == (2, "pmt: cannot write x.csv: its ending must be .npz, or its beginning minari:\n")


def test_an_evaluation_is_a_data_set_of_minari(
    whole: pathlib.Path, tmp_path: pathlib.Path, cli, monkeypatch: pytest.MonkeyPatch
):
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    code, text, _ = cli("eval", whole, "--episodes", 3, "--save", "minari:lane/team-v0")
    assert code == 0 and text.endswith("wrote every step to minari:lane/team-v0\n")
    assert cli("eval", whole, "--episodes", 3, "--save", tmp_path / "episodes.npz")[0] == 0
    steps, dataset = np.load(tmp_path / "episodes.npz"), minari.load_dataset("lane/team-v0")
    episodes = list(dataset)
    assert dataset.total_steps == steps["length"].sum() == 150 and len(episodes) == 6
    for k, episode in enumerate(episodes):
        i, j = divmod(k, 3)
        np.testing.assert_array_equal(episode.observations[:-1], steps["obs"][i, j])
        np.testing.assert_array_equal(episode.observations[-1], steps["final_obs"][i, j])
        np.testing.assert_array_equal(episode.actions, steps["action"][i, j])
        np.testing.assert_array_equal(episode.rewards, steps["reward"][i, j])
        np.testing.assert_array_equal(episode.infos["cost"], steps["cost"][i, j])
        np.testing.assert_array_equal(episode.infos["position"], steps["info/position"][i, j])
        assert (episode.infos["seed"] == i).all() and episode.truncations[-1] and not episode.truncations[:-1].any()
        # The last observation is of where the last action led, not of the next episode.
        np.testing.assert_allclose(episode.observations[-1, 0, 0], 2 * episode.infos["position"][-1] - 1, atol=1e-6)
    again = cli("eval", whole, "--save", "minari:lane/team-v0")
    assert again[0] == 2 and "there is such a Minari data set; choose another name or version" in again[2]
    for name in ("minari:", "minari:a b", "minari:lane/team"):
        assert "a Minari data set is called like minari:lane/mappo_l-v0" in cli("eval", whole, "--save", name)[2]


def test_minari_without_its_extra(whole: pathlib.Path, cli, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    code, _, error = cli("eval", whole, "--save", "minari:lane/team-v0")
    assert code == 2 and "this needs minari, which is missing here: pip install 'pmt-jax[minari]'" in error


def test_steps_after_the_end_of_an_episode_are_zero(tmp_path: pathlib.Path, cli):
    file = tmp_path / "episodes.npz"
    assert cli("eval", "noisy", "--policy", "zero", "--save", file)[0] == 2  # toys have no baselines
    env = tasks.make("lane")
    ends = jnp.array([3, 25])

    def act(state: tasks.State, t: jax.Array) -> jax.Array:
        return jnp.where((t < ends)[:, None, None], 0.0, jnp.nan) * jnp.ones((2, 2, 2))

    kept = jax.jit(lambda: play(env, act, 2, record=True))()
    assert kept["episode_length"].tolist() == [4, 25]  # broken physics ends the first
    for name, x in kept.items():
        if name.startswith("step/"):
            assert (np.asarray(x[4:, 0]) == 0).all() and np.isfinite(x[:3]).all()


@pytest.mark.full
def test_what_was_chosen_is_evaluated_from_other_starts(monkeypatch):
    monkeypatch.setattr(evaluate, "load_run", lambda *_: ())
    monkeypatch.setattr(evaluate, "evaluate_states", lambda *_, fresh, save: fresh)
    runs = (("run", "last"), ("run", "best"), ("hub:lane/r4sg", "last"))
    assert [evaluate.evaluate_run(pathlib.Path(run), 8, True, which) for run, which in runs] == [False, True, True]

    env = tasks.make("noisy")
    push = jnp.ones((8, *env.spec.action_mask.shape))
    both = jax.jit(lambda: [play(env, lambda *_: push, 8, fresh=fresh)["episode_cost"] for fresh in (False, True)])()
    assert not np.array_equal(*both)


figures = st.floats(-100, 100, width=32) | st.just(float("nan"))


@given(reward=figures, cost=figures, best_reward=figures, best_cost=figures)
def test_better_is_an_order(reward: float, cost: float, best_reward: float, best_cost: float):
    def better(a: tuple[float, float], b: tuple[float, float]) -> bool:
        return bool(is_better(*np.float32([*a, *b]), limit=1.0))

    new, old = (reward, cost), (best_reward, best_cost)
    assert not better(new, new)
    assert not (better(new, old) and better(old, new))
    if not np.isnan([*new, *old]).any():
        key = [(c <= 1, r if c <= 1 else -c) for r, c in (new, old)]
        assert better(new, old) == (key[0] > key[1])
    if np.isnan(cost):
        assert not better(new, old)


def test_the_interval_is_students():
    x = np.random.default_rng(0).normal(3, 2, 7)
    mean, half = interval(x)
    low, high = scipy.stats.t.interval(0.95, 6, x.mean(), scipy.stats.sem(x))
    np.testing.assert_allclose([mean - half, mean + half], [low, high])
    assert np.isnan(interval(x[:1])[1])
