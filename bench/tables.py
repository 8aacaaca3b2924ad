"""What the documentation shows of bench/results: each table is a pure function from results by name to Markdown."""

from __future__ import annotations

import functools
import textwrap
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from .compare import Report, label, on_cpu

Reports = dict[str, Report]
Row = dict[str, Any]
NOT_YET = "*Not measured yet.*"


def markdown(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(line) + " |" for line in (head, *body)]
    return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:]])


def where(report: Report) -> str:
    """Device, versions, commit, date and circumstances in one line; what was not written down is left out."""
    machine, versions = report.get("machine", {}), report["versions"]
    device = machine.get("cpu", "CPU") if on_cpu(report) else f"{report.get('devices', 1)} x {report['device']}"
    words = [device + (f", {machine['threads']} threads" if on_cpu(report) and "threads" in machine else "")]
    words += [f"{name} {versions[name]}" for name in ("jax", "mujoco", "warp-lang") if versions.get(name)]
    words += [f"commit {report['commit']}"] if report.get("commit") else []
    words += [report["date"][:10]] if "date" in report else []
    words += [report["note"]] if "note" in report else []
    return ", ".join(words)


def matching(rows: list[Row], **wanted: Any) -> list[Row]:
    """Those of `rows` that have all these entries; None stands for one that is missing."""
    return [row for row in rows if all(row.get(name) == value for name, value in wanted.items())]


def throughput(reports: Reports, name: str) -> str:
    """Rates of ant or hands by what is run and batch, beside the plain loop."""
    report = reports[name]
    plain, at_once = (matching(report["rows"], what=what)[0] for what in ("plain loop", "plain loops at once"))
    rows = [row for row in report["rows"] if row["what"] in ("environment", "training")]
    busy = max(row["other_work_cpus"] for row in (plain, at_once, *rows))
    shares = "the share of plain loop x threads"
    if by_cpu := all("steps_per_cpu_second" in row for row in rows):
        shares += ", and of the plain loop per CPU-second"
    batches = sorted({row["batch"] for row in rows})
    lines: dict[str, dict[int, Row]] = {}
    for row in rows:
        lines.setdefault(_contestant(row), {})[row["batch"]] = row

    def cell(row: Row | None) -> str:
        if row is None:
            return "-"
        per_cpu = f"; {row['steps_per_cpu_second'] / plain['steps_per_cpu_second']:.2f}" if by_cpu else ""
        return f"{row['steps_per_second']:,} ({row['of_plain_x_threads']:.2f}{per_cpu})"

    fastest = sorted(lines, key=lambda line: -max(row["steps_per_second"] for row in lines[line].values()))
    head = [f"{plain['task']}, control steps a second", f"{batches[0]} environments", *map(str, batches[1:])]
    single, several = plain["steps_per_second"], at_once["steps_per_second"]
    said = (
        f"{where(report)}; other work took at most {busy:.2f} CPUs. Medians of interleaved runs. A plain Python "
        f"loop over C MuJoCo with the same model does {single:,} control steps a second on one thread, "
        f"{report['machine']['threads']} such loops at once {several:,}; in brackets {shares}:"
    )
    body = ([line, *(cell(lines[line].get(batch)) for batch in batches)] for line in fastest)
    return f"{textwrap.fill(said, 120, break_on_hyphens=False)}\n\n{markdown(head, body)}"


def _contestant(row: Row) -> str:
    what = {"environment": "environment alone", "training": "whole MAPPO-Lagrangian training"}[row["what"]]
    return f"{what}, {_engine(row)}"


def _engine(row: Row) -> str:
    if "physics" not in row:
        return "plain JAX"
    return f"`{row['physics']}`" + (f", `solver = {row['solver']}`" if row.get("solver") else "")


