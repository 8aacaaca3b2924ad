"""Recorded episodes as a data set of Minari; needs the extra `minari`."""

from __future__ import annotations

import shutil
import warnings
from typing import Any

import numpy as np

from ..errors import UsageError, optional

PREFIX = "minari:"


def check(name: str) -> None:
    """Whether a data set can have the name `minari:[NAMESPACE/]NAME-vVERSION`.

    Raises:
      UsageError: the name is not one of Minari, a data set has it already, or the extra is missing.
    """
    minari = optional("minari", "minari")
    optional("h5py", "minari")
    dataset = name.removeprefix(PREFIX)
    parse = optional("minari.dataset.minari_dataset", "minari").parse_dataset_id
    try:
        version = parse(dataset)[2]
    except (ValueError, TypeError):  # the latter of a name without a version
        version = None
    if version is None:
        raise UsageError(f"cannot write '{name}': a Minari data set is called like minari:lane/mappo_l-v0")
    if dataset in minari.list_local_datasets(latest_version=False):
        raise UsageError(f"cannot write '{name}': there is such a Minari data set; choose another name or version")


def write(name: str, steps: dict[str, Any]) -> None:
    """Writes the arrays that `pmt eval --save` records, [S, E, T, ...], as one data set of S * E episodes.

    Observations are [T + 1, N, O] with the last one of the episode, actions [T, N, A]. The costs, the task's metrics
    and the seed of the run are `infos`. The data set lies where Minari looks for it (MINARI_DATASETS_PATH).

    Raises:
      UsageError: the folder of data sets cannot be written.
    """
    spaces = optional("gymnasium", "minari").spaces
    create = optional("minari.utils", "minari").create_dataset_from_buffers
    buffer = optional("minari.data_collector", "minari").EpisodeBuffer
    infos = [*(x for x in steps if x.startswith("info/")), "cost", "true_cost"]  # the last of a name counts
    episodes = []
    for i, seed in enumerate(steps["seed"]):
        for j, length in enumerate(steps["length"][i]):
            one = {key: x[i, j, :length] for key, x in steps.items() if key not in ("seed", "length", "final_obs")}
            signals = {key.removeprefix("info/"): one[key] for key in infos} | {"seed": np.full(length, seed)}
            episodes.append(
                buffer(
                    observations=np.concatenate([one["obs"], steps["final_obs"][i, j][None]]),  # pyright: ignore[reportArgumentType]
                    actions=one["action"],
                    rewards=one["reward"],
                    terminations=one["terminated"],
                    truncations=one["truncated"],
                    infos=signals,
                )
            )
    observation, action = (spaces.Box(-np.inf, np.inf, steps[key].shape[3:]) for key in ("obs", "action"))
    dataset = name.removeprefix(PREFIX)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it misses an author and a gymnasium environment
            create(
                dataset,
                episodes,
                observation_space=observation,
                action_space=action,
                description="Episodes that pmt eval recorded (pmt-jax)",
                data_format="hdf5",
            )
    except OSError as error:
        paths = optional("minari.storage.datasets_root_dir", "minari")
        shutil.rmtree(paths.get_dataset_path(dataset), ignore_errors=True)
        raise UsageError(f"cannot write '{name}': {error.strerror or error}; set MINARI_DATASETS_PATH") from error
