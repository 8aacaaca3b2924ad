"""Voltage control against rollouts recorded from the genuine MAPDN class, and everything the recordings do not show."""

from __future__ import annotations

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs import grid_data
from envs.errors import TaskError

DATA = Path(__file__).parent / "data"
FOLDER = DATA / "mapdn_format_case33"
ROWS_A_DAY = 480


@functools.cache
def recorded(tag: str) -> dict[str, np.ndarray]:
    with np.load(DATA / "grid_env_reference_case33.npz") as file:
        return {k.split("/")[-1]: file[k] for k in file.files if f"/{tag}/" in k}


def start_row(data: dict[str, np.ndarray]) -> int:
    day, hour, interval = data["start"]
    return int(interval + hour * 20 + day * ROWS_A_DAY)


def worst(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(np.abs(np.asarray(ours, np.float64) - theirs).max())


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-7), ("float32", 1e-5)])
@pytest.mark.parametrize(
    ("tag", "options"), [("full_nonoise", {}), ("bowl", {"barrier": "bowl"}), ("history3", {"history": 3})]
)
def test_recorded_rollouts_are_replayed(tag: str, options: dict, dtype: str, tolerance: float) -> None:
    data = recorded(tag)
    with jax.enable_x64(dtype == "float64"):
        env = envs.make("voltage_33", noise=False, data=FOLDER, **options)
        state = jax.jit(env.restore)(start_row=start_row(data), q=data["q_prev"][0])
        actions = jnp.asarray(data["action"] / 0.8, dtype)[..., None]
        _, states = jax.jit(lambda s, a: jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, s, a))(state, actions)
        assert state.obs.dtype == dtype
    frames, flows = len(data["obs"]) - 1, len(data["vm"])
    errors = {
        "obs": max(worst(state.obs, data["obs"][0]), worst(states.obs[:frames], data["obs"][1:])),
        "state": max(
            worst(state.global_state, data["state"][0]), worst(states.global_state[:frames], data["state"][1:])
        ),
        "reward": worst(states.reward, data["reward"]),
        "vm": worst(states.carry.vm_pu[:flows], data["vm"]),
        "va": worst(np.rad2deg(states.carry.va_rad[:flows]), data["va"]),
        "pbus": worst(states.carry.p_bus[:flows], data["pbus"]),
        "qbus": worst(states.carry.q_bus[:flows], data["qbus"]),
        "line_loss": worst(states.carry.line_loss_mw[:flows], data["line_loss"].sum(axis=1)),
        "pv_next": worst(states.carry.row[-1, :6], data["pv_next"]),
        "pl_next": worst(states.carry.row[-1, 6:38], data["pl_next"]),
        **{f"info {k}": worst(states.info[k], data["info"][:, i]) for i, k in enumerate(data["info_keys"])},
    }
    print({k: f"{e:.1e}" for k, e in errors.items()})
    assert set(data["info_keys"]) == set(states.info)
    assert {k: e for k, e in errors.items() if not e <= tolerance} == {}
