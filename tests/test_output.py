"""What the program says."""

from __future__ import annotations

import io

import pytest

from pmt_jax.output import say


def test_a_line_is_one_write_and_threads_cannot_mix_theirs(monkeypatch: pytest.MonkeyPatch):
    class Recorded(io.StringIO):
        def write(self, text: str, /) -> int:
            written.append(text)
            return super().write(text)

    written: list[str] = []
    monkeypatch.setattr("sys.stdout", Recorded())
    say("steps 64")
    assert [text for text in written if text] == ["steps 64\n"]


class Terminal(io.StringIO):
    """What is written to a terminal."""

    def isatty(self) -> bool:
        return True


LINES = [
    "batch 64 environments x 200 steps = 12,800 a seed, 782 updates = 10,009,600 steps a seed",
    "limit 1 kept by 3 of 5 seeds, the worst 0.3 beyond in the last tenth of the steps (training episodes, with noise)",
    "  note: an indented sentence, whose words do not fit into the width of a narrow terminal in one line",
    "/a/path/that/is/longer/than/every/terminal/" + "x" * 100,
]


@pytest.mark.parametrize("width", [20, 40, 80, 120])
@pytest.mark.parametrize("line", LINES)
def test_no_word_breaks_on_a_terminal_and_nothing_changes_in_a_pipe(line: str, width: int, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    terminal = Terminal()
    monkeypatch.setattr("sys.stdout", terminal)
    say(line)
    printed = terminal.getvalue().splitlines()
    assert " ".join(" ".join(printed).split()) == " ".join(line.split())  # every word, whole and in order
    assert all(len(x) <= width or " " not in x.strip() for x in printed)
    assert printed[0].startswith(line[: len(line) - len(line.lstrip())])
    pipe = io.StringIO()
    monkeypatch.setattr("sys.stdout", pipe)
    say(line)
    assert pipe.getvalue() == f"{line}\n"


def test_columns_stay_as_they_are(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "20")
    table = "task  method  reward\n" + "lane  mappo   12345678901234567890"
    monkeypatch.setattr("sys.stdout", terminal := Terminal())
    say(table)
    assert terminal.getvalue() == f"{table}\n"
