"""Every run ends with an evaluation under mean actions, and with lines that say whether the limit was kept."""

from __future__ import annotations

import dataclasses
import json
import pathlib
import signal
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from pmt_jax import load_config, tasks
from pmt_jax.learning.evaluation import interval, is_better, play
from pmt_jax.learning.setup import make_setup
from pmt_jax.policies import evaluate
from pmt_jax.studies import run_log, verdict
from pmt_jax.training import final, outlook, trainer
from runs import ARGUMENTS, STEPS, assert_same_run, rows


def ends(out: pathlib.Path) -> list[dict]:
    return [json.loads(line) for line in (out / final.FILE).read_text().splitlines()]


def test_the_end_of_a_run_is_what_eval_measures(whole: pathlib.Path, cli):
    """Seed for seed, figure for figure; and every row of the table has both measures, named and defined."""
    code, text, _ = cli("eval", whole, "--episodes", final.EPISODES, "--deterministic")
    measured = [line.split() for line in text.splitlines() if line.startswith("  ")]
    found = ends(whole)
    assert code == 0 and [row["seed"] for row in found] == [0, 1] and {row["step"] for row in found} == {STEPS}
    assert {row["episodes"] for row in found} == {64} and {row["actions"] for row in found} == {"mean"}
    for name in ("episode_reward", "episode_cost", "violation_rate", "within_limit"):
        theirs = [float(words[1]) for words in measured if words[0] == name]
        np.testing.assert_allclose([row[name] for row in found], theirs, atol=1e-4)
    text = cli("table", whole)[1]
    for part in ("mean-action reward", "mean-action cost", "mean-action seeds within", "without noise, as one deploys"):
        assert part in text
    (data,) = json.loads(cli("table", whole, "--format", "json")[1])["rows"]
    assert data["mean_actions"]["seeds"] == 2
    np.testing.assert_allclose(
        data["mean_actions"]["reward"]["mean"], np.mean([row["episode_reward"] for row in found])
    )
    assert data["mean_actions"]["within"] == sum(row["episode_cost"] <= row["cost_limit"] for row in found)


@pytest.mark.full
def test_a_run_that_trains_on_is_evaluated_anew(copy: pathlib.Path, cli):
    before = (copy / final.FILE).read_text()
    code, text, _ = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", copy, "--resume")
    assert code == 0 and "evaluating" not in text and (copy / final.FILE).read_text() == before  # it is done
    code, text, _ = cli("train", *ARGUMENTS, "--steps", STEPS + 200, "--out", copy, "--resume")
    assert code == 0 and "evaluating 64 episodes a seed under mean actions" in text
    assert {row["step"] for row in ends(copy)} == {STEPS + 200}
    (copy / final.FILE).write_text("")  # of a run of an earlier version
    code, text, _ = cli("train", *ARGUMENTS, "--steps", STEPS + 200, "--out", copy, "--resume")
    assert code == 0 and "evaluating" in text and len(ends(copy)) == 2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_leaves_the_evaluation_to_resume(
    number: int, whole: pathlib.Path, copy: pathlib.Path, cli, monkeypatch: pytest.MonkeyPatch
):
    """It arrives when all is trained and saved; the evaluation that --resume makes is the same."""
    (copy / final.FILE).unlink()
    save = trainer.Trainer.save
    with monkeypatch.context() as patch:
        patch.setattr(trainer.Trainer, "save", lambda self: (save(self), signal.raise_signal(number)))
        code, text, _ = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", copy, "--resume")
    assert code == 128 + number and "interrupted" in text and "--resume" in text and not (copy / final.FILE).exists()
    assert cli("train", *ARGUMENTS, "--steps", STEPS, "--out", copy, "--resume")[0] == 0
    assert ends(copy) == ends(whole)
    assert_same_run(copy, whole)


def test_an_evaluation_that_fails_costs_nothing_else(copy: pathlib.Path, cli, monkeypatch: pytest.MonkeyPatch):
    from pmt_jax.training import failures

    def fail(self, state):
        raise failures.Failed("out of memory")

    (copy / final.FILE).unlink()
    compile_run = trainer.compile_run

    def compiled(setup, say):
        state, programs = compile_run(setup, say)
        return state, programs._replace(final=lambda state: fail(None, state))

    monkeypatch.setattr(trainer, "compile_run", compiled)
    code, text, _ = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", copy, "--resume")
    assert code == 0 and "note: the evaluation could not be made: out of memory" in text and "done:" in text


# ---------------------------------------------------------------------------------------------------------------------
# Whether the limit was kept


