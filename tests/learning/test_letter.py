"""The letter of the paper: each equation's closed form, the replay buffer, and when each network is fitted."""

from __future__ import annotations

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmt_jax import METHODS, Method, load_config, make_setup, make_train
from pmt_jax.errors import UsageError
from pmt_jax.learning import critics, learner, letter, policies, schedules
from pmt_jax.learning.maths import losses
from pmt_jax.learning.maths.advantages import gae
from pmt_jax.learning.optimise import fit
from pmt_jax.learning.types import Batch, LearnerState, ReplayState, Tag
from pmt_jax.training import checkpoint, outlook
from runs import TINY, assert_same_run
from small import SMALL, program

F4SG = program("f4sg_letter", preset="letter", minibatches=1)
R4SG = program("r4sg_letter", preset="letter", minibatches=1)
ROWS = ("f4sg_letter", "r4sg_letter")
LATE = [pytest.param("f4sg_letter", marks=pytest.mark.full), pytest.param("r4sg_letter", marks=pytest.mark.slow)]


@functools.cache
def acted(method: str) -> tuple[LearnerState, Batch]:
    """The method's first state, and a batch of its team in `switch`."""
    made = {"f4sg_letter": F4SG, "r4sg_letter": R4SG}[method]
    start = made.init(made.setup.hyper, jax.random.key(0))
    tagged = {tag: jax.random.fold_in(jax.random.key(1), tag) for tag in Tag}
    state, batch = jax.jit(functools.partial(learner.act, made.setup))(made.setup.hyper, start, tagged)
    assert 0 < batch.cost.mean() < 1
    return state, batch


@functools.cache
def appraise(part: str):
    """An emotion's jitted function (hyper, net, batch, key) -> net, signal, metrics."""
    made, of = {"fear": (F4SG, letter.appraise_fear), "regret": (R4SG, letter.appraise_regret)}[part]

    @jax.jit
    def appraised(hyper, net, batch, key):
        now = schedules.at(made.setup.config, hyper, jnp.int32(0))
        largest = (jnp.ones((2, 1)),) if part == "fear" else ()
        return of(made.setup, hyper, now, net, batch, *largest, key)

    return appraised


# ---------------------------------------------------------------------------------------------------------------------
# Equations 3 and 4: fear


def replaying(count: int = 3) -> ReplayState:
    """Networks whose replay buffer has states and answers that they would not give."""
    net = acted("f4sg_letter")[0].fear
    assert isinstance(net, ReplayState)
    state, answer = (jax.random.normal(jax.random.key(5), x.shape) for x in (net.state, net.answer))
    return dataclasses.replace(net, state=state, answer=jax.nn.sigmoid(answer), count=jnp.int32(count))


@pytest.mark.full
def test_the_loss_is_the_reversed_divergence_and_the_change_of_what_was_said_of_stored_states():
    _, batch = acted("f4sg_letter")
    net, key = replaying(), jax.random.key(7)
    hyper = F4SG.hyper(emotion_lr=0.0, emotion_l2=0.5)
    after, _, metrics = appraise("fear")(hyper, net, batch, key)

    nets = F4SG.setup.nets
    rows = batch.state.reshape(-1, batch.state.shape[-1])
    cost = np.asarray(batch.cost).reshape(len(rows), 2, 1) * 0.98 + 0.01
    _, _, draw_key, noise_key = jax.random.split(key, 4)
    noise = jax.random.logistic(noise_key, cost.shape)
    b = np.clip(jax.nn.sigmoid((nets.fear(net.params, rows) + noise) / letter.TEMPERATURE), 1e-6, 1 - 1e-6)
    divergence = b * np.log(b / cost) + (1 - b) * np.log((1 - b) / (1 - cost))
    stored, said = letter.draw(after, len(rows), draw_key)
    change = np.asarray(jax.nn.sigmoid(nets.fear(net.params, stored)) - said)
    np.testing.assert_allclose(metrics["loss"], divergence.mean() + 0.5 * (change**2).mean(), rtol=1e-4)
    assert (change**2).mean() > 0.01


