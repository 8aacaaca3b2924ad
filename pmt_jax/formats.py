"""Tables as text, Markdown or LaTeX: the one writer of the command line, of the studies and of the benchmarks."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence

from .errors import UsageError
from .tasks import did_you_mean

Cells = Sequence[str]


def number(x: float | None, spec: str = ".4g") -> str:
    """A number as a cell; - for what is unknown."""
    return "-" if x is None else format(x, spec)


def write(head: Cells, body: Sequence[Cells], layout: str = "text", notes: Sequence[str] = ()) -> str:
    """A table with its notes, which ends in a newline.

    Args:
      layout: text, markdown or latex.

    Raises:
      UsageError: another format.
    """
    if layout not in WRITERS:
        raise UsageError(f"unknown format '{layout}'{did_you_mean(layout, WRITERS)}")
    return WRITERS[layout](head, body, notes) + "\n"


def markdown(head: Cells, body: Iterable[Cells], notes: Sequence[str] = ()) -> str:
    """A Markdown table, then its notes; without a newline at the end."""
    lines = ["| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |" for line in (head, *body)]
    return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:], *_below(notes)])


def text(head: Cells, body: Sequence[Cells], notes: Sequence[str] = ()) -> str:
    """Columns of equal width, for a terminal."""
    widths = [max(map(len, column)) for column in zip(head, *body, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in (head, *body)]
    rule = "  ".join("-" * width for width in widths)
    return "\n".join(line.rstrip() for line in [lines[0], rule, *lines[1:], *_below(notes)])


def latex(head: Cells, body: Sequence[Cells], notes: Sequence[str] = ()) -> str:
    """A booktabs tabular whose notes are comments above it."""
    symbols = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}

    def line(cells: Cells) -> str:
        escaped = (re.sub(r"[\\~^_%&#${}]", lambda m: symbols.get(m[0], "\\" + m[0]), cell) for cell in cells)
        return " & ".join(escaped) + r" \\"

    top = [r"\begin{tabular}{ll" + "r" * (len(head) - 2) + "}", r"\toprule", line(head), r"\midrule"]
    return "\n".join([*(f"% {note}" for note in notes), *top, *map(line, body), r"\bottomrule", r"\end{tabular}"])


def _below(notes: Sequence[str]) -> list[str]:
    return ["", *notes] if notes else []


WRITERS: dict[str, Callable[[Cells, Sequence[Cells], Sequence[str]], str]] = {
    "text": text,
    "markdown": markdown,
    "latex": latex,
}
