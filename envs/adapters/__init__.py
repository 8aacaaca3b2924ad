"""Tasks as environments of other libraries: gymnasium, PettingZoo, brax.

The library is imported when its adapter is first asked for (`pip install "pmt-jax[adapters]"` brings all three).

Examples:
  >>> import envs
  >>> vector = to_gymnasium(envs.make("lane"), num_envs=3)
  >>> obs, info = vector.reset(seed=0)
  >>> obs.shape  # environments, agents, observation
  (3, 2, 8)
  >>> obs, reward, terminated, truncated, info = vector.step(vector.action_space.sample())
  >>> info["cost"].shape  # environments, agents, costs
  (3, 2, 1)
"""

from __future__ import annotations

import importlib
import types
from typing import TYPE_CHECKING

from ..base import Env
from ..errors import TaskError

if TYPE_CHECKING:
    from .brax_env import BraxEnv
    from .gymnasium_vector import GymnasiumVector
    from .pettingzoo_parallel import PettingZooParallel

__all__ = ["to_brax", "to_gymnasium", "to_pettingzoo"]


def to_gymnasium(env: Env, num_envs: int, seed: int = 0) -> GymnasiumVector:
    """`num_envs` copies of `env` as a `gymnasium.vector.VectorEnv` that resets in the same step.

    Observations are [num_envs, N, O] and actions [num_envs, N, A] in [-1, 1]; the reward is the team's. `info` holds
    `cost` [num_envs, N, K], `global_state` [num_envs, S], the task's scalars, and `final_obs` where an episode ended.

    Args:
      seed: of the first episodes where `reset` names none.

    Raises:
      TaskError: gymnasium is not installed.
    """
    return _adapter("gymnasium", "gymnasium_vector").GymnasiumVector(env, num_envs, seed)


def to_pettingzoo(env: Env, seed: int = 0) -> PettingZooParallel:
    """`env` as a `pettingzoo.ParallelEnv`: agents `agent_0` ..., each with the actions it has (padding cut off).

    Every agent gets the team's reward; its costs [K] are in `infos[agent]["cost"]`; `state()` is the global state.

    Args:
      seed: of the first episode where `reset` names none.

    Raises:
      TaskError: PettingZoo is not installed.
    """
    return _adapter("pettingzoo", "pettingzoo_parallel").PettingZooParallel(env, seed)


def to_brax(env: Env) -> BraxEnv:
    """`env` as a `brax.envs.Env` with one controller for the whole team, for brax's wrappers and training code.

    The observation is all agents' [N * O] in a row, the action [N * A]. `metrics` holds `cost` (one agent's, mean over
    agents, summed over K) and the task's own scalars. brax's EpisodeWrapper brings the time limit: give it
    `env.spec.horizon`.

    Raises:
      TaskError: brax is not installed.
    """
    return _adapter("brax", "brax_env").BraxEnv(env)


def _adapter(library: str, module: str) -> types.ModuleType:
    """The module of the adapter to `library`, imported on first use."""
    try:
        return importlib.import_module(f".{module}", __name__)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] != library:
            raise
        raise TaskError(f"this adapter needs {library}, which is not installed: pip install {library}") from None
