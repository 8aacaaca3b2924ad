"""Fear and regret: closed forms, calibration, and what each equation is."""

from __future__ import annotations

import ast
import collections
import functools
import pathlib
import re

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import pmt_jax
from pmt_jax.learning import fear, letter, regret
from pmt_jax.learning.maths import losses
from small import program


def test_bernoulli_divergence():
    np.testing.assert_allclose(losses.bernoulli_kl(jnp.asarray(0.5), jnp.asarray(0.25)), 0.143841, rtol=1e-5)
    np.testing.assert_allclose(losses.bernoulli_kl(jnp.asarray(0.25), jnp.asarray(0.5)), 0.130812, rtol=1e-5)
    assert np.isfinite(losses.bernoulli_kl(jnp.asarray(1.0), jnp.asarray(0.0)))


def test_deliberateness():
    z = jnp.asarray([0.0, 1.0, 2.0])
    np.testing.assert_allclose(regret.deliberateness(z), [1, 0.606531, 0.135335], rtol=1e-5)


def test_mean_of_a_relaxed_sample():
    noise = jax.random.logistic(jax.random.key(0), (400_000,))
    np.testing.assert_allclose(letter.relaxed_bernoulli(jnp.asarray(1.3), noise, 1.0).mean(), 0.705158, atol=2e-3)


def weigh(new: list[float], old: list[float], omega: float = 2 / 3, bound: float = jnp.inf, **changes) -> jax.Array:
    mask = jnp.ones(len(new))
    options = {"omega": omega, "bound": bound, **changes}
    return regret.regret_weight(jnp.asarray(new), jnp.asarray(old), mask, **options)


def test_regret_weight():
    log_weight = weigh([0.5, 0.2, 0.1], [0.25, 0.1, 0.0])
    np.testing.assert_allclose(log_weight, -0.523248, rtol=1e-5)
    np.testing.assert_allclose(jnp.exp(log_weight), 0.592593, rtol=1e-5)
    np.testing.assert_allclose(jnp.exp(weigh([0.5, 0.2, 0.1], [0.25, 0.1, 0.0], bound=0.1)), 0.9, rtol=1e-6)


def test_no_regret_has_no_weight_at_all():
    assert weigh([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]) == 0
    assert weigh([0.3, 0.2, 0.1], [0.3, 0.2, 0.1]) == 0


def test_regret_masks():
    new, old = [0.5, 0.2, 0.2], [0.0, 0.0, 0.0]
    logs = np.log1p(-np.asarray(new))
    np.testing.assert_allclose(weigh(new, old, omega=1 / 3), logs[0], rtol=1e-5)
    np.testing.assert_allclose(weigh(new, old, omega=2 / 3), logs.sum(), rtol=1e-5)  # ties all count
    np.testing.assert_allclose(weigh([1.0], [0.0], omega=1.0), np.log(0.1), rtol=1e-5)


def test_padded_actions_have_no_regret():
    mask = jnp.asarray([1.0, 1.0, 0.0])
    with_padding = regret.regret_weight(jnp.asarray([0.1, 0.2, 0.8]), jnp.zeros(3), mask, omega=0.5, bound=jnp.inf)
    np.testing.assert_allclose(with_padding, np.log(0.8), rtol=1e-5)


def test_an_agent_without_a_costly_step_keeps_its_regret():
    """Though another agent had one; momentum would move it."""
    costly = jnp.zeros((3, 4, 2, 2)).at[1, 2, 0, 1].set(1.0)
    new, old = ({"weights": jnp.full((2, 5), x), "count": jnp.full(2, x)} for x in (1.0, 0.0))
    kept = regret.where_costly(costly, new, old)  # pyright: ignore[reportArgumentType]
    assert kept["weights"].sum(1).tolist() == [5.0, 0.0] and kept["count"].tolist() == [1.0, 0.0]


def test_regret_arises_only_where_it_cost():
    logits, cost = jnp.asarray([[2.0, -1.0], [2.0, -1.0]]), jnp.asarray([[1.0], [0.0]])
    found = regret.regret(logits, cost)
    np.testing.assert_allclose(found[0], jax.nn.sigmoid(logits[0]))
    np.testing.assert_array_equal(found[1], 0)


def test_calibration():
    p, y = jnp.asarray([0.05, 0.05, 0.95, 0.95]), jnp.asarray([0.0, 0.0, 1.0, 0.0])
    figures = fear.calibration(p, y)
    np.testing.assert_allclose(figures["brier"], (2 * 0.05**2 + 0.05**2 + 0.95**2) / 4, rtol=1e-5)
    np.testing.assert_allclose(figures["ece"], (0.1 + 0.9) / 4, rtol=1e-5)
    np.testing.assert_allclose(figures["on_costly"], 0.95, rtol=1e-6)
    np.testing.assert_allclose(figures["on_safe"], 1.05 / 3, rtol=1e-5)


# ---------------------------------------------------------------------------------------------------------------------
# Tabular appraisal

PROBABILITY = np.asarray([0.0, 0.02, 0.3, 1.0])