def test_the_order_of_samples_has_nothing_to_do_with_their_noise(monkeypatch):
    """`fit` splits its key into one an epoch, which are the numbers that `fold_in` would make of it."""
    keys, (state, batch) = {}, acted("f4sg_letter")
    for name, of, place in (("fit", letter.fit, 3), ("remember", letter.remember, 3), ("draw", letter.draw, 2)):

        def spy(*given, name=name, of=of, place=place, **more):
            keys[name] = given[place]
            return of(*given, **more)

        monkeypatch.setattr(letter, name, spy)
    logistic = jax.random.logistic
    monkeypatch.setattr(jax.random, "logistic", lambda key, shape: logistic(keys.setdefault("noise", key), shape))
    now = schedules.at(F4SG.setup.config, F4SG.setup.hyper, jnp.int32(0))
    net = state.fear
    letter.appraise_fear(F4SG.setup, F4SG.setup.hyper, now, net, batch, jnp.ones((2, 1)), jax.random.key(7))
    orders = {jax.random.key_data(key).tobytes() for key in jax.random.split(keys.pop("fit"), 50)}
    others = {jax.random.key_data(key).tobytes() for key in keys.values()}
    assert len(others) == 3 and not others & orders


def test_fear_of_a_batch_is_that_of_the_networks_before_they_learned_from_it():
    state, batch = acted("f4sg_letter")
    after, signal, _ = appraise("fear")(F4SG.setup.hyper, state.fear, batch, jax.random.key(7))
    nets = F4SG.setup.nets
    np.testing.assert_allclose(signal, jax.nn.sigmoid(nets.fear(state.fear.params, batch.state)), rtol=1e-5)
    assert jnp.abs(signal - jax.nn.sigmoid(nets.fear(after.params, batch.state))).max() > 1e-3


def test_each_agent_has_a_fear_network_that_learns_from_its_own_costs_alone():
    state, batch = acted("f4sg_letter")
    assert {x.shape[0] for x in jax.tree.leaves(state.fear.params)} == {2}
    start = F4SG.setup.nets.fear(state.fear.params, batch.state)
    assert jnp.abs(start[:, :, 0] - start[:, :, 1]).max() > 1e-3  # with weights of their own
    other = dataclasses.replace(batch, cost=batch.cost.at[:, :, 1].set(1 - batch.cost[:, :, 1]))
    learned, changed = (
        appraise("fear")(F4SG.setup.hyper, state.fear, each, jax.random.key(7))[0].params for each in (batch, other)
    )
    first, second = (policies.select_agent((learned, changed), i) for i in (0, 1))
    chex.assert_trees_all_equal(*first)
    assert any(jnp.abs(x - y).max() > 1e-4 for x, y in zip(*map(jax.tree.leaves, second), strict=True))


@pytest.mark.full
@settings(max_examples=15, deadline=None)
@given(updates=st.integers(1, 2 * letter.UPDATES + 1))
def test_the_replay_buffer_has_the_latest_updates_and_nothing_is_drawn_that_was_never_stored(updates: int):
    net, _ = acted("f4sg_letter")
    stored, size = net.fear, net.fear.state.shape[1]
    remember, draw = jax.jit(letter.remember), jax.jit(letter.draw, static_argnums=1)
    rows = jnp.arange(size, dtype=jnp.float32)
    for update in range(updates):  # each row says which update it is of, and which row of it
        state = jnp.zeros((size, stored.state.shape[-1])).at[:, 0].set(update + 1).at[:, 1].set(rows)
        answer = jnp.zeros((size, 2, 1)) + (state[:, 0] + state[:, 1] / size)[:, None, None]
        stored = remember(stored, state, answer, jax.random.key(update))
    state, answer = draw(stored, 1000, jax.random.key(0))
    latest = set(range(max(0, updates - letter.UPDATES) + 1, updates + 1))
    assert set(np.asarray(state[:, 0]).tolist()) == latest
    np.testing.assert_array_equal(answer[:, 0, 0], state[:, 0] + state[:, 1] / size)
    assert stored.state.shape == net.fear.state.shape  # whatever has been stored


def test_of_a_large_batch_the_replay_buffer_has_a_random_part():
    made = make_setup(load_config("switch", "f4sg_letter", num_envs=128, rollout_length=25))
    net = jax.eval_shape(functools.partial(letter.init_fear, made), jax.random.key(0))
    assert net.state.shape == (letter.UPDATES, letter.MOST_STATES, made.vector.spec.state_dim)
    empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), net)
    rows = jnp.zeros((3200, made.vector.spec.state_dim)).at[:, 0].set(jnp.arange(3200.0))
    stored = letter.remember(empty, rows, jnp.zeros((3200, 2, 1)), jax.random.key(0)).state[0, :, 0]
    assert len(set(stored.tolist())) == letter.MOST_STATES
    assert abs(float(stored.mean()) - 1600) < 5 * 3200 / np.sqrt(12 * letter.MOST_STATES)


