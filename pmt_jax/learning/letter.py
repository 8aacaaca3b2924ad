"""The letter: fear and regret as the paper prints them, where the working form of fear.py and regret.py differs.

docs/methods/f4sg.md and r4sg.md say what differs and why. A method has it by its row's `letter`, and is then the only
one whose program has anything of this file.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from . import fear, regret
from .maths.losses import appraisal_loss, bernoulli_kl, smoothed
from .optimise import fit, init_train_state, shuffled
from .rollout import flatten_steps
from .schedules import Schedule
from .setup import Setup
from .types import Batch, Hyper, Metrics, Params, ReplayState, TrainState

UPDATES = 16  # that the replay buffer remembers
MOST_STATES = 1024  # of one update in it
TEMPERATURE = 0.5  # of the relaxed samples


# ---------------------------------------------------------------------------------------------------------------------
# Fear


def init_fear(setup: Setup, key: jax.Array) -> ReplayState:
    """A fear network for each agent, weights with a leading [N], and an empty replay buffer."""
    net = jax.vmap(init_train_state)(setup.nets.init_fear(key, 0.0))
    spec, states = setup.vector.spec, (UPDATES, min(setup.config.batch_size, MOST_STATES))
    return ReplayState(
        net.params,
        net.opt_state,
        state=jnp.zeros((*states, spec.state_dim)),
        answer=jnp.zeros((*states, spec.num_agents, spec.num_costs)),
        count=jnp.zeros((), jnp.int32),
    )


def appraise_fear(
    setup: Setup,
    hyper: Hyper,
    now: Schedule,
    net: TrainState | None,
    batch: Batch,
    largest: jax.Array,
    key: jax.Array,
) -> tuple[TrainState | None, jax.Array, Metrics]:
    """As `fear.appraise_fear`, but the fear of a batch is that of networks which have not learned from it yet.

    Equations 3 and 4 as printed: each agent's own network is fitted to the batch's costs, and keeps to what it said of
    the states of its replay buffer. Fear is fitted after its use, as a value function is.
    """
    if not isinstance(net, ReplayState):
        return fear.appraise_fear(setup, hyper, now, net, batch, largest, key)
    seen = batch.next_state if setup.config.fear_time == "next" else batch.state
    signal = jax.nn.sigmoid(setup.nets.fear(net.params, seen))
    state, cost, answer = jax.tree.map(flatten_steps, (seen, batch.cost, signal))
    fit_key, memory_key, draw_key, noise_key = jax.random.split(key, 4)  # `fit` splits its own once more
    net = remember(net, state, answer, memory_key)
    replayed = draw(net, len(state), draw_key)
    noise = jax.random.logistic(noise_key, cost.shape)

    def loss(params: Params, samples: tuple[jax.Array, ...]) -> tuple[jax.Array, Metrics]:
        *states, cost, noise, answer = samples
        logits, replayed = setup.nets.fear_of_one(params, jnp.stack(states))
        distance = divergence(logits, cost, noise)
        return appraisal_loss(distance, replayed, answer, jnp.ones_like(cost), hyper.emotion_l2), {}

    passes = {"epochs": setup.config.emotion_epochs, "minibatches": setup.config.minibatches}
    limits = {"learning_rate": now.emotion_lr, "max_grad_norm": hyper.max_grad_norm}
    samples = (state, replayed[0], cost, noise, replayed[1])
    learned, metrics = jax.vmap(
        lambda net, samples: fit(net, loss, samples, fit_key, **limits, **passes), in_axes=(0, (None, None, 1, 1, 1))
    )(TrainState(net.params, net.opt_state), samples)
    net = dataclasses.replace(net, params=learned.params, opt_state=learned.opt_state)
    return net, signal, {**{k: x.mean(0) for k, x in metrics.items()}, **fear.calibration(signal, batch.cost)}


def divergence(logits: jax.Array, target: jax.Array, noise: jax.Array) -> jax.Array:
    """KL(sample || target) of a relaxed Bernoulli sample, elementwise (Eq. 3, without its term that no weight moves).

    It is nearly linear in the probability, so its minimiser is the more likely of 0 and 1, and a cost rarer than one
    half is not feared at all.

    Args:
      logits: [...]; target: [...] in [0, 1], smoothed by 0.01; noise: [...] logistic.
    """
    return bernoulli_kl(relaxed_bernoulli(logits, noise, TEMPERATURE), smoothed(target))


def relaxed_bernoulli(logits: jax.Array, noise: jax.Array, temperature: jax.Array | float) -> jax.Array:
    """The two-class Gumbel-softmax sigmoid((l + noise) / tau) in (0, 1), through which gradients flow.

    `noise` [...] is a draw of the standard logistic distribution, which is the difference of two Gumbels.
    """
    return jax.nn.sigmoid((logits + noise) / temperature)


def remember(net: ReplayState, state: jax.Array, answer: jax.Array, key: jax.Array) -> ReplayState:
    """Stores an update's states [R, S] and what the networks say of them [R, N, K]: M at random, for the oldest M."""
    rows = shuffled(key, len(state))[: net.state.shape[1]]
    place = net.count % UPDATES
    return dataclasses.replace(
        net,
        state=net.state.at[place].set(state[rows]),
        answer=net.answer.at[place].set(answer[rows]),
        count=net.count + 1,
    )


