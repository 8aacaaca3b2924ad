"""Every pytree of the learner, once, with shapes.

T time steps, B environments, N agents, O observation, A action, S state, K costs. Axes always come in this order.
"""

from __future__ import annotations

import enum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..config.settings import HYPER_FIELDS, Hyper
from ..tasks import VectorState
from .maths.pytree import pytree
from .maths.running_moments import RunningMoments

Params = Any  # a pytree of network weights; for actors every leaf has a leading [N] ([1] if one actor is shared)

jax.tree_util.register_dataclass(Hyper, data_fields=HYPER_FIELDS, meta_fields=())


class Tag(enum.IntEnum):
    """The consumers of randomness: each folds its tag into the update's key, so adding one moves no other."""

    UPDATE = 0
    ENV = 1
    ACTION = 2
    ORDER = 3
    ACTOR = 4
    CRITIC = 5
    COST_CRITIC = 6
    FEAR = 7
    REGRET = 8
    OBSERVED_COST = 9


@pytree
class TrainState:
    """A network in training: its weights and Adam's state."""

    params: Params
    opt_state: Any


@pytree
class ReplayState(TrainState):
    """A network in training with the replay buffer D from which it learns again: U updates of M states (see letter.py).

    state: [U, M, S] as the network saw them; answer: [U, M, N, K], what it said of them then; count: [] int32, updates
    stored so far, the latest in place of the oldest.
    """

    state: jax.Array
    answer: jax.Array
    count: jax.Array


@pytree
class Critic:
    """A value function in training, with the moments of its returns (heads in their own, normalised units)."""

    net: TrainState
    returns: RunningMoments


@pytree
class Memory:
    """Hidden states of recurrent networks before the next step of B environments, 0 where an episode begins.

    actor: [B, N, H]; critic, cost_critic: [B, H], or [B, N, H] of critics of observations.
    """

    actor: jax.Array
    critic: jax.Array
    cost_critic: jax.Array


@pytree
class Sequences:
    """What a recurrent network sees, in place of an array of single steps: whole sequences of environments.

    x: [B, T, ..., I]; hidden: [B, ..., H] before the first step; done: [B, T] bool, an episode ends with this step.
    """

    x: jax.Array
    hidden: jax.Array
    done: jax.Array


@pytree
class Remembered:
    """What a recurrent network reads its outputs from: hidden states [..., H] after the steps that are asked for."""

    states: jax.Array


Seen = jax.Array | Sequences | Remembered  # what a network computes from; the latter two of recurrent ones


@pytree
class RolloutState:
    """What the collection of experience carries from one update to the next.

    vector: B environments; reward_sum [B], cost_sum and true_cost_sum [B, N, K], length [B]: sums over the running
    episodes; memory: None without recurrent networks.
    """

    vector: VectorState
    reward_sum: jax.Array
    cost_sum: jax.Array
    true_cost_sum: jax.Array
    length: jax.Array
    memory: Memory | None = None


@pytree
class Batch:
    """One update's experience; observations and states are normalised with the moments of its beginning.

    Attributes:
      obs: [T, B, N, O]; action: [T, B, N, A] as sampled, not clipped; log_prob: [T, B, N] and mean: [T, B, N, A]
        under the policy that acted; std: [T, B, N, A] likewise.
      state, next_state: [T, B, S]; the next state is the one before any reset.
      reward: [T, B]; cost: [T, B, N, K] as observed (see `envs.vector.observed_cost`); true_cost: the same as it was.
      terminated, truncated: [T, B] bool, never both.
      info: {name: [T, B]}.
      non_finite: [T, B] bool, quarantined steps; cost_out_of_range: [T, B] bool, steps with a cost outside [0, 1].
      episode_reward: [T, B], episode_cost and true_episode_cost: [T, B, N, K], episode_length: [T, B]: sums up to
        and with this step; complete if the episode is done.
      whole: [T, B] bool, the time limit counts from the episode's own beginning; False in first ones with spread starts
        (see `rollout.start`), which it cuts short.
      next_obs: [T, B, N, O], those before any reset; None where critics see the state.
    """

    obs: jax.Array
    action: jax.Array
    log_prob: jax.Array
    mean: jax.Array
    std: jax.Array
    state: jax.Array
    next_state: jax.Array
    reward: jax.Array
    cost: jax.Array
    true_cost: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    info: dict[str, jax.Array]
    non_finite: jax.Array
    cost_out_of_range: jax.Array
    episode_reward: jax.Array
    episode_cost: jax.Array
    true_episode_cost: jax.Array
    episode_length: jax.Array
    whole: jax.Array
    next_obs: jax.Array | None = None

    @property
    def done(self) -> jax.Array:
        """[T, B] bool: the episode ended with this step, for whichever reason."""
        return self.terminated | self.truncated

    @property
    def finished(self) -> jax.Array:
        """[T, B] bool: a whole episode ended with this step."""
        return self.done & self.whole


