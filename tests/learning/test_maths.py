"""Closed-form numbers ."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from pmt_jax.learning import constraint
from pmt_jax.learning.fused import gpu
from pmt_jax.learning.maths import distributions, running_moments
from pmt_jax.learning.maths.advantages import gae, standardise
from pmt_jax.learning.maths.losses import (
    FOCOPS_TEMPERATURE,
    clipped_penalty,
    clipped_surrogate,
    first_order_surrogate,
    huber,
    hybrid_advantage,
    value_loss,
)
from pmt_jax.learning.networks import LayerNorm
from pmt_jax.learning.optimise import fit, init_train_state, shuffled
from pmt_jax.learning.trust_region import (
    DAMPING,
    PRECISION,
    backtrack,
    conjugate_gradient,
    constrained_direction,
    fisher,
    in_parts,
    solve,
)


def column(x: list[float], dtype: type = float) -> jax.Array:
    return jnp.asarray(x, dtype)[:, None]


def test_gae_bootstraps_at_a_truncation_and_not_at_a_termination():
    advantage, returns = gae(
        column([1, 0, 2, 1]),
        column([1, 2, 0, 4]),
        column([2, 8, 0, 2]),
        column([0, 0, 1, 0], bool),
        column([0, 1, 1, 0], bool),
        0.5,
        0.5,
    )
    np.testing.assert_allclose(advantage[:, 0], [1.5, 2, 2, -2])
    np.testing.assert_allclose(returns[:, 0], [2.5, 4, 2, 2])


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-10, 10, width=32), min_size=6, max_size=6), st.floats(0, 1))
def test_gae_without_decay_is_the_discounted_sum(signal: list[float], gamma: float):
    x, never = column(signal), jnp.zeros((6, 1), bool)
    value = jnp.arange(1.0, 7.0)[:, None]
    next_value = jnp.concatenate([value[1:], jnp.zeros((1, 1))])
    _, returns = gae(x, value, next_value, never, never, gamma, 1.0)
    expected = [sum(gamma ** (s - t) * signal[s] for s in range(t, 6)) for t in range(6)]
    np.testing.assert_allclose(returns[:, 0], expected, atol=1e-3)


def test_gae_takes_costs_of_all_agents_at_once():
    key = jax.random.key(0)
    x, v, w = jax.random.normal(key, (3, 5, 4, 2, 3))
    terminated = jax.random.bernoulli(key, 0.2, (5, 4))
    done = terminated | jax.random.bernoulli(jax.random.key(1), 0.2, (5, 4))
    together, _ = gae(x, v, w, terminated, done, 0.9, 0.8)
    alone, _ = gae(x[..., 1, 2], v[..., 1, 2], w[..., 1, 2], terminated, done, 0.9, 0.8)
    np.testing.assert_allclose(together[..., 1, 2], alone, rtol=1e-6)


def test_standardise_centres_and_never_divides_by_less_than_the_floor():
    x = jnp.asarray([0.0, 0.0, 0.0, 0.04])[:, None]
    centred, scaled = standardise(x, 0.05)
    np.testing.assert_allclose(centred.mean(), 0, atol=1e-8)
    np.testing.assert_allclose(scaled, centred / 0.05, rtol=1e-6)
    _, unit = standardise(x * 100)
    np.testing.assert_allclose(unit.std(), 1, rtol=1e-4)


def test_forgetting_moments():
    moments = running_moments.update_ema(running_moments.init(()), jnp.asarray([1.0, 3.0]), 0.5)
    mean, scale = running_moments.centre_and_scale(moments)
    np.testing.assert_allclose(
        [mean, scale, running_moments.normalise(moments, jnp.asarray(3.0))], [2, 1, 1], rtol=1e-6
    )
    moments = running_moments.update_ema(moments, jnp.asarray([5.0, 7.0]), 0.5)
    mean, scale = running_moments.centre_and_scale(moments)
    np.testing.assert_allclose([mean, scale**2], [4.66667, 4.55556], rtol=1e-5)
    np.testing.assert_allclose(running_moments.normalise(moments, jnp.asarray(3.0)), -0.780869, rtol=1e-5)
    np.testing.assert_allclose(
        running_moments.denormalise(moments, running_moments.normalise(moments, jnp.asarray(9.0))), 9
    )


def test_moments_of_nothing_normalise_as_the_identity():
    x = jnp.asarray([3.0, -4.0])
    np.testing.assert_array_equal(running_moments.normalise(running_moments.init((2,)), x), x)
    np.testing.assert_array_equal(running_moments.normalise_obs(running_moments.init((2,)), x), x)


@settings(max_examples=20, deadline=None)
@given(st.floats(-1e3, 1e3), st.integers(1, 9))
def test_accumulated_moments_equal_those_of_everything_seen(offset: float, cut: int):
    x = offset + np.random.default_rng(0).normal(size=(10, 3)).astype(np.float32)
    moments = running_moments.init((3,))
    for part in (x[:cut], x[cut:]):
        moments = running_moments.accumulate(moments, jnp.asarray(part))
    np.testing.assert_allclose(moments.mean, x.mean(0), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(moments.second, x.var(0), rtol=1e-2, atol=1e-3)


def test_huber_is_linear_on_both_sides():
    np.testing.assert_allclose(huber(jnp.asarray([12.0, -12.0, 2.0])), [70, 70, 2])


def test_value_loss_takes_the_worse_of_the_two():
    loss = value_loss(jnp.asarray(1.0), jnp.asarray(0.0), jnp.asarray(2.0), 0.2)
    np.testing.assert_allclose(loss, 0.5 * 1.8**2, rtol=1e-6)


def test_initial_deviation():
    np.testing.assert_allclose(distributions.std(jnp.asarray(1.0)), 0.365529, rtol=1e-5)


@pytest.mark.parametrize(
    ("ratio", "advantage", "factor", "weight", "expected"),
    [
        (1.5, 1, 1, 1, 1.2),
        (1.5, -1, 1, 1, -1.5),
        (0.5, 1, 1, 1, 0.5),
        (0.5, -1, 1, 1, -0.8),
        (1.5, 1, 2, 1, 2.4),
        (1.15, 1, 1, 0.9, 1.035),
        (1.4, 1, 1, 0.9, 1.2),
        (0.85, -1, 1, 0.9, -0.8),
    ],
)
def test_clipped_surrogate(ratio: float, advantage: float, factor: float, weight: float, expected: float):
    gain = clipped_surrogate(jnp.log(ratio), jnp.log(weight), jnp.asarray(advantage), jnp.asarray(factor), 0.2)
    np.testing.assert_allclose(gain, expected, rtol=1e-5)


def test_gradient_stays_alive_for_small_weights_only():
    def slope(weight: float) -> jax.Array:
        return jax.grad(lambda r: clipped_surrogate(r, jnp.log(weight), jnp.asarray(-1.0), jnp.asarray(1.0), 0.2))(0.0)

    assert slope(0.9) != 0
    assert slope(0.7) == 0


def test_hybrid_advantage():
    np.testing.assert_allclose(
        hybrid_advantage(jnp.asarray([1.0]), jnp.asarray([[0.4, -0.1]]), jnp.asarray([[0.5, 2.0]])), [1.0], rtol=1e-6
    )


@pytest.mark.parametrize(("cost_advantage", "expected"), [([0.5, -0.25], 0.805), ([0.5, 0.25], 0.855)])
def test_dual_update(cost_advantage: list[float], expected: float):
    surrogate = jnp.mean(jnp.asarray([1.0, 2.0]) * jnp.asarray(cost_advantage))
    violation = jnp.asarray(0.25)
    np.testing.assert_allclose(
        constraint.dual_update(jnp.asarray(0.78), violation + surrogate, 0.1, 20.0), expected, rtol=1e-6
    )


def test_dual_update_is_projected():
    violation = jnp.asarray(-0.5)
    assert constraint.dual_update(jnp.asarray(0.78), violation, 2.0, 20.0) == 0
    assert constraint.dual_update(jnp.asarray(19.9), -violation, 2.0, 20.0) == 20


def test_a_relative_update_is_a_share_of_the_multiplier_within_its_bounds():
    multiplier = jnp.asarray([0.5, 4.0])
    up, down = (constraint.relative_update(multiplier, jnp.asarray(x), 0.25, 0.01, 20.0) for x in (1.0, -1.0))
    np.testing.assert_allclose(up / multiplier, 1.25, rtol=1e-6)
    np.testing.assert_allclose(down / multiplier, 0.75, rtol=1e-6)
    for near, excess, bound in (19.9, 1.0, 20.0), (0.0101, -1.0, 0.01):
        bounded = constraint.relative_update(jnp.asarray(near), jnp.asarray(excess), 0.25, 0.01, 20.0)
        np.testing.assert_allclose(bounded, bound, rtol=1e-6)


def test_a_limit_is_lowered_by_what_was_not_kept():
    excess = jnp.asarray([2.0, -2.0, -9.0])
    assert constraint.lower_limit(jnp.asarray(0.5), excess, 0.125, jnp.asarray(99.0)).tolist() == [0.75, 0.25, 0]


@pytest.mark.parametrize("excess", [2.0, 0.25])
def test_a_limit_that_was_lowered_too_far_returns_to_what_a_step_can_reach(excess: float):
    """However long the cost was beyond the limit, the sum ends where a step does nothing but lower the cost."""
    for start in 0.0, 40.0:
        lowered = jnp.asarray(start)
        for _ in range(400):
            lowered = constraint.lower_limit(lowered, jnp.asarray(excess), 0.1, jnp.asarray(3.0))
        np.testing.assert_allclose(lowered, 3.0, rtol=1e-5)
    once = constraint.lower_limit(jnp.asarray(40.0), jnp.asarray(excess), 0.125, jnp.asarray(3.0))
    assert once == 40.0 - 0.125 * (40.0 - 3.0)


def test_pid_adds_what_the_excess_is_and_how_it_rises():
    integral, risen, fallen = jnp.asarray(0.75), (jnp.asarray(0.5), 0.25), (jnp.asarray(-0.25), 0.5)
    assert constraint.pid(integral, *risen, 0.0, 0.0, 20.0) == 0.75
    assert constraint.pid(integral, *risen, 2.0, 0.0, 20.0) == 0.75 + 2 * 0.5
    assert constraint.pid(integral, *risen, 0.0, 4.0, 20.0) == 0.75 + 4 * 0.25
    assert constraint.pid(integral, *fallen, 2.0, 4.0, 20.0) == 0.75 - 2 * 0.25  # a cost that falls adds nothing
    assert constraint.pid(integral, *fallen, 4.0, 0.0, 20.0) == 0
    assert constraint.pid(integral, *risen, 99.0, 0.0, 20.0) == 20


@pytest.mark.parametrize("sign", [1, -1])
def test_pid_does_not_wind_up(sign: int):
    """However long the excess lasted, one update of the other sign takes the multiplier off its bound."""
    excess, integral = jnp.asarray(0.5 * sign), jnp.asarray(1.0)
    for _ in range(1000):
        integral = constraint.dual_update(integral, excess, 0.25, 2.0)
    after = constraint.dual_update(integral, -excess, 0.25, 2.0)
    assert constraint.pid(after, -excess, excess, 1.0, 0.0, 2.0) == (2 - 0.125 - 0.5 if sign > 0 else 0.125 + 0.5)


def test_log_prob_and_entropy_agree_with_scipy():
    rng = np.random.default_rng(0)
    action, mean = rng.normal(size=(2, 5, 3))
    std = np.asarray([0.1, 0.3, 0.5])
    expected = stats.norm.logpdf(action, mean, std).sum(-1)
    ones = jnp.ones(3)
    np.testing.assert_allclose(distributions.log_prob(action, mean, jnp.asarray(std), ones), expected, rtol=1e-4)
    np.testing.assert_allclose(
        distributions.entropy(jnp.asarray(std), ones), stats.norm.entropy(mean[0], std).sum(), rtol=1e-5
    )


def test_padded_actions_do_not_count():
    mask = jnp.asarray([1.0, 1.0, 0.0])
    x, mean, std = jnp.asarray([0.1, 0.2, 9.0]), jnp.zeros(3), jnp.full(3, 0.3)
    np.testing.assert_allclose(
        distributions.log_prob(x, mean, std, mask), distributions.log_prob(x[:2], mean[:2], std[:2], mask[:2])
    )
    np.testing.assert_allclose(distributions.entropy(std, mask), distributions.entropy(std[:2], mask[:2]))
    assert distributions.kl(mean, std, mean.at[2].set(5.0), std, mask) == 0


def test_kl_and_its_derivatives_at_equal_parameters():
    mean, std, mask = jnp.asarray([0.1, -0.2]), jnp.asarray([0.2, 0.4]), jnp.ones(2)

    def divergence(m: jax.Array) -> jax.Array:
        return distributions.kl(mean, std, m, std, mask)

    np.testing.assert_allclose(divergence(mean), 0, atol=1e-7)
    np.testing.assert_allclose(jax.grad(divergence)(mean), 0, atol=1e-6)
    np.testing.assert_allclose(jax.hessian(divergence)(mean), np.diag(1 / np.asarray(std) ** 2), rtol=1e-4, atol=1e-4)


def test_kl_against_the_textbook():
    kl = distributions.kl(jnp.asarray([1.0]), jnp.asarray([0.5]), jnp.asarray([0.0]), jnp.asarray([2.0]), jnp.ones(1))
    np.testing.assert_allclose(kl, np.log(4) + (0.25 + 1) / 8 - 0.5, rtol=1e-5)


def penalty(ratio: list[float], cost: list[float], excess: float, factor: float = 1.0) -> float:
    log_ratio = jnp.log(jnp.asarray(ratio))
    none = jnp.zeros_like(log_ratio)
    cost_advantage, excesses = column(cost), jnp.asarray([excess])
    return float(clipped_penalty(log_ratio, none, cost_advantage, none + factor, excesses, 0.2))


def test_a_penalty_is_clipped_towards_the_worse_and_only_beyond_the_limit():
    assert penalty([1.0, 1.0], [1.0, -1.0], -0.1) == 0  # within
    np.testing.assert_allclose(penalty([1.0, 1.0], [1.0, -1.0], 0.3), 0.3, rtol=1e-6)
    np.testing.assert_allclose(penalty([1.5, 1.0], [1.0, 0.0], 0.0), 0.75, rtol=1e-6)  # what costs more is not clipped
    np.testing.assert_allclose(penalty([0.5, 1.0], [1.0, 0.0], 0.0), 0.4, rtol=1e-6)  # less of it counts to 0.8
    np.testing.assert_allclose(penalty([1.5, 1.0], [-1.0, 0.0], 1.0), 0.4, rtol=1e-6)
    np.testing.assert_allclose(penalty([1.5, 1.0], [1.0, 0.0], 0.0, factor=2.0), 1.5, rtol=1e-6)


def test_a_penalty_of_two_costs_counts_each_alone():
    none = jnp.zeros(2)
    both = clipped_penalty(none, none, jnp.zeros((2, 2)), none + 1, jnp.asarray([0.5, -9.0]), 0.2)
    np.testing.assert_allclose(both, 0.5)


def test_focops_stands_still_at_the_best_policy_of_its_trust_region():
    """Of a Gaussian with the advantage g (a - m), pi exp(A / tau) / Z is the same Gaussian moved by g std^2 / tau."""
    std, slope = 0.4, 0.3
    noise = std * stats.norm.ppf((np.arange(4000) + 0.5) / 4000)  # quantiles in place of samples
    action, one = jnp.asarray(noise, jnp.float32)[:, None], jnp.ones(1)

    def objective(mean: jax.Array, kl_limit: float = jnp.inf) -> jax.Array:
        old, new = ((jnp.full(1, m), jnp.full(1, std)) for m in (0.0, mean))
        log_ratio = distributions.log_prob(action, *new, one) - distributions.log_prob(action, *old, one)
        kl = jnp.broadcast_to(distributions.kl(*new, *old, one), log_ratio.shape)
        none = jnp.zeros_like(log_ratio)
        return first_order_surrogate(log_ratio, none, slope * action[:, 0], none + 1, kl, kl_limit).mean()

    best = slope * std**2 / FOCOPS_TEMPERATURE
    np.testing.assert_allclose(jax.grad(objective)(0.0), slope / FOCOPS_TEMPERATURE, rtol=1e-2)
    np.testing.assert_allclose(jax.grad(objective)(best), 0.0, atol=2e-3)
    assert jax.grad(objective)(2 * best) < -0.1 and jax.grad(objective)(2 * best, 1e-6) == 0


def test_crpo_improves_the_cost_furthest_beyond_its_limit_or_the_reward():
    chosen = constraint.switching(jnp.asarray([[0.1, 0.3], [-0.1, 0.2], [-0.2, -0.1], [0.0, -0.1]]))
    np.testing.assert_array_equal(chosen, [[0, 1], [0, 1], [0, 0], [0, 0]])


def test_fit_finds_the_least_squares_solution_and_sees_every_row_in_each_epoch():
    x = jax.random.normal(jax.random.key(0), (64, 3))
    weights = jnp.asarray([1.0, -2.0, 0.5])

    def loss(params: jax.Array, rows: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, dict[str, jax.Array]]:
        inputs, target = rows
        return jnp.mean((inputs @ params - target) ** 2), {"mean_target": target.mean()}

    settings_ = {"learning_rate": 0.05, "max_grad_norm": 10.0, "epochs": 100, "minibatches": 4}
    net, metrics = fit(init_train_state(jnp.zeros(3)), loss, (x, x @ weights), jax.random.key(1), **settings_)
    np.testing.assert_allclose(net.params, weights, atol=1e-2)
    np.testing.assert_allclose(metrics["mean_target"], (x @ weights).mean(), rtol=1e-5)


@pytest.mark.parametrize(("bound", "step"), [(1e-8, 0.5e-8 / 1e-5), (np.inf, 1.0)])
def test_fit_scales_gradients_down_to_the_given_norm(bound: float, step: float):
    """Adam's eps of 1e-5 dwarfs a gradient of norm 1e-8, so the step is gradient / eps in place of 1."""

    def loss(params: jax.Array, rows: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        return 1e6 * params.sum() + 0 * rows.sum(), {}

    one_step = {"learning_rate": 1.0, "epochs": 1, "minibatches": 1}
    net, metrics = fit(
        init_train_state(jnp.zeros(4)), loss, jnp.ones((2, 1)), jax.random.key(0), max_grad_norm=bound, **one_step
    )
    np.testing.assert_allclose(net.params, -step, rtol=1e-2)
    np.testing.assert_allclose(metrics["grad_norm"], 2e6, rtol=1e-5)


def test_layer_normalisation_is_what_its_name_says():
    x = 3 * jax.random.normal(jax.random.key(0), (7, 33)) + 2
    weights = {"params": {"scale": jnp.arange(33.0) / 10, "bias": jnp.arange(33.0)}}
    np.testing.assert_allclose(LayerNorm().apply(weights, x), nn.LayerNorm().apply(weights, x), atol=2e-5)


@pytest.mark.parametrize("count", [1, 2, 7, 4096, 5000])
def test_shuffled_is_every_row_once(count: int):
    first, second = (shuffled(jax.random.key(seed), count) for seed in (0, 1))
    np.testing.assert_array_equal(jnp.sort(first), np.arange(count))
    assert count < 3 or (first != second).any()


def test_shuffled_brings_every_row_to_every_place_alike():
    """4,000 shuffles of 8 rows: each row is in each place 500 times, give or take five standard deviations."""
    orders = jax.jit(jax.vmap(lambda key: shuffled(key, 8)))(jax.random.split(jax.random.key(0), 4000))
    counts = (np.asarray(orders)[:, :, None] == np.arange(8)).sum(0)
    assert np.abs(counts - 500).max() < 5 * np.sqrt(500 * 7 / 8)


# ---------------------------------------------------------------------------------------------------------------------
# MACPO's step against closed forms and an exact solver


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


def test_products_of_the_fisher_matrix_use_tensor_cores_where_there_are_some(monkeypatch):
    obs, start = jax.random.normal(jax.random.key(0), (20, 3)), jnp.arange(6.0) / 6

    def policy(flat: jax.Array) -> tuple[jax.Array, jax.Array]:
        mean = jnp.tanh(obs @ flat.reshape(3, 2))
        return mean, jnp.ones_like(mean)

    def divergence(mean: jax.Array, std: jax.Array) -> jax.Array:
        return jnp.mean(mean**2 / std)

    for there_are in (True, False):
        monkeypatch.setattr(gpu, "available", lambda there_are=there_are: there_are)
        program = str(jax.make_jaxpr(lambda at, v: fisher(policy, divergence, at)(v))(start, start))
        products = program.count("dot_general[")
        assert products >= 3 and program.count(PRECISION) == there_are * products


def test_a_policy_in_parts_has_the_same_outputs_and_products():
    obs, weights, step = (jax.random.normal(jax.random.key(i), shape) for i, shape in enumerate([(20, 3), (8,), (8,)]))

    def policy(flat: jax.Array, obs: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jnp.tanh(obs @ flat[:6].reshape(3, 2)), jnp.exp(flat[6:])

    whole, cut = (jax.linearize(in_parts(policy, obs, parts), weights) for parts in (1, 4))
    for ours, theirs in zip([*cut[0], *cut[1](step)], [*whole[0], *whole[1](step)], strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)
    pulled = [jax.linear_transpose(push, weights)(whole[1](step))[0] for _, push in (whole, cut)]
    np.testing.assert_allclose(pulled[1], pulled[0], rtol=1e-5, atol=1e-5)


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
