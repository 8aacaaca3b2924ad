"""What in fear does it? Methods that lack a part of F4SG, and others that have one.

    pmt train paper/ant_2x4 --method bench/controls.py:squared --cost-seen 0.03 --seed 3000

F4SG's network, loss and use are one function, and no switch of `Method` turns a part of them off: only an experiment
asks for that. This file wraps the function and the estimate of advantages; what the table of methods holds trains as
ever. Two more controls are settings of F4SG: `--fear-time current` and `--emotion-l2 0`.
"""

from __future__ import annotations

import dataclasses
from typing import Any
from unittest import mock

import jax

from pmt_jax import Method
from pmt_jax.learning import constraint, fear, learner


@dataclasses.dataclass(frozen=True)
class Control(Method):
    """A method with what an experiment changes.

    Attributes:
      squared_loss: fear is fitted by squares, as a model of the next cost would be, not by cross entropy.
      target_only: the cost critic learns sums of fear, but policies learn from the costs, with that critic as baseline.
      cost_trace: lambda of the costs' advantages alone, 1 for Monte Carlo; None for `gae_lambda`.
    """

    squared_loss: bool = False
    target_only: bool = False
    cost_trace: float | None = None


_LAGRANGIAN: dict[str, Any] = {"order": "sequential", "constraint": "lagrangian"}
squared = Control(**_LAGRANGIAN, cost_signal="fear", squared_loss=True)
target_only = Control(**_LAGRANGIAN, cost_signal="fear", target_only=True)
trace_99 = Control(**_LAGRANGIAN, cost_trace=0.99)
monte_carlo = Control(**_LAGRANGIAN, cost_trace=1.0)

_appraise, _gae = fear.appraise_fear, learner.gae
_traced: dict[str, Any] = {}  # the method that is being traced, and its costs


def squared_error(logits: jax.Array, target: jax.Array) -> jax.Array:
    """(sigmoid(l) - c)^2, elementwise: its minimiser is the mean cost, as that of the cross entropy."""
    return (jax.nn.sigmoid(logits) - target) ** 2


def appraise_fear(setup: Any, hyper: Any, now: Any, net: Any, batch: Any, *rest: Any) -> Any:
    """As `fear.appraise_fear`, by the loss of the method; keeps the costs for `gae`."""
    method = setup.method
    _traced["method"], _traced["cost"] = method, constraint.in_unit(setup, hyper, batch.cost)
    squares = isinstance(method, Control) and method.squared_loss
    with mock.patch.object(fear, "cross_entropy", squared_error if squares else fear.cross_entropy):
        return _appraise(setup, hyper, now, net, batch, *rest)


def gae(signal: jax.Array, *rest: Any) -> tuple[jax.Array, jax.Array]:
    """As `advantages.gae`; of danger [T, B, N, K] by the method."""
    method = _traced["method"]
    if signal.ndim < 4 or not isinstance(method, Control):
        return _gae(signal, *rest)
    if method.cost_trace is not None:
        rest = (*rest[:-1], method.cost_trace)
    advantage, returns = _gae(signal, *rest)
    return (_gae(_traced["cost"], *rest)[0], returns) if method.target_only else (advantage, returns)


fear.appraise_fear, learner.gae = appraise_fear, gae
