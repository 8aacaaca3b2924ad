"""MACPO's step against closed forms and an exact solver."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pmt_jax.learning.maths import distributions
from pmt_jax.learning.trust_region import (
    DAMPING,
    backtrack,
    conjugate_gradient,
    constrained_direction,
    fisher,
    solve,
)

G = jnp.asarray([-1.0, 0.0])


@pytest.mark.parametrize(
    ("c", "b", "step", "case"),
    [
        (-0.6, (1, 0), (0.6, 0), 2),
        (0.3, (1, 0), (-0.3, 0), 1),
        (-2, (1, 0), (1, 0), 3),
        (2, (1, 0), (-1, 0), 0),
        (-0.6, (0.6, 0.8), (1, 0), 2),
        (0.5, (0.6, 0.8), (0.3928, -0.9196), 1),
        (-1, (0, 0), (1, 0), 4),
    ],
)
def test_direction(c: float, b: tuple[float, float], step: tuple[float, float], case: int):
    direction = constrained_direction(G, jnp.asarray(b, float), jnp.asarray(c, float), lambda v: v, 0.5)
    np.testing.assert_allclose(direction.step, step, atol=2e-4)
    assert direction.case == case


def test_the_fisher_matrix_is_the_hessian_of_the_divergence():
    obs, mask = jax.random.normal(jax.random.key(0), (20, 3)), jnp.asarray([1.0, 0.0]).repeat(10)[:, None]
    start = jax.random.normal(jax.random.key(1), (10,))

    def policy(flat: jax.Array) -> tuple[jax.Array, jax.Array]:
        mean = jnp.tanh(obs @ flat[:6].reshape(3, 2)) @ flat[6:8, None]
        return mean, jnp.broadcast_to(jnp.exp(flat[8:9]), mean.shape)

    outputs = policy(start)

    def divergence(mean: jax.Array, std: jax.Array) -> jax.Array:
        return distributions.kl(*outputs, mean, std, mask).mean()

    hessian = jax.hessian(lambda flat: divergence(*policy(flat)))(start) + DAMPING * jnp.eye(10)
    columns = jax.vmap(fisher(policy, divergence, start), out_axes=1)(jnp.eye(10))
    np.testing.assert_allclose(columns, hessian, atol=1e-5)


def exact(g: np.ndarray, b: np.ndarray, c: float, h: np.ndarray, delta: float) -> np.ndarray | None:
    """The solution in coordinates y = L'x, where the trust region is a ball; None where no step is feasible."""
    low = np.linalg.cholesky(h)
    gy, by = np.linalg.solve(low, g), np.linalg.solve(low, b)
    radius = np.sqrt(2 * delta)
    y = -radius * gy / np.linalg.norm(gy)
    if c + by @ y > 0:
        nearest = -c * by / (by @ by)
        if np.linalg.norm(nearest) > radius:
            return None
        across = gy - (gy @ by) / (by @ by) * by
        y = nearest - np.sqrt(radius**2 - nearest @ nearest) * across / np.linalg.norm(across)
    return np.linalg.solve(low.T, y)


def test_direction_against_an_exact_solver():
    """3,000 random problems in float64."""
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(3000, 4, 4))
    h = roots @ roots.transpose(0, 2, 1) + 0.5 * np.eye(4)
    g, b = rng.normal(size=(2, 3000, 4))
    c = rng.normal(size=3000)
    with jax.enable_x64(True):
        solve = jax.jit(jax.vmap(lambda g, b, c, h: constrained_direction(g, b, c, lambda v: h @ v, 0.5)))
        found = solve(*(jnp.asarray(x) for x in (g, b, c, h)))
        steps, cases = np.asarray(found.step), np.asarray(found.case)
    seen = set()
    for i in range(3000):
        expected = exact(g[i], b[i], c[i], h[i], 0.5)
        assert (expected is None) == (cases[i] == 0)
        assert steps[i] @ h[i] @ steps[i] / 2 <= 0.5 + 1e-6
        if expected is not None:
            assert c[i] + b[i] @ steps[i] <= 1e-5
            np.testing.assert_allclose(steps[i], expected, atol=1e-5)
        seen.add(int(cases[i]))
    assert seen == {0, 1, 2, 3}


def test_conjugate_gradient():
    h = jnp.asarray([1.0, 2.0, 5.0])
    np.testing.assert_allclose(conjugate_gradient(lambda v: h * v, jnp.ones(3), 3), 1 / h, rtol=1e-5)
    np.testing.assert_array_equal(conjugate_gradient(lambda v: h * v, jnp.zeros(3)), 0)


def test_uncoupled_entries_are_solved_exactly_however_small_their_curvature():
    """As a policy's deviations next to a network whose curvatures lie orders of magnitude apart."""
    h, b = jnp.r_[jnp.logspace(0, 4, 40), 0.15, 0.2], jnp.ones(42).at[:40].set(10.0)
    uncoupled = jnp.arange(42) >= 40
    np.testing.assert_allclose(solve(lambda v: h * v, b, uncoupled)[40:], 1 / h[40:], rtol=1e-6)
    assert (solve(lambda v: h * v, b)[40:] < 0.5 / h[40:]).all()


def test_line_search_takes_the_first_that_is_accepted():
    start, step = jnp.zeros(1), jnp.ones(1)
    point, tried = backtrack(lambda x: x[0] <= 0.5, start, step)
    np.testing.assert_allclose(point, 0.8**4, rtol=1e-6)
    assert tried == 4
    point, tried = backtrack(lambda x: x[0] < 0, start, step)
    assert point == 0 and tried == 10


def test_gradients_and_curvature_of_a_linear_gaussian_policy():
    """N(theta, sd^2), A = a.u, A_c = a.w: the gradients of the surrogates are u and w, the curvature is 1/sd^2."""
    from pmt_jax.learning.maths import distributions

    sd, rows = 0.3, 100_000
    u, w = jnp.asarray([1.0, -0.5]), jnp.asarray([0.3, 0.8])
    theta, std, mask = jnp.asarray([0.2, -0.1]), jnp.full(2, sd), jnp.ones(2)
    action = theta + sd * jax.random.normal(jax.random.key(0), (rows, 2))
    old = distributions.log_prob(action, theta, std, mask)

    def surrogate(theta: jax.Array, direction: jax.Array) -> jax.Array:
        ratio = jnp.exp(distributions.log_prob(action, theta, std, mask) - old)
        return jnp.mean(ratio * (action @ direction))

    np.testing.assert_allclose(jax.grad(surrogate)(theta, u), u, atol=2e-2)
    np.testing.assert_allclose(jax.grad(surrogate)(theta, w), w, atol=2e-2)
    curvature = jax.hessian(lambda t: distributions.kl(theta, std, t, std, mask))(theta)
    np.testing.assert_allclose(curvature, np.eye(2) / sd**2, rtol=1e-4, atol=1e-3)