# ---------------------------------------------------------------------------------------------------------------------
# Equations 8 and 9: advantages to the end


def test_advantages_are_the_discounted_sum_of_fear_to_the_end_less_the_value():
    config = load_config("switch", "f4sg_letter", "letter")
    assert (config.gae_lambda, config.fear_time) == (1.0, "current")
    fear_of, value = np.random.default_rng(0).uniform(size=(2, 6, 3)).astype(np.float32)
    following = np.append(value[1:], value[:1], axis=0)
    over = np.zeros((6, 3), bool)
    advantage, _ = gae(*map(jnp.asarray, (fear_of, value, following, over, over)), 0.9, config.gae_lambda)
    for t in range(6):
        total = sum(0.9 ** (later - t) * fear_of[later] for later in range(t, 6)) + 0.9 ** (6 - t) * following[-1]
        np.testing.assert_allclose(advantage[t], total - value[t], rtol=1e-5)


# ---------------------------------------------------------------------------------------------------------------------
# Equation 12: critics


def test_values_have_the_worse_of_two_squared_errors_in_the_returns_own_unit():
    loss = losses.value_loss(jnp.asarray(1.0), jnp.asarray(0.0), jnp.asarray(2.0), 0.2, jnp.square)
    np.testing.assert_allclose(loss, 1.8**2, rtol=1e-6)
    state, batch = acted("f4sg_letter")
    setup, hyper = F4SG.setup, F4SG.hyper(critic_lr=0.0)
    old = setup.nets.value(state.critic.net.params, batch.state)
    target = 30.0 + jax.random.normal(jax.random.key(3), old.shape)  # far beyond where Huber's loss is linear
    now = schedules.at(setup.config, hyper, jnp.int32(0))
    samples = (batch.state, old, target)
    after, metrics = critics.fit_critic(
        setup, hyper, now, state.critic, setup.nets.value, 0.2, samples, jax.random.key(0)
    )
    np.testing.assert_allclose(metrics["loss"], ((target - old) ** 2).mean(), rtol=1e-4)
    chex.assert_trees_all_equal(after.returns, state.critic.returns)  # nothing is normalised


# ---------------------------------------------------------------------------------------------------------------------
# Equations 13 to 16: regret


def test_regret_is_drawn_to_the_density_by_its_own_divergence():
    density, logits = jnp.asarray([0.9, 0.2]), jnp.asarray([-0.3, 0.7])
    q = np.asarray(jax.nn.sigmoid(logits))
    expected = q * np.log(q / density) + (1 - q) * np.log((1 - q) / (1 - density))
    np.testing.assert_allclose(losses.bernoulli_kl(jnp.asarray(q), density), expected, rtol=1e-5)
    # Of several densities it is drawn to the mean of their logits. The other direction is drawn to their mean.
    several = jnp.asarray([0.9, 0.2, 0.05])
    lowest = jax.nn.sigmoid(jnp.log(several / (1 - several)).mean())
    slope = jax.grad(lambda x: losses.bernoulli_kl(jax.nn.sigmoid(x), several).mean())
    np.testing.assert_allclose(slope(jnp.log(lowest / (1 - lowest))), 0.0, atol=1e-6)


@pytest.mark.full
def test_the_loss_of_regret_is_its_divergence_from_the_density_over_costly_steps():
    state, batch = acted("r4sg_letter")
    hyper = R4SG.hyper(emotion_lr=0.0)
    net, _, metrics = appraise("regret")(hyper, state.regret, batch, jax.random.key(7))
    seen = jnp.broadcast_to(batch.state[:, :, None], (*batch.log_prob.shape, batch.state.shape[-1]))
    q = jax.nn.sigmoid(jax.vmap(R4SG.setup.nets.regret, (0, 2, 2), 2)(net.params, seen, batch.action))
    p = jnp.exp(-(((batch.action - batch.mean) / batch.std) ** 2) / 2)
    costly = np.broadcast_to(batch.cost > 0, q.shape)
    each = np.asarray(losses.bernoulli_kl(q, p))
    by_agent = [each[:, :, i][costly[:, :, i]].mean() for i in (0, 1)]
    np.testing.assert_allclose(metrics["loss"], np.mean(by_agent), rtol=1e-4)


