"""What pages show of bench/results: each table is a pure function from results by name to Markdown.

A row of a result holds what was measured; figures that relate it to other rows are made here, turn by turn if both
have the rates of as many turns, else of the medians.
"""

from __future__ import annotations

import statistics
import textwrap
from collections.abc import Callable
from typing import Any, NamedTuple

from pmt_jax.formats import markdown
from pmt_jax.limits import WORST

from ..compare import on_cpu
from ..records import Record, Records, Report

Reports = dict[str, Report]
Figure = Callable[[Record, Records], float | None]
NOT_YET = "*Not measured yet.*"


def where(report: Report) -> str:
    """Device, versions, commit, date and circumstances; what was not written down is left out."""
    machine, versions = report.get("machine", {}), report["versions"]
    device = machine.get("cpu", "CPU") if on_cpu(report) else f"{report.get('devices', 1)} x {report['device']}"
    words = [device + (f", {machine['threads']} threads" if on_cpu(report) and "threads" in machine else "")]
    words += [f"{name} {versions[name]}" for name in ("jax", "mujoco", "warp-lang") if versions.get(name)]
    words += [f"commit {report['commit']}"] if report.get("commit") else []
    words += [report["date"][:10]] if "date" in report else []
    words += [report["note"]] if "note" in report else []
    busy = max((row["other_work_cpus"] for row in report["rows"] if "other_work_cpus" in row), default=0)
    words += [f"other work took at most {busy:.2f} CPUs"] if busy else []
    return textwrap.fill(", ".join(words) + ":", 120, break_on_hyphens=False)


def of_bench(reports: Reports, bench: str) -> Reports:
    """The results of a bench: that of a CPU has its name, those of GPUs the device's, too."""
    return {name: report for name, report in reports.items() if name == bench or name.startswith(f"{bench}_")}


def matching(rows: Records, **wanted: Any) -> Records:
    """Those of `rows` that have all these entries; None stands for one that is missing."""
    return [row for row in rows if all(row.get(name) == value for name, value in wanted.items())]


# ---------------------------------------------------------------------------------------------------------------------
# Figures of a row among the other rows of its result


def rate(row: Record) -> float | None:
    """Environment steps or power flows per second."""
    return row.get("steps_per_second", row.get("flows_per_second"))


def ratios(row: Record, other: Record) -> list[float]:
    """The rate over that of another row, turn by turn."""
    ours, theirs = (x.get("rates", ()) for x in (row, other))
    if not ours or len(ours) != len(theirs):
        ours, theirs = [rate(row) or 0.0], [rate(other) or 1.0]
    return [x / y for x, y in zip(ours, theirs, strict=True)]


def _over(row: Record, rows: Records, **reference: Any) -> float | None:
    """The median ratio to the row that is like this one but for `reference`; None if there is no such row."""
    found = [other for other in matching(rows, **reference) if rate(other)]
    return statistics.median(ratios(row, found[0])) if found and rate(row) else None


def _of_plain_on_each_core(row: Record, rows: Records) -> float | None:
    """The rate over the steps that a plain loop makes in a CPU-second, on every core."""
    plain = max(matching(rows, kind="plain loop"), key=lambda loops: loops["threads"], default={})
    return rate(row) / (plain["threads"] * plain["steps_per_cpu_second"]) if plain and rate(row) else None


def _of_as_many_loops(row: Record, rows: Records) -> float | None:
    threads = max((loops["threads"] for loops in matching(rows, kind="plain loop", task=row["task"])), default=1)
    return _over(row, rows, kind="plain loop", task=row["task"], threads=threads)


def _of_reference_walls(row: Record, rows: Records) -> float | None:
    same = {name: row.get(name) for name in ("physics", "num_envs")}
    return _over(row, rows, **same, what="reference")


def _efficiency(row: Record, rows: Records) -> float | None:
    ratio = _over(row, rows, task=row["task"], what="one device")
    return ratio and ratio / row.get("devices", 1)


