"""The environment contract: one State in, one State out.

An environment is a value with a `spec`, the name of its `engine`, and two pure functions, `reset` and `step`. It does
not reset itself and has no horizon: `envs.vector` does batching, time limits, auto-reset and broken physics for all.

Examples:
  >>> import jax, envs
  >>> env = envs.make("lane")
  >>> state = env.reset(jax.random.key(0))
  >>> state = env.step(state, jax.numpy.zeros((env.spec.num_agents, env.spec.action_dim)))
  >>> state.obs.shape == (env.spec.num_agents, env.spec.obs_dim)
  True
"""

from __future__ import annotations

import dataclasses
import numbers
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Protocol

import jax
import numpy as np

from .blocks import Blocks
from .errors import TaskError

_NAME = re.compile(r"\w[\w+-]*(\.[\w+-]+)*")


@dataclasses.dataclass(frozen=True, eq=False)
class EnvSpec:
    """The static facts of a task.

    Attributes:
      name: the task's name, as `envs.make` takes it; folders of runs are named after it.
      num_agents: N.
      obs_dim: O, length of one agent's observation (padded to the longest).
      action_dim: A, length of one agent's action (padded to the longest).
      state_dim: S, length of the global state that centralised critics see.
      num_costs: K, cost functions per agent.
      horizon: control steps after which an episode is truncated.
      action_mask: [N, A], 1 where an agent has that action entry, 0 where it is padding.
      cost_limit: the benchmark's limit on one agent's undiscounted cost per episode: one number for every cost, or a
        tuple of K.
    """

    name: str
    num_agents: int
    obs_dim: int
    action_dim: int
    state_dim: int
    num_costs: int
    horizon: int
    action_mask: np.ndarray
    cost_limit: float | tuple[float, ...]

    def __post_init__(self) -> None:
        """Refuses facts that no task can have.

        Raises:
          TaskError: the first such fact.
        """
        if not isinstance(self.name, str) or not _NAME.fullmatch(self.name):
            raise TaskError(f"spec.name names folders: letters, digits, '_', '-', '+' and '.' only, not {self.name!r}")
        for name in ("num_agents", "obs_dim", "action_dim", "state_dim", "num_costs", "horizon"):
            value = getattr(self, name)
            if not isinstance(value, numbers.Integral) or value < 1:
                raise TaskError(f"spec.{name} must be a whole number of at least 1, not {value!r}")
        shape = (self.num_agents, self.action_dim)
        if np.shape(self.action_mask) != shape or not np.isin(self.action_mask, (0, 1)).all():
            found = f"an array of shape {np.shape(self.action_mask)}"
            raise TaskError(f"spec.action_mask must hold 0 and 1 in shape {shape} (agents, actions), not {found}")
        object.__setattr__(self, "action_mask", np.asarray(self.action_mask))
        limits = self.cost_limit if isinstance(self.cost_limit, tuple) else (self.cost_limit,) * self.num_costs
        if len(limits) != self.num_costs or any(not isinstance(x, numbers.Real) or not float(x) >= 0 for x in limits):
            wanted = f"a number of at least 0, or a tuple of {self.num_costs} of them"
            raise TaskError(f"spec.cost_limit must be {wanted}, not {self.cost_limit!r}")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """One environment at one moment; `reset` and `step` return the same structure, shapes and dtypes.

    Attributes:
      obs: [N, O] local observations.
      global_state: [S] what centralised critics and the fear prior network see.
      reward: [] the team's reward for the transition that led here (0 after a reset).
      cost: [N, K] in [0, 1], for the transition that led here (0 after a reset).
      terminated: [] bool, the task ended here by its own rule (never by a time limit).
      info: scalars for reporting, the same keys from reset on.
      carry: the environment's own quantities, any pytree of finite numbers.
    """

    obs: jax.Array
    global_state: jax.Array
    reward: jax.Array
    cost: jax.Array
    terminated: jax.Array
    info: dict[str, jax.Array]
    carry: Any


