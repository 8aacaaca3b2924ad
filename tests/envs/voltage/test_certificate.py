"""The certificate of what any reactive power can do, against brute force on small feeders and on the packaged data."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.errors import TaskError
from envs.voltage import certificate, power_flow
from envs.voltage.control import Scenario, VoltageControl
from envs.voltage.profiles import Profiles

PLANTS = (3, 4)


def forked_feeder(rng: np.random.Generator, rows: int) -> VoltageControl:
    """Five buses, two plants, loads at all buses, long lines: voltages leave the band on either side."""
    parent = [-1, 0, 1, 1, 2]
    network = power_flow.radial_network(parent, rng.uniform(0.04, 0.08, 5), rng.uniform(0.04, 0.08, 5), 10.0)
    loads = np.arange(1, 5)
    table = {
        "load_bus": loads,
        "pv_bus": np.array(PLANTS),
        "zone": np.array([0, 1, 1, 1, 1]),
        "p0": np.ones(4),
        "q0": np.ones(4) / 3,
        "s_max": np.full(2, 5.0),
    }
    day = rng.uniform(size=(rows, 1)) < 0.5
    pv, load = rng.uniform(0, 8, (rows, 2)) * day, rng.uniform(0, 4, (rows, 4)) * ~day
    data = Profiles(pv, load, load / 3, rows_per_knot=480)  # knots are days: as many as there must be
    return VoltageControl(Scenario("fork", network, table, action_scale=0.15), data=data, noise=False)


@pytest.mark.full
def test_verdicts_agree_with_brute_force():
    """What is proven impossible is, what brute force can do the dispatch does, and what misses by far is proven."""
    with jax.enable_x64(True):
        env = forked_feeder(np.random.default_rng(0), rows=60)
        rows = np.concatenate([env.profiles.pv, env.profiles.p_load, env.profiles.q_load], axis=1)
        grid = jnp.asarray(list(itertools.product(np.linspace(-1, 1, 21), repeat=2)))[..., None]
        flows = jax.jit(jax.vmap(jax.vmap(env.flow_of, (None, 0)), (0, None)))(jnp.asarray(rows), grid)
        vm = np.asarray(flows.vm_pu)
        worst = np.maximum(vm - env.v_upper, env.v_lower - vm).max(axis=-1)
        least = np.where(np.isfinite(worst), worst, np.inf).min(axis=1)
        found = certificate.certify(env, rows[:, None])
    excess, proven = found.excess[:, 0], found.impossible[:, 0]
    possible = least <= 0
    low = np.nanmin(vm, axis=(1, 2)) < env.v_lower
    assert 15 < possible.sum() < 45
    assert not (proven & possible).any() and not (proven & (excess <= 0)).any()
    assert (excess[possible] <= 0).all()
    assert (excess[~possible] < least[~possible] + 1e-6).all()  # never worse than the grid's best
    assert proven[least > 0.01].all() and (proven & low).sum() > 5 and (proven & ~low).sum() > 5


@pytest.mark.full
def test_the_packaged_data_have_states_of_both_kinds():
    """Sunny noons of 141 buses: with every inverter absorbing all it can, some states are still out of the band."""
    with jax.enable_x64(True):
        env = envs.make("voltage_141", noise=False)
        knots = np.concatenate([env.profiles.pv, env.profiles.p_load, env.profiles.q_load], axis=1)
        knots = knots[np.argsort(env.profiles.pv.sum(axis=1))[::-500]]
        proven = certificate.impossible(env, knots)
        assert 0 < proven.sum() < len(knots) / 10
        dispatch = certificate.Dispatch(env)
        for row in knots[proven][:2]:
            action, excess = dispatch.from_several(row, np.zeros(env.num_agents))
            assert excess > 0
            np.testing.assert_allclose(action, -1, atol=1e-6)
        possible = np.flatnonzero(~proven)[[0, -1]]
        assert all(dispatch.from_several(knots[i], np.zeros(env.num_agents))[1] <= 0 for i in possible[1:])


def test_bounds_need_a_radial_network():
    branches = [power_flow.Branch(a, b, 0.01, 0.01) for a, b in ((0, 1), (1, 2), (2, 0))]
    scenario = Scenario("ring", power_flow.branch_network(3, branches, 10.0, name="ring"), {
        "load_bus": np.array([1]), "pv_bus": np.array([2]), "zone": np.array([0, 1, 1]),
        "p0": np.ones(1), "q0": np.ones(1), "s_max": np.ones(1),
    })  # fmt: skip
    data = Profiles(np.ones((4, 1)), np.ones((4, 1)), np.ones((4, 1)), rows_per_knot=480)
    with pytest.raises(TaskError, match="'ring' is not radial"):
        certificate.impossible(VoltageControl(scenario, data=data), np.ones((1, 3)))
