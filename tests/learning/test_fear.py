"""Where fear begins before any experience, and that it becomes calibrated on what it sees."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from small import program

PROGRAM = program("f4sg")
SETUP = PROGRAM.setup
STATES = jax.random.normal(jax.random.key(1), (50, SETUP.vector.spec.state_dim))


def test_fear_begins_at_the_logit_that_is_asked_for():
    for start in (-4.0, 0.5):
        logits = SETUP.nets.fear(SETUP.nets.init_fear(jax.random.key(0), start), STATES)
        np.testing.assert_allclose(logits, start, atol=0.05)  # the head's weights are small, not zero


def test_without_a_start_fear_begins_at_the_cost_rate_of_the_first_batch():
    rate = jnp.asarray([[0.3], [0.9]])
    awake = SETUP.nets.set_fear_to_cost_rate(SETUP.nets.init_fear(jax.random.key(0), jnp.nan), rate)
    fear = jax.nn.sigmoid(SETUP.nets.fear(awake, STATES))
    np.testing.assert_allclose(fear, jnp.broadcast_to(rate, fear.shape), atol=0.02)
    again = SETUP.nets.set_fear_to_cost_rate(awake, 1 - rate)
    jax.tree.map(np.testing.assert_array_equal, again, awake)  # once awake, it only learns


def test_a_first_batch_without_any_cost_leaves_fear_finite():
    awake = SETUP.nets.set_fear_to_cost_rate(SETUP.nets.init_fear(jax.random.key(0), jnp.nan), jnp.zeros((2, 1)))
    assert (jax.nn.sigmoid(SETUP.nets.fear(awake, STATES)) < 0.002).all()


@pytest.mark.full
def test_an_update_from_nan_is_finite_everywhere():
    hyper = PROGRAM.hyper()
    state, metrics = PROGRAM.step(hyper, PROGRAM.init(hyper, jax.random.key(0)))
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(state.fear.params))
    assert jnp.isfinite(metrics["fear/loss"])


def test_fear_tells_danger_from_safety_after_sixty_updates():
    """Of 12 seeds the mean squared error is 0.240 +- 0.007 in the first update and 0.037 +- 0.009 in the last."""
    hyper = PROGRAM.hyper(actor_lr=0.0)
    state, errors = PROGRAM.init(hyper, jax.random.key(0)), []
    for _ in range(60):
        state, metrics = PROGRAM.step(hyper, state)
        errors.append(float(metrics["fear/brier"]))
    assert errors[0] > 0.2 and errors[-1] < 0.1