def starts(reports: Reports) -> str:
    """What a newcomer waits for, and memory."""
    report = reports["throughput"]
    first, second, big = (
        matching(report["rows"], what=what)[0] for what in ("first start", "second start", "256 x 64")
    )
    said = (
        f"`pmt train {first['task']}` compiles in {first['compile_seconds']:.1f} s and reaches its first update "
        f"{first['first_update_seconds']:.1f} s after the process starts; with the compile cache "
        f"{second['compile_seconds']:.1f} s and {second['first_update_seconds']:.1f} s. "
        f"Training 256 environments x 64 steps takes {big['memory_gb']:.2f} GB."
    )
    return textwrap.fill(said, 120, break_on_hyphens=False)


def compiling(reports: Reports) -> str:
    """CPU-seconds to trace and compile a step of the environment."""
    body = [
        [row["task"], _engine(row), str(row["batch"]), f"{row['trace_seconds']:g}", f"{row['compile_seconds']:g}"]
        for name in ("throughput", "hand_over")
        for row in matching(reports[name]["rows"], what="step compiled")
    ]
    return markdown(("task", "engine", "environments", "trace, CPU-s", "compile, CPU-s"), body) if body else NOT_YET


def methods(reports: Reports) -> str:
    """What an emotion or a trust region costs."""
    return f"{where(reports['methods'])}.\n\n{of_methods(reports['methods']['rows'])}"


def of_methods(rows: list[Row]) -> str:
    """The table of bench.methods."""
    head = ("task", "method", "compile, s (x MAPPO-L)", "update, s (x MAPPO-L)", "steps/s (x MAPPO-L)")
    body = [
        [
            row["task"],
            row["method"],
            f"{row['compile_seconds']} ({row['compile_ratio']})",
            f"{row['update_seconds']} ({row['update_ratio']})",
            f"{row['steps_per_second']:,} ({row['throughput_ratio']})",
        ]
        for row in rows
    ]
    return markdown(head, body)


def grid(reports: Reports) -> str:
    """Power flows and environment steps per second, and ratios to the tools of grid engineers."""
    report = reports["grid"]
    cells: dict[str, dict[str, str]] = {}
    for row in report["rows"]:
        size = f"batch {row['batch']:,}" if row["batch"] > 1 else "one at a time"
        if "flows_per_second" in row:
            figure, unit = f"{row['flows_per_second']:,.0f}", "power flows/s"
        elif "ratio" in row:
            figure, unit = f"{row['ratio']:,.2f} ({row['lowest']:,.2f})", "ratio"
        else:
            figure, unit = f"{row['steps_per_second']:,}", "environment steps/s"
        feeder = row.get("case", row.get("task", "")).removeprefix("case").removeprefix("voltage_")
        cells.setdefault(f"{row['what']}, {size}, {unit}", {})[feeder] = figure
    feeders = ("33", "141")
    body = [[line, *(found.get(feeder, "-") for feeder in feeders)] for line, found in cells.items()]
    note = "Ratios: median over rounds, in brackets the lowest."
    return f"{where(report)}. {note}\n\n{markdown(('', *(f'{feeder} buses' for feeder in feeders)), body)}"


def checkpoint(reports: Reports) -> str:
    """What keeping a run safe costs."""
    report = reports["checkpoint"]
    row = report["rows"][0]
    head = ("task, method, environments", "size, MB", "save, s", "load, s", "share of wall time")
    body = [
        f"{row['task']}, {row['method']}, {row['num_envs']}",
        f"{row['checkpoint_mb']:.1f}",
        f"{row['save_seconds']:.2f}",
        f"{row['load_seconds']:.2f}",
        f"{100 * row['overhead']:.2f} %",
    ]
    return f"{where(report)}.\n\n{markdown(head, [body])}"


def per_device(reports: Reports, bench: str, table: Callable[[Report], str]) -> str:
    """The table of each device that the bench has results of."""
    found = [report for name, report in reports.items() if name.startswith(f"{bench}_")]
    return "\n\n".join(f"{where(report)}:\n\n{table(report)}" for report in found) or NOT_YET