def log_of(costs, multiplier=1.0, deployed=None, limit=1.0, method="mappo_l", true=None, **settings) -> run_log.RunLog:
    """A run of 20 rows: `costs` [S, 20] of the training episodes as they were noticed, and as they were."""
    costs = np.asarray(costs, float)
    names = {"episode_cost": costs, "lambda": np.full_like(costs, multiplier)}
    names |= {} if true is None else {"true_episode_cost": np.asarray(true, float)}
    evaluation = {} if deployed is None else {"episode_cost": np.asarray(deployed, float)}
    settings = {"lambda_max": 20.0, **settings}
    return run_log.RunLog(
        pathlib.Path("run"), "lane", method, run_log.Limits((limit,)), settings, tuple(range(len(costs))),
        np.arange(1, 21) * 100, names, evaluation=evaluation,
    )  # fmt: skip


FLAT = np.full(20, 1.3)
CASES = {
    "kept": (log_of([FLAT - 0.5], deployed=[0.2]), "kept by 1 of 1 seed", None),
    "at its bound": (log_of([FLAT, FLAT - 1], multiplier=20.0), "kept by 1 of 2 seeds", "raise --lambda-max"),
    "still falling": (log_of([np.linspace(5, 1.2, 20)]), "0 of 1 seed in", "costs were still falling"),
    "never near": (log_of([FLAT + 4]), "0 of 1", "costs never came near the limit (lowest row 5.3); raise --lambda-lr"),
    "left it again": (
        log_of([np.repeat([0.3, 24], 10)]),
        "0 of 1",
        "came, but did not stay, near the limit (lowest row 0.3)",
    ),
    "one far, one near": (log_of([FLAT, FLAT + 4]), "0 of 2", "costs never came near the limit (lowest row 5.3)"),
    "about the limit": (log_of([FLAT]), "0 of 1", "--cost-margin"),
    "some falling": (
        log_of([FLAT, np.linspace(5, 1.2, 20), FLAT]),
        "0 of 3",
        "seed 1: costs were still falling (1.7 to 1.3);",
    ),
    "many": (
        log_of([FLAT - x for x in [0] * 4 + [1, 0, 0, 1] * 6]),
        "kept by 12 of 28",
        " and others, 16 in all: ",
    ),
    "in a row": (log_of([FLAT - x for x in (0, 0, 0, 1, 0, 0, 1, 0)]), "2 of 8", "seeds 0 to 2, 4, 5, 7: costs stay"),
    "no constraint": (log_of([FLAT], method="mappo"), "0 of 1", "mappo has no constraint"),
    "trust region": (log_of([FLAT + 4], method="macpo"), "0 of 1", "raise --limit-lr"),
    "pid": (log_of([FLAT + 4], method="mappo_pid"), "0 of 1", "raise --lambda-lr"),
    "pid at its bound": (log_of([FLAT], multiplier=20.0, method="mappo_pid"), "0 of 1", "raise --lambda-max"),
    "penalty": (log_of([FLAT + 4], method="p3o"), "0 of 1", "raise --lambda-max"),
    "switching": (log_of([FLAT + 4], method="crpo"), "0 of 1", "(lowest row 5.3); train longer"),
    "by its noise": (log_of([FLAT], deployed=[0.2]), "; by 1 of 1 seed under mean actions", "keeps the limit"),
    "no episode": (
        log_of([FLAT * np.nan], deployed=[3.0]),
        "limit 1: unknown in",
        "no episode ended; kept by 0 of 1 seed",
    ),
    "few are noticed": (
        log_of([FLAT - 1], true=[np.linspace(50, 12, 20)], cost_seen=0.1),
        "limit 10 on true costs: kept by 0 of 1 seed",
        "costs were still falling (17 to 13)",
    ),
    "only with noise": (log_of([FLAT - 1], deployed=[3.0]), "under mean actions, the worst 2 beyond", "with noise"),
}


@pytest.mark.parametrize("case", CASES)
def test_what_the_end_says_of_a_limit(case: str, monkeypatch: pytest.MonkeyPatch):
    log, kept, advice = CASES[case]
    monkeypatch.setattr(verdict, "read", lambda folder, note: log)
    said = verdict.lines(pathlib.Path("run"))
    assert 1 <= len(said) <= 3 and kept in said[0]
    assert (len(said) == 1) if advice is None else any(advice in line for line in said)


