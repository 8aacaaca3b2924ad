"""`python -m bench`: what runs, how figures are compared, and that pages show what is stored."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import json
import multiprocessing
import pathlib
import re
import sys
import time
import tomllib
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

import envs
from bench import compare, measure, once, plain, records, render, runner, update
from bench.__main__ import main
from bench.cases import BENCHES, Bench, Case
from bench.tables import pages, runs, speed, study, values
from docs.figures import ant_paths, curves, episode_cost, style
from pmt_jax import load_config, make_train
from pmt_jax.config.methods import METHODS
from pmt_jax.errors import UsageError
from pmt_jax.learning import fear, learner
from pmt_jax.learning.maths import advantages
from pmt_jax.policies import hub
from pmt_jax.studies import points
from pmt_jax.training import final

ROOT = pathlib.Path(__file__).parents[2]
FAKE = """
import json, os, signal, sys
what, out = sys.argv[1], sys.argv[-1]
if what == "interrupted":
    os.kill(os.getppid(), signal.SIGINT)
report = {"device": "cpu", "versions": {}, "rows": [{"task": "lane", "steps_per_second": 100}]}
open(out, "w").write(json.dumps(report))
sys.exit(3 if what == "failing" else 0)
"""


def report(device: str = "cpu", cpu: str = "A", **figures: Any) -> records.Report:
    return {"device": device, "machine": {"cpu": cpu, "threads": 2}, "versions": {}, "rows": [{"task": "x", **figures}]}


@pytest.fixture
def fakes(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., pathlib.Path]:
    """Replaces the benches by ones that write, fail or interrupt, as their names say; gives a folder for results."""
    (tmp_path / "fake.py").write_text(FAKE)
    monkeypatch.setattr(runner, "MEASURE", (sys.executable, str(tmp_path / "fake.py")))

    def replace(*names: str, **on: Any) -> pathlib.Path:
        for name in list(BENCHES):
            monkeypatch.delitem(BENCHES, name)
        for name in names:
            monkeypatch.setitem(BENCHES, name, Bench(f"does {name}", (), (), on.get(name, "cpu")))
        return tmp_path / "results"

    return replace


def test_one_that_fails_does_not_stop_the_others(
    fakes, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    out = fakes("first", "failing", "last")
    old = report() | {"machine": {}, "rows": [{"task": "lane", "steps_per_second": 200}]}
    monkeypatch.setattr(runner, "last_results", lambda say: {"last": old})
    assert main(["run", "--out", str(out)]) == 1
    assert sorted(path.name for path in out.iterdir()) == ["failing.json.unfinished", "first.json", "last.json"]
    said = capsys.readouterr().out
    assert "[3/3] last: does last" in said and "failed: failing" in said
    assert "first: nothing older" in said and "0.50 x  lane: steps_per_second: 200 -> 100  <- worse" in said


def test_ctrl_c_keeps_what_is_finished(fakes):
    out = fakes("first", "interrupted", "last")
    assert main(["run", "--out", str(out)]) == 130
    assert json.loads((out / "first.json").read_text())["rows"]
    assert not (out / "interrupted.json").exists() and not (out / "last.json").exists()


@pytest.mark.parametrize(
    ("count", "device", "skipped"),
    [(1, "cpu", ["no GPU", "no GPU"]), (1, "NVIDIA H200", ["one GPU only"]), (2, "NVIDIA H200", [])],
)
def test_what_a_machine_lacks_is_skipped(
    fakes, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], count: int, device: str, skipped: list
):
    out = fakes("first", "second", "third", "fourth", second="either", third="gpu", fourth="gpus")
    monkeypatch.setattr(runner, "devices", lambda: (count, device))
    assert main(["run", "--out", str(out)]) == 0
    second = "second" if device == "cpu" else "second_h200"  # what runs on either is named after the GPU
    names = sorted(["first", second, *["third_h200", "fourth_h200"][: 2 - len(skipped)]])
    assert sorted(path.stem for path in out.iterdir()) == names
    said = capsys.readouterr().out
    assert [line.split("there is ")[1] for line in said.splitlines() if "skipped" in line] == [
        f"{x} here" for x in skipped
    ]


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["ru"], "unknown command 'ru'; did you mean 'run'?"),
        (["run", "grid", "methodss"], "unknown bench 'methodss'; did you mean 'methods'?"),
        (["compare", "nowhere", "HEAD"], "'nowhere' is neither a file of results, a folder of them nor a git revision"),
        (["run", "--quick", "--out", str(records.RESULTS)], "figures of --quick, --only or --threads do not belong in"),
    ],
)
def test_a_mistake_is_one_sentence(argv: list[str], said: str, capsys: pytest.CaptureFixture[str]):
    assert main(argv) == 2
    captured = capsys.readouterr()
    assert said in captured.err and captured.err.count("\n") == 1 and not captured.out


def test_programs_take_turns_and_failures_are_rows(monkeypatch: pytest.MonkeyPatch, tmp_path: pathlib.Path):
    calls = []

    def make(case: Case) -> Any:
        if case.task == "no engine":
            raise UsageError("warp is missing")
        return lambda: measure.Program(lambda: calls.append(case.task), 10, {"physics": "fake"})

    monkeypatch.setitem(measure.MAKE, "environment", make)
    cases = [Case("environment", task, num_envs=5) for task in ("a", "no engine", "b")]
    monkeypatch.setitem(BENCHES, "fake", Bench("", cases, ()))
    monkeypatch.setattr(measure, "FULL", measure.Effort(3, 0.0, 0.0))
    monkeypatch.setattr("jax.config.update", lambda *_: None)
    runner.measure("fake", tmp_path / "fake.json", quick=False, threads=0, only="", say=lambda _: None)
    assert calls == ["a", "b"] + 3 * ["a", "b"]  # each warms up once, then they take turns
    stored = records.load(tmp_path / "fake.json")["fake"]
    assert stored["command"] == "python -m bench run fake"
    a, b, failed = sorted(stored["rows"], key=lambda row: (row["task"] == "no engine", row["task"]))
    assert (a["kind"], a["num_envs"], a["physics"], len(a["rates"])) == ("environment", 5, "fake", 3)
    assert b["steps_per_second"] == sorted(b["rates"])[1] > 0
    assert failed["failed"] == "UsageError: warp is missing" and "rates" not in failed


@pytest.mark.full
def test_workers_share_seeds_and_cpus():
    case = Case("training", "lane", method="mappo_l", seeds=2, num_envs=4, rollout_length=5, workers=2)
    program = measure.training(case)()
    assert program.steps == 2 * 4 * 5
    for _ in range(2):
        program.call()


@pytest.mark.full
def test_plain_loops_have_processes_that_end_with_their_program():
    before = multiprocessing.active_children()
    program = plain.plain_loop(Case("plain loop", "ant_2x4", threads=2))()
    assert program.steps == 2 * plain.STEPS
    (worker,) = set(multiprocessing.active_children()) - set(before)
    watch, begin = measure.Watch(), time.process_time()
    program.call()
    assert watch.own > 1.3 * (time.process_time() - begin)  # the worker's time counts
    del program
    worker.join(10)
    assert worker.exitcode == 0


def test_quick_and_only_choose_cases(monkeypatch: pytest.MonkeyPatch, tmp_path: pathlib.Path):
    seen = []
    monkeypatch.setattr(measure, "rows", lambda cases, effort, say: seen.append((cases, effort)) or [])
    monkeypatch.setattr("jax.config.update", lambda *_: None)
    for quick, only in ((True, ""), (False, "environment, num_envs 256")):
        runner.measure("ant", tmp_path / "x.json", quick, threads=0, only=only, say=lambda _: None)
    assert seen[0] == (list(BENCHES["ant"].quick), measure.QUICK)
    assert [(case.physics, case.num_envs) for case in seen[1][0]] == [("fused", 256), ("mujoco", 256)]


def test_a_gpu_has_cases_of_its_own(monkeypatch: pytest.MonkeyPatch, tmp_path: pathlib.Path):
    seen = []
    monkeypatch.setattr(measure, "rows", lambda cases, effort, say: seen.append((cases, effort)) or [])
    monkeypatch.setattr("jax.config.update", lambda *_: None)
    for backend in ("cpu", "gpu"):
        monkeypatch.setattr("jax.default_backend", lambda backend=backend: backend)
        runner.measure("loop", tmp_path / "x.json", quick=False, threads=0, only="", say=lambda _: None)
    assert seen == [(list(BENCHES["loop"].cases), measure.FULL), (list(BENCHES["loop"].gpu), measure.ON_GPU)]
    assert {case.physics for case in BENCHES["loop"].gpu} == {"fused", "warp"}


def test_an_engine_that_cannot_run_here_is_left_out_with_a_sentence(monkeypatch: pytest.MonkeyPatch):
    """Not a failure: a machine without Warp measures the rest."""
    monkeypatch.setitem(measure.MAKE, "environment", lambda case: lambda: measure.Program(lambda: None, 10))
    said, cases = [], [Case("environment", "a", physics=engine, num_envs=5) for engine in ("warp", "mujoco")]
    found = list(measure.rows(cases, measure.Effort(1, 0.0, 0.0), said.append))
    assert [row["physics"] for row in found] == ["mujoco"]
    assert said[0].startswith("left out: environment, a, warp, ") and "physics 'warp' needs an NVIDIA GPU" in said[0]


@pytest.mark.slow
def test_certificates_are_of_the_episodes_that_policies_are_evaluated_in():
    env: Any = envs.make("voltage_33")
    rows = once.data_rows("voltage_33", 2)
    voltages = jax.jit(jax.vmap(lambda row: env.flow_of(row, np.zeros((6, 1), np.float32)).vm_pu))
    off = np.abs(np.asarray(voltages(rows.reshape(-1, rows.shape[-1]))) - 1).max(axis=1)
    zero = once.baseline(Case("baseline", "voltage_33", "zero", num_envs=2))
    assert 0.5 < zero["info/totally_controllable_ratio"] < 1
    assert np.mean(off <= 0.05) == pytest.approx(zero["info/totally_controllable_ratio"], abs=1e-5)


def test_ratios_are_below_one_for_what_became_worse():
    old = report(steps_per_second=100.0, first_update_seconds=2.0, memory_gb=1.0, overhead=0.5)
    new = report(steps_per_second=50, first_update_seconds=4.0, memory_gb=0.8, overhead=0.1)
    found = {change.figure: change for change in compare.changes(old, new)}
    assert found["x: steps_per_second"].ratio == 0.5  # half as many steps: worse
    assert found["x: first_update_seconds"].ratio == 0.5  # twice the seconds: worse
    assert found["x: memory_gb"].ratio == 1.25
    assert len(found) == 3
    assert compare.describe("y", old, new).splitlines()[0].startswith("y: 3 figures, 2 worse")


def test_other_machines_are_not_compared():
    here = report(steps_per_second=100)
    for other in (report(cpu="B", steps_per_second=50), report(device="NVIDIA H200", steps_per_second=50)):
        assert "not compared" in compare.describe("y", other, here)
    assert "1.00 x" in compare.describe("y", report("NVIDIA H200", "B", x_second=1), report("NVIDIA H200", x_second=1))


def test_a_result_says_what_it_was_measured_on(tmp_path: pathlib.Path):
    out = tmp_path / "new" / "lane.json"
    records.write(out, [{"task": "lane", "steps_per_second": 7}], "python -m bench run lane")
    written = records.load(out)["lane"]
    assert {"machine", "device", "versions", "commit", "date", "load_average", "seconds", "command"} <= set(written)
    assert written["versions"]["jax"] and [c.ratio for c in compare.changes(written, written)] == [1.0]


def test_rows_about_the_same_thing_stay_apart():
    twice = report(steps_per_second=1) | {"rows": [{"task": "x", "steps_per_second": n} for n in (1, 2)]}
    assert list(compare.figures(twice).values()) == [1, 2]


def test_ratios_between_rows_are_taken_turn_by_turn():
    def row(kind: str, rates: list[float], **more: Any) -> records.Record:
        return {"kind": kind, "task": "x", "steps_per_second": float(np.median(rates)), "rates": rates, **more}

    loops = [row("plain loop", [100, 50, 100], threads=1), row("plain loop", [200, 100, 200], threads=2)]
    elsewhere = row("plain loop", [1, 1, 1], threads=8) | {"task": "y"}
    alone = row("environment", [160, 90, 170], num_envs=8, physics="mujoco")  # the machine was busy in the second turn
    shown = speed.COLUMNS["of plain loops at once"](alone, [elsewhere, *loops, alone])
    assert shown == "0.85"  # the median of 0.8, 0.9 and 0.85
    five = {"kind": "training", "task": "x", "seeds": 5, "steps_per_second": 250.0}
    locked = loops[1] | {"steps_per_cpu_second": 125}  # that waited for each other
    assert speed.COLUMNS["of a plain loop on each core"](five, [locked, five]) == "1.00"
    assert speed.COLUMNS["of a plain loop on each core"](five, [five]) == "-"


@pytest.mark.parametrize("name", [name for name, each in speed.TABLES.items() if isinstance(each, speed.Table)])
def test_every_column_shows_something(name: str):
    """A column that is empty in each row of the stored results reads a name that they do not have."""
    made = speed.TABLES[name](records.load())
    heads = [[x.strip() for x in line.split("|")[1:-1]] for line in made.splitlines() if line.startswith("|")]
    head, body = heads[0], [row for row in heads if row[0] != "---" and row != heads[0]]
    empty = [column for i, column in enumerate(head) if column and {row[i] for row in body} <= {"-", ""}]
    assert body and not empty


def test_a_table_for_each_device_and_a_failure_in_it():
    row = {"kind": "environment", "task": "ant_2x4", "physics": "warp", "seeds": 1, "num_envs": 16_384}
    head = {"device": "NVIDIA H200", "versions": {"jax": "1"}}
    reports = {
        "engines_h200": head | {"rows": [row | {"steps_per_second": 4321.0, "compile_seconds": 2.52}]},
        "engines_b200": head | {"rows": [row | {"failed": "OutOfMemory: too much"}]},
    }
    said = speed.TABLES["engines"](reports)
    assert "1 x NVIDIA H200, jax 1:" in said and "| ant_2x4 | `warp` | 1 x 16,384 | 4,321 | 2.5 |" in said
    assert "| ant_2x4 | `warp` | 1 x 16,384 | failed: OutOfMemory | - |" in said
    assert speed.TABLES["engines"]({}) == speed.NOT_YET


def test_the_readme_compares_the_newest_rows_and_names_their_results():
    row = {"kind": "environment", "task": "ant_2x4", "seeds": 1}
    head, large = {"device": "NVIDIA H100", "versions": {"jax": "1"}, "commit": "abc"}, {"num_envs": 16_384}
    reports = {
        "ant_warp_h200": head
        | {"date": "2026-01-01", "rows": [row | large | {"physics": "warp", "steps_per_second": 100.0}]},
        "ant_h100": head
        | {"date": "2026-03-01", "rows": [row | large | {"physics": "fused", "steps_per_second": 900.0}]},
        "ant_h200": head
        | {"date": "2026-02-01", "rows": [row | large | {"physics": "fused", "steps_per_second": 500.0}]},
    }
    said = speed.TABLES["alternatives"](reports)
    assert "| 900 | MuJoCo-Warp | 100 | 9.0 | `ant_h100`, `ant_warp_h200` |" in said
    assert len([line for line in said.splitlines() if line.startswith("|")]) == 3  # what was not measured has no line


# ---------------------------------------------------------------------------------------------------------------------
# Pages


@pytest.fixture(scope="module")
def reports() -> dict[str, records.Report]:
    return records.load()


@pytest.mark.parametrize("path", render.documents(), ids=lambda path: path.name)
def test_documents_show_the_committed_results(path: pathlib.Path, reports: dict[str, records.Report]):
    assert render.render(path.read_text(), reports) == path.read_text(), "run python -m bench render"


def test_pages_show_every_result():
    """In a table, in a number of a sentence, in a picture, or in the generated page of pretrained policies."""
    pages = [path.read_text() for path in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md"))]
    blocks = {name for text in pages for _, name, _, _ in render.BLOCK.findall(text)}
    marks = {name for text in pages for _, name, _, _ in render.NUMBER.findall(text)}
    shown = {file for name in blocks for file in (name.partition(":")[2] or name).split("+")}
    shown |= {file for name in marks for file in name.split(":")[1].split("+")}
    shown |= {"ant_paths_methods", "episode_cost", "fear_map", "hand_over_catch", "hub"} | {
        result for result, _ in curves.FIGURES.values()
    }
    benches = {speed.TABLES[name].result for name in shown if isinstance(speed.TABLES.get(name), speed.Table)}
    for file in records.RESULTS.glob("*.json"):
        used = file.stem in shown or any(file.stem == name or file.stem.startswith(f"{name}_") for name in benches)
        assert used, f"no page shows {file.name}"


def test_the_tree_is_small():
    """Results that pages show fit into 60 files and 10 MB, and what repeats them into 6 sweeps."""
    results = list(records.RESULTS.iterdir())
    assert {file.suffix for file in results} == {".json"}
    assert len(results) <= 60 and sum(file.stat().st_size for file in results) <= 10e6 and len(SWEEPS) <= 6


def test_rendering_replaces_blocks_and_nothing_else():
    reports = records.load()
    text = "before\n<!-- bench: start -->\nold\n<!-- /bench -->\nafter\n"
    rendered = render.render(text, reports)
    assert rendered.startswith("before\n<!-- bench: start -->\n") and rendered.endswith("-->\nafter\n")
    assert "| second start | 2,048 x 8 | hit |" in rendered
    assert "old" not in rendered and render.render(rendered, reports) == rendered
    for broken in ("<!-- bench: starts -->\n<!-- /bench -->", "<!-- bench: start -->\n"):
        with pytest.raises(UsageError):
            render.render(broken, reports)


def test_rendering_fills_numbers_in_sentences():
    mark = "within:laptop:f4sg:{}"
    text = f"kept by <!-- bench: {mark.format('1:ant_2x4')} -->9<!-- /bench --> of 10"
    assert "-->3<!-- /bench --> of 10" in render.render(text, {})
    assert values.number(mark.format("*:ant_2x4")) == "20"
    assert values.number(mark.format("1:ant_2x4").replace("within", "seeds")) == "10"
    both = "within:table1_ant_2x4_h200+recipe_ant_4x2_h200:f4sg+mappo_l:*"
    assert values.number(both) == "80" and values.number(both.replace("within", "reward")).replace(",", "").isdigit()
    assert values.number("seeds:velocity_h200:happo:25:velocity_humanoid_9_8") == "5"  # of one task in a file of eight
    for wrong, said in (
        (mark.format("7"), "no run of laptop is 'f4sg:7'"),
        ("withn:x:*:1", "unknown value 'withn'; did you mean 'within'?"),
        ("within:x:*:1", "holds no stored runs"),
        ("within:x", "expected within:FILE:METHOD:LIMIT"),
    ):
        with pytest.raises(UsageError, match=re.escape(said)):
            render.render(f"<!-- bench: {wrong} -->3<!-- /bench -->", {})


def test_pages_describe_what_there_is():
    for kind, name, said in (
        ("observation", "lane", "| 1 to 4 | last action | - | of all agents, after clipping |"),
        ("actions", "velocity_swimmer_2x1", "| `velocity_swimmer_2x1` | 1 | 0 motor2_rot |"),
        ("options", "velocity_swimmer_2x1", "| `fall_cost` | `false` | adds a second cost"),
        ("tasks", "lane+noisy", "| `noisy` | "),
        ("settings", "fear_time", "| `fear_time` | `next` | `next`, `current` | fear of the state"),
        ("switches", "all", "| `f4sg` | sequential, an actor each | lagrangian | fear | none |"),
    ):
        assert said in pages.KINDS[kind](name)
    for kind, name in (("observation", "lan"), ("settings", "fear_tim")):
        with pytest.raises(UsageError, match="did you mean"):
            pages.KINDS[kind](name)


def test_names_beside_lines_do_not_overlap():
    axis: Any = Figure().subplots()
    style.label_lines(axis, [(method, 0.5 + 0.001 * i) for i, method in enumerate(style.NAMES)])
    heights = sorted(text.get_position()[1] for text in axis.texts)
    assert len(heights) == len(style.NAMES) and np.diff(heights).min() > 0.9 * style.GAP


# ---------------------------------------------------------------------------------------------------------------------
# Stored runs


@functools.cache  # nobody changes them
def stored() -> dict[str, list[runs.Run]]:
    found = {file.stem: json.loads(file.read_text()) for file in sorted(records.RESULTS.glob("*.json"))}
    return {name: x for name, x in found.items() if isinstance(x, list) and "table" in x[0]}


SWEEPS = sorted((ROOT / "bench" / "sweeps").glob("*.toml"))


@pytest.mark.parametrize("file", SWEEPS, ids=lambda file: file.stem)
def test_sweep_files_can_be_swept(file: pathlib.Path):
    assert points.make_points(points.from_file(file))


@pytest.mark.parametrize("file", SWEEPS, ids=lambda file: file.stem)
def test_stored_runs_have_the_settings_that_their_sweep_names(file: pathlib.Path):
    sweep = tomllib.loads(file.read_text())
    grids = [sweep | grid for grid in sweep.pop("sweep")]
    fixed = [{k: v for k, v in grid.items() if k not in ("extends", "set", "random")} for grid in grids]
    for run in [run for run in stored().get(file.stem, []) if "config" in run]:  # the oldest have none
        settings = tomllib.loads(run["config"])
        assert any(
            all(settings[name] == value for name, value in given.items())
            and all(settings[name] in values for name, values in grid["set"].items())
            for given, grid in zip(fixed, grids, strict=True)
        )


def fake_run(folder: pathlib.Path, **settings: Any) -> pathlib.Path:
    folder.mkdir(parents=True)
    lines = ['task = "lane"', 'method = "happo"', "seeds = 2", *(f"{k} = {v}" for k, v in settings.items())]
    (folder / "config.toml").write_text("\n".join(lines) + "\n")
    (folder / "versions.json").write_text("{}")
    log = [
        {"step": step, "seed": seed, "task": "lane", "method": "happo", "cost_limit": 2.0, "seconds": 1.0}
        | {name: (i + 1) * (step + seed) / 3 for i, name in enumerate(runs.CURVES)}
        for step in range(1, 301)
        for seed in (0, 1)
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in log))
    return folder


def test_a_block_of_stored_runs_is_their_table(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    fake_run(tmp_path / "runs" / "x")
    assert main(["store", str(tmp_path / "runs"), "-o", str(tmp_path / "one.json")]) == 0
    monkeypatch.setattr(records, "RESULTS", tmp_path)
    block = "<!-- bench: paper:{} -->\n{}<!-- /bench -->\n"
    of_runs = runs.as_paper(tmp_path / "one.json")
    assert render.render(block.format("one", "old\n"), {}) == block.format("one", of_runs + "\n")
    (tmp_path / "bad.json").write_text("[{}]")
    for name in ("bad", "none"):
        with pytest.raises(UsageError, match=f"{name}.json"):
            render.render(block.format(name, ""), {})


def test_runs_are_stored_as_if_all_had_ended_with_the_first(tmp_path: pathlib.Path):
    long, short = (fake_run(tmp_path / "runs" / name, clip=clip) for name, clip in (("long", 0.1), ("short", 0.2)))
    rows = [line for line in (short / "metrics.jsonl").read_text().splitlines() if json.loads(line)["step"] <= 200]
    (short / "metrics.jsonl").write_text("\n".join(rows) + "\n")
    out = tmp_path / "both.json"
    assert main(["store", str(long), str(short), "-o", str(out), "--same-end"]) == 0
    both = runs.load(out)
    assert [run["steps"][-1] for run in both] == [200, 200]
    assert both[0]["table"] == both[1]["table"]


def test_curves_are_stored_with_as_many_points_as_asked_and_tables_come_from_all_rows(tmp_path: pathlib.Path):
    run = fake_run(tmp_path / "run")
    assert main(["store", str(run), "-o", str(tmp_path / "all.json")]) == 0
    assert main(["store", str(run), "-o", str(tmp_path / "two.json"), "--points", "2"]) == 0
    (every,), (two,) = (runs.load(tmp_path / f"{name}.json") for name in ("all", "two"))
    assert len(two["steps"]) == 2 < len(every["steps"]) and two["steps"][-1] == every["steps"][-1]
    assert two["table"] == every["table"]


def test_labels_say_what_sets_runs_apart(tmp_path: pathlib.Path):
    for clip in (0.1, 0.2):
        fake_run(tmp_path / "runs" / f"clip={clip}", clip=clip)
    runs.store([tmp_path / "runs"], tmp_path / "points.json")
    assert [run["label"] for run in runs.load(tmp_path / "points.json")] == ["happo clip=0.1", "happo clip=0.2"]


def test_mean_actions_are_those_of_the_last_evaluation(tmp_path: pathlib.Path):
    run = fake_run(tmp_path / "run", cost_limit=1)
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    steps = sorted({row["step"] for row in rows})
    for row in rows:
        row["cost_limit"] = 1.0
        if row["step"] in steps[:2]:  # long before the end, whose figures stay those of training
            at = steps.index(row["step"])
            row |= {"eval/episode_cost": 7.0 - 3 * at - 4 * row["seed"], "eval/episode_reward": 10.0 * at}
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    runs.store([run], tmp_path / "run.json")
    line = runs.as_mean_actions(tmp_path / "run.json").splitlines()[2]
    assert re.fullmatch(r"\| happo \| \d; 1 of 2 \| [\d.]+; 2\.00 \| [\d.]+; 10 \|", line)

    about = {name: rows[0][name] for name in ("task", "method")} | {"step": steps[-1], "cost_limit": 1.0}
    ended = [about | {"seed": seed, "episode_cost": 3.0 * seed, "episode_reward": 20.0} for seed in range(2)]
    final.write(run, ended)  # the one that ended the run
    runs.store([run], tmp_path / "run.json")
    line = runs.as_mean_actions(tmp_path / "run.json").splitlines()[2]
    assert re.fullmatch(r"\| happo \| \d; 1 of 2 \| [\d.]+; 1\.50 \| [\d.]+; 20 \|", line)


def test_seeds_within_are_judged_by_the_worst_agent(tmp_path: pathlib.Path):
    (run,) = [x for x in stored()["goals_point_1_h200"] if x["method"] == "f4sg"]
    (tmp_path / "run.json").write_text(json.dumps([run]))
    line = runs.as_mean_actions(tmp_path / "run.json").splitlines()[2]
    assert max(run["table"]["cost"]) <= run["cost_limit"] < max(run["table"]["worst agent"])
    assert "| 9; 8 of 10 |" in line


def test_seeds_within_are_judged_by_true_costs_where_few_were_noticed(tmp_path: pathlib.Path):
    """A tenth of the costs is noticed: 0.5 of a limit of 1, but 20 of 10 of them all."""
    run = fake_run(tmp_path / "run", cost_seen=0.1)
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    rows = [row | {"cost_limit": 1.0, "episode_cost": 0.5, "true_episode_cost": 20.0} for row in rows]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    runs.store([run], tmp_path / "run.json")
    (stored,) = runs.load(tmp_path / "run.json")
    assert stored["table"]["beyond"] == [10.0, 10.0] and stored["limits"] == [1.0]
    assert ", 0 of 2" in runs.as_summary(tmp_path / "run.json")


def test_a_table_of_methods_by_tasks_refuses_two_runs_of_one_cell(tmp_path: pathlib.Path):
    two = [run_of_three_seeds("f4sg", seen, [1.0]) for seen in (1.0, 0.5)]
    (tmp_path / "x.json").write_text(json.dumps(two))
    for kind in (runs.as_summary, runs.as_overview):
        with pytest.raises(UsageError, match="several runs of f4sg on lane"):
            kind(tmp_path / "x.json")


def test_a_method_of_a_file_has_a_line_in_every_table(tmp_path: pathlib.Path):
    run = run_of_three_seeds("mine", 1.0, [1.0, 2.0]) | {
        "label": "mine",
        "versions": {"device": "cpu", "engine": "xla"},
    }
    run["table"] |= {f"of mean actions: {name}": [1.0, 2.0] for name in ("cost", "reward")}
    (tmp_path / "x.json").write_text(json.dumps([run]))
    for kind in (runs.as_mean_actions, runs.as_overview, runs.as_summary, runs.as_paper):
        assert "1 of 1" not in kind(tmp_path / "x.json") and len(kind(tmp_path / "x.json").splitlines()) == 3


@pytest.mark.parametrize(("text", "says"), [("[]", "x.json holds no measurements"), ("[", "x.json is damaged")])
def test_files_that_cannot_be_compared_are_one_sentence(text: str, says: str, tmp_path: pathlib.Path, capsys):
    (tmp_path / "x.json").write_text(text)
    good = str(records.RESULTS / "ant.json")
    assert main(["compare", good, str(tmp_path / "x.json")]) == 2
    err = capsys.readouterr().err
    assert says in err and err.count("\n") == 1


def test_a_seed_that_broke_has_no_score(tmp_path: pathlib.Path):
    found = [run for run in stored()["recipe_ant_4x2_h200"] if len(run["seeds"]) == 5]
    one = next(run for run in found if run["method"] == "mixed")
    one["table"] = {column: [None, *scores[1:]] for column, scores in one["table"].items()}
    file = tmp_path / "broken.json"
    file.write_text(json.dumps(found))
    assert runs.as_paper(file).splitlines()[-1] == "| mixed pid | - | - | 4 of 5 | - | - | - |"
    assert "- / -, 4 of 5" in runs.as_summary(file)


def test_only_a_multiplier_is_called_pid(tmp_path: pathlib.Path):
    """The setting is in the configuration of every method, also where nothing reads it."""
    made = []
    for method in ("mappo", "macpo", "f4sg"):
        run = fake_run(tmp_path / method, lambda_kp=0.5)
        for file in (run / "config.toml", run / "metrics.jsonl"):
            file.write_text(file.read_text().replace("happo", method))
        made.append(run)
    runs.store(made, tmp_path / "rules.json")
    lines = runs.as_paper(tmp_path / "rules.json").splitlines()[2:]
    assert [line.split(" | ")[0] for line in lines] == ["| mappo", "| macpo", "| f4sg pid"]


def test_an_overview_has_multipliers_with_pid_only(tmp_path: pathlib.Path):
    """And "-" where a method of another task is missing."""
    for task, methods in {"lane": ("mappo", "f4sg", "mixed"), "switch": ("mappo", "f4sg")}.items():
        for method in methods:
            run = fake_run(tmp_path / task / method, lambda_kp=0.0 if method == "mixed" else 0.5)
            for file in (run / "config.toml", run / "metrics.jsonl"):
                file.write_text(file.read_text().replace("happo", method).replace("lane", task))
        runs.store([tmp_path / task], tmp_path / f"{task}.json")
    runs.store([tmp_path / "lane" / "mappo"], tmp_path / "mappo.json")
    head, _, *lines = runs.as_overview(tmp_path / "lane+switch.json").splitlines()
    assert head == "|  | `mappo` | `f4sg` |"
    assert [line.split(" | ")[0] for line in lines] == ["| `lane`", "| `switch`"]
    (lane, switch) = runs.as_overview(tmp_path / "mappo+switch.json").splitlines()[2:]
    assert lane.endswith(" | - |") and " - " not in switch
    *_, missing = runs.as_summary(tmp_path / "mappo+switch.json").splitlines()
    assert missing.startswith("| `f4sg` | - | ")


@pytest.mark.full
def test_paths_of_ants_are_stored_and_drawn(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    asked = []

    def record(folder: pathlib.Path, seed: int | None, number: int) -> SimpleNamespace:
        asked.append((str(folder), seed, number))
        walk = np.stack([np.arange(31.0), 2 * np.arange(31.0), np.ones(31)], axis=1)
        raw = {"torso_xpos": walk} if folder.name != "lane" else {}
        walls = {"x": "solid", "r4sg": "costly"}.get(folder.name, "reference")
        env = SimpleNamespace(spec=SimpleNamespace(name="lane"), walls=walls)
        return SimpleNamespace(raw=raw, env=env, reward_sum=np.array([1.0, 5.0]), cost_sum=np.array([0.0, 2.0]))

    monkeypatch.setattr(ant_paths, "record_run", record)
    monkeypatch.setattr(ant_paths, "EPISODES", 2)
    files = ["--json", str(tmp_path / "paths.json"), "--png", str(tmp_path / "paths.png")]
    point = tmp_path / "method=r4sg"  # as a sweep names its folders
    point.mkdir()
    ant_paths.main(["Who turns=runs/x@3", "hub:ant_2x4/r4sg", f"{point}@1", f"R4SG={point}", *files])
    places = [("runs/x", 3), ("hub:ant_2x4/r4sg", None), (str(point), 1), (str(point), None)]
    assert asked == [(*place, number) for place in places for number in (0, 1)]
    first, *others = json.loads((tmp_path / "paths.json").read_text())
    assert [first["title"], *(p["title"] for p in others)] == ["Who turns", "hub:ant_2x4/r4sg", str(point), "R4SG"]
    assert [first["walls"], *(p["walls"] for p in others)] == ["solid", "costly", "reference", "reference"]
    assert first["episodes"][0] == {"x": [0, 10, 20, 30], "y": [0, 20, 40, 60], "reward": 5.0, "cost": 2.0}
    ant_paths.main(files)  # again, of what is stored
    assert (tmp_path / "paths.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(SystemExit, match="2"):
        ant_paths.main(["runs/lane", *files])
    assert "paths are drawn of ants only" in capsys.readouterr().err


def test_costs_through_an_episode_are_measured_of_policies_that_exist(monkeypatch, tmp_path: pathlib.Path):
    asked = []

    def measure(task: str, method: str) -> list[float]:
        asked.append(f"hub:{task}/{method}")
        return [0.0, 1.0]

    monkeypatch.setattr(episode_cost, "measure", measure)
    monkeypatch.setattr(episode_cost, "STORED", tmp_path / "costs.json")
    monkeypatch.setattr(episode_cost, "PICTURE", tmp_path / "costs.png")
    monkeypatch.setattr(sys, "argv", ["episode_cost", "--measure"])
    episode_cost.main()
    assert len(asked) == 14 and set(asked) <= set(hub.names())  # of two tasks, seven methods each
    assert (tmp_path / "costs.png").read_bytes().startswith(b"\x89PNG")


def test_kernels_of_a_loop_are_its_bodys_instructions_without_bookkeeping():
    program = """