def tabular(loss: str, l2: float = 0.0, steps: int = 300, remembered: str = "self") -> np.ndarray:
    """Fear of four states after `steps` of Adam on 4,096 rows of observed costs."""
    state = jnp.tile(jnp.arange(4), 1024)
    key = jax.random.key(0)
    cost = jax.random.bernoulli(key, jnp.asarray(PROBABILITY)[state]).astype(float)
    adam = optax.adam(5e-2)

    def objective(logits: jax.Array, key: jax.Array) -> jax.Array:
        mine = logits[state]
        noise = jax.random.logistic(key, mine.shape)
        printed = letter.divergence(mine, cost, noise)
        distance = printed if loss == "letter" else losses.cross_entropy(mine, cost)
        old = jax.lax.stop_gradient(jax.nn.sigmoid(mine)) if remembered == "self" else jnp.zeros_like(mine)
        return losses.appraisal_loss(distance, mine, old, jnp.ones_like(mine), l2)

    def step(carry, key):
        logits, opt = carry
        update, opt = adam.update(jax.grad(objective)(logits, key), opt)
        return (optax.apply_updates(logits, update), opt), None

    start = jnp.zeros(4)
    (logits, _), _ = jax.jit(lambda s: jax.lax.scan(step, s, jax.random.split(key, steps)))((start, adam.init(start)))
    return np.asarray(jax.nn.sigmoid(logits))


def test_cross_entropy_is_calibrated():
    np.testing.assert_allclose(tabular("ce"), PROBABILITY, atol=0.03)


def test_the_letter_of_the_paper_does_not_fear_what_is_rare():
    feared = tabular("letter")
    assert feared[2] < 0.05  # a cost three times in ten
    assert feared[3] > 0.95


@pytest.mark.full
def test_remembering_oneself_leaves_fear_unbiased_and_remembering_nothing_does_not():
    np.testing.assert_allclose(tabular("ce", l2=1.0), tabular("ce"), atol=0.02)
    shrunk = tabular("ce", l2=1.0, steps=2000, remembered="zero")
    np.testing.assert_allclose(shrunk, [0.001, 0.025, 0.216, 0.707], atol=0.03)
    shrunk = tabular("ce", l2=10.0, steps=2000, remembered="zero")
    np.testing.assert_allclose(shrunk, [0.002, 0.019, 0.102, 0.224], atol=0.03)


def test_without_weight_there_is_no_loss_and_no_gradient():
    logits, target = jnp.asarray([0.3, -2.0]), jnp.asarray([0.9, 0.1])

    def objective(logits: jax.Array) -> jax.Array:
        distance = losses.cross_entropy(logits, target)
        return losses.appraisal_loss(distance, logits, jnp.zeros(2), jnp.zeros(2), 1.0)

    assert objective(logits) == 0
    np.testing.assert_array_equal(jax.grad(objective)(logits), 0)


@pytest.mark.full
def test_regret_learns_how_deliberate_a_costly_action_was():
    import flax.linen as nn

    from pmt_jax.learning.optimise import fit, init_train_state

    action = jax.random.normal(jax.random.key(0), (8192, 1))
    target = regret.deliberateness(action)
    net = nn.Sequential([nn.Dense(32), nn.tanh, nn.Dense(32), nn.tanh, nn.Dense(1)])

    def loss(params, rows):
        x, p = rows
        logits: jax.Array = net.apply(params, x)  # pyright: ignore
        distance = losses.cross_entropy(logits, p)
        return losses.appraisal_loss(distance, logits, p, jnp.ones_like(p), 0.0), {}

    start = init_train_state(net.init(jax.random.key(1), action[:1]))
    options = {"learning_rate": 5e-3, "max_grad_norm": 10.0, "epochs": 60, "minibatches": 8}
    trained, _ = fit(start, loss, (action, target), jax.random.key(2), **options)
    probe = jnp.linspace(-2, 2, 41)[:, None]
    learned = jax.nn.sigmoid(net.apply(trained.params, probe))  # pyright: ignore
    np.testing.assert_allclose(learned, jnp.exp(-0.5 * probe**2), atol=0.05)


# ---------------------------------------------------------------------------------------------------------------------
# The paper's equations


@functools.cache
def functions_of_equations() -> dict[str, list[str]]:
    """Of each equation's number, the functions whose docstrings name it."""
    named = collections.defaultdict(list)
    for path in pathlib.Path(pmt_jax.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                for numbers in re.findall(r"Eq\. (\d+(?:, \d+)*)", ast.get_docstring(node) or ""):
                    for number in numbers.split(", "):
                        named[number].append(f"{path.name}:{node.name}")
    return named


@pytest.mark.parametrize("number", [3, 4, *range(8, 18)])
def test_every_equation_is_one_function(number: int):
    named = functions_of_equations()[str(number)]
    assert len(named) == 1, named


# ---------------------------------------------------------------------------------------------------------------------
# Where fear begins before any experience, and that it becomes calibrated on what it sees


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


@pytest.mark.full
def test_fear_tells_danger_from_safety_after_sixty_updates():
    """Of 12 seeds the mean squared error is 0.240 +- 0.007 in the first update and 0.037 +- 0.009 in the last."""
    hyper = PROGRAM.hyper(actor_lr=0.0)
    state, errors = PROGRAM.init(hyper, jax.random.key(0)), []
    for _ in range(60):
        state, metrics = PROGRAM.step(hyper, state)
        errors.append(float(metrics["fear/brier"]))
    assert errors[0] > 0.2 and errors[-1] < 0.1
