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
