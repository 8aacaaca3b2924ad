"""TOML files of settings: where they are, what they extend, and the presets that may be laid over them."""

from __future__ import annotations

import os
import pathlib
import shlex
import tomllib
from typing import Any

from ..errors import UsageError
from ..tasks import did_you_mean

_PACKAGE = pathlib.Path(__file__).parents[1]
CONFIG_DIR = _PACKAGE / "configs" if (_PACKAGE / "configs").is_dir() else _PACKAGE.parent / "configs"
_PRESETS = "presets"

Table = dict[str, Any]


def names() -> list[str]:
    """The configurations that come with the package, each named by its path in configs/: `lane`, `paper/ant_2x4`."""
    return [name for name in _names(CONFIG_DIR) if not name.startswith(f"{_PRESETS}/")]


def presets() -> dict[str, str]:
    """What can be laid over any configuration: {name: one sentence about it}."""
    return {name: about(f"{_PRESETS}/{name}") for name in _names(CONFIG_DIR / _PRESETS)}


def _names(folder: pathlib.Path) -> list[str]:
    return sorted(path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.toml"))


def about(name: str) -> str:
    """The sentence in which a file of configs/ describes itself; '' if it has none."""
    path = CONFIG_DIR / f"{name}.toml"
    return str(_parse(path).get("about", "")) if path.is_file() else ""


def read(source: str | pathlib.Path) -> Table:
    """The settings of a file, laid over those of the file that it `extends`.

    Args:
      source: one of `names()`, or the path of a TOML file.

    Raises:
      UsageError: no such file, or one that is not valid.
    """
    return _resolve(_find(str(source)), ())


def read_preset(name: str) -> Table:
    """The settings of a preset.

    Raises:
      UsageError: there is none of that name.
    """
    if name not in _names(CONFIG_DIR / _PRESETS):
        raise UsageError(f"unknown preset '{name}'{did_you_mean(name, _names(CONFIG_DIR / _PRESETS))}")
    return read(CONFIG_DIR / _PRESETS / f"{name}.toml")


def resume_command(out: str) -> str:
    """What continues the run in the folder `out`, to be typed into a shell."""
    return shlex.join(["pmt", "train", os.path.join(out, "config.toml"), "--out", out, "--resume"])


def _find(source: str) -> pathlib.Path:
    known = names()
    if source in known:
        return CONFIG_DIR / f"{source}.toml"
    if source.endswith(".toml") or os.path.isfile(source):
        return pathlib.Path(source)
    if os.path.isfile(settings := os.path.join(source, "config.toml")):
        again = resume_command(source)
        raise UsageError(f"{source} is a run folder; its settings are {settings}, and this continues it: {again}")
    raise UsageError(f"unknown task '{source}'{did_you_mean(source, known)} (pmt envs lists all)")


def _resolve(path: pathlib.Path, below: tuple[pathlib.Path, ...]) -> Table:
    """A file's settings; `below` are the files that it was reached from by `extends`."""
    table = _parse(path)
    table.pop("about", None)
    base = table.pop("extends", None)
    if base is None:
        return table
    if not isinstance(base, str):
        raise UsageError(f"{path}: 'extends' must be one name in configs/ or one path, not {base!r}")
    found = CONFIG_DIR / f"{base}.toml" if base in names() else path.parent / base
    if not found.is_file():
        raise UsageError(f"{path} extends '{base}', which is not there{did_you_mean(base, names())}")
    chain = (*below, path.resolve())
    if found.resolve() in chain:
        raise UsageError(f"{path} extends '{base}', which extends it in turn")
    return over(_resolve(found, chain), table)


def over(base: Table, top: Table) -> Table:
    """`top` laid over `base`, tables within them key by key."""
    both = {key: over(base[key], top[key]) for key in base.keys() & top.keys() if _tables(base[key], top[key])}
    return {**base, **top, **both}


def _tables(*values: Any) -> bool:
    return all(isinstance(value, dict) for value in values)


def _parse(path: pathlib.Path) -> Table:
    try:
        return tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise UsageError(f"{path} is not valid TOML: {error}") from None
    except FileNotFoundError:
        raise UsageError(f"there is no configuration file {path}") from None
    except (OSError, ValueError) as error:  # ValueError: a path with a null character
        reason = getattr(error, "strerror", None) or error
        raise UsageError(f"cannot read the configuration file {path}: {reason}") from None
