"""`python -m pmt_jax` is `pmt`."""

import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main())
