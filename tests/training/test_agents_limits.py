"""A task whose agents differ in cost: the run, its table, its best state and its evaluation hold each to its limit."""

from __future__ import annotations

import dataclasses
import functools
import json
import pathlib
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pmt_jax import METHODS, load_config, make_setup
from pmt_jax.learning import learner
from pmt_jax.learning.evaluation import evaluate
from pmt_jax.learning.types import Best, LearnerState
from pmt_jax.policies import publish
from pmt_jax.policies.load import trusting
from pmt_jax.render import episode
from pmt_jax.training import run_folder
from pmt_jax.training.checkpoint import Checkpoints
from pmt_jax.training.provenance import Provenance
from runs import rows

TASK = """
import dataclasses
import jax
import jax.numpy as jnp
from envs.toys import Lane

class Lop(Lane):
    '''Agent 0 costs in 18 of 25 steps, agent 1 in none.'''

    name = "lop"
    cost_limit = 10.0

    def _state(self, carry, last_action, reward, cost):
        state = super()._state(carry, last_action, reward, cost)
        return dataclasses.replace(state, cost=self._costs(carry, last_action).astype(state.cost.dtype))

    def _costs(self, carry, last_action):
        costly = (carry.time >= 1) & (carry.time <= 18)
        return jnp.stack([costly, jnp.zeros_like(costly)])[:, None]

class Pushes(Lop):
    '''A push costs the agent that pushes, and the team gets 1 for every push.'''

    def _costs(self, carry, last_action):
        return last_action[:, :1] > 0.3

    def step(self, state, action):
        after = super().step(state, action)
        return dataclasses.replace(after, reward=after.cost.sum() + 0.1 * action[0, 1])

class Drawn(Lop):
    '''Three agents and two costs, each of which occurs at random.'''

    def __init__(self):
        super().__init__(num_agents=3)
        self.spec = dataclasses.replace(self.spec, name="drawn", num_costs=2, cost_limit=(10.0, 0.0))

    def _costs(self, carry, last_action):
        draw = jax.random.uniform(carry.key, (3, 2))
        return (draw < jnp.array([0.3, 0.005])) & (carry.time > 0)
"""
TINY = (
    "--num-envs",
    8,
    "--rollout-length",
    25,
    "--hidden",
    16,
    "--epochs",
    1,
    "--minibatches",
    1,
    "--method",
    "mappo_l",
    "--episode-starts",
    "together",
)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """The tasks' file."""
    path = tmp_path_factory.mktemp("tasks") / "lop.py"
    path.write_text(TASK)
    return path


@pytest.fixture(scope="module")
def run(file: pathlib.Path) -> pathlib.Path:
    """A run of `Lop`, whose costs no policy changes."""
    from pmt_jax.cli import main

    out = file.parent / "run"
    how = (*TINY, "--steps", 600, "--log-interval", 1, "--eval-interval", 1, "--eval-episodes", 2, "--out", out)
    assert main([str(x) for x in ("train", f"{file}:Lop", *how)]) == 0
    return out


@pytest.mark.full
def test_a_row_names_each_agent(run: pathlib.Path):
    """Agent 0 costs 18 of an allowed 10 (8 with the margin), agent 1 nothing; their mean is within the limit."""
    for found in rows(run):
        for name in ("episode_cost", "true_episode_cost", "eval/episode_cost"):
            assert (found[name], found[f"{name}/agent_0"], found[f"{name}/agent_1"]) == (9, 18, 0)
            assert found[f"{name}_worst"] == 18
        assert found["within_limit"] == found["eval/within_limit"] == 0
        assert found["episode_cost_beyond"] == 8
        assert found["cost_excess"] == found["cost_excess/agent_0"] == pytest.approx(1.25)
        assert found["cost_excess/agent_1"] == pytest.approx(-1)
    first, last = rows(run)[0], rows(run)[-1]
    assert last["lambda/agent_0"] > first["lambda/agent_0"] > 2 > first["lambda/agent_1"] > last["lambda/agent_1"]
    assert last["lambda"] == pytest.approx((last["lambda/agent_0"] + last["lambda/agent_1"]) / 2)


@pytest.mark.full
def test_a_shared_actor_is_held_to_the_limit_of_the_worst_agent(file: pathlib.Path, monkeypatch):
    """On average the agents of `Lop` are within their limit."""
    row = dataclasses.replace(METHODS["p3o"], order="simultaneous", share_actor=True)
    monkeypatch.setitem(METHODS, "p3o_shared", row)
    sizes = {"num_envs": 8, "rollout_length": 25, "hidden": (16,), "epochs": 1, "minibatches": 1, "log_interval": 1}
    monkeypatch.chdir(file.parent)
    with trusting():
        config = load_config(f"{file}:Lop", method="p3o_shared", steps=600, cost_limit=10.0, **sizes)
        _, metrics = jax.jit(learner.make_train(config))(jax.random.key(0))
    assert (metrics["cost_excess/agent_0"][1:] > 0).all() and (metrics["cost_excess/agent_1"] < 0).all()
    assert (metrics["actor/penalty"][1:] > 0).all()


