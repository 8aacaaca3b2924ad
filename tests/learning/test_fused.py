"""The learner's C++ code computes what XLA computes, to rounding, and the same bits whatever runs next to it."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs import native
from pmt_jax import load_config, tasks
from pmt_jax.learning import fused, learner
from pmt_jax.learning.maths import gru
from pmt_jax.learning.networks import MLP
from pmt_jax.learning.optimise import fit, init_train_state
from stepping import compiled

pytestmark = compiled


@pytest.fixture
def by_xla(monkeypatch):
    """Calls a function where no C++ code is used."""

    def call(function, *arguments):
        with monkeypatch.context() as patch:
            patch.setattr(fused, "available", lambda: False)
            return function(*arguments)

    return call


def network(inputs, hidden, outputs, activation="relu", layer_norm=True, input_norm=False, seed=0):
    """A network, and weights none of which is 0 or 1."""
    module = MLP(hidden, outputs, 1.0, activation, layer_norm, input_norm)
    params = jax.jit(module.init)(jax.random.key(seed), jnp.zeros(inputs))
    draw = np.random.default_rng(seed)
    return module, jax.tree.map(lambda x: x + 0.1 * draw.standard_normal(x.shape, np.float32), params)


@functools.partial(jax.jit, static_argnums=0)
def gradients(apply, params, x):
    """Outputs of a network, and the gradient of a function in which every output counts differently."""
    out = apply(params, x)
    weight = jnp.cos(jnp.arange(out.size).reshape(out.shape))
    return out, jax.grad(lambda p: jnp.sum(weight * jnp.sin(apply(p, x))))(params)


def assert_close(found, expected, tolerance=2e-5):
    """Leaves differ by no more than `tolerance` of the largest number in all of them: sums may cancel in some."""
    largest = max(float(np.abs(y).max(initial=0)) for y in jax.tree.leaves(expected))
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=tolerance * largest)


@pytest.mark.full  # each shape compiles for seconds
@settings(max_examples=5, deadline=None)
@given(
    st.integers(1, 40),
    st.lists(st.integers(1, 150), min_size=0, max_size=3),
    st.integers(1, 20),
    st.integers(1, 130),
    st.sampled_from(fused.ACTIVATIONS),
    st.booleans(),
    st.booleans(),
)
def test_a_network_of_any_shape_has_xlas_outputs_and_gradients(inputs, hidden, outputs, rows, activation, layer, first):
    # A norm of few numbers divides by their spread: rounding grows with it, in XLA as here.
    norms = [norm and min(inputs, *hidden, 99) > 7 for norm in (layer, first)]
    module, params = network(inputs, tuple(hidden), outputs, activation, *norms)
    x = jax.random.normal(jax.random.key(9), (rows, inputs))
    with jax.default_matmul_precision("highest"):
        expected = gradients(module.apply, params, x)
    assert_close(gradients(functools.partial(fused.apply, module), params, x), expected, 1e-4)


@functools.partial(jax.jit, static_argnums=0)
def along(unroll, hidden, done, *weights):
    """Hidden states, and the gradient of a function in which each counts differently."""

    def total(weights):
        states = unroll(weights[0], hidden, done, *weights[1:])
        return jnp.sum(jnp.cos(jnp.arange(states.size).reshape(states.shape)) * states), states

    (_, states), gradient = jax.value_and_grad(total, has_aux=True)(weights)
    return states, gradient


def sequences(count, steps, agents, width):
    """Hidden states, ends, gates, kernel and bias of a recurrent unit."""
    key = functools.partial(jax.random.fold_in, jax.random.key(width))
    gates = jax.random.normal(key(0), (count, steps, *agents, 3 * width))
    hidden, done = jax.random.normal(key(1), (count, *agents, width)), jax.random.bernoulli(key(2), 0.2, (count, steps))
    kernel, bias = jax.random.normal(key(3), (width, 3 * width)), jax.random.normal(key(4), (width,))
    return hidden, done, gates, kernel / width**0.5, bias


# Widths of whole vectors and of parts of them; sequences that fill a task and that do not.
@pytest.mark.parametrize(
    ("count", "agents", "width"),
    [(7, (2,), 13), *(pytest.param(*x, marks=pytest.mark.full) for x in ((8, (), 16), (1, (), 1), (13, (3,), 40)))],
)
def test_a_recurrent_unit_has_xlas_states_and_gradients(count, agents, width):
    given = sequences(count, 9, agents, width)
    with jax.default_matmul_precision("highest"):
        expected = along(gru.unroll, *given)
    assert_close(along(fused.unroll, *given), expected)


@pytest.mark.parametrize("input_norm", [False, True])
def test_what_a_network_sees_has_xlas_gradient_where_it_is_asked_for(input_norm):
    module, params = network(13, (), 3, input_norm=input_norm)
    x = jax.random.normal(jax.random.key(9), (50, 13))

    def of_input(apply):
        return jax.jit(jax.grad(lambda x: jnp.sum(jnp.sin(apply(params, x)))))(x)

    with jax.default_matmul_precision("highest"):
        expected = of_input(module.apply)
    assert_close(of_input(functools.partial(fused.apply, module, through=True)), expected)
    np.testing.assert_array_equal(of_input(functools.partial(fused.apply, module)), 0)


def test_recurrent_units_side_by_side_have_the_bits_of_each_alone():
    first = sequences(7, 5, (), 13)
    second = (first[0] + 1, ~first[1], *(x / 2 for x in first[2:]))
    both = jax.vmap(functools.partial(along, fused.unroll))(*map(jnp.stack, zip(first, second, strict=True)))
    for i, one in enumerate((first, second)):
        np.testing.assert_array_equal(both[0][i], along(fused.unroll, *one)[0])


@pytest.mark.parametrize("activation", fused.ACTIVATIONS)
def test_activations_agree_with_xlas_from_tiny_to_huge_inputs(activation):
    module = MLP((16,), 16, 1.0, activation, layer_norm=False)
    size = np.logspace(-6, 2, 200, dtype=np.float32)
    x = np.concatenate([-size, [0.0], size, [1e4, -1e4]])[:, None] * np.ones(16, np.float32)
    eye, zero = jnp.eye(16), jnp.zeros(16)
    params = {"params": {name: {"kernel": eye, "bias": zero} for name in ("Dense_0", "Dense_1")}}
    expected, found = module.apply(params, x), fused.apply(module, params, jnp.asarray(x))
    np.testing.assert_allclose(found, expected, rtol=3e-7, atol=1.2e-7)


@pytest.mark.parametrize("activation", fused.ACTIVATIONS)
def test_what_is_not_finite_stays_so(activation):
    module, params = network(5, (20, 20), 3, activation)
    x = jnp.ones((4, 5)).at[1, 2].set(jnp.nan)
    out = fused.apply(module, params, x)
    assert jnp.isnan(out[1]).all() and jnp.isfinite(out[jnp.array([0, 2, 3])]).all()


def rows_of(count=96, inputs=7):
    x = jax.random.normal(jax.random.key(5), (count, inputs))
    return x, jnp.sin(x[:, :2])


def fitted(module, params, rows, key, learning_rate=1e-2, max_grad_norm=0.5):
    """A fit by C++ code where there is any."""
    apply = functools.partial(fused.apply, module) if fused.available() else module.apply

    def loss(params, rows):
        x, target = rows
        return jnp.mean((apply(params, x) - target) ** 2), {"largest": jnp.abs(target).max()}

    limits = {"learning_rate": learning_rate, "max_grad_norm": max_grad_norm}
    return fit(init_train_state(params), loss, rows, key, **limits, epochs=3, minibatches=2)


@pytest.mark.parametrize("bound", [0.1, *(pytest.param(x, marks=pytest.mark.full) for x in (10.0, np.inf))])
def test_a_fit_ends_where_xlas_ends(by_xla, bound):
    module, params = network(7, (33, 16), 2, "elu")
    run = functools.partial(fitted, module, params, rows_of(), jax.random.key(3), max_grad_norm=bound)
    expected = by_xla(jax.jit(run))
    assert_close(jax.jit(run)(), expected, 1e-4)
    assert jax.tree.structure(jax.jit(run)()) == jax.tree.structure(expected)


@pytest.mark.full
def test_weights_as_one_vector_end_where_a_tree_of_them_ends(by_xla, monkeypatch):
    module, params = network(7, (33, 16), 2, "elu")
    run = functools.partial(fitted, module, params, rows_of(), jax.random.key(3))
    expected = by_xla(jax.jit(run))
    monkeypatch.setattr(fused, "steps_vectors", lambda: True)  # as on a GPU
    found = by_xla(jax.jit(lambda: run()))
    assert_close(found, expected, 1e-6)
    assert jax.tree.structure(found) == jax.tree.structure(expected)


def test_networks_fitted_side_by_side_have_the_bits_of_each_alone():
    seeds = range(3)
    module, _ = network(7, (40, 24), 2)
    each = [network(7, (40, 24), 2, seed=seed)[1] for seed in seeds]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    keys, rates = jax.random.split(jax.random.key(1), 3), jnp.array([1e-2, 1e-3, 2e-2])
    run = functools.partial(fitted, module)
    all_of = jax.jit(jax.vmap(lambda p, k, r: run(p, rows_of(), k, r)))(together, keys, rates)
    for seed in seeds:
        alone = jax.jit(run)(each[seed], rows_of(), keys[seed], rates[seed])
        jax.tree.map(lambda x, y, i=seed: np.testing.assert_array_equal(x[i], y), all_of, alone)


def learned(state):
    parts = (state.actor.params, state.critic.net, state.cost_critic.net, state.fear, state.regret)
    return [np.asarray(x) for x in jax.tree.leaves(parts)]


# One actor or one each, critics of states or of observations, epochs or a trust region, fear and regret or neither:
# what else methods differ in computes with these networks' results.
NETWORKS = [("lane", "mappo"), ("lane", "ippo_l"), ("lane", "mixed"), ("lane", "macpo")]


@pytest.mark.parametrize(
    ("task", "method"),
    [pytest.param(*x, marks=pytest.mark.full if x[1] in ("mixed", "macpo") else pytest.mark.slow) for x in NETWORKS],
)
def test_an_update_learns_what_xla_learns(by_xla, task, method):
    config = load_config(task, method=method, num_envs=8, rollout_length=16, steps=128, log_interval=1)
    train = jax.jit(lambda key: learner.make_train(config)(key))
    expected = by_xla(jax.jit(lambda key: learner.make_train(config)(key)), jax.random.key(0))
    state, metrics = train(jax.random.key(0))
    assert_close(learned(state), learned(expected[0]), 2e-3)
    assert metrics.keys() == expected[1].keys()


@pytest.mark.parametrize(
    ("architecture", "obstacle", "expected"),
    [("9.0", None, True), ("12.0", None, True), ("8.0", None, True), ("7.5", None, False), ("9.0", "no NVRTC", False)],
)
def test_gpus_without_tf32_or_a_compiler_compute_networks_by_xla(architecture, obstacle, expected, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(tasks.gpu(), "architecture", lambda: architecture)
    monkeypatch.setattr(tasks.gpu(), "obstacle", lambda: obstacle)
    assert fused.gpu.available.__wrapped__() is expected


CUDA = ["mlp_forward", "mlp_backward", "mlp_gradients", "mlp_sum"]


@pytest.mark.full
@pytest.mark.parametrize(
    ("method", "recurrent", "nets"), [("mixed", "none", 5), ("mappo_l", "gru", 3), ("macpo", "none", 2)]
)
def test_an_update_is_lowered_for_a_gpu_with_the_networks_kernels(method, recurrent, nets, monkeypatch):
    """Without a GPU: its calls are traced, batched, differentiated and lowered, but not compiled."""
    kernels = tasks.gpu()
    monkeypatch.setattr(kernels, "ptx", lambda *_: "ptx")
    monkeypatch.setattr(kernels, "knows_call", lambda: True)
    monkeypatch.setattr(fused.gpu, "available", lambda: True)
    monkeypatch.setattr(fused, "on_cpu", lambda: False)
    sizes = {"num_envs": 16, "rollout_length": 32, "steps": 512, "log_interval": 1}
    train = jax.vmap(learner.make_train(load_config("lane", method=method, recurrent=recurrent, **sizes)))
    traced = jax.jit(train).trace(jax.random.split(jax.random.key(0), 2))
    program = traced.lower(lowering_platforms=("cuda",)).as_text()
    forward, *backward = (program.count(f'name = "{name}"') for name in CUDA)
    assert backward == [nets] * 3 and forward > nets


def test_without_a_compiler_the_learner_is_xlas_and_one_sentence_says_so(monkeypatch):
    def none(code):
        raise native.NoLibrary("needs a C++ compiler; found none")

    monkeypatch.setattr(native, "targets", none)
    fused.function_names.cache_clear()
    lines = []
    try:
        with tasks.announcing(lines.append):
            assert not fused.available() and not fused.available()
        assert lines == ["XLA computes the networks, more slowly: their own code needs a C++ compiler; found none"]
        module, params = network(7, (16,), 2)
        fitted(module, params, rows_of(), jax.random.key(0))
    finally:
        fused.function_names.cache_clear()
