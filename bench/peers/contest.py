"""Peers take turns, each in a process of its own; their turns become the rows of one result."""

from __future__ import annotations

import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from .. import once, records, runner
from ..records import Record
from . import learners
from .report import Report

Lines = list[dict[str, Any]]
SIZES = ("num_envs", "rollout_length", "epochs", "minibatches")
COMMAND = (sys.executable, "-m", "bench.peers")
COMPILING = 600.0  # seconds that a turn may take more than its own


class Peer(NamedTuple):
    """A program to train with.

    Attributes:
      task: what it trains on; only the rewards of one task can be compared.
      networks: what an update fits, and from what.
      learn: trains until its time is up; method: that its settings are of.
    """

    name: str
    task: str
    networks: str
    learn: Callable[[learners.Arguments, Report], None]
    method: str = "mappo_l"


class Effort(NamedTuple):
    """Turns of each peer (each has a seed of its own); seconds of a turn on the task, and of one without its reward."""

    turns: int
    seconds: float
    elsewhere: float


FULL, QUICK = Effort(1, 15.0, 8.0), Effort(1, 5.0, 3.0)
_EACH = "2 actors, 2 critics of 128-128; cost"
PEERS = {
    "plain": Peer("Python loops over C MuJoCo", f"{learners.TASK}, random actions", "none", learners.plain),
    "mappo": Peer("pmt train, MAPPO", learners.TASK, "1 actor, 1 critic of 128-128; no cost", learners.ours, "mappo"),
    "mappo_l": Peer("pmt train, MAPPO-L", learners.TASK, _EACH, learners.ours),
    "torch": Peer("PyTorch MAPPO-L, to_gymnasium", learners.TASK, _EACH, learners.torch),
    "brax": Peer("brax PPO, to_brax", learners.TASK, "1 actor, 1 critic of 128-128; no cost", learners.brax),
    "ippo": Peer("JaxMARL IPPO, to_jaxmarl", learners.TASK, "1 actor, 1 critic of 64-64; no cost", learners.ippo),
    "mabrax": Peer("JaxMARL IPPO", "MABrax ant_4x2", "1 actor, 1 critic of 64-64; no cost", learners.ippo_mabrax),
}


def run(out: pathlib.Path | None, quick: bool, jaxmarl: pathlib.Path | None, say: Callable[[str], None]) -> int:
    """Runs all peers by turns and writes the result; 0 if at least ours have run.

    Args:
      out: a JSON file; None for bench/results/peers.json (on a GPU with its name), with `quick` for a new folder.
      jaxmarl: the folder of a clone of JaxMARL.

    Raises:
      UsageError: figures of `quick` would replace the real ones.
    """
    _, device = runner.devices()
    effort = QUICK if quick else FULL
    folder = runner.folder(out.parent if out else None, quick)
    out = out or folder / ("peers.json" if device == "cpu" else f"peers_{runner.slug(device)}.json")
    shape = (16, 16) if quick else (64, 64) if device == "cpu" else (2048, 8)
    sizes: dict[str, int] = dict(zip(SIZES, (*shape, 5, 8), strict=True))
    flags = " --quick" * quick + " --jaxmarl FOLDER" * bool(jaxmarl)
    turns: dict[str, list[Record]] = {name: [] for name in PEERS}
    caches = tempfile.TemporaryDirectory()  # of compiled programs and kernels, empty in a peer's first turn
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # naming the device then takes no memory
    for turn in range(effort.turns):
        for name, peer in PEERS.items():
            if turns[name] and "failed" in turns[name][-1]:
                continue
            for cache in ("JAX_COMPILATION_CACHE_DIR", *once.CACHES):
                os.environ[cache] = str(pathlib.Path(caches.name) / name / cache)
            seconds = effort.seconds if peer.task == learners.TASK else effort.elsewhere
            turns[name].append(figures(_turn(name, seconds, turn, sizes, jaxmarl), seconds))
            say(f"[{turn + 1}/{effort.turns}] {peer.name}: {turns[name][-1]}")
        rows = [row(peer, sizes, turns[name]) for name, peer in PEERS.items()]
        records.write(out, rows, f"python -m bench peers{flags}")
    say(f"in {out}")
    return int("failed" in turns["mappo_l"][-1])


def _turn(name: str, seconds: float, seed: int, sizes: dict[str, int], jaxmarl: pathlib.Path | None) -> Lines:
    """What a peer reports in a process of its own, below a line that says when that began."""
    with tempfile.TemporaryDirectory() as folder:
        lines, errors = pathlib.Path(folder) / "lines", pathlib.Path(folder) / "errors"
        words = [*COMMAND, name, "--out", str(lines), "--seconds", str(seconds), "--seed", str(seed)]
        words += [f"--{size}={count}" for size, count in sizes.items()] + ([f"--jaxmarl={jaxmarl}"] if jaxmarl else [])
        begin = time.time()
        with errors.open("w") as said:
            try:
                code = subprocess.run(
                    words,
                    stdout=subprocess.DEVNULL,
                    stderr=said,
                    timeout=seconds + COMPILING,
                    check=False,
                ).returncode
            except subprocess.TimeoutExpired:
                return [{"failed": f"not ready after {COMPILING:.0f} s"}]
        found = [json.loads(line) for line in lines.read_text().splitlines()] if lines.exists() else []
        if code:
            found.append({"failed": (errors.read_text().strip().splitlines() or [f"exit code {code}"])[-1][:200]})
        return [{"begin": begin}, *found]


def figures(lines: Lines, seconds: float) -> Record:
    """A turn's facts and figures: the rate after the first update, reward and cost in the last tenth of its time."""
    updates = [line for line in lines if "steps" in line]
    facts = {name: x for line in lines if "steps" not in line for name, x in line.items()}
    begin = facts.pop("begin", 0.0)
    if "failed" in facts or len(updates) < 2:
        return {"failed": facts.get("failed", "not two updates in its time")}
    first, last = updates[0], updates[-1]
    rate = (last["steps"] - first["steps"]) / (last["time"] - first["time"])
    found = facts | {"first_update_seconds": round(first["time"] - begin, 1), "rate": round(rate, 1)}
    for score in ("reward", "cost"):
        known = [line for line in updates if score in line]
        late = [x[score] for x in known if x["time"] >= first["time"] + 0.9 * seconds] or [x[score] for x in known[-1:]]
        found |= {score: round(statistics.mean(late), 3)} if late else {}
    return found


def row(peer: Peer, sizes: dict[str, int], turns: list[Record]) -> Record:
    """A peer's row: median rate, seconds of a cold start to the first update, reward and cost of each turn."""
    about = {"kind": "peer", "name": peer.name, "task": peer.task, "networks": peer.networks}
    about |= sizes if peer.networks != "none" else {}
    if "failed" in turns[-1]:
        return about | turns[-1]
    others = {"other_work_cpus": statistics.median(turn["other_work_cpus"] for turn in turns)}
    first = ("physics", "learner", "threads", "first_update_seconds")  # the first turn compiles, others load
    facts = {name: turns[0][name] for name in first if name in turns[0]}
    scores = {
        f"{name}s": [turn[name] for turn in turns] for name in ("reward", "cost") if all(name in x for x in turns)
    }
    rates = [turn["rate"] for turn in turns]
    return about | facts | {"steps_per_second": statistics.median(rates), "rates": rates} | others | scores