def draw(net: ReplayState, count: int, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """`count` stored states s_D [count, S] and what was said of them, f_D [count, N, K]; any may come again."""
    stored = jnp.minimum(net.count, UPDATES) * net.state.shape[1]
    rows = jax.random.randint(key, (count,), 0, stored)
    return net.state.reshape(-1, net.state.shape[-1])[rows], net.answer.reshape(-1, *net.answer.shape[2:])[rows]


# ---------------------------------------------------------------------------------------------------------------------
# Regret


def appraise_regret(
    setup: Setup, hyper: Hyper, now: Schedule, net: TrainState | None, batch: Batch, key: jax.Array
) -> tuple[TrainState | None, jax.Array, Metrics]:
    """As `regret.appraise_regret`, but regret is fitted in the epochs of the policies, and the weight moves with it.

    Equation 14 as printed: the divergence of regret from the density of a costly action. No network has an input that
    depends on the policies' new weights, so all epochs' weights are known before the policies change.

    Returns:
      the networks of all agents; log w [T, B, N, epochs + 1], of each epoch and then that of the multiplier's step, see
      `log_weight`; metrics.
    """
    if net is None:
        return regret.appraise_regret(setup, hyper, now, net, batch, key)
    mask, before, costly, samples = regret.samples_of_agents(setup, net, batch, lambda density: density)

    def loss(params: Params, samples: tuple[jax.Array, ...]) -> tuple[jax.Array, Metrics]:
        state, action, target, old, weight = samples
        logits = setup.nets.regret(params, state, action)
        distance = bernoulli_kl(jax.nn.sigmoid(logits), target)
        return appraisal_loss(distance, logits, old, weight, hyper.emotion_l2), {}

    limits = {"learning_rate": now.emotion_lr, "max_grad_norm": hyper.max_grad_norm}
    passes = {"epochs": 1, "minibatches": setup.config.minibatches}

    def one_agent(net: TrainState, samples: Any, key: jax.Array) -> tuple[TrainState, tuple[jax.Array, Metrics]]:
        def epoch(net: TrainState, key: jax.Array) -> tuple[TrainState, tuple[jax.Array, Metrics]]:
            net, metrics = fit(net, loss, samples, key, **limits, **passes)
            return net, (setup.nets.regret(net.params, *samples[:2]), metrics)

        return jax.lax.scan(epoch, net, jax.random.split(key, setup.config.epochs))

    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(setup.nets.num_agents))
    learned, (after, metrics) = jax.vmap(one_agent)(net, samples, keys)
    learned = regret.where_costly(costly, learned, net)
    after = jnp.moveaxis(after, (1, 2, 0), (0, 1, 2)).reshape(-1, *before.shape)  # [epochs, T, B, N, A]
    moving = log_weight(after, before, batch.cost, mask, hyper.omega)
    whole = log_weight(after[-1], before, batch.cost, mask, jnp.inf)
    shown = regret.diagnostics(after[-1], regret.regret(after[-1], batch.cost), mask, costly, jnp.exp(moving[-1]))
    weights = jnp.moveaxis(jnp.concatenate([moving, whole[None]]), 0, -1)
    return learned, weights, {**{k: x[:, -1].mean(0) for k, x in metrics.items()}, **shown}


def log_weight(new: jax.Array, old: jax.Array, cost: jax.Array, mask: jax.Array, omega: jax.Array | float) -> jax.Array:
    """The logarithm of the weight that regret puts on the probability ratio, without a bound.

    Equation 15 as printed, log prod (1 - r) / (1 - r_old): numerator and denominator each have the entries Omega with
    the most regret of their own.
    With `omega` = inf it has all entries, which is Equation 16 as printed.

    Args:
      new, old: [..., A] logits of regret now and when the action was taken; cost: [..., K]; mask: [..., A].

    Returns:
      [...]; exactly 0 where the step had no cost.
    """

    def log_product(logits: jax.Array) -> jax.Array:
        chosen = regret.most_regretted(jax.nn.sigmoid(logits) * mask, mask, omega) * mask
        return -jnp.sum(chosen * jax.nn.softplus(logits), axis=-1)  # log(1 - r), finite for every logit

    return (log_product(new) - log_product(old)) * (cost.max(-1) > 0)