@pytree
class Constraint:
    """What the costs of each agent are held by, all [N, K] (see constraint.py).

    Attributes:
      estimate: undiscounted cost of an episode, in units of the limit.
      multiplier: lambda, of PID its integral; 0 without a multiplier.
      lowered: by how much a trust region keeps below the limit, in its unit; else 0.
    """

    estimate: jax.Array
    multiplier: jax.Array
    lowered: jax.Array


@pytree
class PolicySamples:
    """The samples of a policy update; R = T * B samples, with a leading [N] before an agent is chosen.

    Those of a recurrent policy are sequences: obs is `Sequences`, and [B, T] takes the place of [R].

    Attributes:
      obs: [R, O]; action: [R, A]; mask: [R, A]; log_prob: [R], mean: [R, A], std: [R, A] under the policy that acted.
      advantage: [R], hybrid: reward less weighted cost.
      cost_advantage: [R, K], centred, in units of the limit.
      log_weight: [R], bias on the probability ratio.
      factor: [R], M: the probability ratios of the agents updated before.
      paid: [R], what the costs take off the advantage where no factor weighs it; None if `advantage` is less that.
      moving_log_weight: [R, epochs], the bias in each epoch; None if it is `log_weight` in all of them.
    """

    obs: jax.Array | Sequences
    action: jax.Array
    mask: jax.Array
    log_prob: jax.Array
    mean: jax.Array
    std: jax.Array
    advantage: jax.Array
    cost_advantage: jax.Array
    log_weight: jax.Array
    factor: jax.Array
    paid: jax.Array | None = None
    moving_log_weight: jax.Array | None = None


@pytree
class ActingState:
    """What of a learner state acts: all that evaluations, pictures and exports need.

    Attributes:
      actor: weights with a leading agent axis.
      obs_moments: [O], of raw observations.
      update: [] int32, updates done.
    """

    actor: TrainState
    obs_moments: RunningMoments
    update: jax.Array


@pytree
class LearnerState(ActingState):
    """All that training carries; saving it and loading it continues the run bit for bit.

    Attributes:
      actor, obs_moments, update: of ActingState.
      critic: V(s) -> []; cost_critic: Vc(s) -> [N, K]; of each agent's own observation V(o_i) -> [], Vc(o_i) -> [K].
      fear: f(s') -> logits [N, K]; regret: r(s, a_i) -> logits [A], weights with a leading [N]; None in methods
        without them. With the letter fear has a network for each agent, and is a ReplayState.
      constraint: estimate of the cost, multiplier and lowered limit, [N, K].
      largest_cost: [N, K], the largest cost of a step so far that was noticed; fear is a share of it.
      state_moments: [S], of raw states.
      rollout: environments and running sums.
      key: the run's key; update u draws from fold_in(key, u).
    """

    critic: Critic
    cost_critic: Critic
    fear: TrainState | None
    regret: TrainState | None
    constraint: Constraint
    largest_cost: jax.Array
    state_moments: RunningMoments
    rollout: RolloutState
    key: jax.Array


@pytree
class Best:
    """Each seed's best learner state so far and the metrics it was chosen by, with a leading [seeds].

    Attributes:
      state: the learner state.
      reward, cost: [seeds] f32, mean episode reward and cost; -inf and inf if nothing is known yet.
    """

    state: LearnerState
    reward: np.ndarray
    cost: np.ndarray

    @classmethod
    def initial(cls, state: LearnerState) -> Best:
        """Before anything is known of a run of any number of seeds."""
        nothing = np.full(state.update.shape, np.inf, np.float32)
        return cls(_copy(state), -nothing, nothing)


@jax.jit
def _copy(state: LearnerState) -> LearnerState:
    return jax.tree.map(jnp.copy, state)  # in one program: a copy of each array would compile one for each shape


Metrics = dict[str, jax.Array]
