"""Power flow against pandapower's recorded answers, physics, finite differences and hand-made networks."""

from __future__ import annotations

import functools
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
from paths import DATA

RECORDED = DATA / "grid_powerflow_reference.npz"
CASES = ("case33", pytest.param("case141", marks=pytest.mark.full))


@functools.cache
def recorded(case: str) -> dict[str, np.ndarray]:
    with np.load(RECORDED) as file:
        return {key.split("/", 1)[1]: file[key] for key in file.files if key.startswith(case)}


def injections(case: str) -> tuple[np.ndarray, np.ndarray]:
    """[272, n] MW and MVAr of the recorded states, generation positive."""
    data = recorded(case)
    p = np.zeros((len(data["lam"]), int(data["net/n"])))
    q = np.zeros_like(p)
    p[:, data["net/load_bus"]] -= data["p_load"]
    q[:, data["net/load_bus"]] -= data["q_load"]
    p[:, data["net/pv_bus"]] += data["p_pv"]
    q[:, data["net/pv_bus"]] += data["q_pv"]
    return p, q


@functools.cache
def solved(case: str, dtype: str, restricted: bool = False) -> power_flow.PowerFlow:
    with jax.enable_x64(dtype == "float64"):
        p, q = injections(case)
        used = np.flatnonzero(np.any(p != 0, axis=0)) if restricted else None
        network = power_flow.load_network(case, used)
        flow = jax.jit(jax.vmap(lambda p, q: power_flow.solve(network, p, q)))
        return jax.tree.map(np.asarray, flow(jnp.asarray(p, dtype), jnp.asarray(q, dtype)))


def mismatch(case: str, vm: np.ndarray, va: np.ndarray) -> np.ndarray:
    """[state] MVA by which voltages miss the injections they should bring about, in f64 and from the branches alone."""
    data = recorded(case)
    p, q = injections(case)
    v = vm * np.exp(1j * va)
    child = np.flatnonzero(data["net/parent"] >= 0)
    parent = data["net/parent"][child]
    current = (v[:, parent] - v[:, child]) / (data["net/r"] + 1j * data["net/x"])[child]
    injected = np.zeros_like(v)
    for line, (top, bottom) in enumerate(zip(parent, child, strict=True)):
        injected[:, top] += current[:, line]
        injected[:, bottom] -= current[:, line]
    power = v * np.conj(injected) * float(data["net/base_mva"])
    return np.abs(power - (p + 1j * q))[:, child].max(axis=1)


@pytest.mark.parametrize(
    ("dtype", "restricted"),
    [pytest.param("float32", False, marks=pytest.mark.full), ("float32", True), ("float64", False)],
)
@pytest.mark.parametrize("case", CASES)
def test_convergence_is_told_apart_from_collapse(case: str, dtype: str, restricted: bool) -> None:
    flow, data = solved(case, dtype, restricted), recorded(case)
    np.testing.assert_array_equal(flow.converged, data["converged"])
    assert np.isnan(flow.vm_pu[~data["converged"]]).all(), "an unsolved state must not look like a solved one"
    assert flow.vm_pu.dtype == dtype and np.isfinite(flow.vm_pu[data["converged"]]).all()


