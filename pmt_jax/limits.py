"""Limits on costs, and the one rule by which costs are judged: each cost of each agent, then all of them.

The learner constrains [agent, cost]. A mean over agents can be within a limit that an agent is far beyond, so nothing
is judged by it. Where a task declares that its agents share their costs, the mean is every agent's cost.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from .config.settings import Config

if TYPE_CHECKING:
    from .tasks import EnvSpec

ROUNDING = 1e-6  # share of a limit: costs are rounded to 32 bits, and a cost that is its limit is within it
WORST = "_worst"  # behind the name of a cost: that of the agent whose is highest
KEY = "cost_limit"
LARGEST = float(np.finfo(np.float32).max)


@dataclasses.dataclass(frozen=True)
class Limits:
    """The allowed undiscounted cost of any agent per episode.

    Attributes:
      each: of each of K costs.

    Examples:
      >>> limits = Limits((25.0, 0.1))
      >>> print(limits)
      25 + 0.1
      >>> limits.excess([[18.0, 0.0], [0.0, 0.5]]).round(6)  # of two agents; the second's second cost is beyond
      np.float64(0.4)
    """

    each: tuple[float, ...]

    @classmethod
    def of_task(cls, spec: EnvSpec) -> Limits:
        """The benchmark's own."""
        return cls(_for_each(spec.cost_limit, spec.num_costs))

    @classmethod
    def configured(cls, config: Config, costs: int) -> Limits | None:
        """What the settings of a run say; None if they leave it to the task."""
        given = config.cost_limit
        return None if isinstance(given, float) and math.isnan(given) else cls(_for_each(given, costs))

    @classmethod
    def of_run(cls, config: Config, spec: EnvSpec) -> Limits:
        """What the learner holds costs to, as it observes them: the settings', or what the task's amount to there."""
        own = cls.of_task(spec).observed(config.cost_seen)
        return cls.configured(config, spec.num_costs) or own

    @classmethod
    def of_row(cls, row: Mapping[str, Any]) -> Limits:
        """Those of a row of metrics.jsonl or of an evaluation."""
        each = tuple(x for name, x in row.items() if name.startswith(f"{KEY}/")) or (row[KEY],)
        return cls(tuple(math.inf if d > LARGEST else d for d in each))  # to training, in 32 bits, it was none

    @property
    def columns(self) -> dict[str, float]:
        """What a row says: the sum, as `episode_cost` is one, and each of several."""
        several = self.each if len(self.each) > 1 else ()
        return {KEY: self.total, **{f"{KEY}/{k}": x for k, x in enumerate(several)}}

    @property
    def total(self) -> float:
        """The sum over costs."""
        return float(sum(self.each))

    def observed(self, cost_seen: float) -> Limits:
        """Limits on true costs, of which each is observed with that probability, as limits on observed ones."""
        return Limits(tuple(cost_seen * d for d in self.each))

    def true(self, cost_seen: float) -> Limits:
        """Limits on observed costs as limits on true ones, of which each is observed with that probability."""
        return Limits(tuple(d / cost_seen for d in self.each))

    def excess(self, costs: Any) -> Any:
        """[...] how far the agent and cost that is furthest beyond its limit is beyond it; at most 0 if all are within.

        Args:
          costs: [..., N, K] of an episode, or means over episodes; N is 1 where agents share them.
        """
        return excess(np.asarray(costs, float), np.asarray(self.each)).max((-2, -1))

    def __str__(self) -> str:
        return " + ".join(f"{d:g}" for d in self.each)


def _for_each(limit: float | tuple[float, ...], costs: int) -> tuple[float, ...]:
    return tuple(np.broadcast_to(np.asarray(limit, float), costs).tolist())


def excess(cost: Any, limit: Any, xp: Any = np) -> Any:
    """Elementwise, how far a cost is beyond its limit; 0 where only rounding is between them, below 0 within.

    Args:
      cost: [..., K]; limit: [] or [K]; xp: numpy or jax.numpy, whichever the arrays are of.
    """
    over = cost - limit
    return xp.where(abs(over) <= ROUNDING * limit, 0.0, over)


# ---------------------------------------------------------------------------------------------------------------------
# The names of costs in rows


def columns(name: str, x: Any, shared: bool) -> dict[str, Any]:
    """The columns for the parts of x [..., N, K], for which a column `name` has one number.

    `NAME/k` is the mean over agents, of each of several costs. `NAME/agent_i`, of several costs `NAME/agent_i/cost_k`,
    is of one agent, where agents do not share their costs.

    Examples:
      >>> columns("lambda", np.array([[1.0, 2.0], [3.0, 4.0]]), shared=True)
      {'lambda/0': np.float64(2.0), 'lambda/1': np.float64(3.0)}
    """
    agents, costs = x.shape[-2:]
    parts = {f"{name}/{k}": x[..., k].mean(-1) for k in range(costs if costs > 1 else 0)}
    each = () if shared or agents == 1 else range(agents)
    return parts | {_of_agent(name, i, k, costs): x[..., i, k] for i in each for k in range(costs)}


def worst(name: str, costs: Any, shared: bool) -> dict[str, Any]:
    """`NAME_worst`, where agents do not share their costs: of episodes' costs [E, N, K], those [E] of the worst agent.

    That is the agent whose mean over episodes, of several costs the sum, is highest. Without an axis of episodes,
    costs [N, K] are means already.
    """
    each = costs.sum(-1)
    if shared or each.shape[-1] == 1:
        return {}
    return {f"{name}{WORST}": each[..., each.reshape(-1, each.shape[-1]).mean(0).argmax()]}


def judged(known: Collection[str], name: str, costs: int) -> list[list[str]]:
    """The columns [N][K] that a cost is judged by: each agent's, or one for all where rows have no more."""
    agent = re.compile(rf"{re.escape(name)}/agent_\d+" + (r"/cost_0" if costs > 1 else ""))
    agents = sum(agent.fullmatch(column) is not None for column in known)
    if agents:
        return [[_of_agent(name, i, k, costs) for k in range(costs)] for i in range(agents)]
    return [[f"{name}/{k}" for k in range(costs)] if costs > 1 else [name]]


def of_agents(known: Mapping[str, Any], name: str) -> list[Any]:
    """What each agent's columns of a cost add up to; nothing where agents share it."""
    own = re.compile(rf"{re.escape(name)}/agent_(\d+)(/cost_\d+)?")
    sums: dict[int, Any] = {}
    for column, x in known.items():
        if found := own.fullmatch(column):
            sums[int(found[1])] = sums.get(int(found[1]), 0.0) + x
    return list(sums.values())


def base(name: str) -> str:
    """The column next to which `columns` puts this one; the name itself if none.

    Examples:
      >>> base("lambda/agent_1/cost_0"), base("cost_limit/0"), base("critic/loss")
      ('lambda', 'cost_limit', 'critic/loss')
    """
    return re.sub(r"(/agent_\d+(/cost_\d+)?|/\d+)$", "", name)


def _of_agent(name: str, agent: int, cost: int, costs: int) -> str:
    return f"{name}/agent_{agent}" + (f"/cost_{cost}" if costs > 1 else "")
