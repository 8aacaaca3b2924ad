"""Where tests find what they read: the repository, and what was recorded for them."""

import pathlib

ROOT = pathlib.Path(__file__).parents[1]
DATA = ROOT / "tests" / "data"
