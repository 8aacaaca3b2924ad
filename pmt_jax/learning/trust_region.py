"""MACPO's policy step: CPO's constrained trust region for one agent (Achiam et al., 2017; Gu et al., 2023).

From top to bottom: the step, its direction by the exact dual, the line search.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from . import sharding
from .fused import gpu
from .maths import distributions
from .maths.pytree import pytree
from .schedules import Schedule
from .setup import Setup
from .types import Metrics, PolicySamples, Sequences, TrainState

EPS = 1e-8
LINE_SEARCH_STEPS = 10
STEP_DECAY = 0.8  # factor between one step of the line search and the next
DAMPING = 0.1  # added to the Fisher matrix
PARTS = 16  # of the rows, see `in_parts`
PRECISION = "TF32_TF32_F32_X3"  # of Fisher products on tensor cores: three of TF32 that make up one of float32
KL_SLACK = 1.5  # a step is accepted up to this multiple of the trust region

Hvp = Callable[[jax.Array], jax.Array]


def trust_region_step(
    setup: Setup, now: Schedule, net: TrainState, samples: PolicySamples, violation: jax.Array
) -> tuple[TrainState, jax.Array, Metrics]:
    """One constrained step (MACPO): direction, line search. The optimiser's state is not touched.

    This is CPO's update (Achiam et al., 2017, section 6), as MACPO takes it for one agent. Of several costs it
    constrains the one most beyond its limit, in standard deviations of its advantage.

    Args:
      violation: [K] in units of the limit, how far each cost is beyond what it is held to.

    Returns:
      the network; [] in units of the limit, the most that the step promised to take off the cost; metrics.
    """
    start, unravel = ravel_pytree(net.params)
    samples, c = _most_violated(samples, violation)
    samples, nets = sharding.shard(samples), setup.nets.plain  # the Fisher matrix takes second derivatives

    def policy(flat: jax.Array, obs: jax.Array | Sequences = samples.obs) -> tuple[jax.Array, jax.Array]:
        return nets.policy(unravel(flat), obs)

    mean0, std0 = jax.lax.stop_gradient(policy(start))

    def objectives(flat: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Loss and cost surrogates."""
        mean, std = policy(flat)
        log_ratio = distributions.log_prob(samples.action, mean, std, samples.mask) - samples.log_prob
        ratio = samples.factor * jnp.exp(log_ratio + samples.log_weight)  # weighted by regret as in Eq. 15
        return -jnp.mean(ratio * samples.advantage), jnp.mean(ratio * samples.cost_advantage)

    def divergence(mean: jax.Array, std: jax.Array) -> jax.Array:
        return distributions.kl(mean0, std0, mean, std, samples.mask).mean()

    (loss0, cost0), pull = jax.vjp(objectives, start)
    one, zero = jnp.ones_like(loss0), jnp.zeros_like(loss0)
    (g,), (b,) = pull((one, zero)), pull((zero, one))
    uncoupled, _ = ravel_pytree(setup.nets.is_std(unravel(start)))
    curvature = fisher(in_parts(policy, samples.obs, _parts(samples)), divergence, start)
    direction = constrained_direction(g, b, c, curvature, now.kl_limit, uncoupled)

    def accept(flat: jax.Array) -> jax.Array:
        loss, cost = objectives(flat)
        kl = divergence(*policy(flat))
        better = (loss < loss0) | (direction.case <= 1)
        safe = cost - cost0 <= jnp.maximum(-c, 0.0)
        finite = jnp.isfinite(loss) & jnp.isfinite(cost) & jnp.isfinite(kl)
        return (kl <= KL_SLACK * now.kl_limit) & better & safe & finite

    flat, tried = backtrack(accept, start, direction.step)
    loss, _ = objectives(flat)
    _, std = policy(flat)
    metrics = {
        "loss": loss,
        "entropy": distributions.entropy(std, samples.mask).mean(),
        "std": (std * samples.mask).sum() / samples.mask.sum(),
        "case": direction.case.astype(loss.dtype),
        "reach": direction.reach,
        "line_search_steps": tried.astype(loss.dtype),
    }
    return TrainState(unravel(flat), net.opt_state), direction.reach, metrics


