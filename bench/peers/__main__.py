"""One turn of one peer, in this process: python -m bench.peers NAME --out FILE (`python -m bench peers` calls it)."""

from __future__ import annotations

import argparse
import pathlib

from pmt_jax import load_config
from pmt_jax.cli import end
from pmt_jax.errors import UsageError

from .contest import PEERS, SIZES
from .learners import TASK, Arguments
from .report import Report


def main() -> None:
    """Trains until its time is up; a last line says why if it cannot."""
    parser = argparse.ArgumentParser()
    parser.add_argument("name", choices=PEERS)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jaxmarl", type=pathlib.Path)
    for size in SIZES:
        parser.add_argument(f"--{size}", type=int, required=True)
    asked = parser.parse_args()
    sizes = {size: getattr(asked, size) for size in SIZES}
    peer, report = PEERS[asked.name], Report(asked.out, asked.seconds)
    config = load_config(TASK, method=peer.method, seed=asked.seed, **sizes)
    try:
        peer.learn(Arguments(config, asked.jaxmarl), report)
    except ModuleNotFoundError as error:
        report.about(failed=f"needs {error.name}, which is not installed: pip install 'pmt-jax[peers]'")
    except UsageError as error:
        report.about(failed=str(error))


if __name__ == "__main__":
    main()
    end(0)