@pytest.mark.parametrize("restricted", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_f32_voltages_are_within_1e_6_up_to_the_nose(case: str, restricted: bool) -> None:
    flow, data = solved(case, "float32", restricted), recorded(case)
    ok = data["converged"]
    assert np.abs(flow.vm_pu - data["vm_pu"])[ok].max() <= 1e-6
    assert np.abs(np.rad2deg(flow.va_rad) - data["va_deg"])[ok & (data["kind"] == 0)].max() <= 1e-5
    scale = np.maximum(data["loss_mw"][ok], 1)
    assert (np.abs(flow.line_loss_mw - data["loss_mw"])[ok] / scale).max() <= 1e-5


@pytest.mark.parametrize("case", CASES)
def test_f64_voltages_are_within_2e_8_or_closer_to_the_truth_than_the_recording(case: str) -> None:
    """pandapower stops at 1e-8 MVA, which near collapse leaves 2.3e-7 p.u.; ours must then obey physics better."""
    flow, data = solved(case, "float64"), recorded(case)
    ok = data["converged"]
    near = (np.abs(flow.vm_pu - data["vm_pu"]).max(axis=1) <= 2e-8) | ~ok
    assert near[data["kind"] == 0].all()
    assert (~near).sum() <= 3
    ours = mismatch(case, flow.vm_pu, flow.va_rad)
    theirs = mismatch(case, data["vm_pu"], np.deg2rad(data["va_deg"]))
    assert ours[ok].max() <= 2e-8  # f64 voltages over a line of 6e-7 p.u. tell its current no better
    assert (ours < 0.2 * theirs)[~near].all()
    usual = ok & (data["kind"] == 0)
    assert np.abs(flow.line_loss_mw - data["loss_mw"])[usual].max() <= 1e-7
    assert np.abs(flow.line_loss_mvar - data["loss_mvar"])[usual].max() <= 1e-7
    assert np.abs(flow.slack_mw + data["p_bus"][:, 0])[usual].max() <= 1e-7
    assert np.abs(flow.slack_mvar + data["q_bus"][:, 0])[usual].max() <= 1e-7


@pytest.mark.parametrize("case", CASES)
def test_branch_losses_add_up(case: str) -> None:
    flow, ok = solved(case, "float64"), recorded(case)["converged"]
    np.testing.assert_allclose(flow.branch_loss_mw.sum(axis=1)[ok], flow.line_loss_mw[ok], rtol=1e-9)
    np.testing.assert_allclose(flow.branch_loss_mvar.sum(axis=1)[ok], flow.line_loss_mvar[ok], rtol=1e-9)
    p, _ = injections(case)
    np.testing.assert_allclose((flow.slack_mw + p.sum(axis=1))[ok], flow.line_loss_mw[ok], atol=1e-8)


@pytest.mark.full
def test_a_single_solve_equals_its_batch() -> None:
    p, q = (jnp.asarray(x[:3], jnp.float32) for x in injections("case33"))
    network = power_flow.load_network("case33")
    alone = jax.jit(power_flow.solve)(network, p[1], q[1])
    np.testing.assert_allclose(alone.vm_pu, solved("case33", "float32").vm_pu[1], atol=5e-7)
    assert alone.vm_pu.dtype == jnp.float32 and alone.iterations.dtype == jnp.int32


def test_power_where_there_should_be_none_is_not_ignored() -> None:
    network = power_flow.load_network("case33", inject=[5, 6])
    power = np.zeros(33, np.float32)
    power[5] = -0.1
    elsewhere = power.copy()
    elsewhere[9] = 0.01
    converged = jax.jit(jax.vmap(lambda p: power_flow.solve(network, p, power).converged))
    assert converged(np.stack([power, elsewhere])).tolist() == [True, False]


@pytest.mark.full
def test_gradients_agree_with_finite_differences() -> None:
    with jax.enable_x64(True):
        network = power_flow.load_network("case33")
        p, q = (jnp.asarray(x[0]) for x in injections("case33"))

        def outcome(q: jax.Array) -> jax.Array:
            flow = power_flow.solve(network, p, q)
            return flow.line_loss_mw + jnp.sum(flow.vm_pu**3) + jnp.sin(flow.va_rad[20]) + flow.slack_mvar

        gradient = np.asarray(jax.jit(jax.grad(outcome))(q))
        rows = np.eye(33)[[5, 17, 24, 32]] * 1e-4
        value = jax.jit(jax.vmap(outcome))
        difference = (value(q + rows) - value(q - rows)) / 2e-4
        np.testing.assert_allclose(gradient[[5, 17, 24, 32]], difference, rtol=1e-7)
        tangent = jax.jvp(outcome, (q,), (jnp.asarray(rows[1]) * 1e4,))[1]
        np.testing.assert_allclose(tangent, gradient[17], rtol=1e-8)


@pytest.mark.full
def test_batches_of_batches_and_of_gradients() -> None:
    """More states than one group holds, below two vmaps, and gradients below one."""
    network = power_flow.load_network("case33")
    p, q = (jnp.asarray(x[:150], jnp.float32) for x in injections("case33"))
    nested = jax.vmap(jax.vmap(lambda p, q: power_flow.solve(network, p, q).vm_pu))
    voltages = jax.jit(nested)(p.reshape(2, 75, 33), q.reshape(2, 75, 33)).reshape(150, 33)
    np.testing.assert_allclose(voltages, solved("case33", "float32").vm_pu[:150], atol=5e-7)
    gradient = jax.grad(lambda q, p: power_flow.solve(network, p, q).line_loss_mw)
    batch = jax.jit(jax.vmap(gradient))(q[:3], p[:3])
    np.testing.assert_allclose(batch[1], jax.jit(gradient)(q[1], p[1]), atol=1e-5)


def test_two_buses_have_a_closed_form() -> None:
    """|V|^4 + |V|^2 (2 (r p + x q) - 1) + |z|^2 |s|^2 = 0 for consumption p + jq behind r + jx; it ends at the nose."""
    r, x, p, q = 0.1, 0.2, 0.6, 0.3
    half = 0.5 - (r * p + x * q)
    expected = np.sqrt(half + np.sqrt(half**2 - (r**2 + x**2) * (p**2 + q**2)))
    network = power_flow.radial_network([-1, 0], [0, r], [0, x], base_mva=1.0)
    with jax.enable_x64(True):
        solve = jax.jit(power_flow.solve)
        flow = solve(network, jnp.array([0, -p]), jnp.array([0, -q]))
        np.testing.assert_allclose(flow.vm_pu, [1, expected], atol=1e-10)
        assert not solve(network, jnp.array([0, -2 * p]), jnp.array([0, -2 * q])).converged


def test_transformer_shunt_and_mesh_obey_kirchhoff() -> None:
    branches = [
        power_flow.Branch(0, 1, 0.01, 0.1, b=-0.02, g=0.001, tap=0.97, shift=0.3, is_line=False),
        power_flow.Branch(1, 2, 0.05, 0.04, b=0.03),
        power_flow.Branch(2, 3, 0.05, 0.06, b=0.01),
        power_flow.Branch(1, 3, 0.08, 0.03),
    ]
    shunt = np.array([0, 0, 0.01 + 0.05j, 0])
    with jax.enable_x64(True):
        network = power_flow.branch_network(4, branches, 2.0, slack_vm=1.02, slack_va=0.1, shunt=shunt)
        p, q = jnp.array([0, 0, -0.4, 0.3]), jnp.array([0, 0.1, -0.2, 0])
        flow = jax.jit(power_flow.solve)(network, p, q)
        v = np.asarray(flow.vm_pu * jnp.exp(1j * flow.va_rad))
    into = np.zeros(4, complex) - np.abs(v) ** 2 * np.conj(shunt)
    lost = []
    for b in branches:
        ratio, y, half = b.tap * np.exp(1j * b.shift), 1 / complex(b.r, b.x), complex(b.g, b.b) / 2
        series = (v[b.from_bus] / ratio - v[b.to_bus]) * y
        start = v[b.from_bus] * np.conj((series + half * v[b.from_bus] / ratio) / np.conj(ratio))
        end = v[b.to_bus] * np.conj(-series + half * v[b.to_bus])
        into[b.from_bus] -= start
        into[b.to_bus] -= end
        lost.append((start + end) * 2.0)
    np.testing.assert_allclose(-into[1:] * 2.0, np.asarray(p + 1j * q)[1:], atol=1e-9)
    np.testing.assert_allclose(flow.branch_loss_mw + 1j * flow.branch_loss_mvar, lost, atol=1e-9)
    np.testing.assert_allclose(flow.slack_mw + 1j * flow.slack_mvar, -into[0] * 2.0, atol=1e-9)
    np.testing.assert_allclose(flow.line_loss_mw, np.sum(lost[1:]).real, atol=1e-9)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: power_flow.load_network("case34"), "did you mean 'case33'"),
        (lambda: power_flow.load_network("case33", inject=[0, 1]), "without the slack 0"),
        (lambda: power_flow.radial_network([-1, -1], [0, 1], [0, 1], 1.0), "one bus without parent"),
        (lambda: power_flow.radial_network([-1, 2, 1], [0, 1, 1], [0, 1, 1], 1.0), "no path from the slack"),
        (lambda: power_flow.radial_network([-1, 0], [0, 0], [0, 0], 1.0), "has no impedance"),
    ],
)
def test_mistakes_are_told(build, message: str) -> None:
    with pytest.raises(TaskError, match=message):
        build()


# ---------------------------------------------------------------------------------------------------------------------
# The certificate of what any reactive power can do, against brute force on small feeders and on the packaged data


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
