"""Load and solar profiles for the voltage-control tasks: measured, generated, or a user's own folder in MAPDN's format.

A row is 3 minutes. Profiles may be stored as coarser knots (15 minutes); the environment interpolates between them
while it runs, as MAPDN did once and for all when it made its files.
"""

from __future__ import annotations

import dataclasses
import lzma
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import TaskError
from .power_flow import DATA

MINUTES = 3  # of a row
ROWS_PER_DAY = 24 * 60 // MINUTES
KNOT_ROWS = 5  # rows between the 15-minute knots of measured and generated profiles
FILES = ("load_active.csv", "load_reactive.csv", "pv_active.csv")
# MW, largest sum of all loads. MAPDN's README states 3.5 and 20; these make the zero, random and droop policies reach
# the figures that are published for the genuine data (docs/design/earlier.md says where they are side by side).
PEAK_LOAD = {
    ("simbench", "case33"): 3.15,
    ("simbench", "case141"): 18.0,
    ("synthetic", "case33"): 3.15,
    ("synthetic", "case141"): 13.0,
}
SIMBENCH_PV = 8  # the first columns of the SimBench pack; the others are loads


@dataclasses.dataclass(frozen=True, eq=False)
class Profiles:
    """Time series of one network, in MW and MVAr.

    Attributes:
      pv: [K, n_pv] active power of each PV plant (agent).
      p_load, q_load: [K, n_load] active and reactive power of each load.
      rows_per_knot: rows of 3 minutes from one of the K entries to the next.
      source: for messages.
    """

    pv: np.ndarray
    p_load: np.ndarray
    q_load: np.ndarray
    rows_per_knot: int = 1
    source: str = "profiles"

    def __post_init__(self) -> None:
        if not len(self.pv) == len(self.p_load) == len(self.q_load):
            raise TaskError(f"{self.source}: PV, active and reactive load must have equally many rows")
        for name in ("pv", "p_load", "q_load"):
            if not np.isfinite(getattr(self, name)).all():
                raise TaskError(f"{self.source}: {name} contains values that are not finite")

    @property
    def num_rows(self) -> int:
        """Rows of 3 minutes, those between the knots included."""
        return (len(self.pv) - 1) * self.rows_per_knot + 1

    @property
    def days(self) -> int:
        """Whole days between the first row and the last."""
        return (self.num_rows - 1) // ROWS_PER_DAY

    def scaled(self, pv: float = 1.0, demand: float = 1.0) -> Profiles:
        """The same with all PV and all loads multiplied."""
        return dataclasses.replace(self, pv=self.pv * pv, p_load=self.p_load * demand, q_load=self.q_load * demand)

    def row_std(self) -> np.ndarray:
        """[n_pv + 2 n_load] population standard deviation of each column over all rows, interpolated ones included."""
        knots = np.concatenate([self.pv, self.p_load, self.q_load], axis=1).astype(np.float64)
        mean = knots.mean(axis=0)
        knots = knots - mean  # so that the squares below do not cancel
        total, square = knots[-1], knots[-1] ** 2
        for weight in np.arange(self.rows_per_knot) / self.rows_per_knot:
            rows = knots[:-1] * (1 - weight) + knots[1:] * weight
            total, square = total + rows.sum(axis=0), square + (rows**2).sum(axis=0)
        return np.sqrt(np.maximum(square / self.num_rows - (total / self.num_rows) ** 2, 0))


def load_profiles(source: str | Path | Profiles, name: str, table: dict[str, np.ndarray]) -> Profiles:
    """Profiles for the network `name` with the facts `table`.

    Args:
      source: "simbench", "synthetic" or "synthetic:SEED", a folder in MAPDN's format, an npz of `save_profiles`, or
        Profiles as they are.
    """
    if isinstance(source, Profiles):
        profiles = source
    elif source == "simbench":
        profiles = simbench_profiles(name, table)
    elif str(source).split(":")[0] == "synthetic":
        profiles = synthetic_profiles(name, table, seed=_seed(str(source)))
    else:
        profiles = _from_disk(Path(source), len(table["load_bus"]), len(table["pv_bus"]))
    expected = (len(table["pv_bus"]), len(table["load_bus"]), len(table["load_bus"]))
    found = tuple(x.shape[1] for x in (profiles.pv, profiles.p_load, profiles.q_load))
    if found != expected:
        raise TaskError(f"{profiles.source}: {found} columns of PV, active, reactive load; '{name}' needs {expected}")
    return profiles


