"""What surrounds a command: output that cannot be written or that nobody reads, Ctrl-C at its start, encodings."""

from __future__ import annotations

import os
import pathlib
import shutil
import signal
import subprocess
import sys

import pytest

from pmt_jax.cli import process
from runs import environment

COMMANDS = [
    ("envs",),
    ("envs", "lane"),
    ("hub",),
    ("completion", "bash"),
    ("--help",),
    ("--version",),
    ("train", "--help"),
    ("eval", "RUN", "--episodes", "2"),
    ("table", "RUN"),
]


def words(command: tuple[str, ...], run: pathlib.Path) -> list[str]:
    return [str(run) if word == "RUN" else word for word in command]


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_full_disk_is_an_error(command: tuple[str, ...], whole: pathlib.Path, cli, monkeypatch):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        code, _, err = cli(*words(command, whole))
    assert code == 2
    assert err == "pmt: cannot write to standard output: No space left on device; the result is not complete\n"


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_reader_that_has_ended_is_none(command: tuple[str, ...], whole: pathlib.Path, cli, monkeypatch):
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as closed:
        monkeypatch.setattr(sys, "stdout", closed)
        code, _, err = cli(*words(command, whole))
    assert (code, err) == (0, "")


def test_nothing_is_kept_for_the_next_command(cli, monkeypatch):
    with open("/dev/full", "w") as full, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", full)
        assert cli("envs")[0] == 2
    code, text, err = cli("envs")
    assert code == 0 and "lane" in text and not err


def test_the_exit_code_is_that_of_the_process():
    command = f"{sys.executable} -m pmt_jax --help > /dev/full"
    done = subprocess.run(["bash", "-c", command], env=environment(), capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "No space left on device" in done.stderr


# ---------------------------------------------------------------------------------------------------------------------
# Ctrl-C before there is anything to save: exit code 130 at once, and no traceback

# Ctrl-C arrives while `module` is imported. JAX's own imports would turn an exception into something else.
INTERRUPTED = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run in the background
class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            try:
                os.kill(os.getpid(), signal.SIGINT)
            except KeyboardInterrupt as interrupt:
                {then}
sys.meta_path.insert(0, Interrupt())
from pmt_jax.cli import run
run(["train", "lane"])
"""


@pytest.mark.parametrize(
    ("module", "then"), [("pmt_jax.cli.commands", "raise"), ("jax", "raise RecursionError"), ("numpy", "pass")]
)
def test_during_imports(module: str, then: str, tmp_path):
    command = [sys.executable, "-c", INTERRUPTED.format(module=module, then=then)]
    path = os.pathsep.join(os.path.abspath(folder) for folder in sys.path if folder)
    done = subprocess.run(
        command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stderr, done.stdout) == (130, "", "")


def test_the_handler_goes_with_the_command(cli):
    before = signal.getsignal(signal.SIGINT)
    assert cli("train", "lane", "--steps", "1")[0] == 2
    assert signal.getsignal(signal.SIGINT) is before


# ---------------------------------------------------------------------------------------------------------------------
# Names and texts are UTF-8 whatever the locale says; what cannot be is one sentence

ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
MAIN = "import sys; from pmt_jax.cli import run; run()"
NAME = "r\u00fcn".encode()


def in_ascii(folder: pathlib.Path, *command: str | bytes) -> subprocess.CompletedProcess[str]:
    environ = environment() | ASCII
    return subprocess.run([sys.executable, *command], env=environ, cwd=folder, capture_output=True, text=True)


@pytest.mark.full
def test_every_locale_is_taken_for_utf8(whole: pathlib.Path, tmp_path: pathlib.Path):
    """Checkpoints take no other names, and the page has letters that ASCII lacks."""
    shutil.copytree(whole, tmp_path / "r\u00fcn")
    done = in_ascii(tmp_path, "-c", MAIN, "report", NAME, "--episodes", "1", "-o", "\u00fc.html".encode())
    assert done.returncode == 0 and not done.stderr
    page = (tmp_path / "\u00fc.html").read_text(encoding="utf-8")
    assert "<h3>Evaluation</h3>" in page and "<h3>An episode</h3>" in page and "<h2>r\u00fcn</h2>" in page
    # Where another program has started Python and calls `main`, it can only say so.
    called = in_ascii(tmp_path, "-c", MAIN.replace("run()", "run(['eval', sys.argv[1]])"), NAME)
    assert called.returncode == 2 and "set PYTHONUTF8=1" in called.stderr and called.stderr.count("\n") == 1


@pytest.mark.parametrize("command", [("eval", "{}"), ("train", "lane", "--out", "{}"), ("export", "{}", "-o", "x")])
def test_a_name_that_is_no_utf8(command: tuple[str, ...], whole: pathlib.Path, tmp_path: pathlib.Path, cli):
    out = tmp_path / os.fsdecode(b"r\xfcn")
    if command[0] != "train":
        shutil.copytree(whole, out)
    code, _, err = cli(*(word.format(out) for word in command))
    assert code == 2 and "is not UTF-8, which checkpoints need; rename the folder" in err and err.count("\n") == 1
    assert out.exists() == (command[0] != "train")


def test_texts_that_the_locale_cannot_read(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    def read() -> int:
        b"\xc2".decode("ascii")
        return 0

    with pytest.raises(UnicodeDecodeError):
        process.answer("pmt", read)
    monkeypatch.setattr(sys, "getfilesystemencoding", lambda: "ascii")
    assert process.answer("pmt", read) == 2
    assert capsys.readouterr().err == "pmt: the locale has another encoding than UTF-8 (ascii); set PYTHONUTF8=1\n"
