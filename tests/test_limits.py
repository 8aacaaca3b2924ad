"""Costs are judged one by one, of every agent, and then all of them; each place that judges does it so."""

from __future__ import annotations

import itertools
import json
import pathlib
import tempfile
import types
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from by_hand import row, written
from pmt_jax import limits as judging
from pmt_jax.learning import rollout
from pmt_jax.limits import Limits
from pmt_jax.studies.rows import rows
from pmt_jax.studies.run_log import read
from pmt_jax.studies.table import summarise
from pmt_jax.training.loop import Trainer
from pmt_jax.training.metrics import METRICS, describe, judged_cost, make_rows

LIMITS = st.lists(st.sampled_from([0.0, 0.1, 1.0, 4.8, 25.0]), min_size=1, max_size=3).map(tuple)
AGENTS = st.integers(1, 4)


def costs(*shape: int) -> st.SearchStrategy[np.ndarray]:
    """Costs whose parts are often a limit, and as often a little more or less."""
    near = [0.0, 0.05, 0.1, 0.15, 0.9, 1.0, 1.1, 4.7, 4.8, 4.9, 24.0, 25.0, 26.0, 500.0]
    return hnp.arrays(np.float32, shape, elements=st.sampled_from([float(np.float32(x)) for x in near]))


def beyond(cost: np.ndarray, limits: Limits) -> list[list[float]]:
    """[N][K] by a plain loop; costs and limits are compared as 32 bits hold them."""
    return [
        [float(x) - d if np.float32(x) > np.float32(d) else 0.0 for x, d in zip(agent, limits.each, strict=True)]
        for agent in cost
    ]


def written_row(cost: np.ndarray, limits: Limits, prefix: str = "", **more: Any) -> dict[str, Any]:
    """A row of costs [N, K], as training or an evaluation writes it."""
    parts = judging.columns("episode_cost", cost, False) | judging.worst("episode_cost", cost, False)
    parts["episode_cost"] = cost.sum(-1).mean(-1)
    return limits.columns | {f"{prefix}{name}": float(x) for name, x in parts.items()} | more


@given(st.data(), LIMITS.map(Limits), AGENTS)
def test_an_excess_is_that_of_the_agent_and_cost_furthest_beyond(data: st.DataObject, limits: Limits, agents: int):
    cost = data.draw(costs(3, agents, len(limits.each)))
    for found, one in zip(limits.excess(cost), cost, strict=True):
        each = list(itertools.chain(*beyond(one, limits)))
        assert (found <= 0) == (max(each) == 0)
        assert max(found, 0) == pytest.approx(max(each))


@given(st.data(), LIMITS.map(Limits), AGENTS)
@settings(deadline=None)
def test_episodes_of_training_are_within_if_every_agent_and_cost_is(data: st.DataObject, limits: Limits, agents: int):
    """Also where a whole episode did not end, which does not count."""
    cost = data.draw(costs(2, 3, agents, len(limits.each)))
    finished = data.draw(hnp.arrays(bool, (2, 3)))
    batch: Any = types.SimpleNamespace(
        episode_cost=jnp.asarray(cost), true_episode_cost=jnp.asarray(cost), finished=jnp.asarray(finished)
    )
    batch.done = batch.finished
    limit = jnp.asarray(limits.each, jnp.float32) if len(limits.each) > 1 else jnp.float32(limits.total)
    hyper: Any = types.SimpleNamespace(cost_limit=limit, cost_seen=1.0)
    kept = rollout.limit_metrics(batch, hyper)
    each = [beyond(one, limits) for one in cost[finished]]
    within = [all(x == 0 for agent in one for x in agent) for one in each]
    furthest = [sum(max(agent[k] for agent in one) for k in range(len(limits.each))) for one in each]
    if each:
        assert kept["within_limit"] == pytest.approx(np.mean(within))
        assert kept["episode_cost_beyond"] == pytest.approx(np.mean(furthest), rel=1e-4, abs=1e-5)
    else:
        assert np.isnan(kept["within_limit"]) and np.isnan(kept["episode_cost_beyond"])