def in_parts(
    policy: Callable[[jax.Array, Any], tuple[jax.Array, jax.Array]], obs: jax.Array | Sequences, parts: int
) -> Callable[[jax.Array], tuple[jax.Array, jax.Array]]:
    """The same policy at weights [P], which computes equal parts of its rows by a copy of the weights each.

    A layer's gradient is a small product, as deep as a batch has rows, and keeps few blocks of a GPU busy. In parts it
    is as many products, and a sum.
    """
    if parts == 1:
        return lambda flat: policy(flat, obs)
    count = len(jax.tree.leaves(obs)[0])
    each = jax.tree.map(lambda x: x.reshape(parts, -1, *x.shape[1:]), obs)

    def apply(flat: jax.Array) -> tuple[jax.Array, jax.Array]:
        mean, std = jax.vmap(policy)(jnp.broadcast_to(flat, (parts, *flat.shape)), each)
        return mean.reshape(count, *mean.shape[2:]), std[0]

    return apply


def _parts(samples: PolicySamples) -> int:
    """How many parts `in_parts` makes."""
    divides = len(samples.log_prob) % PARTS == 0
    return PARTS if divides and jax.default_backend() == "gpu" and sharding.single_device() else 1


def fisher(
    policy: Callable[[jax.Array], tuple[jax.Array, jax.Array]],
    divergence: Callable[[jax.Array, jax.Array], jax.Array],
    start: jax.Array,
) -> Hvp:
    """The damped Hessian of the divergence at its minimum `start` [P], times a vector.

    There its gradient is 0, so the Hessian is J' M J: J of the policy's outputs, M of the divergence in them. That
    takes two thirds of the products that differentiating twice does.
    """
    with _precision():
        outputs, push = jax.linearize(policy, start)
        pull = jax.linear_transpose(push, start)
    _, curvature = jax.linearize(jax.grad(divergence, (0, 1)), *outputs)

    def hvp(v: jax.Array) -> jax.Array:
        with _precision():
            return pull(curvature(*push(v)))[0] + DAMPING * v

    return hvp


def _precision() -> contextlib.AbstractContextManager[object]:
    """Inside, matrix products have `PRECISION` where a GPU can."""
    return jax.default_matmul_precision(PRECISION) if gpu.available() else contextlib.nullcontext()


def _most_violated(samples: PolicySamples, violation: jax.Array) -> tuple[PolicySamples, jax.Array]:
    """The samples with the cost furthest beyond its limit, in standard deviations of its advantage, and how far []."""
    spread = samples.cost_advantage.std(tuple(range(samples.log_prob.ndim))) + 1e-5
    worst = jnp.argmax(violation / spread)
    return dataclasses.replace(samples, cost_advantage=samples.cost_advantage[..., worst]), violation[worst]


@pytree
class Direction:
    """step [P], which of the five cases it came from (see `constrained_direction`), and `reach` [], the most that the
    trust region can take off the cost, sqrt(2 delta b'H^-1 b), by the linear model."""

    step: jax.Array
    case: jax.Array
    reach: jax.Array