def _update_seconds(row: Record, rows: Records) -> float | None:
    if "num_envs" not in row or not rate(row):
        return None
    return row["seeds"] * row["num_envs"] * row["rollout_length"] / row["steps_per_second"]


def _times_mappo_l(row: Record, rows: Records) -> float | None:
    ratio = _over(row, rows, task=row["task"], method="mappo_l")
    return ratio and 1 / ratio


def _of_mappo_l(row: Record, rows: Records) -> float | None:
    return _over(row, rows, name="pmt train, MAPPO-L")


def _ours(row: Record, rows: Records) -> list[float]:
    """Our rate in 32 bits, same network and batch, over that of this row, turn by turn."""
    same = {name: row.get(name) for name in ("kind", "task", "num_envs")}
    ours = [other for other in matching(rows, **same, what="ours f32") if rate(other)]
    return ratios(ours[0], row) if ours and rate(row) else []


# ---------------------------------------------------------------------------------------------------------------------
# Columns


def _shown(pattern: str, found: Figure | str) -> Callable[[Record, Records], str]:
    """A column: a figure (or what stands in the row under that name) in some format, `-` if there is none."""

    def cell(row: Record, rows: Records) -> str:
        value = row.get(found) if isinstance(found, str) else found(row, rows)
        return pattern.format(value) if value is not None else "-"

    return cell


def _engine(row: Record, rows: Records) -> str:
    if row.get("physics", "xla") == "xla":
        return "plain C" if row["kind"] == "plain loop" else "plain JAX"
    return f"`{row['physics']}`"


def _contestant(row: Record, rows: Records) -> str:
    if row["kind"] == "plain loop":
        return f"plain loop, {row['threads']} thread{'s' * (row['threads'] > 1)}"
    return {"environment": "environment alone", "training": f"training, {row.get('method')}"}[row["kind"]]


def _rate_or_failure(row: Record, rows: Records) -> str:
    return f"failed: {row['failed'].split(':')[0]}" if "failed" in row else f"{rate(row):,.0f}"


def _turns(name: str) -> Callable[[Record, Records], str]:
    """The mean over turns of what stands in the row under that name, with the lowest and highest of several."""

    def cell(row: Record, rows: Records) -> str:
        found = row.get(name)
        if not found:
            return "-"
        scatter = f" ({min(found):.2f} to {max(found):.2f})" if len(found) > 1 else ""
        return f"{statistics.mean(found):.2f}{scatter}"

    return cell


def _sizes(*names: str) -> Callable[[Record, Records], str]:
    return lambda row, rows: " x ".join(f"{row[name]:,}" for name in names if name in row) or "-"


def _ours_cell(row: Record, rows: Records) -> str:
    found = _ours(row, rows) if row["what"] != "ours f32" else []
    lowest = f" ({min(found):,.2f})" if len(found) > 1 else ""
    return f"{statistics.median(found):,.2f}{lowest}" if found else "-"