@given(st.data(), LIMITS.map(Limits), AGENTS, st.sampled_from(["", "eval/"]))
@settings(deadline=None, max_examples=50)
def test_seeds_of_a_run_are_within_if_every_agent_and_cost_is(
    data: st.DataObject, limits: Limits, agents: int, prefix: str
):
    """In the run as read, in the table, and by the rule that keeps the best state."""
    cost = data.draw(costs(3, agents, len(limits.each)))
    lines = [written_row(one, limits, prefix, **{f"{prefix}episode_reward": 1.0}) for one in cost]
    within = [all(x == 0 for agent in beyond(one, limits) for x in agent) for one in cost]
    with tempfile.TemporaryDirectory() as folder:
        text = [row(100, seed, 1.0, **line) for seed, line in enumerate(lines)]
        log = read(written(pathlib.Path(folder) / "run", text))
        assert log is not None and (log.excess <= 0).tolist() == within
        (data_of_row,) = summarise(rows([log]))
    assert data_of_row["within"] == pytest.approx(np.mean(within))
    highest = [one.sum(-1).max() for one in cost.astype(float)]
    assert data_of_row["worst"] == pytest.approx(max(highest))
    assert ("worst agent" in data_of_row) == (agents > 1)
    for line, expected in zip(lines, within, strict=True):
        judged, limit = judged_cost(line, prefix)
        assert (np.float32(judged) <= np.float32(limit)) == expected


@given(st.data(), LIMITS.map(Limits), AGENTS)
@settings(deadline=None, max_examples=50)
def test_the_best_state_is_chosen_by_every_agent_and_cost(data: st.DataObject, limits: Limits, agents: int):
    """The highest reward of the rows that are within; the least excess while none is."""
    cost = data.draw(costs(6, agents, len(limits.each)))
    reward = data.draw(st.permutations(range(6)))
    best = types.SimpleNamespace(state=np.array([-1]), reward=np.array([-np.inf]), cost=np.array([np.inf]))
    where_seed = lambda improved, old, new: np.where(improved, new, old)  # noqa: E731
    trainer: Any = types.SimpleNamespace(
        best=best, config=types.SimpleNamespace(eval_interval=0), programs=types.SimpleNamespace(where_seed=where_seed)
    )
    for at in range(6):
        trainer.state = np.array([at])
        line = written_row(cost[at], limits, broken=None, episode_reward=float(reward[at]))
        Trainer.keep_best(trainer, [line])
    chosen = int(trainer.best.state[0])
    worst = [max(itertools.chain(*beyond(one, limits))) for one in cost]
    if 0 in worst:
        within = [at for at in range(6) if worst[at] == 0]
        assert chosen == max(within, key=lambda at: reward[at])
    else:
        assert worst[chosen] == pytest.approx(min(worst), abs=1e-5)


@given(st.lists(st.lists(st.floats(-10, 10, width=32), max_size=5), min_size=1, max_size=6))
@settings(deadline=None)
def test_a_row_weighs_episodes_and_not_updates(updates: list[list[float]]):
    """The mean over the row's episodes, of which each update has another number; nan if none ended."""
    means = np.array([[np.mean(x) if x else np.nan for x in updates]])
    metrics = {"episodes": np.array([[len(x) for x in updates]]), "violation_rate": means}
    metrics |= {name: means for name, metric in METRICS.items() if metric.reduction == "episodes"}
    metrics |= {"episode_cost/agent_1": means, "true_episode_cost/0": means}
    config = types.SimpleNamespace(seed=0)
    setup: Any = types.SimpleNamespace(config=config, label="happo", limits_of_seeds=[Limits((1.0,))])
    setup.vector = types.SimpleNamespace(spec=types.SimpleNamespace(name="lane"))
    (found,) = make_rows(setup, 100, metrics)
    every = list(itertools.chain(*updates))
    expected = np.mean(every) if every else np.nan
    for name in metrics.keys() - {"episodes", "violation_rate"}:
        np.testing.assert_allclose(found[name], expected, rtol=1e-9, atol=1e-9, err_msg=name)
    assert found["episodes"] == len(every)
    known = means[np.isfinite(means)]
    np.testing.assert_allclose(found["violation_rate"], known.mean() if known.size else np.nan)


