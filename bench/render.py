"""Tables in the documentation, made from bench/results.

A block of a Markdown file, from the line `<!-- bench: NAME -->` to the line `<!-- /bench -->`, holds what NAME in
bench/tables/speed.py makes of the results; whatever stood there before is replaced. The name `paper:FILE` means a
table of the runs stored in bench/results/FILE.json: means and standard deviations next to the paper's;
`mean_actions:FILE` has both measures of a limit, `summary:FILE+FILE` methods by tasks, `overview:FILE+FILE` tasks by
methods with PID. Tables of seldom noticed costs are in study.py; those of tasks, settings and methods, as
`observation:ant_2x4`, in pages.py. In a sentence, `<!-- bench: within:FILE:METHOD:LIMIT -->18<!-- /bench -->` is a
number, see values.py.
"""

from __future__ import annotations

import pathlib
import re
from collections.abc import Callable

from pmt_jax.errors import UsageError
from pmt_jax.files import replace_text
from pmt_jax.tasks import did_you_mean

from . import records
from .tables import pages, runs, study, values
from .tables.speed import TABLES, Reports

ROOT = pathlib.Path(__file__).parent.parent
BLOCK = re.compile(r"^(<!-- bench: (\S+) -->\n)(.*?)^(<!-- /bench -->)$", re.DOTALL | re.MULTILINE)
NUMBER = re.compile(r"(<!-- bench: (\S+) -->)([^<`\n]*)(<!-- /bench -->)")
MARK = re.compile(r"^<!-- (?:bench: \S+|/bench) -->$", re.MULTILINE)
STORED = {**runs.KINDS, **study.KINDS}


def documents() -> list[pathlib.Path]:
    """The Markdown files that have blocks."""
    pages = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
    return [path for path in pages if MARK.search(text := path.read_text()) or NUMBER.search(text)]


def render(text: str, reports: Reports) -> str:
    """`text` with its blocks and numbers made anew.

    Raises:
      UsageError: a block names no table, or does not end.
    """

    def block(found: re.Match[str]) -> str:
        begin, name, _, end = found.groups()
        kind, _, file = name.partition(":")
        if kind in STORED:
            return f"{begin}{STORED[kind](records.RESULTS / f'{file}.json')}\n{end}"
        if kind in pages.KINDS:
            return f"{begin}{pages.KINDS[kind](file)}\n{end}"
        if name not in TABLES:
            raise UsageError(f"unknown table '{name}'{did_you_mean(name, TABLES)}")
        return f"{begin}{TABLES[name](reports)}\n{end}"

    rendered, blocks = BLOCK.subn(block, text)
    if 2 * blocks != len(MARK.findall(text)):
        raise UsageError("a block that begins with <!-- bench: NAME --> does not end with <!-- /bench -->")
    return NUMBER.sub(lambda found: f"{found[1]}{values.number(found[2])}{found[4]}", rendered)


def documents_anew(check: bool, say: Callable[[str], None] = print) -> int:
    """Makes the tables anew or, to `check`, says which are not what the results say; 1 if there are any."""
    reports, old = records.load(), 0
    for path in documents():
        text = path.read_text()
        if (rendered := render(text, reports)) != text:
            old += 1
            say(f"{path.relative_to(ROOT)}: " + ("old; python -m bench render makes it anew" if check else "made anew"))
            if not check:
                replace_text(path, rendered)
    return int(check and old > 0)
