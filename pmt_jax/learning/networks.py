"""The networks; the only file that uses flax."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from ..config.methods import Method
from ..config.settings import Config
from ..tasks import EnvSpec
from . import fused
from .maths import distributions, gru
from .types import Memory, Params, Remembered, Seen, Sequences

_ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {"relu": nn.relu, "tanh": nn.tanh, "elu": nn.elu}
NORM_EPS = 1e-6
_GAINS = {"relu": math.sqrt(2), "tanh": 5 / 3, "elu": 1.0}


class LayerNorm(nn.Module):
    """Zero mean and unit variance over the last axis, then a learned scale and bias, as `nn.LayerNorm`."""

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        width = x.shape[-1]
        scale = self.param("scale", nn.initializers.ones, (width,))
        bias = self.param("bias", nn.initializers.zeros, (width,))
        centred = x - _mean(x)
        return centred * jax.lax.rsqrt(_mean(centred * centred) + NORM_EPS) * scale + bias


def _mean(x: jax.Array) -> jax.Array:
    """The mean over the last axis, [..., 1]; on a CPU by a matrix product.

    There XLA multiplies faster than it sums, which was worth 8 % of an update. A GPU's updates took 6 % longer for it.
    """
    if jax.default_backend() != "cpu":
        return x.mean(-1, keepdims=True)
    return x @ jnp.full((x.shape[-1], 1), 1 / x.shape[-1], x.dtype)


class MLP(nn.Module):
    """[LayerNorm of the input], then Dense, activation, [LayerNorm] for each hidden layer, then a linear head."""

    hidden: tuple[int, ...]
    outputs: int
    head_gain: float
    activation: str = "relu"
    layer_norm: bool = True
    input_norm: bool = False

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        x = LayerNorm()(x) if self.input_norm else x
        for width in self.hidden:
            x = nn.Dense(width, kernel_init=nn.initializers.orthogonal(_GAINS[self.activation]))(x)
            x = _ACTIVATIONS[self.activation](x)
            x = LayerNorm()(x) if self.layer_norm else x
        return nn.Dense(self.outputs, kernel_init=nn.initializers.orthogonal(self.head_gain))(x)


class Recurrent(nn.Module):
    """An MLP whose last hidden layer is a gated recurrent unit; called, it takes the first step of an episode.

    gates: all that is not recurrent, from the input to what it adds to the gates [..., 3H].
    """

    gates: MLP
    outputs: int
    head_gain: float

    @property
    def width(self) -> int:
        """H."""
        return self.gates.outputs // 3

    @property
    def last(self) -> MLP:
        """From the hidden state to the outputs, as a network of its own."""
        return MLP((), self.outputs, self.head_gain, input_norm=self.gates.layer_norm, parent=None)

    def weights_of_last(self, params: Params) -> Params:
        """Those that `last` has, among the weights of the whole."""
        own = params["params"]
        return {"params": {"Dense_0": own["head"]} | ({"LayerNorm_0": own["norm"]} if self.gates.layer_norm else {})}

    def setup(self) -> None:
        """Its own weights, next to those of `gates`."""
        self.kernel = self.param("kernel", _orthogonal_gates, (self.width, 3 * self.width))
        self.bias = self.param("bias", nn.initializers.zeros, (self.width,))
        self.norm = LayerNorm() if self.gates.layer_norm else None
        self.head = nn.Dense(self.outputs, kernel_init=nn.initializers.orthogonal(self.head_gain))

    def __call__(self, x: jax.Array) -> jax.Array:
        gates = self.gates(x)
        return self.read(gru.cell(gates, jnp.zeros_like(gates[..., : self.width]), self.kernel, self.bias))

    def read(self, hidden: jax.Array) -> jax.Array:
        """The outputs at hidden states [..., H]."""
        return self.head(hidden if self.norm is None else self.norm(hidden))


def _orthogonal_gates(key: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """[H, 3H], orthogonal for each gate, as in flax's `GRUCell`."""
    make = nn.initializers.orthogonal()
    return jnp.concatenate([make(k, (shape[0], shape[0])) for k in jax.random.split(key, 3)], 1)


class Actor(nn.Module):
    """Mean of the Gaussian as a function of the observation; its standard deviation is a parameter of its own."""

    trunk: MLP | Recurrent

    @nn.compact
    def __call__(self, obs: jax.Array) -> tuple[jax.Array, jax.Array]:
        std = distributions.std(self.param("std", nn.initializers.ones, (self.trunk.outputs,)))
        return self.trunk(obs), std


