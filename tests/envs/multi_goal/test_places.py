"""Layouts and new goals: laws of each, and statistics against 400 recorded resets of the reference."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from envs.multi_goal import LEVELS
from envs.multi_goal.places import AGENT, GOAL, HAZARD, VASE, layout, place_one, plan
from paths import DATA


def keepouts(robots: int, hazards: int, vases: int) -> np.ndarray:
    return np.array([AGENT] * robots + [GOAL] * robots + [HAZARD] * hazards + [VASE] * vases)


@functools.cache
def drawn(number: int, reference: bool = True, count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Layouts [count, M, 2] of a level, and how many things of each found no room."""
    level = LEVELS[number]
    order = plan(2, level.hazards, level.vases, reference)
    draw = jax.jit(jax.vmap(lambda key: layout(key, order, level.size, jnp.dtype("float32"))))
    return tuple(np.asarray(x) for x in draw(jax.random.split(jax.random.key(3), count)))  # type: ignore[return-value]


def recorded(number: int) -> np.ndarray:
    with np.load(DATA / "multi_goal_reference.npz") as data:
        return data[f"layout_{number}"]


def least_slack(places: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """[B] m by which the closest pair keeps its distance: of all things but robot 1, and of robot 1 by its own rule."""
    level = LEVELS[number]
    radius = keepouts(2, level.hazards, level.vases)
    apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1) + 9 * np.eye(len(radius))
    slack = apart - radius[:, None] - radius
    others = np.delete(np.arange(len(radius)), 1)
    last = GOAL if number == 0 else VASE
    return slack[:, others][:, :, others].min((1, 2)), (apart[:, 1, others] - radius[others] - last).min(1)


@pytest.mark.parametrize(
    "number", [pytest.param(0, marks=pytest.mark.full), pytest.param(1, marks=pytest.mark.full), 2]
)
def test_layouts_keep_the_rules_and_look_like_the_recorded_ones(number):
    (ours, crowded), theirs = drawn(number), recorded(number)
    level = LEVELS[number]
    room = level.size - keepouts(2, level.hazards, level.vases)
    assert (np.abs(ours) <= room[:, None] + 1e-6).all() and (np.abs(theirs) <= room[:, None] + 1e-5).all()
    slack, slack_of_last = least_slack(ours, number)
    assert (slack >= -1e-5).all() and not crowded.any()
    # In 6 of 400 recorded layouts of level 0 the blue goal is too near to robot 0 or to red, which no rule explains.
    assert (least_slack(theirs, number)[0] < -1e-5).mean() == (0.015 if number == 0 else 0)
    broken = [(least_slack(x, number)[1] < -1e-5).mean() for x in (ours, theirs)]
    assert abs(broken[0] - broken[1]) < 0.08, broken  # 13 % at level 0, hardly any at 1 and 2
    assert (slack_of_last < -1e-5).any() == (number == 0)
    # Distances of robots to each other and to their goals, of a goal to the first hazard, and places: p > .1 % each.
    pairs = [(0, 1), (0, 2), (1, 3), (2, 3)] + ([(2, 4), (1, 4)] if level.hazards else [])
    for a, b in pairs:
        distances = [np.linalg.norm(x[:, a] - x[:, b], axis=1) for x in (ours, theirs)]
        assert stats.ks_2samp(*distances).pvalue > 1e-3, (a, b)
    for thing in range(4):
        assert stats.ks_2samp(ours[:, thing].ravel(), theirs[:, thing].ravel()).pvalue > 1e-3


@pytest.mark.parametrize(("number", "most"), [(0, 0.1), (1, 0.0), (2, 0.0)])
def test_the_own_layouts_nearly_always_find_room(number, most):
    """Robots need most room. If the second one comes last, as in the reference, it finds none in half of level 0."""
    _, crowded = drawn(number, reference=False)
    assert (crowded > 0).mean() <= most


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**31 - 1), st.floats(0.0, 0.5), st.lists(st.tuples(*[st.floats(-1, 1)] * 2), min_size=4, max_size=4)
)
def test_a_place_keeps_its_distances_or_lacks_the_least(seed, gap, others):
    others, gaps = np.array(others, np.float32), np.full(4, gap, np.float32)
    place, kept = _place(jax.random.key(seed), others, gaps)
    slack = np.linalg.norm(np.asarray(place) - others, axis=1).min() - gap
    assert bool(kept) == (slack >= -1e-6) or abs(slack) < 1e-5
    assert np.abs(place).max() <= 1


_place = jax.jit(lambda key, others, gaps: place_one(key, jnp.float32(1.0), others, gaps, 100))


def test_what_finds_no_room_takes_the_best_draw_and_says_so():
    others, gaps = np.zeros((1, 2), np.float32), np.full(1, 3.0, np.float32)  # further than any corner
    place, kept = _place(jax.random.key(0), jnp.tile(others, (4, 1)), jnp.tile(gaps, 4))
    keys = [jax.random.fold_in(jax.random.key(0), i) for i in range(5)]
    draws = np.concatenate([jax.random.uniform(key, (20, 2), minval=-1.0, maxval=1.0) for key in keys])
    assert not kept
    np.testing.assert_allclose(place, draws[np.linalg.norm(draws, axis=1).argmax()], atol=1e-6)


def test_a_thing_that_stays_draws_nothing():
    start = (jnp.array([0.25, 0.5]), jnp.asarray(True))
    gaps = jnp.full(1, 9.0)
    place, kept = place_one(jax.random.key(0), jnp.float32(1.0), jnp.zeros((1, 2)), gaps, 100, start=start)
    assert place.tolist() == [0.25, 0.5] and bool(kept)


@pytest.mark.parametrize("robots", [2, 3, 8])
def test_the_own_plan_keeps_every_pair_apart_by_both_keepouts(robots):
    order = plan(robots, 2, 1, reference=False)
    radius = keepouts(robots, 2, 1)
    np.testing.assert_array_equal(order.keepout, radius[order.order])
    below = np.tri(len(radius), k=-1, dtype=bool)
    expected = (order.keepout[:, None] + order.keepout)[below]
    np.testing.assert_allclose(order.gap[below], expected)
    assert np.isneginf(order.gap[~below]).all() and sorted(order.order) == list(range(len(radius)))
    assert not order.keep_last.any()