def logit(p) -> jax.Array:
    return jnp.log(jnp.asarray(p) / (1 - jnp.asarray(p)))


@pytest.mark.parametrize(
    ("omega", "weight"),
    [
        (2 / 3, (0.5 * 0.8) / (0.75 * 0.9)),  # .5 and .2 above, .25 and .1 below: each the most of its own
        (1 / 3, 0.5 / 0.75),
        (jnp.inf, (0.5 * 0.8 * 0.9) / (0.95 * 0.9 * 0.75)),  # Equation 16 has no mask
    ],
)
def test_the_weight_on_the_ratio(omega: float, weight: float):
    new, old, mask = logit([0.5, 0.2, 0.1]), logit([0.05, 0.1, 0.25]), jnp.ones(3)
    costly = letter.log_weight(new, old, jnp.ones(1), mask, omega)
    np.testing.assert_allclose(jnp.exp(costly), weight, rtol=1e-5)
    assert letter.log_weight(new, old, jnp.zeros(1), mask, omega) == 0


def test_the_weight_has_no_bound_and_no_padding():
    for r in (0.99, 0.9999):
        weight = letter.log_weight(logit([r, 0.5]), logit([0.5, 0.5]), jnp.ones(1), jnp.asarray([1.0, 0.0]), jnp.inf)
        np.testing.assert_allclose(jnp.exp(weight), (1 - r) / 0.5, rtol=1e-3)
    assert jnp.isfinite(letter.log_weight(jnp.asarray([200.0]), jnp.zeros(1), jnp.ones(1), jnp.ones(1), jnp.inf))


@pytest.mark.full
def test_the_weight_moves_in_the_epochs():
    state, batch = acted("r4sg_letter")
    net, weights, _ = appraise("regret")(R4SG.setup.hyper, state.regret, batch, jax.random.key(7))
    assert weights.shape == (*batch.log_prob.shape, SMALL["epochs"] + 1)
    assert jnp.abs(weights[..., 0] - weights[..., 1]).max() > 1e-4
    seen = jnp.broadcast_to(batch.state[:, :, None], (*batch.log_prob.shape, batch.state.shape[-1]))
    new, old = (
        jax.vmap(R4SG.setup.nets.regret, (0, 2, 2), 2)(each.params, seen, batch.action) for each in (net, state.regret)
    )
    mask = jnp.asarray(R4SG.setup.vector.spec.action_mask)
    for place, omega in ((-2, R4SG.setup.hyper.omega), (-1, jnp.inf)):  # of the last epoch, and of the multiplier
        expected = letter.log_weight(new, old, batch.cost, mask, omega)
        np.testing.assert_allclose(weights[..., place], expected, rtol=1e-4, atol=1e-5)
    assert not weights[(batch.cost.max(-1) == 0)].any()


def test_regret_stands_still_where_nothing_costs():
    state, batch = acted("r4sg_letter")
    harmless = dataclasses.replace(batch, cost=jnp.zeros_like(batch.cost))
    net, weights, _ = appraise("regret")(R4SG.setup.hyper, state.regret, harmless, jax.random.key(7))
    chex.assert_trees_all_equal(net, state.regret)
    assert not weights.any()


# ---------------------------------------------------------------------------------------------------------------------
# Equations 7, 10, 11, 15 to 17: policies and multipliers