@pytest.mark.full
def test_tables_and_the_console_say_that_the_limit_is_violated(run: pathlib.Path, cli):
    (data,) = json.loads(cli("table", run, "--format", "json")[1])["rows"]
    assert (data["within"], data["worst"], data["cost_limit"]) == (0, 18, 10)
    assert (data["cost"]["mean"], data["worst agent"]["mean"]) == (9, 18)
    assert (data["cost beyond"]["mean"], data["episodes within"]["mean"]) == (8, 0)
    assert " 10     0/1           18" in cli("table", run)[1]
    text = cli("eval", run, "--episodes", 2, "--trust")[1]
    for name, mean in (
        ("episode_cost", 9),
        ("episode_cost/agent_0", 18),
        ("episode_cost_worst", 18),
        ("within_limit", 0),
    ):
        assert re.search(rf"^  {name} +{mean}\.0000 ", text, re.MULTILINE)


@pytest.mark.full
def test_a_run_is_compared_by_its_worst_agent(run: pathlib.Path, tmp_path: pathlib.Path, cli):
    other = tmp_path / "other"
    other.mkdir()
    (other / "config.toml").write_text((run / "config.toml").read_text().replace("seed = 0", "seed = 1"))
    (other / "metrics.jsonl").write_text("".join(json.dumps(x | {"seed": 1}) + "\n" for x in rows(run)))
    text = cli("compare", run, other)[1]
    assert "worst agent (limit 10)  18 [-]" in text and "seeds within the limit  0 of 1" in text


@pytest.mark.full
def test_the_state_that_is_kept_as_best_was_judged_by_the_worst_agent(run: pathlib.Path):
    """None is within, so that its excess is kept, by which later states are judged."""
    saved = run_folder.load_saved(run)[2]
    assert saved["best"].cost == pytest.approx([8.0])


@pytest.mark.full
def test_a_picture_sums_the_cost_of_the_agent_who_has_most(run: pathlib.Path):
    with trusting():
        shown = episode.record_run(run)
    assert shown.cost_sum[-1] == 18 and str(shown.limits) == "10" and shown.cost.max() == 0.5


@pytest.mark.full
def test_the_policy_that_is_published_keeps_every_agent_within(file: pathlib.Path, tmp_path: pathlib.Path):
    """Of one that pushes with agent 0 alone (25 of an allowed 15, mean 12.5) and one that does not push, the second."""
    config = load_config(f"{file}:Pushes", method="mappo_l", num_envs=4, hidden=[8], cost_limit=15)
    setup = make_setup(config)
    hyper, keys, axes = setup.vmap_arguments
    state = jax.jit(jax.vmap(functools.partial(learner.init, setup), axes))(hyper, keys)

    def pushing(*pushes: float) -> LearnerState:
        params = jax.tree.map(jnp.zeros_like, state.actor.params)
        head = params["params"]["trunk"]["Dense_1"]
        head["bias"] = head["bias"] + jnp.array([[x, 0.0] for x in pushes])
        return dataclasses.replace(state, actor=dataclasses.replace(state.actor, params=params))

    tmp_path.joinpath("run").mkdir()
    out = tmp_path / "run"
    run_folder.write_settings(out, setup)
    known = dataclasses.replace(Best.initial(state), state=pushing(0.0, 0.0))
    checkpoints = Checkpoints(out)
    checkpoints.save(100, {"last": pushing(1.0, 0.0), "best": known}, Provenance(setup.config))
    checkpoints.close()
    _, which, found, _ = publish.choose(out, 2)
    assert which == "best" and found["episode_cost_worst"][0] == 0


@pytest.mark.full
def test_episodes_of_an_evaluation_are_within_if_every_agent_and_cost_is(file: pathlib.Path):
    """Of 64 episodes with random costs of three agents and two costs, as a plain loop over every step says."""
    config = load_config(f"{file}:Drawn", method="macpo", num_envs=4, hidden=[8])
    setup = make_setup(config)
    state = learner.init(setup, setup.hyper, jax.random.key(0))
    found = jax.jit(lambda: evaluate(setup, state, 64, deterministic=True, record=True))()
    found = {name: np.asarray(x) for name, x in found.items()}
    for at in range(64):
        sums = [[sum(found["step/cost"][:, at, i, k]) for k in range(2)] for i in range(3)]
        assert found["within_limit"][at] == all(first <= 10 and second <= 0 for first, second in sums)
        for i, (first, second) in enumerate(sums):
            assert found[f"episode_cost/agent_{i}/cost_0"][at] == first
            assert found[f"true_episode_cost/agent_{i}/cost_1"][at] == second
        np.testing.assert_allclose(found["episode_cost/0"][at], np.mean(sums, axis=0)[0], rtol=1e-6)
        np.testing.assert_allclose(found["episode_cost"][at], np.sum(sums) / 3, rtol=1e-6)
    assert 0.05 < found["within_limit"].mean() < 0.95  # the loop saw both
    totals = [sum(found[f"episode_cost/agent_{i}/cost_{k}"].mean() for k in range(2)) for i in range(3)]
    assert found["episode_cost_worst"].mean() == pytest.approx(max(totals))


