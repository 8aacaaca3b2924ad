"""The benches that `python -m bench all` runs, each in a process of its own: memory and compiling are nobody else's."""

from __future__ import annotations

import os
import pathlib
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Literal, NamedTuple

from pmt_jax.errors import UsageError
from pmt_jax.tasks import did_you_mean

from . import compare

Say = Callable[[str], None]

PROBE = "import jax; print(jax.device_count(), jax.devices()[0].device_kind)"


class Bench(NamedTuple):
    """One bench.

    Attributes:
      what: what it measures, with units.
      command: the module and its arguments; quick: those that a smoke has besides.
      on: `cpu`, or `gpu` or `gpus` for one that is skipped where there is none, or only one, unless it is asked for by
        name; the results of the latter two are called after the device too.
    """

    what: str
    command: str
    quick: str
    on: Literal["cpu", "gpu", "gpus"] = "cpu"


_SHORT = "--quick --repeats 2 --seconds 0.3 --patience 0"
BENCHES = {
    "throughput": Bench(
        "ant: control steps/s per engine and batch beside a plain loop; seconds to compile and to start; memory, GB",
        "bench.throughput ant_2x4",
        _SHORT,
    ),
    "hand_over": Bench(
        "hands: control steps/s per engine and batch beside a plain loop; CPU-seconds to compile",
        "bench.throughput hand_over_2x6",
        _SHORT,
    ),
    "methods": Bench(
        "every method: seconds to compile and per update, steps/s of the whole training loop",
        "bench.methods",
        "--rounds 1 --tasks switch",
    ),
    "grid": Bench(
        "power flows/s beside other tools; environment steps/s", "bench.grid", "--quick --rounds 1 --seconds 0.2"
    ),
    "checkpoint": Bench("seconds to save and load; MB", "bench.checkpoint", "--chunks 2 --repeats 2"),
    "engines": Bench(
        "GPU: environment steps/s per engine and batch; seconds to compile", "bench.engines", "--quick", on="gpu"
    ),
    "loop": Bench(
        "GPU: environment steps/s of the whole training loop per method; seeds; memory, GB; share of time busy",
        "bench.loop",
        "--cases ant_2x4:mappo_l:1x64x8,ant_2x4:mappo_l:2x64x8 --updates 2 --repeats 1",
        on="gpu",
    ),
    "scaling": Bench(
        "GPUs: environment steps/s of the whole training loop over 1, 2, 4 ... devices, and the efficiency",
        "bench.scaling",
        "--tasks switch --num-envs 8 --updates 1 --repeats 1",
        on="gpus",
    ),
}


def chosen(only: str | None) -> list[str]:
    """The benches by these names (with commas), in the order of BENCHES; without any, all.

    Raises:
      UsageError: there is none by that name.
    """
    names = list(BENCHES) if only is None else only.split(",")
    for name in names:
        if name not in BENCHES:
            raise UsageError(f"unknown bench '{name}'{did_you_mean(name, BENCHES)}")
    return [name for name in BENCHES if name in names]


def folder(out: pathlib.Path | None, quick: bool) -> pathlib.Path:
    """Where results go: `out`, else bench/results, or a new folder for quick ones.

    Raises:
      UsageError: quick figures would replace the real ones.
    """
    if quick and out is not None and out.resolve() == compare.RESULTS.resolve():
        raise UsageError("figures of --quick do not belong in bench/results; choose another --out")
    return out or (pathlib.Path(tempfile.mkdtemp(prefix="bench-")) if quick else compare.RESULTS)


def run_all(only: str | None, out: pathlib.Path | None, quick: bool, say: Say) -> int:
    """Runs benches one after the other, then shows their figures beside those of the last commit.

    Returns:
      0; 1 where one failed, which does not stop the others; 130 after Ctrl-C, which keeps what is finished.
    """
    names, out = chosen(only), folder(out, quick)
    out.mkdir(parents=True, exist_ok=True)
    committed = _committed(say)
    count, device = _devices() if any(BENCHES[name].on != "cpu" for name in names) else (0, "cpu")
    done, failed, stopped = [], [], False
    for number, name in enumerate(names, 1):
        bench = BENCHES[name]
        result = name if bench.on == "cpu" else f"{name}_{slug(device)}"
        if only is None and (missing := _missing(bench, count, device)):
            say(f"[{number}/{len(names)}] {name}: skipped, as there is {missing} here")
            continue
        say(f"[{number}/{len(names)}] {name}: {bench.what}{'' if quick else _usually(committed.get(result))}")
        try:
            (done if _run(bench, out / f"{result}.json", quick, say) else failed).append(result)
        except KeyboardInterrupt:
            stopped = True
            break
    for result in done:
        say(compare.describe(result, committed.get(result), compare.load(str(out / f"{result}.json"))[result]))
    say(f"in {out}: {', '.join(done) or 'nothing new'}{'; stopped' if stopped else ''}")
    if failed:
        say(f"failed: {', '.join(failed)}")
    return 130 if stopped else 1 if failed else 0


def slug(device: str) -> str:
    """A device's kind as part of a file's name: `h200` of `NVIDIA H200`."""
    return re.sub("[^a-z0-9]+", "_", device.lower().removeprefix("nvidia ")).strip("_")


def _run(bench: Bench, result: pathlib.Path, quick: bool, say: Say) -> bool:
    """Runs one bench; its result takes the old one's place only when it is complete."""
    unfinished = result.with_name(f"{result.name}.unfinished")
    words = [*bench.command.split(), *(bench.quick.split() if quick else ())]
    quiet = {"TF_CPP_MIN_LOG_LEVEL": "3"}  # XLA's complaints about programs it takes from the cache
    environment = quiet | os.environ | ({"JAX_PLATFORMS": "cpu"} if bench.on == "cpu" else {})
    unfinished.unlink(missing_ok=True)
    begin = time.monotonic()
    child = [sys.executable, "-m", *words, "--out", str(unfinished)]
    code = subprocess.run(child, env=environment, check=False).returncode
    took = f"{time.monotonic() - begin:.0f} s"
    if code or not unfinished.exists():
        say(f"  failed after {took} with exit code {code}; what it had written, if anything, is in {unfinished}")
        return False
    unfinished.replace(result)
    say(f"  took {took}")
    return True


def _usually(report: compare.Report | None) -> str:
    return f" (took {report['seconds']} s the last time)" if report and "seconds" in report else ""


def _committed(say: Say) -> dict[str, compare.Report]:
    try:
        return compare.load("HEAD")
    except UsageError:
        say("no git repository here: there is nothing to compare with")
        return {}


def _missing(bench: Bench, count: int, device: str) -> str | None:
    """What `count` devices of this kind lack for a bench."""
    if bench.on == "cpu":
        return None
    return "no GPU" if device == "cpu" else "one GPU only" if bench.on == "gpus" and count == 1 else None


def _devices() -> tuple[int, str]:
    """How many devices JAX sees and their kind, asked in another process, since whoever asks takes their memory."""
    asked = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, check=False)
    if asked.returncode:
        raise UsageError(f"JAX does not start here: {asked.stderr.strip().splitlines()[-1]}")
    count, device = asked.stdout.strip().splitlines()[-1].split(maxsplit=1)
    return int(count), device
