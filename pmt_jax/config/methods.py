"""The table of methods: what makes each of them is data, not code.

All methods are one learner (`pmt_jax.learning.learner`) with a few switches; nothing else asks for a method by name.
Adding one is adding a row:

  >>> METHODS["my_happo"] = Method(order="sequential", constraint="none")
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import jax


@dataclasses.dataclass(frozen=True)
class Method:
    """One method: its choice for each switch of the learner.

    Attributes:
      order: `simultaneous` updates all agents at once; `sequential` updates them one after the other in random order,
        each corrected by the factor M of those before it (HAPPO).
      constraint: how the cost limit acts: `none`, a `lagrangian` multiplier per agent and cost, a `trust_region`
        whose step keeps within the limit (CPO), a multiplier by `pid` control, `switching` between reward and cost
        (CRPO), or an exact `penalty` (P3O).
      cost_signal: what counts as danger in the cost advantage: the `cost` itself, the `fear` of it, or a function of
        your own, Batch -> [T, B, N, K] (docs/tutorial.ipynb has one).
      ratio_weight: what biases the probability ratio: nothing, or `regret`.
      share_actor: one actor for all agents (needs equal action spaces and agent ids in the observation).
      surrogate: what the epochs maximise: PPO's `clipped` surrogate, or FOCOPS's `first_order` one.
      critic: what the critics see: the global `state`, or each agent's own `observation` (needs agent ids in it).
    """

    order: Literal["simultaneous", "sequential"]
    constraint: Literal["none", "lagrangian", "trust_region", "pid", "switching", "penalty"]
    cost_signal: Literal["cost", "fear"] | Callable[[Any], jax.Array] = "cost"
    ratio_weight: Literal["none", "regret"] = "none"
    share_actor: bool = False
    surrogate: Literal["clipped", "first_order"] = "clipped"
    critic: Literal["state", "observation"] = "state"


METHODS: dict[str, Method] = {
    "mappo": Method(order="simultaneous", constraint="none", share_actor=True),
    "happo": Method(order="sequential", constraint="none"),
    "mappo_l": Method(order="sequential", constraint="lagrangian"),
    "macpo": Method(order="sequential", constraint="trust_region"),
    "f4sg": Method(order="sequential", constraint="lagrangian", cost_signal="fear"),
    "r4sg": Method(order="sequential", constraint="lagrangian", ratio_weight="regret"),
    "mixed": Method(order="sequential", constraint="lagrangian", cost_signal="fear", ratio_weight="regret"),
    "ippo": Method(order="simultaneous", constraint="none", share_actor=True, critic="observation"),
    "ippo_l": Method(order="simultaneous", constraint="lagrangian", critic="observation"),
    "mappo_pid": Method(order="sequential", constraint="pid"),
    "crpo": Method(order="sequential", constraint="switching"),
    "p3o": Method(order="sequential", constraint="penalty"),
    "focops": Method(order="sequential", constraint="lagrangian", surrogate="first_order"),
}