%body.1 (p: (s32[], f32[4])) -> (s32[], f32[4]) {
  %p = (s32[], f32[4]) parameter(0)
  %x = f32[4]{0} get-tuple-element(%p), index=1
  %y = f32[4]{0} fusion(%x), kind=kLoop, calls=%inner
  %start = ((f32[4]), f32[4]) copy-start(%y)
  %done = f32[4]{0} copy-done(%start)
  %z = f32[4]{0} custom-call(%done), custom_call_target="__cublas$gemm"
  ROOT %t = (s32[], f32[4]) tuple(%i, %z)
}

ENTRY %main (a: f32[4]) -> f32[4] {
  %w = (s32[], f32[4]) while(%init), condition=%cond.1, body=%body.1
}
"""
    assert update.kernels(program) == 3
    assert update.kernels("ENTRY %main (a: f32[4]) -> f32[4] {\n}\n") == 0


@pytest.mark.full
def test_a_gradient_step_is_timed_by_part():
    for case in BENCHES["update"].quick:
        row = update.update(case)
        assert row["minibatch"] > 0 and row["step_seconds"] > 0
        assert {"gather_seconds", "forward_seconds", "backward_seconds", "adam_seconds"} <= row.keys()


# ---------------------------------------------------------------------------------------------------------------------
# The study's tables


CURVED = ("steps", "true_step_cost", "true_episode_cost", "episode_reward", "episode_cost", "violation_rate", "lambda")


def run_of_three_seeds(method: str, seen: float, true_cost: list[float], **settings: float) -> dict:
    """A run of three seeds and ten points whose true episode cost is constant."""
    points, seeds = 10, len(true_cost)
    config = {"cost_seen": seen, "lambda_init": 2.0, "method": method} | settings
    curve = {name: [[1.0] * points] * seeds for name in ("episode_reward", "episode_cost", "violation_rate", "lambda")}
    return {
        "steps": list(range(10, 110, 10)),
        "seeds": list(range(seeds)),
        **curve,
        "episode_length": [[1.0] * points] * seeds,
        "true_episode_cost": [[x] * points for x in true_cost],
        "true_step_cost": [[x / 100] * points for x in true_cost],
        "table": {
            "reward": [1.0] * seeds,
            "cost": [1.0] * seeds,
            "true cost": true_cost,
            "true cost per 1,000 steps while training": [10 * x for x in true_cost],
        },
        "source": "training",
        "task": "lane",
        "method": method,
        "cost_limit": 5.0 * seen,
        "seconds": 1.0,
        "config": "\n".join(f"{k} = {json.dumps(v)}" for k, v in config.items()),
    }


def test_a_probe_compares_fear_where_all_else_is_equal(tmp_path: pathlib.Path):
    """The tables of README and study: a line a comparison; the harm is corrected over lines, the others within one."""
    low, high = list(np.linspace(1, 2, 12)), list(np.linspace(8, 9, 12))
    often = [run_of_three_seeds("f4sg", 0.5, low), run_of_three_seeds("macpo", 0.5, high)]
    (tmp_path / "x.json").write_text(json.dumps([*often, run_of_three_seeds("mappo_l", 0.5, high)]))
    always = [run_of_three_seeds(method, 1.0, low) for method in ("mappo_l", "f4sg")]
    alone = [run_of_three_seeds("f4sg", 0.1, low), run_of_three_seeds("mappo_l", 0.1, low, lambda_init=3.0)]
    other = run_of_three_seeds("f4sg", 0.1, low) | {"task": "noisy"}
    (tmp_path / "y.json").write_text(json.dumps([*always, *alone, other]))
    table = study.as_probe(tmp_path / "x+y.json")
    rows = [[x.strip() for x in line.split("|")[1:-1]] for line in table.splitlines()[2:]]
    assert [row[:3] for row in rows] == [["`lane`", "0.5", "5"], ["`lane`", "1", "5"]]
    assert [row[6] for row in rows] == ["85.0±3.3, 15.0±3.3", "15.0±3.3, 15.0±3.3"]  # nothing rises
    assert [row[-2] for row in rows] == ["12 of 12, 0 of 12", "0 of 12, 0 of 12"]
    assert [row[-1] for row in rows] == ["< .001, < .001, 1", "1, 1, 1"]
    assert rows[0][5].startswith("-70.0 [") and rows[1][5].startswith("0.0 [")


def test_runs_that_differ_in_their_seeds_are_one(tmp_path: pathlib.Path):
    first, ours = run_of_three_seeds("mappo_l", 0.5, [10.0, 12.0]), run_of_three_seeds("r4sg", 0.5, [10.0, 12.0])
    more = run_of_three_seeds("mappo_l", 0.5, [14.0]) | {"seeds": [7]}
    longer = run_of_three_seeds("mappo_l", 0.5, [50.0]) | {"seeds": [8], "steps": list(range(20, 220, 20))}
    (tmp_path / "x.json").write_text(json.dumps([first, ours]))
    (tmp_path / "y.json").write_text(json.dumps([more]))
    (whole,) = [run for run in study.joined(runs.load(tmp_path / "x+y.json")) if run["method"] == "mappo_l"]
    assert whole["seeds"] == [0, 1, 7] and len(whole["true_step_cost"]) == 3
    assert study.measures(whole)["end"].tolist() == [10.0, 12.0, 14.0]
    assert " -8.3 [" in study.as_equivalence(tmp_path / "x+y.json")  # 110 of 120
    assert len(study.joined([first, first, longer])) == 2


def test_the_harm_is_corrected_over_all_lines(tmp_path: pathlib.Path):
    rng = np.random.default_rng(0)
    samples = [(rng.normal(5, 1, 12).tolist(), rng.normal(5 + shift, 1, 12).tolist()) for shift in (0.3, 1, 1.5)]
    found = [
        run_of_three_seeds(method, seen, cost)
        for seen, pair in zip((0.1, 0.2, 0.3), samples, strict=True)
        for method, cost in zip(("mappo_l", "f4sg"), pair, strict=True)
    ]
    (tmp_path / "x.json").write_text(json.dumps(found))
    lines = study.as_probe(tmp_path / "x.json").splitlines()[2:]
    p = [study.welch_test(10 * np.array(ours), 10 * np.array(theirs)) for theirs, ours in samples]
    expected = [study.p_value(x) for x in study.holm(p)]
    assert [line.split("|")[-2].split(",")[0].strip() for line in lines] == expected != [study.p_value(x) for x in p]


def test_early_harm_ends_with_the_first_point_near_the_last_reward():
    """A reward that rises to 9 reaches four fifths of its way at the ninth point of ten; one that falls, too."""
    run = run_of_three_seeds("f4sg", 0.5, [0.0, 0.0])
    run["episode_reward"] = [[float(x) for x in range(10)], [None, *(-float(x) for x in range(9))]]
    run["true_step_cost"] = [[0.9] + [0.0] * 9, [*[0.0] * 9, 1.0]]
    assert study.early(run) == pytest.approx([100.0, 0.0])


def test_lines_of_one_task_are_named_by_what_they_differ_in():
    def pair(limit: float = 5.0, **settings: float) -> tuple[dict, dict]:
        runs_of_pair = [run_of_three_seeds(method, 0.5, [1.0], **settings) for method in study.PAIR]
        return tuple(run | {"cost_limit": limit / 2} for run in runs_of_pair)  # type: ignore[return-value]

    slow, fast = pair(lambda_lr=1.0), pair(lambda_lr=10.0)
    assert study.line_names([slow]) == ["`lane`"]
    assert study.line_names([slow, fast]) == ["`lane`, `lambda_lr` 1", "`lane`, `lambda_lr` 10"]
    assert study.line_names([slow, pair(3.0, lambda_lr=1.0)]) == ["`lane`, limit 5", "`lane`, limit 3"]
    other = tuple(run | {"task": "switch"} for run in fast)
    assert study.line_names([slow, other]) == ["`lane`", "`switch`"]
    assert study.line_names([slow, fast, other])[2] == "`switch`, `lambda_lr` 10", "all have it if one differs"


def test_the_worst_agent_is_judged_where_agents_differ():
    run = run_of_three_seeds("f4sg", 1.0, [1.0, 2.0])
    run["table"]["true worst agent"] = [4.0, 6.0]
    assert study.unsafe(run) == "1 of 2"


def test_the_readmes_harm_is_that_of_the_study(tmp_path: pathlib.Path):
    cells = [(method, cost) for method, cost in (("mappo_l", [8.0, 9.0]), ("f4sg", [2.0, 3.0]))]
    (tmp_path / "x.json").write_text(json.dumps([run_of_three_seeds(method, 0.5, cost) for method, cost in cells]))
    long, short = (kind(tmp_path / "x.json").splitlines()[2] for kind in (study.as_probe, study.as_harm))
    for cell in ("85.0±7.1", "25.0±7.1", "-71 %"):
        assert cell in long and cell in short
    assert short.endswith("| 2 of 2, 0 of 2 |")


def test_the_readmes_harm_is_under_the_better_multiplier(tmp_path: pathlib.Path):
    """A line a task: the multiplier under which MAPPO-L does less harm, named, with p corrected over both."""
    costs = {
        (1.0, "mappo_l"): [8.0, 9.0],
        (1.0, "f4sg"): [1.0, 2.0],
        (10.0, "mappo_l"): [5.0, 6.0],
        (10.0, "f4sg"): [4.0, 4.5],
    }
    stored = [run_of_three_seeds(method, 0.5, cost, lambda_lr=rate) for (rate, method), cost in costs.items()]
    (tmp_path / "x.json").write_text(json.dumps(stored))
    (line,) = study.as_harm(tmp_path / "x.json").splitlines()[2:]
    assert line.startswith("| `lane`, `lambda_lr` 10 | 55.0±7.1 | 42.5±3.5 |")
    slow, fast = (
        study.welch_test(*(10 * np.array(costs[rate, name]) for name in ("f4sg", "mappo_l"))) for rate in (1.0, 10.0)
    )
    assert study.p_value(study.holm([slow, fast])[1]) in line


def test_controls_are_compared_where_all_have_run(tmp_path: pathlib.Path):
    """Up to the end of the shortest run; a line each, against F4SG and against MAPPO-L; what did not run has none."""
    stored = []
    for cost, name in enumerate([*study.CONTROLS][:6], 1):
        run = run_of_three_seeds("f4sg" if name == "current" else name, 0.5, [2.0 * cost, 3.0 * cost, 4.0 * cost])
        run |= {"label": name, "true_step_cost": [[*x[:5], *[9.0] * 5] for x in run["true_step_cost"]]}
        stored.append(run)
    short = stored[-1]
    short |= {name: x[:5] if name == "steps" else [y[:5] for y in x] for name, x in short.items() if name in CURVED}
    elsewhere, noticed = run_of_three_seeds("f4sg", 0.5, [0.0]), run_of_three_seeds("f4sg", 1.0, [0.0])
    (tmp_path / "x.json").write_text(json.dumps([*stored, elsewhere | {"task": "switch"}, noticed]))
    lines = [line.split(" | ") for line in study.as_controls(tmp_path / "x.json").splitlines()[2:]]
    assert [line[1] for line in lines[:2]] == ["30.0±10.0", "60.0±20.0"]  # what is after the fifth point is not
    assert lines[0][2:4] == ["-", "-"] and lines[1][2] == "-" and lines[1][3].startswith("30.0 [")
    assert [line[-1].rstrip(" |") for line in lines] == [f"{x} of 3" for x in (0, 2, 3, 3, 3, 3)]


def test_controls_on_several_tasks_name_them(tmp_path: pathlib.Path):
    """Of tasks on which MAPPO-L and F4SG alone have run, there is none."""
    spread = np.linspace(0, 0.1, 6)
    cells = [
        run_of_three_seeds(method, 0.5, list(mean + spread)) | {"task": task}
        for task, methods in (
            ("lane", ("mappo_l", "f4sg", "macpo")),
            ("noisy", study.PAIR),
            ("switch", ("f4sg", "r4sg")),
        )
        for mean, method in enumerate(methods, 1)
    ]
    (tmp_path / "x.json").write_text(json.dumps([run | {"label": run["method"]} for run in cells]))
    (tmp_path / "y.json").write_text(
        json.dumps([run_of_three_seeds("mappo_l", 0.5, list(2 + spread)) | {"task": "switch"}])
    )
    head, _, *lines = study.as_controls(tmp_path / "x+y.json").splitlines()
    assert head.startswith("| task |  | harm") and len(lines) == 6
    assert [line.split(" | ")[0] for line in lines] == ["| `lane`"] * 3 + ["| `switch`"] * 3
    assert [line.split(" | ")[1] for line in lines[3:]] == ["MAPPO-L", "F4SG", "R4SG"]
    assert lines[5].split(" | ")[4].startswith("0.0 [") and lines[5].split(" | ")[4].endswith(", 1")


def test_equivalence_is_what_an_interval_within_the_bounds_shows(tmp_path: pathlib.Path):
    """The mean's interval at 90 % is within 10 % of 100 +- 1, and is not of 100 +- 20; constant rewards are equal."""
    for costs, words in (([9.9, 10.0, 10.1], "yes"), ([8.0, 10.0, 12.0], "not shown")):
        cells = [run_of_three_seeds(method, 0.5, costs) for method in ("mappo_l", "r4sg")]
        (tmp_path / "x.json").write_text(json.dumps(cells))
        line = study.as_equivalence(tmp_path / "x.json").splitlines()[2]
        assert line.startswith("| `lane` | 0.5 | 3 | 0.0 [0.0, 0.0] | yes | 0.0 [") and line.endswith(f"] | {words} |")