COLUMNS: dict[str, Callable[[Record, Records], str]] = {
    "program": _shown("{}", "name"),
    "physics": _shown("{}", "physics"),
    "environments x steps": _sizes("num_envs", "rollout_length"),
    "of pmt train, MAPPO-L": _shown("{:.2f}", _of_mappo_l),
    "other work, CPUs": _shown("{:.1f}", "other_work_cpus"),
    "turns' reward": _turns("rewards"),
    "turns' cost": _turns("costs"),
    "": _contestant,
    "task": _shown("{}", "task"),
    "what": _shown("{}", "what"),
    "method": lambda row, rows: f"{row['method']} {row.get('what', '')}".strip(),
    "scaling": _shown("{}", "what"),
    "engine": _engine,
    "batch": lambda row, rows: f"{row.get('num_envs', 1):,}",
    "environments": _shown("{:,}", "num_envs"),
    "devices": lambda row, rows: str(row.get("devices", 1)),
    "seeds x environments": _sizes("seeds", "num_envs"),
    "seeds x environments x steps": _sizes("seeds", "num_envs", "rollout_length"),
    "steps in a call": _shown("{}", "rollout_length"),
    "environment steps/s": _rate_or_failure,
    "power flows/s": _rate_or_failure,
    "walls": _shown("{}", "what"),
    "of reference": _shown("{:.2f}", _of_reference_walls),
    "worker processes": _shown("{}", "workers"),
    "steps per CPU-second": _shown("{:,}", "steps_per_cpu_second"),
    "of a plain loop on each core": _shown("{:.2f}", _of_plain_on_each_core),
    "of plain loops at once": _shown("{:.2f}", _of_as_many_loops),
    "trace, CPU-s": _shown("{:g}", "trace_cpu_seconds"),
    "compile, CPU-s": _shown("{:g}", "compile_cpu_seconds"),
    "compile, s": _shown("{:.1f}", "compile_seconds"),
    "update, s": _shown("{:.3f}", _update_seconds),
    "update x MAPPO-L": _shown("{:.2f}", _times_mappo_l),
    "efficiency": _shown("{:.2f}", _efficiency),
    "memory, GB": _shown("{:.1f}", "memory_gb"),
    "compile cache": _shown("{}", "cache"),
    "first update, s": _shown("{:.1f}", "first_update_seconds"),
    "ours f32 is faster by (lowest)": _ours_cell,
    "CR": _shown("{:.3f}", "info/totally_controllable_ratio"),
    "PL, MW": _shown("{:.3f}", "info/total_line_loss"),
    "reward": _shown("{:.2f}", "episode_reward"),
    "cost": _shown("{:.2f}", "episode_cost"),
    "steps": _shown("{:,}", "states"),
    "CR of the best dispatch found": _shown("{:.4f}", "reached"),
    "no CR above": _shown("{:.4f}", "possible"),
    "its cost": _shown("{:.2f}", "cost_reached"),
    "no cost below": _shown("{:.2f}", "cost_at_least"),
    "steps neither reached nor excluded": _shown("{}", "unknown"),
    "their worst excess, p.u.": _shown("{:.4f}", "largest_unknown_excess"),
    "size, MB": _shown("{:.1f}", "checkpoint_mb"),
    "save, s": _shown("{:.2f}", "save_seconds"),
    "load, s": _shown("{:.2f}", "load_seconds"),
    "share of wall time": _shown("{:.2%}", "overhead"),
}


class Table(NamedTuple):
    """A table of a result, one for each device that it has been measured on: rows of some kinds, and their columns."""

    result: str
    kinds: tuple[str, ...]
    columns: tuple[str, ...]

    def __call__(self, reports: Reports) -> str:
        """Markdown, each table below a line that says where it was measured."""
        found = of_bench(reports, self.result).values()
        return "\n\n".join(f"{where(report)}\n\n{self._of(report['rows'])}" for report in found) or NOT_YET

    def _of(self, rows: Records) -> str:
        shown = [row for row in rows if row["kind"] in self.kinds]
        return markdown(self.columns, ([COLUMNS[name](row, rows) for name in self.columns] for row in shown))


def hub(reports: Reports) -> str:
    """The pretrained policies."""
    head = ("policy", "reward", "cost (limit)", "steps trained", "engine, episodes", "packing: action, reward", "kB")
    rows, body = reports["hub"]["rows"], []
    for row in rows:
        figures = row["figures"]
        reward, cost = figures["episode_reward"], figures.get(f"episode_cost{WORST}", figures["episode_cost"])
        moved = row["packed"]["episode_reward"][0] - row["unpacked"]["episode_reward"][0]
        body.append(
            [
                f"`{row['name']}`",
                f"{reward[0]:.2f} ± {reward[1]:.2f}",
                f"{cost[0]:.2f} ± {cost[1]:.2f} ({row['cost_limit']:g})",
                f"{row['step']:,}",
                f"{row['engine']}, {row['episodes']}",
                f"{row['action_change']:.4f}, {moved:+.2f}",
                f"{row['bytes'] / 1000:.0f}",
            ]
        )
    total = sum(row["bytes"] for row in rows)
    return f"{markdown(head, body)}\n\n{len(rows)} policies, {total / 1000:.0f} kB in all."