@pytest.mark.full
def test_policies_have_advantages_as_they_are_and_multipliers_sum_over_steps():
    """Two agents by hand: M weighs the reward alone, each epoch has its weight, lambda <- (lambda + alpha (S + I))+."""
    setup, hyper = R4SG.setup, R4SG.hyper(lambda_lr=0.01)
    state, batch = acted("r4sg_letter")
    _, weights, _ = appraise("regret")(hyper, state.regret, batch, jax.random.key(7))
    advantage, cost = 3.0 + 2.0 * jax.random.normal(jax.random.key(2), (2, *batch.reward.shape))
    costs = jnp.stack([cost, 2 * cost], -1)[..., None]
    price, excess = jnp.asarray([[0.5], [2.0]]), jnp.asarray([[0.5], [-0.25]])
    rows = policies.policy_samples(setup, price, batch, advantage, costs, weights)
    np.testing.assert_array_equal(rows.cost_advantage[1, :, 0], 2 * cost.ravel())  # not even centred
    tagged = {tag: jax.random.fold_in(jax.random.key(1), tag) for tag in Tag}
    now = schedules.at(setup.config, hyper, state.update)
    team = policies.Team(state.actor, state.constraint, rows, excess)
    actor, constraint, _ = jax.jit(functools.partial(policies.update_policies, setup))(hyper, now, team, tagged)

    factor, horizon_sum = jnp.ones(advantage.size), setup.config.rollout_length
    for i in np.asarray(jax.random.permutation(tagged[Tag.ORDER], 2)):
        paid = price[i, 0] * rows.cost_advantage[i, :, 0]
        mine = dataclasses.replace(policies.select_agent(rows, i), paid=None, moving_log_weight=None)
        mine = dataclasses.replace(mine, advantage=factor * advantage.ravel() - paid, factor=jnp.ones_like(factor))
        net = policies.select_agent(state.actor, i)
        loss = policies.policy_loss(setup, hyper, now, mine, excess[i])
        keys = jax.random.split(jax.random.fold_in(tagged[Tag.ACTOR], i), SMALL["epochs"])
        for epoch, key in enumerate(keys):
            weight = weights[:, :, i, epoch].ravel()
            options = {"learning_rate": now.actor_lr, "max_grad_norm": jnp.inf, "epochs": 1, "minibatches": 1}
            net, _ = fit(net, loss, dataclasses.replace(mine, log_weight=weight), key, **options)
        chex.assert_trees_all_close(net.params, policies.select_agent(actor.params, i), rtol=1e-3, atol=1e-5)
        log_ratio, _ = policies.policy_change(setup, policies.select_agent(actor.params, i), mine)
        biased = jnp.exp(log_ratio + weights[:, :, i, -1].ravel()) * rows.cost_advantage[i, :, 0]
        step = excess[i, 0] + horizon_sum * biased.mean()
        expected = jnp.maximum(0.0, state.constraint.multiplier[i, 0] + 0.01 * step)
        np.testing.assert_allclose(constraint.multiplier[i, 0], expected, rtol=1e-4)
        factor = factor * jnp.exp(log_ratio)
    assert jnp.abs(factor - 1).max() > 1e-3


@pytest.mark.full
def test_the_excess_is_of_the_cost_critics_values():
    made, hyper = F4SG, F4SG.setup.hyper
    start = made.init(hyper, jax.random.key(0))
    after, metrics = made.step(hyper, start)
    tagged = {tag: jax.random.fold_in(jax.random.fold_in(start.key, 0), tag) for tag in Tag}
    _, batch = jax.jit(functools.partial(learner.act, made.setup))(hyper, start, tagged)
    value = made.setup.nets.cost_value(start.cost_critic.net.params, batch.state).mean((0, 1))
    rate = (1 - hyper.gamma) * value - hyper.cost_limit / made.setup.vector.horizon
    np.testing.assert_allclose(metrics["cost_excess"], rate.max(), rtol=1e-3, atol=1e-6)
    assert after.constraint.multiplier.shape == (2, 1)


# ---------------------------------------------------------------------------------------------------------------------
# The rows


def test_other_methods_have_nothing_of_it(monkeypatch: pytest.MonkeyPatch):
    for name in [name for name in dir(letter) if callable(getattr(letter, name))]:
        monkeypatch.setattr(letter, name, None)
    setup = make_setup(load_config("switch", "mixed", **SMALL))
    state = jax.eval_shape(functools.partial(learner.init, setup), setup.hyper, jax.random.key(0))
    jax.eval_shape(functools.partial(learner.train_step, setup), setup.hyper, state)
    assert [name for name, method in METHODS.items() if method.letter] == list(ROWS)


@pytest.mark.parametrize(
    "changes", [{"order": "simultaneous"}, {"constraint": "trust_region"}, {"surrogate": "first_order"}]
)
def test_what_the_paper_has_not_is_refused_in_a_row(changes: dict):
    with pytest.raises(UsageError, match="a method's letter needs"):
        Method(**{"order": "sequential", "constraint": "lagrangian", "letter": True, **changes})


