"""Names and texts are UTF-8 whatever the locale says; what cannot be is one sentence."""

from __future__ import annotations

import os
import pathlib
import shutil
import subprocess
import sys

import pytest

from pmt_jax.cli import process
from runs import environment

ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
MAIN = "import sys; from pmt_jax.cli import main; sys.exit(main())"
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
    called = in_ascii(tmp_path, "-c", MAIN.replace("main()", "main(['eval', sys.argv[1]])"), NAME)
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