class Found(NamedTuple):
    """A row, and the name of the result that it is of."""

    result: str
    row: Record


def newest(reports: Reports, bench: str, gpu: bool, **wanted: Any) -> Found | None:
    """The newest row with a rate that a bench measured on GPUs, or on CPUs, with all these entries."""
    found = [
        Found(name, row)
        for name, report in of_bench(reports, bench).items()
        if on_cpu(report) != gpu
        for row in matching(report["rows"], **wanted)
        if rate(row)
    ]
    return max(found, key=lambda x: (reports[x.result].get("date", ""), x.row.get("threads", 0)), default=None)


def _pairs(reports: Reports) -> list[tuple[str, Found | None, str, Found | None]]:
    """What is measured, its row, what one would use instead, and the row of that."""
    ant = {"task": "ant_2x4", "kind": "environment", "seeds": 1}
    large = {"num_envs": 256, "rollout_length": 64}, {"seeds": 1, "num_envs": 2048, "rollout_length": 8}
    case = {"task": "case141", "num_envs": 1024}
    return [
        (
            "ant, control steps, 256 at a time",
            newest(reports, "ant", False, physics="fused", num_envs=256, **ant),
            "plain Python loops over C MuJoCo, one a thread",
            newest(reports, "ant", False, kind="plain loop"),
        ),
        (
            "ant, control steps, 16,384 at a time",
            newest(reports, "ant", True, physics="fused", num_envs=16_384, **ant),
            "MuJoCo-Warp",
            newest(reports, "ant", True, physics="warp", num_envs=16_384, **ant),
        ),
        (
            "ant, steps of training, 256 x 64",
            newest(reports, "loop", False, physics="fused", **large[0]),
            "the same on MuJoCo's C engine",
            newest(reports, "loop", False, physics="mujoco", **large[0]),
        ),
        (
            "ant, steps of training, 2,048 x 8",
            newest(reports, "loop", True, physics="fused", **large[1]),
            "the same on MuJoCo-Warp",
            newest(reports, "loop", True, physics="warp", **large[1]),
        ),
        (
            "hands, control steps, 16,384 at a time",
            newest(reports, "engines", True, task="hand_over_2x6", num_envs=16_384),
            "",
            None,
        ),
        (
            "141 buses, power flows",
            newest(reports, "grid", False, what="ours f32", **case),
            "power-grid-model",
            newest(reports, "grid", False, what="power-grid-model iterative_current", **case),
        ),
    ]


def alternatives(reports: Reports) -> str:
    """Speed in a few rows, next to what one would use instead, and the results, whose own tables say where and when."""
    body = []
    for what, ours, instead, theirs in _pairs(reports):
        if ours is None:
            continue
        used = [found for found in (ours, theirs) if found]
        figures = [f"{rate(found.row):,.0f}" for found in used]
        ratio = f"{statistics.median(ratios(ours.row, theirs.row)):.1f}" if theirs else ""
        names = ", ".join(f"`{name}`" for name in dict.fromkeys(found.result for found in used))
        body.append([what, figures[0], instead, *(figures[1:] or [""]), ratio, names])
    head = ("what", "here, per second", "instead", "per second", "ratio", "results")
    return markdown(head, body)


