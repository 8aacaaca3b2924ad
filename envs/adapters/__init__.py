"""Tasks as environments of other libraries (gymnasium, PettingZoo, brax, JaxMARL), and brax environments as tasks.

An adapter imports its library on first use (`pip install "pmt-jax[adapters]"` installs the first three).
`to_jaxmarl` and `from_brax` import none.

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
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..base import Env
from ..errors import TaskError

if TYPE_CHECKING:
    from gymnasium.vector import AutoresetMode

    from .brax_env import BraxEnv
    from .from_brax_env import FromBrax
    from .gymnasium_vector import GymnasiumVector
    from .jaxmarl_env import JaxMarlEnv
    from .pettingzoo_parallel import PettingZooParallel

__all__ = ["from_brax", "to_brax", "to_gymnasium", "to_jaxmarl", "to_pettingzoo"]


def to_gymnasium(
    env: Env, num_envs: int, seed: int = 0, autoreset_mode: AutoresetMode | str = "SameStep"
) -> GymnasiumVector:
    """`num_envs` copies of `env` as a `gymnasium.vector.VectorEnv`.

    Observations are [num_envs, N, O] and actions [num_envs, N, A] in [-1, 1]; the reward is the team's. `info` holds
    `cost` [num_envs, N, K] of the step, `global_state` [num_envs, S] and the task's scalars. All arrays are copies.

    Args:
      seed: of the first episodes if `reset` names none.
      autoreset_mode: when an episode that has ended begins anew. In the same step (`SameStep`), `info` then holds
        `final_obs` and `final_info`, which has the last `global_state`, `cost` and scalars, for the environments of
        `_final_obs`. Or in the next step (`NextStep`), which ignores that environment's action and has reward and cost
        0, as gymnasium's wrappers with running statistics or other observations want it.

    Raises:
      TaskError: gymnasium is not installed, `num_envs` is not 1 or more, or there is no such mode.
    """
    return _adapter("gymnasium", "gymnasium_vector").GymnasiumVector(env, num_envs, seed, autoreset_mode)


def to_pettingzoo(env: Env, seed: int = 0) -> PettingZooParallel:
    """`env` as a `pettingzoo.ParallelEnv`: agents `agent_0` ..., each with the actions it has (padding cut off).

    Every agent gets the team's reward; its costs [K] are in `infos[agent]["cost"]`; `state()` is the global state. All
    arrays are copies.

    Args:
      seed: of the first episode if `reset` names none.

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


def to_jaxmarl(env: Env) -> JaxMarlEnv:
    """`env` with JaxMARL's interface: `reset(key)`, `step(key, state, actions)`, dictionaries by `agent_0` ...

    Every agent gets the team's reward. `infos` holds arrays [N]: `cost` (an agent's own, summed over K; of several also
    `cost/0` ...), `truncated`, and the task's own scalars. An episode ends for all agents, by the task's rule or its
    time limit, and the next begins in the same step, as in JaxMARL. `get_world_state(state)` is the global state, and
    `get_last_world_state(state)` that of before a new episode. It is not a subclass: JaxMARL's trainers and
    `LogWrapper` need none.

    Example:
      >>> import envs, jax
      >>> env = to_jaxmarl(envs.make("lane"))
      >>> obs, state = env.reset(jax.random.key(0))
      >>> actions = {agent: env.action_space(agent).sample(jax.random.key(1)) for agent in env.agents}
      >>> obs, state, rewards, dones, infos = env.step(jax.random.key(2), state, actions)
      >>> infos["cost"].shape, bool(dones["__all__"])
      ((2,), False)
    """
    return importlib.import_module(".jaxmarl_env", __name__).JaxMarlEnv(env)


def from_brax(
    env: Any,
    cost: str,
    cost_limit: float,
    *,
    above: float | None = None,
    horizon: int = 1000,
    partition: str | Sequence[Sequence[int]] = "",
    name: str = "",
) -> FromBrax:
    """A `brax.envs.Env` or MuJoCo Playground environment, one of whose metrics is a cost, as a task of ours.

    Args:
      env: without wrappers: time limits, auto-reset and batches are `envs.vector`'s.
      cost: the metric; clipped to [0, 1], and the same for every agent.
      cost_limit: allowed sum of costs over an episode.
      above: if given, the cost is 1 while the metric is above it, else 0.
      horizon: control steps of an episode.
      partition: the actuators of each agent, as `0,1|2,3` or lists; one agent if empty. Every agent sees the whole
        observation; each of several agents also sees its own one-hot index.
      name: of the task; the class's if empty.

    Raises:
      TaskError: no such metric, or a partition that leaves an actuator out.

    Example (a file `my_brax.py` for `pmt train my_brax.py:ant`):
        def ant():
            return from_brax(brax.envs.get_environment("ant"), "x_velocity", 25, above=2.0, partition="0,1,2,3|4,5,6,7")
    """
    module = importlib.import_module(".from_brax_env", __name__)
    return module.FromBrax(env, cost, cost_limit, above, horizon, partition, name or type(env).__name__.lower())


def _adapter(library: str, module: str) -> types.ModuleType:
    """The module of the adapter to `library`, imported on first use."""
    try:
        return importlib.import_module(f".{module}", __name__)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] != library:
            raise
        raise TaskError(f"this adapter needs {library}, which is not installed: pip install {library}") from None