class Env(Protocol):
    """What `envs.make` returns: these four are required. All methods are pure and can be jitted and vmapped.

    Two more are optional: `declares`, the `Declarations`, and `shares_cost` (see the function of that name). The tasks
    of this package also have `raw(state)`, the quantities of a state by name, and `restore(**raw)`, a State made of
    them: `restore(**raw(state))` continues exactly as `state` would, so that recorded transitions can be replayed.
    """

    spec: EnvSpec
    engine: str  # the physics engine behind it, 'xla' if the task is plain JAX

    def reset(self, key: jax.Array) -> State:
        """The start of an episode drawn with `key`."""
        ...

    def step(self, state: State, action: jax.Array) -> State:
        """One control step with `action` [N, A]; actions are clipped by the task's own rule, not by the caller."""
        ...


Controller = Callable[[State], jax.Array]  # a state of one environment -> action [N, A]


Raw = Callable[[State], dict[str, Any]]  # the quantities of a state that a picture reads, by name


def _nothing(*_: Any) -> dict[str, Any]:  # a function of the module, so that tasks can be pickled
    return {}


@dataclasses.dataclass(frozen=True, eq=False)
class Plain:
    """No picture of its own: the task's `info` is drawn over time."""

    raw: Raw = _nothing
    kind: ClassVar[str] = "plain"


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """MuJoCo bodies.

    Attributes:
      raw: its `qpos` poses the bodies; those that follow no joint move by `mocap_pos` and `mocap_quat`, if it has
        them.
      model: the mujoco.MjModel that is drawn; its first camera, if any, is the view.
      decorate: `decorate(scene, raw, cost)` changes a mujoco.MjvScene of `model` before it is drawn, by colours or by
        geoms appended to it. Its second argument is what `raw` returned for the moment, its third the cost of the step
        that led there, mean over agents, summed over costs.
    """

    raw: Raw
    model: Any
    decorate: Callable[[Any, dict[str, np.ndarray], float], object] = _nothing
    kind: ClassVar[str] = "scene"


@dataclasses.dataclass(frozen=True, eq=False)
class NetworkMap:
    """A network of n nodes, coloured by a quantity that should stay within a band.

    Attributes:
      raw: its `quantity` [n] colours the nodes.
      quantity: the name.
      band: the quantity's lower and upper bound; unit: of the quantity.
      x, y: [n] places of the nodes, 0 to 1.
      links: [b, 2] the nodes that each line joins.
      agents: [N] the agents' nodes.
    """

    raw: Raw
    quantity: str
    band: tuple[float, float]
    x: np.ndarray
    y: np.ndarray
    links: np.ndarray
    agents: np.ndarray
    unit: str = ""
    kind: ClassVar[str] = "map"


@dataclasses.dataclass(frozen=True)
class Declarations:
    """What only the task defines and generic code needs; every field has a default.

    The names of its columns in tables are declared in the registry of `envs`, which can be read without JAX.

    Attributes:
      observation, state: what the entries of one agent's observation [O] and of the global state [S] are.
      actions: for each agent the names of its action entries, without padding.
      picture: how an episode is drawn.
      baselines: name -> a function that makes a policy which needs no training.
      overflow: the name in `info` that is above 0 if the physics lost contacts, which makes a step wrong.
      kernels: what the physics needs compiled besides XLA's programs, as calls for any threads; only warp needs some.
      stepped: model, readout and forward pass of `make_engine`, where the model is not that of the picture.
    """

    observation: Blocks = ()
    state: Blocks = ()
    actions: tuple[tuple[str, ...], ...] = ()
    picture: Plain | Scene | NetworkMap = Plain()
    baselines: Mapping[str, Callable[[], Controller]] = dataclasses.field(default_factory=dict)
    overflow: str | None = None
    kernels: Callable[[], Sequence[Callable[[], Any]]] = tuple
    stepped: tuple[Any, Mapping[str, Any], bool] | None = None


def shares_cost(env: Env) -> bool:
    """Whether the class of `env` says, by `shares_cost`, that each step costs all agents the same.

    Metrics of costs then have one column for all agents. A subclass may charge its agents otherwise, so it does not
    inherit this. A task for which it is not so is refused, or its training stops.
    """
    return "shares_cost" in vars(type(env)) and bool(getattr(env, "shares_cost", False))


def declarations(env: Env) -> Declarations:
    """What `env` declares; the defaults if it has no `declares`."""
    return getattr(env, "declares", Declarations())
