"""What a run was made with: its settings and trials; and whether another may continue it from there."""

from __future__ import annotations

import dataclasses
import json
import pathlib
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .. import numerics
from ..config.load import load_config, to_toml
from ..config.settings import Config
from ..errors import UsageError
from ..learning.setup import Setup
from ..output import Say
from ..tasks import is_file

# What --change keeps: who the run is, and what is read at its start only.
FIXED = ("task", "method", "seed", "seeds", "init", "num_envs", "rollout_length", "episode_starts")


@dataclasses.dataclass(frozen=True)
class Provenance:
    """What a checkpoint belongs to.

    Attributes:
      config: the settings of its run.
      trials: of a program of a sweep, {setting: its value in each trial}, and their seeds as `seed`; else empty.
    """

    config: Config
    trials: dict[str, list[Any]] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, setup: Setup) -> Provenance:
        """What checkpoints of this setup belong to."""
        if setup.trials is None:
            return cls(setup.config)
        traced = {"seed": setup.trials.seed, **vars(setup.trials.hyper)}
        return cls(setup.config, {name: np.asarray(x).tolist() for name, x in traced.items()})

    def to_bytes(self, step: int) -> np.ndarray:
        """[bytes] uint8, JSON: what is said of the checkpoint after `step`."""
        seeds = self.trials.get("seed") or [self.config.seed + i for i in range(self.config.seeds)]
        said = {"step": step, "seeds": seeds, "settings": to_toml(self.config), "trials": self.trials}
        return np.frombuffer(json.dumps(said).encode(), np.uint8)

    @classmethod
    def from_bytes(cls, data: np.ndarray) -> tuple[int, Provenance]:
        """The inverse of `to_bytes`.

        Raises:
          UsageError: it has settings that this version of pmt-jax does not know.
        """
        said = json.loads(data.tobytes())
        return said["step"], cls(load_config(tomllib.loads(said["settings"])), said["trials"])

    def differences(self, other: Provenance) -> dict[str, str]:
        """{setting: 'ours -> theirs'} of all that differs but the steps to train.

        A Python file is the same task or method in another folder. Trials are not compared where one of both has none.
        """
        found = differences(self.config, other.config)
        for field in ("task", "method"):
            named = [getattr(provenance.config, field) for provenance in (self, other)]
            if all(map(is_file, named)) and len({pathlib.Path(name).name for name in named}) == 1:
                found.pop(field, None)
        if self.trials and other.trials:
            pairs = {name: (repr(x), repr(other.trials.get(name))) for name, x in self.trials.items()}
            found |= {f"{name} of the trials": f"{x} -> {y}" for name, (x, y) in pairs.items() if x != y}
        return {name: change for name, change in found.items() if name != "steps"}

    def unexplained(self, step: int, config: Config, changes: Sequence[Mapping[str, Any]]) -> dict[str, str]:
        """{setting: 'its value here -> its value in `config`'} of what the `changes` from `step` on do not explain."""
        found = self.differences(Provenance(config))
        made = {name: x for row in changes if row["step"] >= step for name, x in row["changed"].items()}
        return {name: x for name, x in found.items() if made.get(name, "").split(" -> ")[-1] != x.split(" -> ")[-1]}


def differences(old: Config, new: Config) -> dict[str, str]:
    """{field: 'old -> new'} of the settings that are not the same; a nan is the same as a nan."""

    def shown(config: Config, name: str) -> str:
        value = getattr(config, name)
        return ", ".join(f"{option}={x}" for option, x in value) or "none" if name == "env" else repr(value)

    pairs = {f.name: (shown(old, f.name), shown(new, f.name)) for f in dataclasses.fields(Config)}
    return {name: f"{a} -> {b}" for name, (a, b) in pairs.items() if a != b}


def check_settings(
    folder: pathlib.Path, made: Provenance, asked: Provenance, edited: Mapping[str, str], change: bool, say: Say
) -> None:
    """Only `steps` may change when a run is continued; with `change` all settings but FIXED.

    Args:
      made, asked: what the run in `folder` was made with, and what is to continue it.
      edited: what its config.toml says differently since, by setting.

    Raises:
      UsageError: something else has changed.
    """
    file = folder / "config.toml"
    changed = made.differences(asked)
    refused = {name: x for name, x in changed.items() if name in FIXED or not change}
    if edited and not changed:
        say(f"{file} was edited since the checkpoint; the run continues with the settings it had:{listed(edited)}")
    if not refused:
        return
    advice = "resume it unchanged (only --steps may grow), add --change to continue with the new ones"
    fixed = [name for name in refused if name in FIXED]
    if edited and not change:
        advice = f"{file} was edited since; mend it{'' if fixed else ', add --change to continue with what it says'}"
    elif fixed:
        advice = f"--change cannot change {', '.join(fixed)}; leave them as they are"
    raise UsageError(
        f"the run in {folder} was made with other settings; {advice}, or choose another --out:{listed(refused)}"
    )


def check_machine(folder: pathlib.Path, physics: str, new: Mapping[str, Any], say: Say) -> None:
    """Refuses another engine or other random numbers; says which versions changed, which costs the last bits.

    Args:
      folder: of the run to continue.
      physics: the setting by which this machine takes its engine.
      new: what the results depend on here (`run_folder.versions`).

    Raises:
      UsageError: the run cannot be continued here.
    """
    old = recorded_versions(folder)
    if old is None:
        say(f"{folder / 'versions.json'} cannot be read: the engine and the versions of the run are unknown")
        return
    if old.get("engine", new["engine"]) != new["engine"]:
        raise UsageError(
            f"the run in {folder} was simulated by engine '{old['engine']}', but physics = {physics} means "
            f"'{new['engine']}' on this {new['device']}, whose numbers differ; resume it where '{old['engine']}' runs, "
            "or choose another --out"
        )
    plain = [name for name in new if name in old and not isinstance(new[name], dict)]
    changed = [f"{name} {old[name]} -> {new[name]}" for name in plain if old[name] != new[name]]
    changed += numerics.changes(old, new, folder)
    if changed:
        say(f"changed since the run began: {', '.join(changed)}; the run may not continue bit for bit")


def recorded_versions(out: pathlib.Path) -> dict[str, Any] | None:
    """What versions.json holds; None if it cannot be read."""
    try:
        return dict(json.loads((out / "versions.json").read_text()))
    except (OSError, ValueError, TypeError):
        return None


def listed(changed: Mapping[str, str]) -> str:
    """Settings and what differs in them, a line each."""
    return "".join(f"\n  {name}: {x}" for name, x in changed.items())