def engines(report: Report) -> str:
    """Steps per second of environments alone."""

    def figures(row: Row) -> list[str]:
        if "failed" in row:
            return [f"failed: {row['failed'].split(':')[0]}", "-"]
        return [f"{row['steps_per_second']:,}", f"{row['compile_seconds']:.1f}"]

    body = [
        [row["task"], _engine(row), f"{row['seeds']} x {row['batch'] // row['seeds']:,}", *figures(row)]
        for row in report["rows"]
    ]
    return markdown(("task", "engine", "seeds x environments", "environment steps/s", "compile, s"), body)


def loop(report: Report) -> str:
    """The whole training loop."""
    head = ("task", "method", "engine", "seeds x environments x steps", "environment steps/s", "update, s")
    body = [
        [
            row["task"],
            row["method"],
            _engine(row),
            f"{row['seeds']} x {row['num_envs']:,} x {row['rollout_length']}",
            f"{row['steps_per_second']:,}",
            f"{row['update_seconds']:.3f}",
            f"{row.get('times_one_seed', '-')}",
            f"{row['compile_seconds']:.1f}",
            f"{row['memory_gb']:.1f}",
            f"{100 * row['gpu_busy']:.0f} %" if "gpu_busy" in row else "-",
        ]
        for row in with_one_seed(report["rows"])
    ]
    return markdown((*head, "x one seed", "compile, s", "memory, GB", "GPU busy"), body)


def scaling(report: Report) -> str:
    """Weak and strong scaling of the training loop over devices."""
    head = ("task", "scaling", "devices", "seeds x environments x steps", "environment steps/s", "efficiency")
    body = [
        [
            row["task"],
            row["scaling"],
            str(row["devices"]),
            f"{row['seeds']} x {row['num_envs']:,} x {row['rollout_length']}",
            f"{row['steps_per_second']:,}",
            f"{row['efficiency']:.2f}",
        ]
        for row in report["rows"]
    ]
    return markdown(head, body)


def with_one_seed(rows: list[Row]) -> list[Row]:
    """`rows`, with `times_one_seed`, the ratio of update seconds, where another row differs in having one seed."""

    def about(row: Row) -> tuple[Any, ...]:
        return tuple(row.get(name) for name in ("task", "method", "physics", "num_envs", "rollout_length"))

    def extended(row: Row) -> Row:
        if row.get("seeds") == 1 or about(row) not in one:
            return row
        return row | {"times_one_seed": round(row["update_seconds"] / one[about(row)], 2)}

    one = {about(row): row["update_seconds"] for row in rows if row.get("seeds") == 1 and "update_seconds" in row}
    return [extended(row) for row in rows]


class Target(NamedTuple):
    """What an issue asked for: a figure of the rows of a result that match; at least or at most `asked`."""

    result: str
    rows: Row
    figure: str
    asked: float
    more: bool = True