def limits(reports: Reports) -> str:
    """Training next to its environment alone, where both were measured at the same size on one kind of device."""
    body = []
    for name, report in of_bench(reports, "loop").items():
        machine = report["machine"]["cpu"] if on_cpu(report) else f"1 {report['device']}"
        alike = [x for x in of_bench(reports, "ant").values() if x["device"] == report["device"]]
        for row in report["rows"]:
            same = {word: row.get(word) for word in ("physics", "seeds", "num_envs")}
            found = [x for other in alike for x in matching(other["rows"], kind="environment", **same) if rate(x)]
            if found and rate(row):
                speeds = [row["steps_per_second"], found[0]["steps_per_second"]]
                size = _sizes("seeds", "num_envs", "rollout_length")(row, [])
                share = f"{speeds[0] / speeds[1]:.2f}"
                body.append([machine, _engine(row, []), size, *(f"{x:,.0f}" for x in speeds), share, f"`{name}`"])
    head = (
        "machine",
        "engine",
        SIZES,
        "training, steps/s",
        "environment alone, steps/s",
        "share of the update",
        "result",
    )
    return markdown(head, body)


SPEED = ("", "engine", "seeds x environments", "environment steps/s", "of plain loops at once")
STARTS = ("what", "environments x steps", "compile cache", "compile, s", "first update, s", "memory, GB")
EVERY = ("plain loop", "environment", "training")
SIZES = "seeds x environments x steps"
TABLES: dict[str, Callable[[Reports], str]] = {
    "ant": Table("ant", EVERY, SPEED),
    "start": Table("start", ("start",), STARTS),
    "walls": Table(
        "walls", ("environment",), ("walls", "engine", "environments", "environment steps/s", "of reference")
    ),
    "hands": Table("hands", EVERY, (*SPEED, "trace, CPU-s", "compile, CPU-s")),
    "workstation": Table(
        "workstation",
        EVERY,
        (
            "",
            SIZES,
            "worker processes",
            "devices",
            "environment steps/s",
            "steps per CPU-second",
            "of a plain loop on each core",
        ),
    ),
    "methods": Table(
        "methods",
        ("training",),
        ("method", "compile, s", "update x MAPPO-L", "environment steps/s"),
    ),
    "power_flows": Table(
        "grid", ("power flow",), ("task", "batch", "what", "power flows/s", "ours f32 is faster by (lowest)")
    ),
    "grid": Table("grid", ("environment",), ("task", "environments", "steps in a call", "environment steps/s")),
    "baselines": Table("baselines", ("baseline",), ("task", "what", "CR", "PL, MW", "reward", "cost")),
    "certificate": Table(
        "certificate",
        ("certificate",),
        (
            *("task", "steps", "CR of the best dispatch found", "no CR above", "its cost", "no cost below"),
            *("steps neither reached nor excluded", "their worst excess, p.u."),
        ),
    ),
    "checkpoint": Table(
        "checkpoint",
        ("checkpoint",),
        ("task", "method", "environments", "size, MB", "save, s", "load, s", "share of wall time"),
    ),
    "engines": Table(
        "engines", ("environment",), ("task", "engine", "seeds x environments", "environment steps/s", "compile, s")
    ),
    "robots": Table("robots", EVERY, ("task", *SPEED)),
    "multi_goal": Table(
        "multi_goal", ("environment",), ("task", "engine", "seeds x environments", "environment steps/s")
    ),
    "loop": Table("loop", ("training",), ("method", "engine", SIZES, "environment steps/s", "update, s")),
    "scaling": Table(
        "scaling", ("training",), ("task", "scaling", "devices", SIZES, "environment steps/s", "efficiency")
    ),
    "hub": hub,
    "alternatives": alternatives,
    "limits": limits,
    "peers": Table(
        "peers",
        ("peer",),
        (
            *("program", "task", "physics", "environment steps/s", "of pmt train, MAPPO-L"),
            *("turns' reward", "turns' cost"),
            *("first update, s", "other work, CPUs"),
        ),
    ),
}