@pytest.mark.full
def test_a_task_that_only_says_that_its_agents_share_costs_is_refused_or_stops(file: pathlib.Path, cli, tmp_path):
    """At once where the first steps show it, else with the first row in which it is so."""
    early = file.with_name("early.py")
    early.write_text(TASK + "\nLop.shares_cost = True\n")
    code, _, err = cli("envs", f"{early}:Lop")
    assert code == 2 and "it has shares_cost = True, but its agents' costs differ; leave shares_cost out" in err
    assert cli("envs", f"{early}:Pushes")[0] == 0  # a subclass does not inherit it
    late = file.with_name("late.py")
    late.write_text(TASK.replace("carry.time >= 1", "carry.time >= 10") + "\nLop.shares_cost = True\n")
    code, text, _ = cli("train", f"{late}:Lop", *TINY, "--steps", 400, "--log-interval", 1, "--out", tmp_path / "run")
    assert (
        code == 1 and "has shares_cost = True, but its agents' costs differ by up to 1 in a step up to step 200" in text
    )
    assert not [name for name in rows(tmp_path / "run")[0] if "spread" in name or "agent_0" in name]


@pytest.mark.parametrize("task", ["lane", *(pytest.param(x, marks=pytest.mark.full) for x in ("switch", "noisy"))])
def test_agents_that_share_costs_have_one_column(task: str):
    setup = make_setup(load_config(task, method="f4sg", num_envs=2, hidden=[8]))
    state = jax.eval_shape(lambda: learner.init(setup, setup.hyper, jax.random.key(0)))
    metrics = jax.eval_shape(functools.partial(learner.train_step, setup, setup.hyper), state)[1]
    assert not [name for name in metrics if "agent_" in name or name.endswith("_worst")]
    evaluated = jax.eval_shape(lambda s: evaluate(setup, s, 2, deterministic=True), state)
    assert not [name for name in evaluated if "agent_" in name or name.endswith("_worst")]


SCOPES = [("zone", 6, 1), *(pytest.param(*x, marks=pytest.mark.full) for x in (("network", 1, 1), ("regions", 1, 4)))]


@pytest.mark.full
@pytest.mark.parametrize(("scope", "agents", "costs"), SCOPES)
def test_zones_of_a_grid_have_a_column_each(scope: str, agents: int, costs: int):
    config = load_config("voltage_33", method="mappo_l", env=[f"cost_scope={scope}"], num_envs=2, hidden=[8])
    setup = make_setup(config)
    state = jax.eval_shape(lambda: learner.init(setup, setup.hyper, jax.random.key(0)))
    metrics = jax.eval_shape(functools.partial(learner.train_step, setup, setup.hyper), state)[1]
    for name in ("episode_cost", "lambda", "cost_excess"):
        assert f"{name}/agent_0" in metrics if agents > 1 else f"{name}/agent_0" not in metrics
        found = [x for x in metrics if x.startswith(f"{name}/")]
        assert len(found) == (agents if agents > 1 else costs if costs > 1 else 0)


@pytest.mark.slow
def test_zones_of_a_grid_are_judged_one_by_one(tmp_path: pathlib.Path, cli):
    """Two of six zones have costs; their mean over agents is a third of these."""
    out, file, limit = tmp_path / "run", tmp_path / "steps.npz", 12
    how = (*TINY[:2], "--rollout-length", 60, *TINY[4:], "--log-interval", 4, "--steps", 1920, "--out", out)
    how += ("--cost-limit", limit)
    assert cli("train", "voltage_33", "--env", "cost_scope=zone", *how)[0] == 0
    text = cli("eval", out, "--episodes", 8, "--deterministic", "--save", file)[1]
    steps = np.load(file)["cost"][0].sum(1)[..., 0]  # [episodes, agents]
    agents = steps.mean(0)
    assert agents.mean() < agents.max() / 2  # or the test shows nothing
    for i, cost in enumerate(agents):
        assert re.search(rf"^  episode_cost/agent_{i} +{cost:.4f} ", text, re.MULTILINE)
    assert re.search(rf"^  episode_cost_worst +{agents.max():.4f} ", text, re.MULTILINE)
    assert re.search(rf"^  within_limit +{(steps <= limit).all(1).mean():.4f} ", text, re.MULTILINE)
    last = [rows(out)[-1][f"episode_cost/agent_{i}"] for i in range(6)]
    (data,) = json.loads(cli("table", out, "--format", "json")[1])["rows"]
    assert data["within"] == all(cost <= limit for cost in last)
    assert data["worst"] == pytest.approx(max(last)) and data["cost"]["mean"] == pytest.approx(np.mean(last))
