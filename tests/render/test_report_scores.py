"""The scores of a report begin with what decides whether a method is safe, and lose no column."""

from __future__ import annotations

import pathlib
import re

from pmt_jax.render import report
from pmt_jax.studies import table
from pmt_jax.studies.rows import rows
from pmt_jax.studies.run_log import read_all


def test_limit_seeds_within_and_worst_seed_come_first(whole: pathlib.Path):
    logs = read_all([whole])
    head, lines, _ = table.cells(rows(logs))
    _, scores, _ = report._table(logs)
    heads = re.findall(r"<th(?: [^>]*)?>(.*?)</th>", scores)
    assert heads[:5] == ["method", "task", "limit", "seeds within", "worst seed"]
    assert sorted(heads) == sorted(head) and "mean-action seeds within" in heads
    cells = [cell.replace("\u00a0", " ") for cell in re.findall(r"<td[^>]*>(.*?)</td>", scores)]
    assert dict(zip(heads, cells, strict=True)) == dict(zip(head, lines[0], strict=True))
    assert '<div class="scores">' in scores