WARP = {"physics": "warp", "solver": None}  # the solver that is not named is the converged one
FIVE_SEEDS = {"task": "ant_2x4", "method": "mappo_l", "seeds": 5}
LARGE = FIVE_SEEDS | {"num_envs": 2048}  # 16,384 steps a seed
TARGETS = (
    Target("throughput", {"what": "environment", "physics": "mujoco"}, "of_plain_x_threads", 0.85),
    Target("throughput", {"what": "training"}, "of_plain_x_threads", 0.7),
    Target("throughput", {"what": "first start"}, "compile_seconds", 15.0, more=False),
    Target("throughput", {"what": "second start"}, "first_update_seconds", 5.0, more=False),
    Target("throughput", {"what": "256 x 64"}, "memory_gb", 2.0, more=False),
    Target("hand_over", {"what": "environment", "physics": "mujoco"}, "of_plain_x_threads", 0.85),
    Target("hand_over", {"what": "environment", "physics": "mjx"}, "steps_per_cpu_second", 1400.0),
    Target("hand_over", {"what": "step compiled", "physics": "mjx"}, "compile_seconds", 25.0, more=False),
    Target("grid", {"case": "case33", "what": "ours f32 / power-grid-model"}, "ratio", 5.0),
    Target("grid", {"case": "case33", "what": "ours f32 / lightsim2grid"}, "ratio", 1.0),
    Target("grid", {"case": "case141", "what": "ours f32 / power-grid-model"}, "ratio", 3.0),
    Target("grid", {"case": "case141", "what": "ours f32 / lightsim2grid"}, "ratio", 1.0),
    Target("grid", {"task": "voltage_33", "what": "in a scan"}, "steps_per_second", 30_000),
    Target("grid", {"task": "voltage_141", "what": "in a scan"}, "steps_per_second", 8_000),
    Target("engines_h200", WARP | {"task": "ant_2x4", "batch": 16_384}, "steps_per_second", 500_000),
    Target("engines_h200", WARP | {"task": "hand_over_2x6", "batch": 4096}, "steps_per_second", 600_000),
    Target("engines_h200", WARP | {"task": "hand_over_2x6", "batch": 16_384}, "steps_per_second", 1_000_000),
    Target("engines_h200", {"task": "voltage_33", "batch": 65_536}, "steps_per_second", 5_000_000),
    Target("engines_h200", {"task": "voltage_141", "batch": 65_536}, "steps_per_second", 1_000_000),
    Target("loop_h200", LARGE, "steps_per_second", 200_000),
    Target("loop_h200", LARGE, "gpu_busy", 0.8),
    Target("loop_h200", FIVE_SEEDS, "times_one_seed", 1.5, more=False),
    Target("scaling_h200", {"task": "ant_2x4", "scaling": "weak, environments", "devices": 4}, "efficiency", 0.9),
)


def hub(reports: Reports) -> str:
    """The pretrained policies."""
    head = ("policy", "reward", "cost (limit)", "steps trained", "engine, episodes", "packing: action, reward", "kB")
    rows, body = reports["hub"]["rows"], []
    for row in rows:
        reward, cost = (row["figures"][f"episode_{what}"] for what in ("reward", "cost"))
        moved = reward[0] - row["unpacked"]["episode_reward"][0]
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


def targets(reports: Reports, gpu: bool) -> str:
    """Each target of a GPU or of a CPU beside what was found, one line for each row that it is about."""
    body = []
    for target in [t for t in TARGETS if t.result.endswith("_h200") == gpu]:
        asked = f"{'>=' if target.more else '<='} {_number(target.asked)}"
        rows = with_one_seed(reports[target.result]["rows"]) if target.result in reports else []
        rows = [row for row in matching(rows, **target.rows) if target.figure in row or "failed" in row]
        for row in rows or [target.rows]:
            found = row.get(target.figure)
            met = found is not None and (found >= target.asked if target.more else found <= target.asked)
            told = _number(found) if found is not None else "failed" if "failed" in row else "not measured yet"
            body.append([label(row), f"`{target.figure}`", asked, told, "yes" if met else "**no**" if rows else "-"])
    return markdown(("what", "figure", "asked", "found", "met"), body)


def _number(x: float) -> str:
    return f"{x:,.0f}" if x >= 1000 else f"{x:g}"


TABLES: dict[str, Callable[[Reports], str]] = {
    "ant": functools.partial(throughput, name="throughput"),
    "hands": functools.partial(throughput, name="hand_over"),
    "starts": starts,
    "compiling": compiling,
    "methods": methods,
    "grid": grid,
    "checkpoint": checkpoint,
    "engines": functools.partial(per_device, bench="engines", table=engines),
    "loop": functools.partial(per_device, bench="loop", table=loop),
    "scaling": functools.partial(per_device, bench="scaling", table=scaling),
    "hub": hub,
    "targets_cpu": functools.partial(targets, gpu=False),
    "targets_h200": functools.partial(targets, gpu=True),
}
