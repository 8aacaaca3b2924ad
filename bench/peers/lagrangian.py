"""MAPPO-Lagrangian in PyTorch, as one would write it for a gymnasium vector environment.

The method is ours (docs/methods/mappo_l.md): agents are updated one after the other, each with the factor of those
before it; the multiplier follows the average cost. Its critics see all agents' observations, which is what the vector
environment gives of the step that ends an episode.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Normal

from envs import adapters
from envs.base import Env, EnvSpec
from pmt_jax import Config
from pmt_jax.learning.constraint import LAMBDA_MIN
from pmt_jax.learning.maths.running_moments import RETURNS_DECAY
from pmt_jax.learning.policies import COST_STD_FLOOR

from .report import Report

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


class Batch(NamedTuple):
    """A rollout [T, B, ...]: N agents, O entries of an observation, A of an action.

    Attributes:
      obs, next_obs: [N, O], the next before any reset; action: [N, A]; log_prob: [N].
      signal: [1 + N], the team's reward and each agent's cost in units of the limit.
      terminated, done: [1] bool.
    """

    obs: Tensor
    next_obs: Tensor
    action: Tensor
    log_prob: Tensor
    signal: Tensor
    terminated: Tensor
    done: Tensor


def mlp(inputs: int, hidden: tuple[int, ...], outputs: int, gain: float) -> nn.Sequential:
    """Hidden layers with ReLU and layer norm; orthogonal weights, those of the last layer times `gain`."""
    layers: list[nn.Module] = []
    for size in (*hidden, outputs):
        linear = nn.Linear(inputs, size)
        nn.init.orthogonal_(linear.weight, math.sqrt(2))
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.ReLU(), nn.LayerNorm(size)]
        inputs = size
    nn.init.orthogonal_(layers[-3].weight, gain)  # pyright: ignore[reportArgumentType]
    return nn.Sequential(*layers[:-2]).to(DEVICE)


class Moments:
    """Running mean and variance over all but the last axis; `decay` of 1 weighs all that was seen alike."""

    def __init__(self, size: int, decay: float = 1.0) -> None:
        self._sums, self._decay = torch.zeros(3, size, device=DEVICE), decay

    def update(self, x: Tensor) -> None:
        """Counts the batch in, as one of weight 1."""
        rows = x.reshape(-1, x.shape[-1])
        self._sums = self._decay * self._sums + torch.stack([torch.ones_like(rows[0]), rows.mean(0), (rows**2).mean(0)])

    def scaled(self, x: Tensor) -> Tensor:
        """In standard deviations from the mean."""
        return (x - self.mean) / self.std

    @property
    def mean(self) -> Tensor:
        return self._sums[1] / self._sums[0].clamp(min=1e-5)

    @property
    def std(self) -> Tensor:
        return (self._sums[2] / self._sums[0].clamp(min=1e-5) - self.mean**2).clamp(min=1e-2).sqrt()


def gae(signal: Tensor, value: Tensor, next_value: Tensor, batch: Batch, config: Config) -> Tensor:
    """Generalised advantage estimation of signals [T, B, H]; a time limit ends the trace, yet bootstraps."""
    delta = signal + config.gamma * ~batch.terminated * next_value - value
    advantage, last = torch.zeros_like(delta), torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        advantage[t] = last = delta[t] + config.gamma * config.gae_lambda * ~batch.done[t] * last
    return advantage


class Learner:
    """An actor per agent; one critic of the reward, one of all agents' costs; a multiplier per agent."""

    def __init__(self, config: Config, spec: EnvSpec) -> None:
        inputs, agents = spec.obs_dim, spec.num_agents
        self.config, self.horizon = config, spec.horizon
        self.unit = spec.horizon / (float(np.sum(spec.cost_limit)) * (1 - config.cost_margin))
        self.actors = [mlp(inputs, config.hidden, spec.action_dim, 0.01) for _ in range(agents)]
        self.logits = [nn.Parameter(torch.ones(spec.action_dim, device=DEVICE)) for _ in range(agents)]
        self.critics = [mlp(agents * inputs, config.hidden, heads, 1.0) for heads in (1, agents)]
        self.seen, self.returns = Moments(inputs), Moments(1 + agents, RETURNS_DECAY)
        self.multiplier = torch.full((agents,), config.lambda_init, device=DEVICE)
        self.estimate = torch.ones(agents, device=DEVICE)  # an episode's cost in units of the limit
        self.adam = [
            torch.optim.Adam([*actor.parameters(), logit], eps=1e-5)
            for actor, logit in zip(self.actors, self.logits, strict=True)
        ]
        self.critic_adam = [torch.optim.Adam(critic.parameters(), eps=1e-5) for critic in self.critics]

    def policy(self, agent: int, obs: Tensor) -> Normal:
        """Of scaled observations [..., O]."""
        return Normal(self.actors[agent](obs), 0.5 * torch.sigmoid(self.logits[agent]))

    @torch.no_grad()
    def act(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Actions [B, N, A], not clipped, and their log-probabilities [B, N]."""
        policies = [self.policy(i, x) for i, x in enumerate(self.seen.scaled(obs).unbind(1))]
        actions = [policy.sample() for policy in policies]
        log_probs = [policy.log_prob(action).sum(-1) for policy, action in zip(policies, actions, strict=True)]
        return torch.stack(actions, 1), torch.stack(log_probs, 1)

    def values(self, obs: Tensor) -> Tensor:
        """[..., 1 + N] in normalised units, of scaled observations [..., N, O]."""
        return torch.cat([critic(obs.flatten(-2)) for critic in self.critics], -1)

    def update(self, batch: Batch, steps: int) -> None:
        """Fits actors, multipliers and critics to a rollout that ends after `steps` environment steps."""
        config, obs = self.config, self.seen.scaled(batch.obs)
        decay = config.lr_end ** (steps / config.steps)
        excess = self._excess(batch)
        with torch.no_grad():
            mean, std, next_obs = self.returns.mean, self.returns.std, self.seen.scaled(batch.next_obs)
            value, after = (mean + std * self.values(x) for x in (obs, next_obs))
            advantage = gae(batch.signal, value, after, batch, config)
        target = advantage + value
        advantage = (advantage - advantage.mean((0, 1))).flatten(0, 1)
        reward, cost = advantage[:, :1], advantage[:, 1:]
        cost = cost / cost.std(0).clamp(min=COST_STD_FLOOR)
        price = (self.multiplier + config.lambda_kp * excess).clamp(0, config.lambda_max)
        hybrid = reward / (reward.std() + 1e-5) - price * cost
        rows = Batch(*(x.flatten(0, 1) for x in batch))
        factor = torch.ones_like(hybrid[:, 0])
        for agent in torch.randperm(len(self.actors)).tolist():
            factor = (
                self._fit_actor(agent, obs.flatten(0, 1)[:, agent], rows, hybrid[:, agent] * factor, decay) * factor
            )
        self.returns.update(target)
        self._fit_critics(obs.flatten(0, 1), self.returns.scaled(value), self.returns.scaled(target), decay)
        lowest, gain = LAMBDA_MIN * config.lambda_init, config.lambda_lr / config.num_updates
        self.multiplier = (self.multiplier * (1 + gain * excess)).clamp(lowest, config.lambda_max)
        self.seen.update(batch.obs)

    def _excess(self, batch: Batch) -> Tensor:
        """[N], how far the moving average of costs, in units of the limit, is beyond it; within [-1, 1]."""
        share = min(1.0, len(batch.signal) / self.horizon)
        self.estimate = self.estimate + share * (batch.signal[..., 1:].mean((0, 1)) - self.estimate)
        return (self.estimate - 1).clamp(-1, 1)

    def _fit_actor(self, agent: int, obs: Tensor, rows: Batch, advantage: Tensor, decay: float) -> Tensor:
        """PPO on one agent's rows; the ratio of its new policy to its old one [T * B]."""
        action, before, clip = rows.action[:, agent], rows.log_prob[:, agent], self.config.clip

        def ratio(part: Tensor | slice) -> Tensor:
            return (self.policy(agent, obs[part]).log_prob(action[part]).sum(-1) - before[part]).exp()

        for part in self._minibatches(len(obs)):
            rho = ratio(part)
            loss = -torch.minimum(rho * advantage[part], rho.clamp(1 - clip, 1 + clip) * advantage[part]).mean()
            self._step(self.adam[agent], loss, decay * self.config.actor_lr)
        with torch.no_grad():
            return ratio(slice(None))

    def _fit_critics(self, obs: Tensor, old: Tensor, target: Tensor, decay: float) -> None:
        """Clipped Huber loss in normalised units; `old` and `target` are [T, B, 1 + N]."""
        obs, old, target = obs.flatten(1), old.flatten(0, 1), target.flatten(0, 1)
        heads = ((slice(0, 1), self.config.clip), (slice(1, None), math.inf))
        for part in self._minibatches(len(obs)):
            for critic, adam, (head, clip) in zip(self.critics, self.critic_adam, heads, strict=True):
                value, before, goal = critic(obs[part]), old[part][:, head], target[part][:, head]
                clipped = before + (value - before).clamp(-clip, clip)
                errors = [nn.functional.huber_loss(x, goal, reduction="none", delta=10.0) for x in (value, clipped)]
                self._step(adam, torch.maximum(*errors).mean(), decay * self.config.critic_lr)

    def _minibatches(self, rows: int) -> Iterator[Tensor]:
        for _ in range(self.config.epochs):
            yield from torch.randperm(rows, device=DEVICE).chunk(self.config.minibatches)

    def _step(self, adam: torch.optim.Adam, loss: Tensor, lr: float) -> None:
        adam.param_groups[0]["lr"] = lr
        adam.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(adam.param_groups[0]["params"], self.config.max_grad_norm)
        adam.step()


def train(config: Config, env: Env, report: Report) -> None:
    """Trains until `report` ends the process."""
    torch.manual_seed(config.seed)
    torch.set_num_threads(1)  # networks are small, and threads that wait take the physics' cores
    report.about(physics=env.engine, learner=f"torch {torch.__version__} on {DEVICE.type}")
    vector, learner = adapters.to_gymnasium(env, config.num_envs, config.seed), Learner(config, env.spec)
    obs, _ = vector.reset()
    learner.seen.update(_tensor(obs))
    sums, ended = np.zeros((config.num_envs, 2)), []
    for update in itertools.count(1):
        steps = []
        for _ in range(config.rollout_length):
            before = _tensor(obs)
            action, log_prob = learner.act(before)
            obs, reward, terminated, truncated, info = vector.step(action.cpu().numpy())
            cost, done = info["cost"].sum(-1), terminated | truncated
            sums += np.stack([reward, cost.mean(1)], 1)
            ended, sums[done] = [*ended, *sums[done]][-100:], 0
            signal = np.concatenate([reward[:, None], cost * learner.unit], 1, dtype=np.float32)
            happened = (_tensor(x) for x in (signal, terminated[:, None], done[:, None]))
            steps.append(Batch(before, _tensor(info.get("final_obs", obs)), action, log_prob, *happened))
        learner.update(Batch(*map(torch.stack, zip(*steps, strict=True))), update * config.batch_size)
        report(update * config.batch_size, *(np.mean(ended, 0) if ended else (None, None)))


def _tensor(x: np.ndarray) -> Tensor:
    return torch.tensor(x, device=DEVICE)
