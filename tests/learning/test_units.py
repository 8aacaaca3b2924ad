"""What the learner computes depends on neither the unit of costs nor how often they are noticed."""

from __future__ import annotations

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.toys import Switch
from pmt_jax import METHODS, load_config, make_setup
from pmt_jax.learning import constraint, learner
from pmt_jax.learning.types import LearnerState
from small import SMALL, program


class Cheap(Switch):
    """`switch` whose costs and limit are both an eighth, so that 32 bits hold the same digits."""

    def __init__(self):
        super().__init__()
        self.spec = dataclasses.replace(self.spec, cost_limit=self.spec.cost_limit / 8)

    def _state(self, *seen, **signals):
        state = super()._state(*seen, **signals)
        return dataclasses.replace(state, cost=state.cost / 8)


def _trained(method: str, env: Switch) -> tuple[LearnerState, dict[str, jax.Array]]:
    setup = make_setup(load_config("switch", method=method, **SMALL), env)
    start = learner.init(setup, setup.hyper, jax.random.key(0))
    return jax.jit(lambda state: learner.train_chunk(setup, setup.hyper, state, 3))(start)


FULL = (
    "mappo_l",
    "mixed",
    "macpo",
    "crpo",
    "ippo_l",
)  # every way to hold a limit, fear, regret, critics of observations


@pytest.mark.parametrize(
    "method",
    [  # but by the letter, whose equations have the unit of costs
        pytest.param(name, marks=pytest.mark.full if name in FULL else pytest.mark.slow)
        for name, row in METHODS.items()
        if not row.letter
    ],
)
def test_costs_and_a_limit_of_an_eighth_change_nothing(method: str):
    """Every method learns the same weights, and moves the same multipliers, bit for bit."""
    (state, metrics), (cheap, others) = (_trained(method, env) for env in (Switch(), Cheap()))
    assert metrics["step_cost"][0] > 0
    np.testing.assert_array_equal(others["step_cost"], metrics["step_cost"] / 8)
    for name in ("actor", "critic", "cost_critic", "fear", "regret", "constraint"):
        chex.assert_trees_all_equal(getattr(cheap, name), getattr(state, name))
    np.testing.assert_array_equal(others["lambda"], metrics["lambda"])
    np.testing.assert_array_equal(others["cost_excess"], metrics["cost_excess"])


def test_units_of_a_limit():
    """A cost in every step is as many limits as the limit is steps; a margin makes the limit smaller."""
    made = program("mappo_l")
    cost = jnp.asarray([0.0, 0.5, 1.0])
    for limit, margin, scale in (5.0, 0.0, 5.0), (5.0, 0.5, 10.0), (0.5, 0.0, 50.0), (0.0, 0.0, 25.0):
        hyper = made.hyper(cost_limit=limit, cost_margin=margin)
        np.testing.assert_allclose(constraint.in_unit(made.setup, hyper, cost), scale * cost, rtol=1e-6)


@pytest.mark.parametrize(("cost", "share"), [(0, -1), (1.5, -0.25), (2, 0), (3, 0.5), (4, 1), (90, 44)])
def test_an_excess_is_a_share_of_the_limit(cost: float, share: float):
    made = program("mappo_l")
    for scale in 1.0, 0.125:
        hyper = made.hyper(cost_limit=2 * scale)
        estimate = constraint.in_unit(made.setup, hyper, jnp.asarray(cost * scale / 25))
        np.testing.assert_allclose(constraint.cost_excess(made.setup, hyper, estimate), share, rtol=1e-5, atol=1e-6)
    assert constraint.cut(jnp.asarray([-3.0, -0.25, 0.5, 44.0])).tolist() == [-1, -0.25, 0.5, 1]


def test_nothing_is_below_a_limit_of_0():
    made = program("mappo_l")
    hyper = made.hyper(cost_limit=0.0)
    assert constraint.cost_excess(made.setup, hyper, jnp.asarray([0.0, 0.5])).tolist() == [0, 0.5]
    assert constraint.init(made.setup, hyper).estimate.tolist() == [[0], [0]]
