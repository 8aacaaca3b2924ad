"""Runs benches, each in a process of its own, so that memory, compiling and JAX's settings belong to that bench."""

from __future__ import annotations

import os
import pathlib
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence

import jax

from pmt_jax.errors import UsageError

from . import compare, grid, records
from .cases import BENCHES, Bench, chosen

Say = Callable[[str], None]

MEASURE = (sys.executable, "-m", "bench", "measure")
PROBE = "import jax; print(jax.device_count(), jax.devices()[0].device_kind)"


def run(names: Sequence[str], out: pathlib.Path | None, quick: bool, threads: int, only: str, say: Say) -> int:
    """Runs benches one after the other, then shows their figures next to those of the last commit.

    Args:
      names: of benches; none for all that this machine has the devices for.
      out: a folder; None for bench/results, or for a new one where figures would be of no use there.
      threads: of the CPU that may be used, 0 for all; only: words, with commas, that a case's label must have.

    Returns:
      0; 1 where one failed, which does not stop the others; 130 after Ctrl-C, which keeps what is finished.
    """
    partly = quick or bool(threads) or bool(only)
    benches, out = chosen(names), folder(out, partly)
    out.mkdir(parents=True, exist_ok=True)
    committed = last_results(say)
    count, device = devices() if any(BENCHES[name].on != "cpu" for name in benches) else (0, "cpu")
    done, failed, stopped = [], [], False
    for number, name in enumerate(benches, 1):
        bench = BENCHES[name]
        on_cpu = bench.on == "cpu" or bench.on == "either" and device == "cpu"
        result = name if on_cpu else f"{name}_{slug(device)}"
        if not names and (missing := _missing(bench, count, device)):
            say(f"[{number}/{len(benches)}] {name}: skipped, as there is {missing} here")
            continue
        usual = "" if partly or result not in committed else f" (took {committed[result].get('seconds', '?')} s before)"
        say(f"[{number}/{len(benches)}] {name}: {bench.what}{usual}")
        words = [name, "--threads", str(threads), "--only", only, *(["--quick"] if quick else [])]
        try:
            ok = _child(words, on_cpu, out / f"{result}.json", say)
        except KeyboardInterrupt:
            stopped = True
            break
        (done if ok else failed).append(result)
    for result in done:
        say(compare.describe(result, committed.get(result), records.load(out / f"{result}.json")[result]))
    say(f"in {out}: {', '.join(done) or 'nothing new'}{'; stopped' if stopped else ''}")
    if failed:
        say(f"failed: {', '.join(failed)}")
    return 130 if stopped else 1 if failed else 0


def measure(name: str, out: pathlib.Path, quick: bool, threads: int, only: str, say: Say) -> None:
    """Runs one bench in this process; what is measured is written after every row."""
    if threads:  # before JAX counts them
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])
    if name == "grid":
        grid.prepare()
    from pmt_jax.training import processes
    from pmt_jax.training.run_folder import MATMUL_PRECISION

    from . import measure as measuring

    bench, rows = BENCHES[name], []
    on_cpu = bench.on == "cpu" or bench.on == "either" and jax.default_backend() == "cpu"
    cases = [case for case in bench.chosen(on_cpu, quick) if _wanted(case.about(), only)]
    if bench.on == "cpu":  # before JAX starts
        processes.make_room(max((case.devices for case in cases), default=1))
    effort = measuring.QUICK if quick else measuring.FULL if on_cpu else measuring.ON_GPU
    jax.config.update("jax_enable_compilation_cache", False)
    jax.config.update("jax_default_matmul_precision", MATMUL_PRECISION)
    flags = " --quick" * quick + f" --threads {threads}" * bool(threads) + f" --only '{only}'" * bool(only)
    for row in measuring.rows(cases, effort, say):
        rows.append(row)
        records.write(out, rows, f"python -m bench run {name}{flags}")


def _wanted(row: records.Record, only: str) -> bool:
    return all(word.strip() in compare.label(row) for word in only.split(","))


def slug(device: str) -> str:
    """A device's kind as part of a file's name: `h200` of `NVIDIA H200`."""
    return re.sub("[^a-z0-9]+", "_", device.lower().removeprefix("nvidia ")).strip("_")


def folder(out: pathlib.Path | None, partly: bool) -> pathlib.Path:
    """Where results go.

    Raises:
      UsageError: figures of a part, or of no use, would replace the real ones.
    """
    if partly and out is not None and out.resolve() == records.RESULTS.resolve():
        raise UsageError("figures of --quick, --only or --threads do not belong in bench/results; choose another --out")
    return out or (pathlib.Path(tempfile.mkdtemp(prefix="bench-")) if partly else records.RESULTS)


def _child(words: Sequence[str], on_cpu: bool, result: pathlib.Path, say: Say) -> bool:
    """Runs one bench; its result takes the old one's place only when it is complete."""
    unfinished = result.with_name(f"{result.name}.unfinished")
    unfinished.unlink(missing_ok=True)
    # XLA's complaints about programs it takes from the cache; a start needs memory of the GPU that this process has.
    usual = {"TF_CPP_MIN_LOG_LEVEL": "3", "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    environment = usual | os.environ | ({"JAX_PLATFORMS": "cpu"} if on_cpu else {})
    begin = time.monotonic()
    code = subprocess.run([*MEASURE, *words, "--out", str(unfinished)], env=environment, check=False).returncode
    took = f"{time.monotonic() - begin:.0f} s"
    if code or not unfinished.exists():
        say(f"  failed after {took} with exit code {code}; what it had written, if anything, is in {unfinished}")
        return False
    unfinished.replace(result)
    say(f"  took {took}")
    return True


def last_results(say: Say) -> dict[str, records.Report]:
    """The results of the last commit; none without a repository."""
    try:
        return records.load("HEAD")
    except UsageError:
        say("no git repository here: there is nothing to compare with")
        return {}


def _missing(bench: Bench, count: int, device: str) -> str | None:
    """What `count` devices of this kind lack for a bench."""
    if bench.on in ("cpu", "either"):
        return None
    return "no GPU" if device == "cpu" else "one GPU only" if bench.on == "gpus" and count == 1 else None


def devices() -> tuple[int, str]:
    """How many devices JAX sees and their kind, asked in another process, because asking takes their memory."""
    asked = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, check=False)
    if asked.returncode:
        raise UsageError(f"JAX does not start here: {asked.stderr.strip().splitlines()[-1]}")
    count, device = asked.stdout.strip().splitlines()[-1].split(maxsplit=1)
    return int(count), device
