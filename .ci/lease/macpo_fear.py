"""`pmt` with one more method: MACPO whose cost surrogate is made of fear, on trial in the study of limits."""

from __future__ import annotations

import dataclasses
import sys

from pmt_jax import METHODS
from pmt_jax.cli import main

METHODS["macpo_fear"] = dataclasses.replace(METHODS["macpo"], cost_signal="fear")
if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
