"""The table of methods: what makes each of them is data, not code.

All methods are one learner (`pmt_jax.learning.learner`) with a few switches; nothing else asks for a method by name.
Adding one is adding a row:

  >>> METHODS["my_happo"] = Method(order="sequential", constraint="none")

A Python file of your own may hold a row, too: `--method my_methods.py:dread`.
"""

from __future__ import annotations

import dataclasses
import pathlib
import re
import typing
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

from ..errors import UsageError
from ..tasks import absolute, did_you_mean, is_file, members

if TYPE_CHECKING:
    import jax


Order = Literal["simultaneous", "sequential"]
Kind = Literal["none", "lagrangian", "trust_region", "pid", "switching", "penalty"]
Weight = Literal["none", "regret"]
Surrogate = Literal["clipped", "first_order"]
Seen = Literal["state", "observation"]


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
      letter: fear and regret, the advantages and the critics' loss are as the paper prints them, where the working form
        differs (docs/methods/f4sg.md, r4sg.md); `--preset letter` has the paper's settings.
    """

    order: Order
    constraint: Kind
    cost_signal: Literal["cost", "fear"] | Callable[[Any], jax.Array] = "cost"
    ratio_weight: Weight = "none"
    share_actor: bool = False
    surrogate: Surrogate = "clipped"
    critic: Seen = "state"
    letter: bool = False

    def __post_init__(self) -> None:
        """Refuses what no row can have.

        Raises:
          UsageError: the first such switch.
        """
        kinds = {"order": Order, "constraint": Kind, "ratio_weight": Weight, "surrogate": Surrogate, "critic": Seen}
        for name, kind in kinds.items():
            words = typing.get_args(kind)
            if getattr(self, name) not in words:
                raise UsageError(f"a method's {name} must be {' or '.join(words)}, not {getattr(self, name)!r}")
        for name in ("share_actor", "letter"):
            if not isinstance(getattr(self, name), bool):
                raise UsageError(f"a method's {name} must be True or False, not {getattr(self, name)!r}")
        if self.cost_signal not in ("cost", "fear") and not callable(self.cost_signal):
            raise UsageError(f"a method's cost_signal must be cost, fear or a function, not {self.cost_signal!r}")
        if self.share_actor and self.order != "simultaneous":
            raise UsageError("a method's share_actor needs order simultaneous, for one actor has no turns to take")
        if self.letter and (self.order, self.constraint, self.surrogate) != ("sequential", "lagrangian", "clipped"):
            raise UsageError("a method's letter needs order sequential, constraint lagrangian and surrogate clipped")


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
    "f4sg_letter": Method(order="sequential", constraint="lagrangian", cost_signal="fear", letter=True),
    "r4sg_letter": Method(order="sequential", constraint="lagrangian", ratio_weight="regret", letter=True),
}


def known(name: str) -> str:
    """The name of a method as it means the same from every folder: of a file of yours, which is not read yet, its path.

    Raises:
      UsageError: it is neither a row of the table nor a Python file.
    """
    if not isinstance(name, str):
        raise UsageError(f"method = {name!r} does not fit: expected a word, as one of {', '.join(METHODS)}")
    if is_file(name):
        return absolute(name)
    if name not in METHODS:
        raise UsageError(f"unknown method '{name}'{did_you_mean(name, METHODS)}")
    return name


def find(name: str) -> Method:
    """The row of that name; one in a Python file is executed.

    Raises:
      UsageError: there is none, or the file cannot be imported.
    """
    if known(name) in METHODS:
        return METHODS[name]
    found, chosen = members(name)
    rows = {key: value for key, value in found.items() if isinstance(value, Method) and not key.startswith("_")}
    if chosen is None and len(rows) == 1:
        (chosen,) = rows
    if chosen not in rows:
        which = (
            f"no Method called '{chosen}'{did_you_mean(chosen, rows)}"
            if chosen
            else (f"{len(rows)} of them ({', '.join(rows) or 'none'}); choose one, as {name}:NAME")
        )
        raise UsageError(f"{name} should hold a pmt_jax.Method, as `dread = Method(order=...)`, but has {which}")
    return rows[chosen]


def label(name: str) -> str:
    """What rows, tables and folders call a method: of one in a file its name there, or the file's."""
    if not is_file(name):
        return name
    file, _, chosen = name.rpartition(".py")
    return re.sub(r"\W+", "_", chosen.removeprefix(":") or pathlib.PurePath(file).name) or "own"