def test_the_limit_is_that_of_true_costs_where_they_are_judged(monkeypatch: pytest.MonkeyPatch):
    """A tenth of the costs is noticed: 0.13 of a limit of 0.1 are 1.3 of 1."""
    log = log_of([0.1 * FLAT], limit=0.1, cost_seen=0.1)
    log = dataclasses.replace(log, metrics=log.metrics | {"true_episode_cost": np.array([FLAT])})
    monkeypatch.setattr(verdict, "read", lambda folder, note: log)
    (said, _) = verdict.lines(pathlib.Path("run"))
    assert said.startswith("limit 1 on true costs: kept by 0 of 1 seed") and said.endswith("the worst 0.3 beyond")


def test_each_agent_and_a_seed_that_broke_count(monkeypatch: pytest.MonkeyPatch):
    """The mean over agents hides agent 0, which is beyond by 8."""
    log = log_of([np.full(20, 9.0), np.full(20, 9.0)], deployed=[9.0, np.nan], limit=10.0)
    agents = {"episode_cost/agent_0": np.full((2, 20), 18.0), "episode_cost/agent_1": np.zeros((2, 20))}
    ended = {"episode_cost/agent_0": np.array([18.0, np.nan]), "episode_cost/agent_1": np.array([0.0, np.nan])}
    log = dataclasses.replace(log, metrics=log.metrics | agents, evaluation=log.evaluation | ended, broken={1: 2000})
    monkeypatch.setattr(verdict, "read", lambda folder, note: log)
    assert verdict.lines(pathlib.Path("run"))[0].count(", the worst 8 beyond") == 2


def test_a_run_says_so_at_its_end(tmp_path: pathlib.Path, cli):
    """Three lines at most, after the line that says it is done."""
    out = tmp_path / "run"
    code, text, _ = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", out)
    after = text.splitlines()[[line.startswith("done:") for line in text.splitlines()].index(True) + 1 :]
    assert code == 0 and 1 <= len(after) <= 3 and after[0].startswith("limit 1: kept by ")
    assert "under mean actions" in after[0] and after == verdict.lines(out)


# ---------------------------------------------------------------------------------------------------------------------
# What can be known of a limit before training

LANE = dict(num_envs=4, rollout_length=25, hidden=(8,), minibatches=1)


@pytest.mark.parametrize(
    ("method", "settings", "said"),
    [
        ("mappo", {"cost_limit": 1.0}, "mappo has no constraint"),
        ("happo", {"cost_limit": 1.0}, "happo has no constraint"),
        ("f4sg", {"cost_limit": 0.0}, "no cost is below a limit of 0"),
        ("macpo", {"cost_limit": 0.0}, "no cost is below a limit of 0"),
        ("mappo_l", {"cost_limit": 1.0, "lambda_lr": 1e-6, "lambda_kp": 0.0}, "raise --lambda-lr"),
        ("mappo_l", {"cost_limit": 1.0, "lambda_lr": 0.01, "lambda_kp": 0.0}, "too little to matter"),
        ("r4sg", {"cost_limit": 1.0, "rollout_length": 5, "steps": 80, "num_envs": 4}, "is hardly measured"),
        (
            "mappo_l",
            {"cost_limit": 1.0, "lambda_init": 2.0, "lambda_max": 2.0, "lambda_lr": 1.0, "lambda_kp": 0.0},
            "may not exceed",
        ),
        ("mappo", {}, None),
        ("mappo_l", {"lambda_lr": 1e-6}, None),  # nobody asked for this limit
        ("mappo_l", {"cost_limit": 1.0, "lambda_lr": 1.0, "steps": 100_000}, None),
        ("mappo_l", {"cost_limit": 1.0}, None),
        ("macpo", {"cost_limit": 1.0}, None),
    ],
)
def test_a_limit_that_the_settings_cannot_reach_is_named_at_the_start(method: str, settings: dict, said: str | None):
    config = load_config("lane", method=method, **(LANE | settings))
    notes = outlook.notes(make_setup(config))
    assert (notes == []) if said is None else any(said in note for note in notes), notes


def test_the_rate_that_is_advised_is_enough():
    """What the sentence says to set, set: nothing is left to say."""
    config = load_config("lane", method="mappo_l", cost_limit=1.0, lambda_lr=1e-4, lambda_kp=0.0, steps=10_000, **LANE)
    (note,) = outlook.notes(make_setup(config))
    enough = float(note.rpartition(" to ")[2].split()[0])
    assert outlook.notes(make_setup(config.replace(lambda_lr=1.1 * enough))) == []


# ---------------------------------------------------------------------------------------------------------------------
# Evaluations during training, and the best policy that they choose


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


@pytest.mark.full
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


@pytest.mark.full
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