@dataclasses.dataclass(frozen=True)
class Networks:
    """The functions of a run's networks; weights live elsewhere.

    Attributes:
      num_actors: N, or 1 if all agents share one.
      num_agents: N.
      own_critics: critics see an agent's own observation [O], not the state [S]; all agents share one.
      own_fear: each agent has a fear network of its own with heads [K], weights with a leading [N].
      gates: of recurrent actors and critics, the layers up to their memory, the same for all; None if none remembers.
      fused: whether compiled code computes them where it can (see `fused`).
    """

    num_actors: int
    num_agents: int
    num_costs: int
    obs_dim: int
    state_dim: int
    own_critics: bool
    own_fear: bool
    actor: Actor
    critic: MLP | Recurrent
    cost_critic: MLP | Recurrent
    fear_net: MLP
    regret_net: MLP
    gates: MLP | None = None
    fused: bool = False

    @property
    def fast(self) -> Networks:
        """The same functions as fast as this machine has them; weights have one gradient, and no other derivative."""
        return dataclasses.replace(self, fused=True)

    @property
    def plain(self) -> Networks:
        """The same functions by XLA, with all their derivatives."""
        return dataclasses.replace(self, fused=False)

    @property
    def _compiled(self) -> bool:
        return self.fused and fused.available()

    @property
    def _unrolls(self) -> bool:
        return self._compiled and fused.on_cpu()

    def init_actor(self, key: jax.Array) -> Params:
        """Weights with a leading [num_actors]."""
        keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(self.num_actors))
        return jax.vmap(lambda k: self.actor.init(k, jnp.zeros(self.obs_dim)))(keys)

    def init_critic(self, key: jax.Array) -> Params:
        """Weights of V."""
        return self.critic.init(key, jnp.zeros(self.obs_dim if self.own_critics else self.state_dim))

    def init_cost_critic(self, key: jax.Array) -> Params:
        """Weights of Vc, all heads in one network: [N, K], or [K] of an agent's own observation."""
        return self.cost_critic.init(key, jnp.zeros(self.obs_dim if self.own_critics else self.state_dim))

    def init_fear(self, key: jax.Array, start: jax.Array | float) -> Params:
        """Weights of the fear prior network, all heads [N, K] in one, whose logits begin at about `start`.

        Fear begins low: from one half it takes tens of updates to come down, and its noise hides the first danger.
        """

        def one(key: jax.Array) -> Params:
            return self.fear_net.init(key, jnp.zeros(self.state_dim))

        if self.own_fear:
            weights = jax.vmap(lambda i: one(jax.random.fold_in(key, i)))(jnp.arange(self.num_agents))
        else:
            weights = one(key)
        return self._with_fear_bias(weights, jnp.full((self.num_agents, self.num_costs), start, jnp.float32))

    def set_fear_to_cost_rate(self, params: Params, cost_rate: jax.Array) -> Params:
        """Starts fear at the observed `cost_rate` [N, K] if it began at nan; other weights stay as they are."""
        rate = jnp.clip(cost_rate, 1e-3, 1 - 1e-3)
        bias: jax.Array = params["params"][self.fear_head]["bias"].reshape(rate.shape)
        return self._with_fear_bias(params, jnp.where(jnp.isnan(bias), jnp.log(rate / (1 - rate)), bias))

    @property
    def fear_head(self) -> str:
        """The layer whose outputs are fear's logits."""
        return f"Dense_{len(self.fear_net.hidden)}"

    def _with_fear_bias(self, params: Params, bias: jax.Array) -> Params:
        layers = params["params"]
        head = layers[self.fear_head]
        head = {**head, "bias": bias.reshape(head["bias"].shape)}
        return {**params, "params": {**layers, self.fear_head: head}}

    def init_regret(self, key: jax.Array) -> Params:
        """Weights with a leading [num_agents]."""
        keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(self.num_agents))
        action_dim = self.actor.trunk.outputs
        return jax.vmap(lambda k: self.regret_net.init(k, jnp.zeros(self.state_dim + action_dim)))(keys)

    def policy(self, params: Params, obs: jax.Array | Sequences) -> tuple[jax.Array, jax.Array]:
        """One agent's Gaussian: obs [..., O], or sequences of them [B, T, O] -> mean [..., A] and std [A]."""
        if self._compiled or isinstance(self.actor.trunk, Recurrent):
            layers = params["params"]
            return self._apply(self.actor.trunk, {"params": layers["trunk"]}, obs), distributions.std(layers["std"])
        return self.actor.apply(params, obs)  # pyright: ignore[reportReturnType] (flax types apply as Any or a tuple)

    def policies(self, params: Params, obs: jax.Array | Sequences) -> tuple[jax.Array, jax.Array]:
        """All agents' Gaussians: obs [..., N, O], or sequences of them [B, T, N, O] -> mean [..., N, A], std [N, A]."""
        axes: Any = Sequences(-2, -2, None) if isinstance(obs, Sequences) else -2  # pyright: ignore[reportArgumentType]
        return jax.vmap(self.policy, in_axes=(0, axes), out_axes=(-2, 0))(self.of_all(params), obs)

    def act(
        self, params: Params, obs: jax.Array, hidden: jax.Array | None
    ) -> tuple[jax.Array, jax.Array, jax.Array | None]:
        """One step of all agents: obs [..., N, O], hidden [..., N, H] -> mean [..., N, A], std [N, A], hidden after it.

        Args:
          hidden: that of `start`, and then what the step before returned, 0 where an episode begins; None of policies
            that are not recurrent.
        """
        if hidden is None:
            return *self.policies(params, obs), None

        def one_agent(params: Params, obs: jax.Array, hidden: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            layers = params["params"]
            trunk = {"params": layers["trunk"]}
            hidden = self.advance(trunk, obs, hidden)
            mean = self._apply(self.actor.trunk, trunk, Remembered(hidden))
            return mean, distributions.std(layers["std"]), hidden

        return jax.vmap(one_agent, (0, -2, -2), (-2, 0, -2))(self.of_all(params), obs, hidden)

    def start(self, count: int) -> Memory | None:
        """The memory of `count` environments where episodes begin; None if no network is recurrent."""
        if self.gates is None:
            return None
        width = self.gates.outputs // 3
        own = jnp.zeros((count, self.num_agents, width))
        central = own if self.own_critics else jnp.zeros((count, width))
        return Memory(own, central, central)

    def advance(self, params: Params, x: jax.Array, hidden: jax.Array) -> jax.Array:
        """What a recurrent network remembers after one more step: x [..., I], hidden [..., H] -> [..., H]."""
        gates = self._gates(params, x)
        if not self._unrolls:
            return gru.cell(gates, hidden, *_recurrence(params))
        steps, before = gates.reshape(-1, 1, gates.shape[-1]), hidden.reshape(-1, hidden.shape[-1])
        never = jnp.zeros(steps.shape[:2], bool)
        return fused.unroll(steps, before, never, *_recurrence(params)).reshape(hidden.shape)

    def remember(self, params: Params, seen: Sequences) -> jax.Array:
        """What a recurrent network remembers after each step, before any reset: [B, T, ..., H]."""
        unroll = fused.unroll if self._unrolls else gru.unroll
        return unroll(self._gates(params, seen.x), seen.hidden, seen.done, *_recurrence(params))

    def of_all(self, params: Params) -> Params:
        """An actor's weights with a leading [N], one shared by all agents included."""
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (self.num_agents, *x.shape[1:])), params)

    def is_std(self, params: Params) -> Params:
        """True at the weights of an actor's standard deviation: on these its Fisher matrix is diagonal."""
        return jax.tree_util.tree_map_with_path(lambda path, x: jnp.full(x.shape, path[-1].key == "std"), params)

    def layers(self, params: Params) -> dict[str, jax.Array]:
        """The mean's weights under plain names, for every layer i and with a leading [N].

        kernel_i [N, I, J] and bias_i [N, J]; norm_scale_i and norm_bias_i [N, I] if layer i's input is normalised.
        Of a recurrent policy the last but one makes the gates [N, I, 3H], and recurrent_kernel [N, H, 3H] and
        recurrent_bias [N, H] multiply the hidden state.
        """
        trunk = params["params"]["trunk"]
        mlp = self.gates or self.actor.trunk
        assert isinstance(mlp, MLP)
        first = 0 if mlp.input_norm else 1  # the first layer whose input may be normalised
        inner = trunk if self.gates is None else trunk["gates"]
        layers = [(inner[f"Dense_{i}"], inner.get(f"LayerNorm_{i - first}", {})) for i in range(len(mlp.hidden) + 1)]
        named = {}
        if self.gates is not None:
            layers.append((trunk["head"], trunk.get("norm", {})))
            named = {"recurrent_kernel": trunk["kernel"], "recurrent_bias": trunk["bias"]}
        for i, (dense, norm) in enumerate(layers):
            named |= {f"{name}_{i}": x for name, x in dense.items()}
            named |= {f"norm_{name}_{i}": x for name, x in norm.items()}
        return self.of_all(named)

    def value(self, params: Params, state: Seen) -> jax.Array:
        """V in normalised units: state [..., S] -> [...], or observations [..., N, O] -> [..., N]; or sequences."""
        return self._apply(self.critic, params, state)[..., 0]

    def cost_value(self, params: Params, state: Seen) -> jax.Array:
        """Vc in normalised units: state [..., S] or observations [..., N, O] -> [..., N, K]; or sequences."""
        heads = self._apply(self.cost_critic, params, state)
        return heads if self.own_critics else heads.reshape(*heads.shape[:-1], self.num_agents, self.num_costs)

    def fear(self, params: Params, state: jax.Array) -> jax.Array:
        """Logits of the fear prior network: state [..., S] -> [..., N, K]."""
        if self.own_fear:
            return jax.vmap(self.fear_of_one, (0, None), -2)(params, state)
        heads = self._apply(self.fear_net, params, state)
        return heads.reshape(*heads.shape[:-1], self.num_agents, self.num_costs)

    def fear_of_one(self, params: Params, state: jax.Array) -> jax.Array:
        """Logits of one agent's own fear prior network: state [..., S] -> [..., K]."""
        return self._apply(self.fear_net, params, state)

    def regret(self, params: Params, state: jax.Array, action: jax.Array) -> jax.Array:
        """Logits of one agent's regret prior network: state [..., S], action [..., A] -> [..., A]."""
        return self._apply(self.regret_net, params, jnp.concatenate([state, action], -1))

    def _apply(self, module: MLP | Recurrent, params: Params, x: Seen) -> jax.Array:
        out: Any
        x = Remembered(self.remember(params, x)) if isinstance(x, Sequences) else x
        if isinstance(x, Remembered) and isinstance(module, Recurrent) and self._compiled:
            out = fused.apply(module.last, module.weights_of_last(params), x.states, through=True)
        elif isinstance(x, Remembered):
            out = module.apply(params, x.states, method="read")
        elif self._compiled and isinstance(module, MLP):
            out = fused.apply(module, params, x)
        else:
            out = module.apply(params, x)
        return out

    def _gates(self, params: Params, x: jax.Array) -> jax.Array:
        assert self.gates is not None
        return self._apply(self.gates, {"params": params["params"]["gates"]}, x)