def test_a_printed_table_is_shown_with_what_made_it(tmp_path: pathlib.Path):
    row = {"task": "lane", "method": "mappo", "seeds": 20, "steps": 10_004_480, "limit": 10.0}
    row |= {"reward": [1234.4, 1200.0, 1300.0], "cost": [2.345, 2.0, 3.0], "within": 19}
    timed = {"command": "pmt y", "device": "GPU", "devices": 1, "seconds": 30, "runs": 5}
    made = {"command": "pmt x", "device": "GPU", "devices": 2, "seconds": 90, "rows": [row], "timed": [timed]}
    (tmp_path / "x.json").write_text(json.dumps(made))
    title, _, head, _, line = runs.as_printed(tmp_path / "x.json").splitlines()
    assert title.startswith("`pmt x`, 20 runs of 10 M steps in 1.5 minutes on 2 x GPU; `pmt y`, 5 runs of 10 M")
    assert title.endswith(" in 0.5 minutes on 1 x GPU, all compiling included:")
    assert "`lane` (limit 10)" in head and line == "| `mappo` | 1,234 [1,200, 1,300] / 2.35, 19 of 20 |"


def wrapped(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The controls, in force until the test ends."""
    before = fear.appraise_fear, learner.gae
    controls = importlib.import_module("bench.controls")
    fear.appraise_fear, learner.gae = before
    monkeypatch.setattr(fear, "appraise_fear", controls.appraise_fear)
    monkeypatch.setattr(learner, "gae", controls.gae)
    return controls


def test_controls_change_what_they_say_and_nothing_else(monkeypatch: pytest.MonkeyPatch):
    """A trace of `gae_lambda` is MAPPO-Lagrangian, bit for bit; each control differs from what it controls."""
    controls = wrapped(monkeypatch)

    def trained(method: str) -> Any:
        config = load_config("lane", method=method, num_envs=8, rollout_length=16, steps=8 * 16 * 3, log_interval=1)
        return jax.jit(make_train(config))(jax.random.key(0))[1]

    monkeypatch.setitem(METHODS, "usual_trace", dataclasses.replace(controls.trace_99, cost_trace=0.95))
    for name in ("squared", "monte_carlo"):
        monkeypatch.setitem(METHODS, name, getattr(controls, name))
    found = {name: trained(name) for name in ("mappo_l", "usual_trace", "monte_carlo", "f4sg", "squared")}
    jax.tree.map(np.testing.assert_array_equal, found["mappo_l"], found["usual_trace"])
    assert (found["monte_carlo"]["actor/loss"] != found["mappo_l"]["actor/loss"]).any()
    assert found["squared"]["fear/loss"][0] != found["f4sg"]["fear/loss"][0]
    np.testing.assert_allclose(jax.grad(lambda x: controls.squared_error(x, jnp.float32(0.5)))(0.0), 0.0)


def test_a_target_only_control_takes_advantages_from_costs_and_returns_from_fear(monkeypatch: pytest.MonkeyPatch):
    controls, plain_gae = wrapped(monkeypatch), advantages.gae
    felt, cost, value, after = jax.random.uniform(jax.random.key(0), (4, 5, 2, 3, 1))
    ends = (jnp.zeros((5, 2), bool), jnp.zeros((5, 2), bool), 0.9, 0.8)
    controls._traced.update(method=controls.target_only, cost=cost)
    advantage, returns = controls.gae(felt, value, after, *ends)
    np.testing.assert_array_equal(advantage, plain_gae(cost, value, after, *ends)[0])
    np.testing.assert_array_equal(returns, plain_gae(felt, value, after, *ends)[1])
