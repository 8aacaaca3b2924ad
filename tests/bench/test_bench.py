"""`python -m bench`: what runs, how figures are compared, and that the documentation shows the committed results."""

from __future__ import annotations

import json
import pathlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bench import compare, curves, paths, records, render, suite, tables
from bench.__main__ import main
from pmt_jax.studies import table

FAKE = """
import json, os, signal, sys
what, out = sys.argv[1], sys.argv[-1]
if what == "interrupted":
    os.kill(os.getppid(), signal.SIGINT)
report = {"device": "cpu", "versions": {}, "rows": [{"task": "lane", "steps_per_second": 100}]}
open(out, "w").write(json.dumps(report))
sys.exit(3 if what == "failing" else 0)
"""


def report(device: str = "cpu", cpu: str = "A", **figures: Any) -> compare.Report:
    return {"device": device, "machine": {"cpu": cpu, "threads": 2}, "versions": {}, "rows": [{"task": "x", **figures}]}


@pytest.fixture
def fakes(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    """Replaces the benches by ones that write, fail or interrupt, as their names say; gives a folder for results."""
    (tmp_path / "fake_bench.py").write_text(FAKE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def replace(*names: str) -> pathlib.Path:
        monkeypatch.setattr(suite, "BENCHES", {n: suite.Bench(f"does {n}", f"fake_bench {n}", "") for n in names})
        return tmp_path / "results"

    return replace


def test_one_that_fails_does_not_stop_the_others(
    fakes, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    out = fakes("first", "failing", "last")
    old = report() | {"machine": {}, "rows": [{"task": "lane", "steps_per_second": 200}]}
    monkeypatch.setattr(suite, "_committed", lambda say: {"last": old})
    assert main(["all", "--out", str(out)]) == 1
    assert sorted(path.name for path in out.iterdir()) == ["failing.json.unfinished", "first.json", "last.json"]
    said = capsys.readouterr().out
    assert "[3/3] last: does last" in said and "failed: failing" in said
    assert "first: nothing older" in said and "0.50 x  lane: steps_per_second: 200 -> 100  <- worse" in said


def test_ctrl_c_keeps_what_is_finished(fakes):
    out = fakes("first", "interrupted", "last")
    assert main(["all", "--out", str(out)]) == 130
    assert json.loads((out / "first.json").read_text())["rows"]
    assert not (out / "interrupted.json").exists() and not (out / "last.json").exists()


@pytest.mark.parametrize(
    ("count", "device", "skipped"),
    [(1, "cpu", ["no GPU", "no GPU"]), (1, "NVIDIA H200", ["one GPU only"]), (2, "NVIDIA H200", [])],
)
def test_what_a_machine_lacks_is_skipped(
    fakes, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], count: int, device: str, skipped: list
):
    out = fakes("first", "second", "third")
    for name, on in (("second", "gpu"), ("third", "gpus")):
        monkeypatch.setitem(suite.BENCHES, name, suite.BENCHES[name]._replace(on=on))
    monkeypatch.setattr(suite, "_devices", lambda: (count, device))
    assert main(["all", "--out", str(out)]) == 0
    names = ["first", "second_h200", "third_h200"][: 3 - len(skipped)]
    assert sorted(path.stem for path in out.iterdir()) == names
    said = capsys.readouterr().out
    assert [line.split("there is ")[1] for line in said.splitlines() if "skipped" in line] == [
        f"{x} here" for x in skipped
    ]


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["al"], "unknown command 'al'; did you mean 'all'?"),
        (["all", "--only", "grid,throughputs"], "unknown bench 'throughputs'; did you mean 'throughput'?"),
        (["compare", "nowhere", "HEAD"], "'nowhere' is neither a file of results, a folder of them nor a git revision"),
        (["all", "--quick", "--out", str(compare.RESULTS)], "figures of --quick do not belong in bench/results"),
    ],
)
def test_a_mistake_is_one_sentence(argv: list[str], said: str, capsys: pytest.CaptureFixture[str]):
    assert main(argv) == 2
    captured = capsys.readouterr()
    assert said in captured.err and captured.err.count("\n") == 1 and not captured.out


def test_ratios_are_below_one_for_what_became_worse():
    old = report(steps_per_second=100.0, update_seconds=2.0, memory_gb=1.0, of_plain=0.5)
    new = report(steps_per_second=50, update_seconds=4.0, memory_gb=0.8, of_plain=0.1)
    found = {change.figure: change for change in compare.changes(old, new)}
    assert found["x: steps_per_second"].ratio == 0.5  # half as many steps: worse
    assert found["x: update_seconds"].ratio == 0.5  # twice the seconds: worse
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
    records.write(out, [{"task": "lane", "steps_per_second": 7}], ("scipy",), settings={"repeats": 1})
    written = compare.load(str(out))["lane"]
    assert {"machine", "device", "versions", "commit", "date", "load_average", "seconds"} <= set(written)
    assert written["versions"]["scipy"] and written["settings"] == {"repeats": 1}
    assert records.read(out) == written["rows"] and [c.ratio for c in compare.changes(written, written)] == [1.0]


def test_rows_about_the_same_thing_stay_apart():
    twice = report(steps_per_second=1) | {"rows": [{"task": "x", "steps_per_second": n} for n in (1, 2)]}
    assert list(compare.figures(twice).values()) == [1, 2]


@pytest.mark.parametrize("path", render.documents(), ids=lambda path: path.name)
def test_documents_show_the_committed_results(path: pathlib.Path):
    reports = compare.load(str(compare.RESULTS))
    assert render.render(path.read_text(), reports) == path.read_text(), "run python -m bench render"