def _recurrence(params: Params) -> tuple[jax.Array, jax.Array]:
    """The weights of a recurrent network that multiply its hidden state."""
    return params["params"]["kernel"], params["params"]["bias"]


def build(config: Config, spec: EnvSpec, method: Method) -> Networks:
    """The networks of a run."""
    own_critics = method.critic == "observation"

    def mlp(outputs: int, head_gain: float, hidden: tuple[int, ...] = config.hidden) -> MLP:
        input_norm = config.obs_norm == "layernorm"
        return MLP(hidden, outputs, head_gain, config.activation, config.layer_norm, input_norm)

    gates = mlp(3 * config.hidden[-1], 1.0, config.hidden[:-1]) if config.recurrent == "gru" else None

    def network(outputs: int, head_gain: float) -> MLP | Recurrent:
        return mlp(outputs, head_gain) if gates is None else Recurrent(gates, outputs, head_gain)

    return Networks(
        num_actors=1 if method.share_actor else spec.num_agents,
        num_agents=spec.num_agents,
        num_costs=spec.num_costs,
        obs_dim=spec.obs_dim,
        state_dim=spec.state_dim,
        own_critics=own_critics,
        own_fear=method.letter,
        actor=Actor(network(spec.action_dim, 0.01)),
        critic=network(1, 1.0),
        cost_critic=network(spec.num_costs if own_critics else spec.num_agents * spec.num_costs, 1.0),
        fear_net=mlp(spec.num_costs if method.letter else spec.num_agents * spec.num_costs, 0.01),
        regret_net=mlp(spec.action_dim, 0.01),
        gates=gates,
    )