def test_a_run_with_settings_that_are_not_the_papers_says_so():
    whole, part, plain = (
        outlook.notes(make_setup(load_config("lane", method, preset)))
        for method, preset in (("f4sg_letter", "letter"), ("f4sg_letter", "default"), ("f4sg", "default"))
    )
    assert whole == plain == [] and "gae_lambda = 0.95 (the paper: 1.0)" in part[0] and "--preset letter" in part[0]


@pytest.mark.full
def test_both_together_are_a_row_of_your_own(monkeypatch: pytest.MonkeyPatch):
    both = dataclasses.replace(METHODS["f4sg_letter"], ratio_weight="regret")
    monkeypatch.setitem(METHODS, "mixed_letter", both)
    setup = make_setup(load_config("switch", "mixed_letter", "letter", **SMALL))
    state = jax.eval_shape(functools.partial(learner.init, setup), setup.hyper, jax.random.key(0))
    after, metrics = jax.eval_shape(functools.partial(learner.train_step, setup), setup.hyper, state)
    assert jax.tree.structure(after) == jax.tree.structure(state) and {"fear/loss", "regret/loss"} <= set(metrics)


@pytest.mark.parametrize("method", LATE)
def test_a_seed_beside_others_is_the_seed_alone(method: str):
    train = jax.jit(jax.vmap(make_train(load_config("switch", method, "letter", **SMALL))))

    def third(seeds: list[int]) -> dict[str, np.ndarray]:
        found = train(jax.vmap(jax.random.key)(jnp.asarray(seeds)))
        return checkpoint.pack(jax.tree.map(lambda x: x[-1], found))

    among = third([0, 1, 2])
    chex.assert_trees_all_equal(among, third([7, 8, 2]))
    # A program of one seed multiplies other matrices than one of three, so the last bits differ.
    chex.assert_trees_all_close(among, third([2]), rtol=1e-3, atol=1e-4)


@pytest.mark.full
def test_a_state_that_was_saved_goes_on_as_if_it_had_not_been():
    step, hyper = F4SG.step, F4SG.setup.hyper
    state = F4SG.init(hyper, jax.random.key(3))
    for _ in range(2):
        state, _ = step(hyper, state)
    assert state.fear.count == 2 and state.fear.answer[:2].all() and not state.fear.answer[2:].any()
    again = checkpoint.unpack(checkpoint.pack(state), state)
    chex.assert_trees_all_equal(*(checkpoint.pack(step(hyper, each)) for each in (state, again)))
    empty = dataclasses.replace(state, fear=dataclasses.replace(state.fear, answer=jnp.zeros_like(state.fear.answer)))
    assert step(hyper, empty)[1]["fear/loss"] != step(hyper, state)[1]["fear/loss"]  # it learns from what was saved


@pytest.mark.parametrize("method", LATE)
def test_a_run_that_continues_is_the_run_in_one_go(method: str, tmp_path, cli):
    words = ["train", "lane", *TINY, "--method", method, "--preset", "letter", "--no-cache", "--seeds", 2]
    assert cli(*words, "--steps", 800, "--out", tmp_path / "whole")[0] == 0
    assert cli(*words, "--steps", 400, "--out", tmp_path / "parts")[0] == 0
    assert cli(*words, "--steps", 800, "--out", tmp_path / "parts", "--resume")[0] == 0
    assert_same_run(tmp_path / "parts", tmp_path / "whole")


def on_lane(method: str) -> tuple[LearnerState, dict[str, np.ndarray]]:
    config = load_config("lane", method, "letter", num_envs=48, rollout_length=25, steps=48 * 25 * 60, hidden=(32, 32))
    state, metrics = jax.jit(make_train(config))(jax.random.key(0))
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves((state.actor.params, state.fear, state.regret)))
    return state, jax.tree.map(np.asarray, metrics)


@pytest.mark.full
def test_regret_learns_lane_within_its_limit():
    _, metrics = on_lane("r4sg_letter")
    assert metrics["episode_reward"][-10:].mean() > metrics["episode_reward"][0] + 8
    assert metrics["episode_cost"][-10:].mean() <= 1


@pytest.mark.full
def test_fear_of_lane_falls_where_nothing_costs_and_policies_learn():
    state, metrics = on_lane("f4sg_letter")
    assert metrics["fear/on_safe"][0] > 0.4 and metrics["fear/on_safe"][-5:].mean() < 0.1
    assert np.ptp(metrics["episode_reward"]) > 5 and state.fear.count == 60
