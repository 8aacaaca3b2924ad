"""`python -m pmt_jax` is `pmt`."""

from .cli import run

if __name__ == "__main__":
    run()
