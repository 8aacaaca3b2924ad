"""robots.py WORDS --out FOLDER: the bench `robots`, cases with these words, beside programs on other GPUs.

`python -m bench run robots` waits before each turn for other work to pause, and here none does.
"""

from __future__ import annotations

import argparse
import functools
import pathlib

from bench import measure, runner

parser = argparse.ArgumentParser()
parser.add_argument("words")
parser.add_argument("--out", type=pathlib.Path, required=True)
arguments = parser.parse_args()
arguments.out.mkdir(parents=True, exist_ok=True)
measure.FULL = measure.FULL._replace(patience=0.0)
say = functools.partial(print, flush=True)
runner.measure("robots", arguments.out / "robots.json", quick=False, threads=0, only=arguments.words, say=say)