def test_the_worst_agent_of_a_row_is_one_agent():
    """Each update may have another; the mean of their costs is higher than that of any agent."""
    each = np.array([[[4.0, 0.0], [0.0, 2.0]]])  # [seeds, updates, agents]
    metrics = {"episodes": np.ones((1, 2)), "episode_cost": each.mean(-1), "episode_cost_worst": each.max(-1)}
    metrics |= {f"episode_cost/agent_{i}": each[..., i] for i in range(2)}
    setup: Any = types.SimpleNamespace(
        config=types.SimpleNamespace(seed=0),
        label="happo",
        limits_of_seeds=[Limits((1.0,))],
        vector=types.SimpleNamespace(spec=types.SimpleNamespace(name="lane")),
    )
    (found,) = make_rows(setup, 100, metrics)
    assert (found["episode_cost"], found["episode_cost_worst"]) == (1.5, 2.0)


@pytest.mark.parametrize("name", ["episode_cost", "true_episode_cost", "lambda", "cost_excess"])
@pytest.mark.parametrize(("agents", "count", "shared"), list(itertools.product((1, 3), (1, 2), (False, True))))
def test_columns_have_names_that_are_found_again(name: str, agents: int, count: int, shared: bool):
    x = np.arange(agents * count, dtype=float).reshape(agents, count)
    found = judging.columns(name, x, shared) | {name: x.mean()}
    apart = agents > 1 and not shared
    expected = {name, *(f"{name}/{k}" for k in range(count) if count > 1)}
    for i, k in itertools.product(range(agents if apart else 0), range(count)):
        expected.add(f"{name}/agent_{i}" + (f"/cost_{k}" if count > 1 else ""))
    assert found.keys() == expected
    places = judging.judged(found, name, count)
    values = [[found[column] for column in each] for each in places]
    np.testing.assert_array_equal(values, x if apart else x.mean(0, keepdims=True))
    assert {judging.base(column) for column in found} == {name}
    assert all(describe(column).unit == METRICS[name].unit for column in found)


def test_a_run_of_before_there_were_columns_of_agents_is_judged_by_what_it_has(tmp_path: pathlib.Path, cli):
    line = {"episode_cost": 3.0, "episode_cost/0": 2.0, "episode_cost/1": 1.0}
    limits = Limits((2.0, 0.5)).columns
    written(tmp_path / "old", [row(100, 0, 1.0, **limits, **line)])
    (found,) = json.loads(cli("table", tmp_path, "--format", "json")[1])["rows"]
    assert found["within"] == 0 and "worst agent" not in found


def test_true_costs_of_agents_are_held_against_the_limit_on_true_costs(tmp_path: pathlib.Path, cli):
    """Half of the costs are seen, so a limit of 1 on these is one of 2: agent 0 is within it, agent 1 is not."""
    seen = written_row(np.array([[0.9], [1.1]]), Limits((1.0,)))
    true = {
        name.replace("episode_cost", "true_episode_cost"): 2 * x for name, x in seen.items() if name != "cost_limit"
    }
    file = written(tmp_path / "run", [row(100, 0, 1.0, **seen, **true)], 'task = "lane"\ncost_seen = 0.5\n')
    log = read(file)
    assert log is not None and log.excess == pytest.approx([0.2])
    text = cli("table", tmp_path)[1]
    assert text.splitlines()[2].split()[-3:] == ["2", "0/1", "2.2"]