def test_rendering_replaces_blocks_and_nothing_else():
    reports = compare.load(str(compare.RESULTS))
    text = "before\n<!-- bench: starts -->\nold\n<!-- /bench -->\nafter\n"
    rendered = render.render(text, reports)
    assert rendered.startswith("before\n<!-- bench: starts -->\n`pmt train") and rendered.endswith("-->\nafter\n")
    assert "old" not in rendered and render.render(rendered, reports) == rendered
    for broken in ("<!-- bench: start -->\n<!-- /bench -->", "<!-- bench: starts -->\n"):
        with pytest.raises(compare.UsageError):
            render.render(broken, reports)


def test_paths_of_ants_are_stored_and_drawn(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    asked = []

    def record(folder: pathlib.Path, seed: int | None, number: int) -> SimpleNamespace:
        asked.append((str(folder), seed, number))
        walk = np.stack([np.arange(31.0), 2 * np.arange(31.0), np.ones(31)], axis=1)
        raw = {"torso_xpos": walk} if folder.name != "lane" else {}
        spec = SimpleNamespace(spec=SimpleNamespace(name="lane"))
        return SimpleNamespace(raw=raw, env=spec, reward_sum=np.array([1.0, 5.0]), cost_sum=np.array([0.0, 2.0]))

    monkeypatch.setattr(paths, "record_run", record)
    stored, drawn = tmp_path / "paths.json", tmp_path / "paths.png"
    point = tmp_path / "method=r4sg"  # as a sweep names its folders
    point.mkdir()
    wanted = ["Who turns=runs/x@3", "hub:ant_2x4/r4sg", f"{point}@1", f"R4SG={point}"]
    monkeypatch.setattr("sys.argv", ["bench.paths", *wanted, "--episodes", "2", "--json", str(stored)])
    paths.main()
    places = [("runs/x", 3), ("hub:ant_2x4/r4sg", None), (str(point), 1), (str(point), None)]
    assert asked == [(*place, number) for place in places for number in (0, 1)]
    first, *others = json.loads(stored.read_text())
    assert [first["title"], *(p["title"] for p in others)] == ["Who turns", "hub:ant_2x4/r4sg", str(point), "R4SG"]
    assert first["episodes"][0] == {"x": [0, 10, 20, 30], "y": [0, 20, 40, 60], "reward": 5.0, "cost": 2.0}
    monkeypatch.setattr("sys.argv", ["bench.paths", "--from", str(stored), "--png", str(drawn)])
    paths.main()
    assert drawn.read_bytes().startswith(b"\x89PNG")
    for mistake in (["runs/lane"], []):
        monkeypatch.setattr("sys.argv", ["bench.paths", *mistake])
        with pytest.raises(SystemExit, match="2"):
            paths.main()


def test_a_block_of_curves_is_the_table_of_their_runs(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.toml").write_text('task = "lane"\nmethod = "happo"\nseeds = 2\n')
    (run / "versions.json").write_text("{}")
    names = ("episode_reward", "episode_cost", "violation_rate", "lambda", "episode_length")
    log = [
        {"step": step, "seed": seed, "task": "lane", "method": "happo", "cost_limit": 2.0, "seconds": 1.0}
        | {name: (i + 1) * (step + seed) / 3 for i, name in enumerate(names)}
        for step in range(1, 301)
        for seed in (0, 1)
    ]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in log))
    (tmp_path / "two.json").write_text(json.dumps([curves.compact(run)]))
    monkeypatch.setattr(render, "RESULTS", tmp_path)
    block = "<!-- bench: curves:two -->\n{}<!-- /bench -->\n"
    of_runs = table.render(table.rows([run]), "markdown").split("\n\n")[0]
    assert render.render(block.format("old\n"), {}) == block.format(of_runs + "\n")
    (tmp_path / "two.json").write_text("[{}]")
    for name in ("two", "none"):
        with pytest.raises(compare.UsageError, match=f"{name}.json"):
            render.render(block.format("").replace("two", name), {})


def test_tables_of_a_gpu():
    rows = [
        {
            "task": "ant_2x4",
            "method": "mappo_l",
            "physics": "warp",
            "seeds": seeds,
            "num_envs": 2048,
            "rollout_length": 8,
        }
        | {"steps_per_second": rate, "update_seconds": took, "compile_seconds": 9.0, "memory_gb": 3.0}
        for seeds, rate, took in ((1, 90_000, 0.2), (5, 230_000, 0.36))
    ]
    alone = [
        {
            "task": "ant_2x4",
            "physics": "warp",
            "seeds": 1,
            "batch": 16_384,
            "steps_per_second": 4,
            "compile_seconds": 1,
        },
        {"task": "ant_2x4", "physics": "warp", "seeds": 5, "batch": 5120, "steps_per_second": 3, "compile_seconds": 1},
        {"task": "voltage_33", "seeds": 1, "batch": 65_536, "failed": "OutOfMemory: too much"},
    ]
    head = {"device": "NVIDIA H200", "versions": {"jax": "1"}}
    reports = {"loop_h200": {**head, "rows": rows}, "engines_h200": {**head, "rows": alone}}
    assert "| 230,000 | 0.360 | 1.8 | 9.0 |" in tables.TABLES["loop"](reports)
    assert "failed: OutOfMemory" in tables.TABLES["engines"](reports)
    said = tables.TABLES["targets_h200"](reports).splitlines()
    assert "| ant_2x4, warp, seeds 1, batch 16,384 | `steps_per_second` | >= 500,000 | 4 | **no** |" in said
    assert any("`times_one_seed` | <= 1.5 | 1.8 | **no** |" in line for line in said)
    assert any(line.startswith("| voltage_33") and "| failed | **no** |" in line for line in said)
    assert any(line.startswith("| voltage_141") and "not measured yet | - |" in line for line in said)
