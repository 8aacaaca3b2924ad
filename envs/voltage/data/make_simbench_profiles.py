"""Makes simbench_profiles.npy.xz from the profiles in the package `simbench` (ODbL 1.0; see README.md).

  pip install --no-deps simbench==1.6.3 && python envs/voltage/data/make_simbench_profiles.py

Eight measured PV plants and eighteen consumers of the year 2016 in 15-minute steps, each scaled to a maximum of 1 and
rounded to 16 bits.
"""

import importlib.util
import lzma
from pathlib import Path

import numpy as np

SOLAR = [f"PV{i}" for i in range(1, 9)]
LOADS = ("G0-A G0-M G1-A G1-B G2-A G3-A G3-M G4-A G4-B G4-M G5-A G6-A H0-A H0-B H0-C L0-A L1-A L2-A").split()
FOLDER = "networks/1-complete_data-mixed-all-1-sw"


def read(path: Path, columns: list[str]) -> np.ndarray:
    """The named columns of one of simbench's csv files: [rows, columns]."""
    with path.open() as file:
        header = file.readline().strip().split(";")
    return np.loadtxt(path, delimiter=";", skiprows=1, usecols=[header.index(c) for c in columns])


def main() -> None:
    """Writes the pack next to this file."""
    spec = importlib.util.find_spec("simbench")
    if spec is None or spec.origin is None:
        raise SystemExit("pip install --no-deps simbench==1.6.3 first")
    folder = Path(spec.origin).parent / FOLDER
    values = np.concatenate(
        [read(folder / "RESProfile.csv", SOLAR), read(folder / "LoadProfile.csv", [f"{x}_pload" for x in LOADS])],
        axis=1,
    )
    pack = np.round(np.clip(values / values.max(axis=0), 0, 1) * 65535).astype(np.uint16)
    with lzma.open(Path(__file__).parent / "simbench_profiles.npy.xz", "wb", preset=9) as file:
        # column by column, which is what compresses
        np.save(file, np.asfortranarray(pack))


if __name__ == "__main__":
    main()