def conjugate_gradient(hvp: Hvp, b: jax.Array, iterations: int = 10, tolerance: float = 1e-10) -> jax.Array:
    """Solves H x = b [P] for symmetric positive definite H, given v -> H v; stops early at a squared residual of
    `tolerance`."""

    def proceed(carry: tuple[Any, ...]) -> jax.Array:
        count, _, _, _, rr = carry
        return (count < iterations) & (rr > tolerance)

    def body(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        count, x, r, p, rr = carry
        hp = hvp(p)
        alpha = rr / (p @ hp + 1e-12)
        x, r = x + alpha * p, r - alpha * hp
        new = r @ r
        return count + 1, x, r, r + new / (rr + 1e-12) * p, new

    start = (jnp.int32(0), jnp.zeros_like(b), b, b, b @ b)
    return jax.lax.while_loop(proceed, body, start)[1]


def solve(hvp: Hvp, b: jax.Array, uncoupled: jax.Array | None = None) -> jax.Array:
    """x [P] with H x = b: exact where `uncoupled`, by conjugate gradient elsewhere.

    Ten iterations do not reach the standard deviations of a Gaussian: their curvature is small next to that of the
    network that makes its mean, and a step four times too short along them was seen.

    Args:
      uncoupled: [P] bool, entries whose rows of H are 0 but on the diagonal.
    """
    if uncoupled is None:
        return conjugate_gradient(hvp, b)
    diagonal = hvp(uncoupled.astype(b.dtype))
    return jnp.where(uncoupled, b / (diagonal + 1e-12), conjugate_gradient(hvp, jnp.where(uncoupled, 0.0, b)))


def constrained_direction(
    g: jax.Array,
    b: jax.Array,
    c: jax.Array,
    hvp: Hvp,
    delta: jax.Array | float,
    uncoupled: jax.Array | None = None,
) -> Direction:
    """The step x that minimises g.x subject to c + b.x <= 0 and x'Hx / 2 <= delta (Achiam et al., 2017).

    | case | when | step |
    |---|---|---|
    | 4 | c < 0 and b = 0: nothing costs | natural gradient |
    | 3 | c < 0 and the whole trust region is safe | natural gradient |
    | 2 | c < 0, the limit cuts the trust region | both constraints, by their exact dual |
    | 1 | c >= 0, the trust region reaches safety | both constraints, by their exact dual |
    | 0 | c >= 0, safety is out of reach | straight towards it |

    Args:
      g, b: [P] gradients of what to minimise and of the cost; c: [] how far the cost is beyond its limit.
      hvp: v -> H v; delta: the trust region, in nats; uncoupled: see `solve`.
    """
    v, w = jax.vmap(lambda x: solve(hvp, x, uncoupled))(jnp.stack([g, b]))  # side by side: half as many, wider products
    c = jnp.where(c == 0, EPS, c)
    q, r, s = g @ v, g @ w, b @ w
    # Rounding makes parallel g and b look anything from a little to not at all different; both end here.
    a_ = jnp.maximum(q - r**2 / (s + EPS), 8 * jnp.finfo(q.dtype).eps * q)
    b_ = 2 * delta - c**2 / (s + EPS)
    no_cost = (b @ b <= EPS) & (c < 0)
    case = jnp.where(no_cost, 4, jnp.where(c < 0, jnp.where(b_ < 0, 3, 2), jnp.where(b_ < 0, 0, 1)))
    lam, nu = _dual(q, r, s, c, a_, b_, delta)
    free = jnp.sqrt(jnp.maximum(q, 0.0) / (2 * delta))
    lam, nu = jnp.where(case >= 3, free, lam), jnp.where(case >= 3, 0.0, nu)
    # With nu > 0 this is -(v + nu w) / lam, rid of the cancellation between v and nu w.
    across = v - r / (s + EPS) * w
    optimal = jnp.where(nu > 0, -across / (lam + EPS) - c / (s + EPS) * w, -v / (lam + EPS))
    recovery = -jnp.sqrt(2 * delta / (s + EPS)) * w
    return Direction(jnp.where(case == 0, recovery, optimal), case, jnp.sqrt(2 * delta * jnp.maximum(s, 0.0)))


def _dual(
    q: jax.Array, r: jax.Array, s: jax.Array, c: jax.Array, a_: jax.Array, b_: jax.Array, delta: jax.Array | float
) -> tuple[jax.Array, jax.Array]:
    """Multipliers of the trust region and of the cost in cases 1 and 2: the better of two regions of lambda."""
    edge = jnp.maximum(r / c, 0.0)
    inf = jnp.inf
    low_a, high_a = jnp.where(c < 0, 0.0, edge), jnp.where(c < 0, edge, inf)
    low_b, high_b = jnp.where(c < 0, edge, 0.0), jnp.where(c < 0, inf, edge)
    lam_a = jnp.clip(jnp.sqrt(a_ / jnp.maximum(b_, EPS)), low_a, high_a)
    lam_b = jnp.clip(jnp.sqrt(jnp.maximum(q, 0.0) / (2 * delta)), low_b, high_b)
    f_a = -0.5 * (a_ / (lam_a + EPS) + b_ * lam_a) - r * c / (s + EPS)
    f_b = -0.5 * (q / (lam_b + EPS) + 2 * delta * lam_b)
    lam = jnp.where(f_a >= f_b, lam_a, lam_b)
    return lam, jnp.maximum(lam * c - r, 0.0) / (s + EPS)


def backtrack(
    accept: Callable[[jax.Array], jax.Array], start: jax.Array, step: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The first accepted of start + 0.8^j step, j = 0 .. 9, or `start` if none is.

    Returns:
      the point [P], and how many were tried in vain (10 if none was accepted).
    """

    def proceed(carry: tuple[jax.Array, jax.Array]) -> jax.Array:
        count, accepted = carry
        return (count < LINE_SEARCH_STEPS) & ~accepted

    def body(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        count, _ = carry
        accepted = accept(start + STEP_DECAY**count * step)
        return jnp.where(accepted, count, count + 1), accepted

    count, accepted = jax.lax.while_loop(proceed, body, (jnp.int32(0), jnp.asarray(False)))
    return jnp.where(accepted, start + STEP_DECAY**count * step, start), count
