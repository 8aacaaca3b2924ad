"""SLURM itself, on one machine: three emulated nodes, the script of docs/howto/hosts.md, signals, requeues, job arrays.

Runs where Debian's `slurm-wlm` and `munge` (or the like) are installed, and as root, which `slurmd` needs.
"""

from __future__ import annotations

import json
import os
import pathlib
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import psutil
import pytest

from runs import environment

NEEDED = ("slurmctld", "slurmd", "munged", "sbatch", "srun", "scontrol", "scancel")
pytestmark = [
    pytest.mark.full,
    pytest.mark.skipif(not all(map(shutil.which, NEEDED)), reason="SLURM and munge are not installed here"),
    pytest.mark.skipif(os.geteuid() != 0, reason="slurmd runs as root"),
]
PAGE = pathlib.Path(__file__).parents[2] / "docs" / "howto" / "hosts.md"
NODES = ("127.0.0.2", "127.0.0.3", "127.0.0.4")  # addresses for names, so that the processes find the first of them
TINY = "lane --num-envs 4 --rollout-length 25 --hidden 8 --minibatches 1 --epochs 1 --no-cache"
PATIENCE = 300.0  # seconds for whatever should happen; a job that is requeued waits for the scheduler's next look

CONFIGURATION = """
ClusterName=emulated
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={port}
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={top}/munge/socket,cred_expire=5
StateSaveLocation={top}/state
SlurmdSpoolDir={top}/spool/%n
SlurmctldPidFile={top}/slurmctld.pid
SlurmdPidFile={top}/%n.pid
SlurmctldLogFile={top}/slurmctld.log
SlurmdLogFile={top}/%n.log
ProctrackType=proctrack/pgid
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerParameters=sched_interval=1,bf_interval=1
SlurmdParameters=config_overrides
ReturnToService=2
SlurmdTimeout=10
KillWait=10
NodeName=127.0.0.[2-4] NodeHostname={host} NodeAddr=127.0.0.1 Port=[{first}-{last}] CPUs=64 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def until(what: str, found: Callable[[], object]) -> object:
    """What `found` returns once it is true."""
    begin = time.monotonic()
    while not (result := found()):
        assert time.monotonic() - begin < PATIENCE, f"{what} did not happen"
        time.sleep(0.2)
    return result


class Cluster:
    """A controller and a daemon for each node; all of it below one folder."""

    def __init__(self, top: pathlib.Path, port: int) -> None:
        self.top = top
        for name in ("munge", "state", "spool"):
            (top / name).mkdir()
        (top / "munge").chmod(0o700)
        (top / "munge" / "key").write_bytes(os.urandom(1024))
        (top / "munge" / "key").chmod(0o400)
        numbers = {"port": port, "first": port + 1, "last": port + 3}
        text = CONFIGURATION.format(host=socket.gethostname().split(".")[0], top=top, **numbers)
        (top / "slurm.conf").write_text(text)
        self.env = environment() | {"SLURM_CONF": str(top / "slurm.conf")}
        self.env["PATH"] = f"{pathlib.Path(sys.executable).parent}:{self.env['PATH']}"  # where pmt is

    def start(self) -> None:
        munge = self.top / "munge"
        files = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}
        self.call("munged", "--force", *(f"--{flag}={munge / name}" for flag, name in files.items()))
        self.call("slurmctld")
        for node in NODES:
            self.call("slurmd", "-N", node)
        until("idle nodes", lambda: self.call("sinfo", "-h", "-t", "idle", "-o", "%D").strip() == str(len(NODES)))

    def call(self, *words: object) -> str:
        """What a command prints."""
        return subprocess.run(
            [str(word) for word in words],
            env=self.env,
            cwd=self.top,
            check=True,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
        ).stdout

    def submit(self, script: str, *options: object) -> str:
        """The number of a job."""
        (self.top / "job.sh").write_text(script)
        return self.call("sbatch", "--parsable", *options, "job.sh").strip()

    def state(self, job: str) -> str:
        return re.search(r"JobState=(\w+)", self.call("scontrol", "show", "job", job))[1]  # pyright: ignore[reportOptionalSubscript]

    def processes(self, node: str) -> list[psutil.Process]:
        """What runs on a node of this cluster, its daemon included."""
        found = []
        for process in psutil.process_iter():
            try:
                own, words = process.environ(), process.cmdline()
            except psutil.Error:
                continue
            if own.get("SLURM_CONF") != self.env["SLURM_CONF"]:
                continue
            if own.get("SLURMD_NODENAME") == node or (words[:1] == ["slurmd"] and node in words):
                found.append(process)
        return found

    def stop(self) -> None:
        with_pid = [*self.top.glob("*.pid"), self.top / "munge" / "pid"]
        for job in self.call("squeue", "-h", "-o", "%i").split():
            subprocess.run(["scancel", "--full", job], env=self.env, timeout=60)
        until("an end of all jobs", lambda: not self.call("squeue", "-h"))
        for file in with_pid:
            if file.is_file():
                try:
                    psutil.Process(int(file.read_text())).terminate()
                except (psutil.Error, ValueError):
                    pass  # it was killed


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = 20_000 + free.getsockname()[1] % 9_000
    made = Cluster(tmp_path_factory.mktemp("slurm"), port)
    try:
        made.start()
        yield made
    finally:
        made.stop()


def page_script(run: pathlib.Path, training: str) -> str:
    """The script of the page, with another training, for one process on each node, which has no GPU."""
    script = re.search(r"```bash\n(#!/bin/bash\n.*?)```", PAGE.read_text(), re.DOTALL)[1]  # pyright: ignore[reportOptionalSubscript]
    changes = {
        "RUN=runs/ant": f"RUN={run}",
        "ant_2x4 --method f4sg --seeds 8 --steps 1e7": training,
        "--ntasks-per-node=4 --gpus-per-node=4": "--ntasks-per-node=1",
    }
    for old, new in changes.items():
        assert old in script
        script = script.replace(old, new)
    return script


def rows(run: pathlib.Path) -> list[dict]:
    file = run / "metrics.jsonl"
    lines = file.read_text().splitlines(keepends=True) if file.is_file() else []
    return [json.loads(line) | {"seconds": 0} for line in lines if line.endswith("\n")]


def test_the_pages_script_saves_requeues_and_survives_a_node(cluster: Cluster):
    """It never ends by itself; what is compared is what two runs have in common, over all that befell one of them."""
    training = f"{TINY} --method mappo --seeds 2 --log-interval 20 --steps 2e9"
    run, calm = cluster.top / "run", cluster.top / "calm"

    def last() -> int:
        return rows(run)[-1]["step"] if rows(run) else 0

    def saved() -> list[int]:
        found = (run / "checkpoints").glob("*") if (run / "checkpoints").is_dir() else ()
        return sorted(int(path.name) for path in found if path.name.isdecimal())

    job = cluster.submit(page_script(run, training), "--open-mode=append", "--output=out.txt")
    until("a first row", lambda: rows(run))
    cluster.call("scancel", "--signal=TERM", job)  # what --signal=TERM@120 does
    until("an end", lambda: cluster.state(job) not in ("RUNNING", "COMPLETING"))
    text = (cluster.top / "out.txt").read_text()
    assert "2 devices in 2 process(es)" in text and "interrupted after" in text and "saved" in text
    first = saved()[-1]
    assert last() == first

    cluster.call("scontrol", "requeue", job)
    until("rows after the requeue", lambda: last() > first)
    assert f"resuming after {first:,} steps" in (cluster.top / "out.txt").read_text()

    used = re.search(r"NodeList=127.0.0.\[(\d)-(\d)\]", cluster.call("scontrol", "show", "job", job))
    assert used is not None
    for process in cluster.processes(f"127.0.0.{used[2]}"):
        process.kill()
    sentence = "stopped: another process of the run has ended or cannot be reached"
    until("a sentence", lambda: sentence in (cluster.top / "out.txt").read_text())
    lost = last()
    assert "Traceback" not in (cluster.top / "out.txt").read_text()
    until("another start", lambda: (cluster.top / "out.txt").read_text().count("resuming after") == 2)
    until("rows beyond what was lost", lambda: last() > lost)
    cluster.call("scancel", "--signal=TERM", job)
    until("an end", lambda: cluster.state(job) not in ("RUNNING", "COMPLETING"))

    end = last()
    other = cluster.submit(page_script(calm, training), "--output=calm.txt")
    until("as many rows without any trouble", lambda: rows(calm) and rows(calm)[-1]["step"] >= end)
    cluster.call("scancel", "--signal=TERM", other)
    until("an end", lambda: cluster.state(other) not in ("RUNNING", "COMPLETING"))
    assert rows(run) == rows(calm)[: len(rows(run))]


def test_a_job_array_finishes_a_sweep(cluster: Cluster):
    out = cluster.top / "sweep"
    training = TINY.replace("--hidden 8 ", "")
    words = f"pmt sweep {training} --method mappo --steps 400 --set 'hidden=[4],[8]' --out {out}"
    job = cluster.submit(f"#!/bin/bash\n#SBATCH --array=1-2 --ntasks=1\n{words}\n", "--output=array-%a.txt")
    until("both points", lambda: len(list(out.glob("*/config.toml"))) == 2)
    until("an end", lambda: not cluster.call("squeue", "-h", "-j", job))
    texts = [(cluster.top / f"array-{i}.txt").read_text() for i in (1, 2)]
    assert "share 1/2" in texts[0] and "share 2/2" in texts[1]
    assert "2 of 2 points are finished" in "".join(texts) and "best first" in "".join(texts)
