"""`python -m bench peers`: turns become rows, and a peer that is missing is a sentence."""

from __future__ import annotations

import json
import pathlib
import sys

import pytest

from bench import records
from bench.__main__ import main
from bench.peers import contest
from bench.peers.contest import PEERS, Peer, figures, row
from bench.peers.learners import Arguments, ippo_mabrax
from bench.peers.report import Report
from bench.tables import speed
from pmt_jax import load_config
from pmt_jax.errors import UsageError

# A peer that takes a second for each of its updates of 100 steps, but in its second turn half of one.
FAKE = """
import json, sys
name, out, seed = sys.argv[1], sys.argv[3], int(sys.argv[7])
if name == "absent":
    lines = [{"failed": "needs torch, which is not installed: pip install 'pmt-jax[peers]'"}]
elif name == "broken":
    sys.exit("ValueError: too much")
else:
    lines = [{"physics": "fake"}]
    lines += [{"time": 1e9 + i / (1 + seed), "steps": 100 * i, "reward": i, "cost": 2} for i in range(1, 8)]
    lines += [{"other_work_cpus": 0.5}]
open(out, "w").write("\\n".join(map(json.dumps, lines)))
"""


def test_peers_take_turns_and_what_is_missing_is_a_sentence(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "fake.py").write_text(FAKE)
    names = {"mappo_l": "pmt train, MAPPO-L", "other": "other", "absent": "absent", "broken": "broken"}
    monkeypatch.setattr(contest, "COMMAND", (sys.executable, str(tmp_path / "fake.py")))
    monkeypatch.setattr(contest, "FULL", contest.Effort(2, 6.0, 1.0))
    monkeypatch.setattr(contest.runner, "devices", lambda: (1, "cpu"))
    monkeypatch.setattr(
        contest, "PEERS", {key: Peer(x, "ant_2x4", "1 actor", lambda *_: None) for key, x in names.items()}
    )
    assert main(["peers", "--out", str(tmp_path / "peers.json")]) == 0
    report = records.load(tmp_path / "peers.json")["peers"]
    ours, other, absent, broken = report["rows"]
    assert (ours["physics"], ours["rates"], ours["steps_per_second"]) == ("fake", [100.0, 200.0], 150.0)
    assert ours["rewards"] == [7.0, 7.0] and ours["other_work_cpus"] == 0.5 and report["load_average"]
    assert absent["failed"].startswith("needs torch") and broken["failed"] == "ValueError: too much"
    shown = speed.TABLES["peers"]({"peers": report})
    assert "| other | ant_2x4 | fake | 150 | 1.00 | 7.00 (7.00 to 7.00) |" in shown
    assert "| absent | ant_2x4 | - | failed: needs torch, which is not installed | - |" in shown


def test_reward_is_of_the_last_tenth_and_compiling_counts_apart():
    updates = [{"time": 10.0 + t, "steps": 50 * t, "reward": t} for t in range(1, 11)]
    found = figures([{"begin": 4.0}, {"physics": "x"}, *updates, {"other_work_cpus": 0.1}], seconds=9.0)
    assert found["first_update_seconds"] == 7.0 and found["rate"] == 50.0 and found["reward"] == 10.0
    assert "cost" not in found
    assert "failed" in figures([{"begin": 0.0}, updates[0]], seconds=9.0)


def test_jaxmarl_needs_its_trainer(tmp_path: pathlib.Path):
    report = Report(tmp_path / "lines", 1.0)
    with pytest.raises(UsageError, match="clone of github.com/FLAIROx/JaxMARL: name its folder with --jaxmarl"):
        ippo_mabrax(Arguments(load_config("lane"), None), report)


def test_a_report_leaves_out_what_is_unknown(tmp_path: pathlib.Path):
    report = Report(tmp_path / "lines", 100.0)
    report(10, float("nan"), 2)
    (line,) = map(json.loads, (tmp_path / "lines").read_text().splitlines())
    assert (line["steps"], line.get("reward"), line["cost"]) == (10, None, 2.0)


def test_every_peer_says_what_its_update_is():
    found = [row(peer, {}, [{"failed": "x"}]) for peer in PEERS.values()]
    assert len({peer["name"] for peer in found}) == len(PEERS) == 7 and all(peer["networks"] for peer in found)
