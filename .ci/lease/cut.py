"""cut.py SWEEP...: metrics of a sweep that the machine's time ended, one folder a point, so that they can be stored.

`pmt sweep` does this itself when it ends. Without its checkpoint, which may have stayed on the machine, it cannot
continue.
"""

from __future__ import annotations

import json
import pathlib
import shutil
import sys

from pmt_jax.config.settings import to_toml
from pmt_jax.files import read_rows
from pmt_jax.studies import sweep


def cut(out: pathlib.Path) -> None:
    for group in sorted(out.glob(".group-*")):
        rows = read_rows(group / "run" / "metrics.jsonl")
        first = 0
        for name, config in sweep._points(group).items():
            trials = range(first, first + config.seeds)
            first = trials.stop
            folder = out / name
            folder.mkdir(exist_ok=True)
            (folder / "config.toml").write_text(to_toml(config))
            shutil.copy(group / "run" / "versions.json", folder)
            own = {"cost_limit": config.cost_limit}
            lines = [
                row | own | sweep._own_seed(row, config.seed - trials.start) for row in rows if row["seed"] in trials
            ]
            (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        shutil.rmtree(group)


if __name__ == "__main__":
    for sweep_folder in sys.argv[1:]:
        cut(pathlib.Path(sweep_folder))