def _seed(source: str) -> int:
    _, _, seed = source.partition(":")
    if seed and not seed.isdecimal():
        raise TaskError(f"data '{source}': the seed after 'synthetic:' must be a whole number, e.g. synthetic:7")
    return int(seed or 0)


def _from_disk(path: Path, num_loads: int, num_pvs: int) -> Profiles:
    if path.is_dir():
        return load_folder(path, num_loads, num_pvs)
    if path.suffix == ".npz" and path.is_file():
        return _from_npz(path)
    raise TaskError(f"data '{path}' is neither 'simbench', 'synthetic', a folder with {', '.join(FILES)}, nor an npz")


def _from_npz(path: Path) -> Profiles:
    try:
        with np.load(path) as file:
            if missing := {"pv", "p_load", "q_load", "rows_per_knot"} - set(file.files):
                raise TaskError(f"{path} was not written by save_profiles; it lacks {', '.join(sorted(missing))}")
            arrays = {key: file[key].astype(float) for key in ("pv", "p_load", "q_load")}
            rows_per_knot = int(file["rows_per_knot"])
    except TaskError:
        raise
    except (ValueError, TypeError, OSError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise TaskError(f"{path} cannot be read: {error}") from None
    return Profiles(**arrays, rows_per_knot=rows_per_knot, source=str(path))


# MAPDN's folder


def load_folder(path: Path, num_loads: int, num_pvs: int) -> Profiles:
    """The three csv files of a MAPDN data folder: a first column of times, then one column per load or PV, MW or MVAr.

    Column headers do not matter, order does: loads by ascending bus, PVs in the order of the agents. The folder's
    `model.p` is not read (see `unpickle_network`).

    Raises:
      TaskError: a file that is missing or malformed, other columns than the network has, unequal or irregular times,
        values that cannot be MW.
    """
    read = {}
    times = None
    for file, columns in zip(FILES, (num_loads, num_loads, num_pvs), strict=True):
        read[file], stamps = _read_csv(path / file, columns)
        if times is None:
            times = stamps
            _check_times(path / file, stamps)
        elif len(times) != len(stamps):
            raise TaskError(f"{path}: {FILES[0]} has {len(times)} rows, {file} has {len(stamps)}; they must be equal")
        elif not np.array_equal(times, stamps):
            first = int(np.argmax(times != stamps))
            raise TaskError(f"{path}: {FILES[0]} and {file} have different times in row {first + 1}")
    profiles = Profiles(read[FILES[2]], read[FILES[0]], read[FILES[1]], source=str(path))
    _check_units(path, profiles)
    return profiles


def _read_csv(path: Path, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """[rows, columns] values and [rows] times of one file."""
    if not path.is_file():
        raise TaskError(f"{path} is missing; a data folder holds {', '.join(FILES)}")
    try:
        with path.open(encoding="utf-8-sig") as file:
            header = file.readline().rstrip("\n").split(",")
    except UnicodeDecodeError:
        raise TaskError(f"{path} is not a text of comma-separated values") from None
    if len(header) != columns + 1:
        raise TaskError(f"{path} has {len(header)} columns, expected a time and {columns} values")
    try:
        values = np.loadtxt(
            path, delimiter=",", skiprows=1, usecols=range(1, columns + 1), ndmin=2, encoding="utf-8-sig"
        )
        stamps = np.loadtxt(path, delimiter=",", skiprows=1, usecols=0, dtype=str, ndmin=1, encoding="utf-8-sig")
    except (ValueError, IndexError) as error:
        raise TaskError(f"{path} cannot be read as numbers: {error}") from error
    if len(values) < 2:
        raise TaskError(f"{path} has {len(values)} rows, too few to simulate")
    return values, _times(path, stamps)


def _times(path: Path, stamps: np.ndarray) -> np.ndarray:
    stamps = np.char.strip(stamps, '" ')
    try:
        return stamps.astype("datetime64[s]")
    except ValueError:
        pass  # not ISO 8601; pandas reads more formats
    try:
        import pandas

        return pandas.to_datetime(stamps).to_numpy().astype("datetime64[s]")
    except ImportError:
        raise TaskError(f"{path}: times like '{stamps[0]}' need pandas (pip install pandas), or ISO 8601") from None
    except ValueError as error:
        raise TaskError(f"{path}: '{stamps[0]}' is not a time: {error}") from error


def _check_times(path: Path, times: np.ndarray) -> None:
    steps = np.diff(times).astype("timedelta64[s]").astype(int)
    wrong = np.flatnonzero(steps != MINUTES * 60)
    if wrong.size:
        i = int(wrong[0])
        raise TaskError(f"{path}: {steps[i] / 60:g} minutes from row {i + 1} to {i + 2}, expected {MINUTES} throughout")


def _check_units(path: Path, profiles: Profiles) -> None:
    """Refuses what can only be kW, and generation or consumption written as negative."""
    if profiles.pv.min() < -1e-6:
        raise TaskError(f"{path / FILES[2]}: PV power is {profiles.pv.min():g}, generation must not be negative")
    if profiles.p_load.min() < -1e-6:
        raise TaskError(f"{path / FILES[0]}: a load is {profiles.p_load.min():g}, consumption must not be negative")
    largest = max(np.abs(x).max() for x in (profiles.pv, profiles.p_load, profiles.q_load))
    if largest > 200:
        raise TaskError(f"{path}: the largest value is {largest:g}; MW and MVAr are expected, this looks like kW")


def save_profiles(path: str | Path, profiles: Profiles) -> None:
    """Writes `profiles` to an npz that loads in a moment; MAPDN's csv files take half a minute.

    Rows that lie on straight lines between 15-minute knots, as MAPDN's do, are stored as these knots.
    """
    kept = at_knots(profiles) or profiles
    arrays = {key: getattr(kept, key).astype(np.float64) for key in ("pv", "p_load", "q_load")}
    np.savez_compressed(path, allow_pickle=False, **arrays, rows_per_knot=kept.rows_per_knot)


def at_knots(profiles: Profiles, tolerance: float = 2e-6) -> Profiles | None:
    """The 15-minute knots of 3-minute rows, or None if rows stray from straight lines by more than `tolerance` MW.

    Knots are rows 0, 5, 10, ...; profiles whose straight lines break at other rows are left alone.
    """
    if profiles.rows_per_knot != 1 or profiles.num_rows % KNOT_ROWS != 1:
        return None
    weight = (np.arange(KNOT_ROWS) / KNOT_ROWS)[None, :, None]
    kept = {}
    for key in ("pv", "p_load", "q_load"):
        rows = getattr(profiles, key)
        knots = rows[::KNOT_ROWS]
        line = knots[:-1, None] * (1 - weight) + knots[1:, None] * weight
        if np.abs(line.reshape(-1, rows.shape[1]) - rows[:-1]).max() > tolerance:
            return None
        kept[key] = knots
    return dataclasses.replace(profiles, **kept, rows_per_knot=KNOT_ROWS)


def unpickle_network(path: str | Path, *, trust: bool = False) -> Any:
    """The pandapower net in MAPDN's `model.p`. Unpickling runs whatever code the file holds: only with `trust=True`."""
    if not trust:
        raise TaskError(f"{path} is a pickle, which can run any code; pass trust=True if you know where it comes from")
    with Path(path).open("rb") as file:
        return pickle.load(file)


# Measured profiles


def simbench_pack() -> tuple[np.ndarray, np.ndarray]:
    """[35136, 8] solar and [35136, 18] load profiles of 2016 in 15-minute steps, maximum 1 each (ODbL 1.0)."""
    with lzma.open(DATA / "simbench_profiles.npy.xz") as file:
        pack = np.load(file).astype(np.float64) / 65535
    return pack[:, :SIMBENCH_PV], pack[:, SIMBENCH_PV:]


def simbench_profiles(name: str, table: dict[str, np.ndarray]) -> Profiles:
    """SimBench's measured year on a network: each region has a solar profile, each load a consumer's."""
    solar, load = simbench_pack()
    random = np.random.Generator(np.random.Philox(33))
    order = np.concatenate([random.permutation(load.shape[1]) for _ in range(-(-len(table["p0"]) // load.shape[1]))])
    return _on_network(name, table, solar, load[:, order[: len(table["p0"])]], random, "simbench")


def _on_network(
    name: str,
    table: dict[str, np.ndarray],
    solar: np.ndarray,
    load: np.ndarray,
    random: np.random.Generator,
    source: str,
) -> Profiles:
    """Scales unit profiles to the network, as MAPDN's paper describes.

    Args:
      solar: [K, any] one column per region, repeated if there are more regions.
      load: [K, n_load]; sizes follow the nominal loads, their common peak is in PEAK_LOAD.
    """
    region = table["zone"][table["pv_bus"]]
    pv = solar[:, (region - 1) % solar.shape[1]]
    pv = pv * (table["s_max"] / 1.2 / pv.max(axis=0))
    p_load = load * (table["p0"] / load.mean(axis=0))
    p_load *= PEAK_LOAD.get((source.split(":")[0], name), float(table["p0"].sum())) / p_load.sum(axis=1).max()
    ratio = table["q0"] / table["p0"] * random.uniform(0.95, 1.05, len(table["p0"]))
    return Profiles(pv, p_load, p_load * ratio, rows_per_knot=KNOT_ROWS, source=source)


# Generated profiles


def synthetic_profiles(name: str, table: dict[str, np.ndarray], seed: int = 0, days: int = 366) -> Profiles:
    """Profiles drawn from a seed: the same numbers on every machine.

    Sun: the clear-sky curve of 50 degrees north times a cloudiness that changes from day to day and within the day, one
    per region with a part in common. Loads: households, shops or industry by the hour and the weekday, heavier in
    winter, times a slow random factor.
    """
    random = np.random.Generator(np.random.Philox(seed))
    quarter = np.arange(days * 96 + 1)
    hour, day = quarter % 96 / 4, quarter // 96
    regions = int(table["zone"].max())
    solar = _clear_sky(hour, day)[:, None] * _clouds(random, days, regions)[quarter]
    loads = _consumers(random, hour, day, len(table["p0"]))
    return _on_network(name, table, solar, loads, random, f"synthetic:{seed}")


def _clear_sky(hour: np.ndarray, day: np.ndarray) -> np.ndarray:
    latitude = np.radians(50.0)
    declination = np.radians(23.44) * np.sin(2 * np.pi * (day - 80) / 365.25)
    height = np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(
        np.pi * (hour - 12) / 12
    )
    return np.maximum(height, 0) ** 1.2


def _clouds(random: np.random.Generator, days: int, regions: int) -> np.ndarray:
    """[96 days + 1, regions] in [0, 1], share of the clear sky's power."""
    steps = days * 96 + 1
    daily = np.repeat(_smooth(random, days + 1, 1, 0.5), 96, axis=0)[:steps]
    common = _smooth(random, steps, 1, 0.97)
    own = _smooth(random, steps, regions, 0.94)
    logit = 0.4 + 1.0 * daily + 0.7 * common + 0.5 * own
    return 0.08 + 0.92 / (1 + np.exp(-1.6 * logit))


def _consumers(random: np.random.Generator, hour: np.ndarray, day: np.ndarray, count: int) -> np.ndarray:
    """[len(hour), count] relative demand."""
    weekend = (day + 4) % 7 >= 5  # day 0 is a Friday, as 2016-01-01 was
    bump = lambda centre, width: np.exp(-0.5 * (((hour - centre + 12) % 24 - 12) / width) ** 2)  # noqa: E731
    household = 0.35 + 0.35 * bump(8, 1.5) + 0.35 * bump(13, 2.5) + 0.8 * bump(19.5, 2.2)
    shop = 0.25 + 0.85 * bump(13, 3.8) * np.where(weekend, 0.45, 1.0)
    industry = 0.55 + 0.45 * bump(12, 5.0) * np.where(weekend, 0.3, 1.0)
    season = 1 + 0.15 * np.cos(2 * np.pi * (day - 15) / 365.25)
    mix = random.dirichlet([1.2, 0.8, 0.6], count)
    shape = np.stack([household, shop, industry], axis=1) * season[:, None]
    return shape @ mix.T * np.exp(0.18 * _smooth(random, len(hour), count, 0.95))


def _smooth(random: np.random.Generator, steps: int, columns: int, memory: float) -> np.ndarray:
    """[steps, columns] first-order autoregressive noise of unit variance."""
    noise = random.standard_normal((steps, columns)) * np.sqrt(1 - memory**2)
    noise[0] /= np.sqrt(1 - memory**2)
    for i in range(1, steps):
        noise[i] += memory * noise[i - 1]
    return noise
