"""Active voltage control on distribution networks (MAPDN, Wang et al., 2021): tasks `voltage_33` and `voltage_141`.

Photovoltaic plants of a feeder are the agents. Every 3 minutes each sets its inverter's reactive power. The team is
rewarded for bus voltages within 0.95 and 1.05 p.u., little reactive power, and small losses. All of it is pure JAX,
power flow and data included.

Written from the facts of the public environment and checked against rollouts recorded from it, oddities included: after
a reset the first data row is used twice (with fresh noise), and observations mix the solved row with the next.

Examples:
  >>> import jax, envs
  >>> env = envs.make("voltage_33")
  >>> state = jax.jit(env.reset)(jax.random.key(0))
  >>> state = jax.jit(env.step)(state, jax.numpy.zeros((6, 1)))
  >>> state.obs.shape, state.cost.shape
  ((6, 50), (6, 1))
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..base import Declarations, EnvSpec, NetworkMap, State
from ..blocks import Block, Blocks, length
from ..errors import TaskError, at_least, one_of, typed
from . import power_flow
from .baselines import CONTROLLERS
from .layout import layout
from .power_flow import Network, PowerFlow
from .profiles import ROWS_PER_DAY, Profiles, load_profiles

EPISODE_LIMIT = 240  # MAPDN's intervals of 3 minutes; with its timing one less is a control step
COST_LIMIT = 4.8  # 2 % of an episode's 239 steps, that is a controllable rate of 0.98
VOLTAGE_WEIGHT, Q_WEIGHT = 1.0, 0.1
COLLAPSE_PENALTY = 200.0
INVERTER_HEADROOM = 1.2  # apparent power rating over the largest active power
MAX_RESETS = 1000  # dates tried until one can be solved; MAPDN has no limit
BLOCKS = {  # option state_space -> name and unit of each of its blocks, in `_views`' order
    "demand": (("active demand", "MW"), ("reactive demand", "MVAr")),
    "pv": (("PV power", "MW"),),
    "reactive": (("inverter's reactive power", "MVAr"),),
    "vm_pu": (("voltage", "p.u."),),
    "va_degree": (("voltage angle", "rad"),),
}
BARRIERS = ("l1", "l2", "bowl", "courant_beltrami", "bump")
COSTS = ("any", "share", "excess_sum", "excess_mean")
SCOPES = ("network", "zone", "regions")


@dataclasses.dataclass(frozen=True, eq=False)
class Scenario:
    """A network with its loads, its agents and their regions; `pandapower_scenario` makes one of a user's own net.

    Attributes:
      name: the network's name.
      network: for the power flow, injections allowed at load and PV buses.
      table: load_bus [n_load], pv_bus [n_pv] in agent order, zone [n] (0 is no region), p0, q0 [n_load] nominal MW and
        MVAr, s_max [n_pv] MVA (used only to scale generated profiles).
      action_scale: of the largest reactive power, at action 1.
      barrier: the reward's default.
    """

    name: str
    network: Network
    table: dict[str, np.ndarray]
    action_scale: float = 0.8
    barrier: str = "l1"


def load_scenario(name: str) -> Scenario:
    """One of the package's: "case33" or "case141"."""
    table = power_flow.load_table(name)
    network = power_flow.load_network(name, np.union1d(table["load_bus"], table["pv_bus"]).tolist())
    scale, barrier = {"case33": (0.8, "l1"), "case141": (0.6, "bowl")}[name]
    return Scenario(name, network, table, scale, barrier)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Carry:
    """The state between control steps.

    Attributes:
      start_row: [] int32, data row of the episode's row 0.
      steps: [] int32, the row (counted from start_row) that is loaded next; MAPDN's `steps`.
      key: what noise is drawn from.
      row: [n_pv + 2 n_load] MW and MVAr of PVs, active and reactive loads that the next power flow uses.
      q: [n_pv] MVAr now set at the inverters.
      p_bus, q_bus: [n] MW and MVAr consumed at each bus in the last solved flow; the slack's is minus the import.
      vm_pu, va_rad: [n] its voltages.
      line_loss_mw: [] its losses in lines.
      frames: [h, N, F] the last observations, oldest first, or None where history is 1.
    """

    start_row: jax.Array
    steps: jax.Array
    key: jax.Array
    row: jax.Array
    q: jax.Array
    p_bus: jax.Array
    q_bus: jax.Array
    vm_pu: jax.Array
    va_rad: jax.Array
    line_loss_mw: jax.Array
    frames: jax.Array | None


class VoltageControl:
    """See the module; agents share reward and (unless `cost_scope="zone"`) cost.

    Args:
      case: "case33", "case141", or a Scenario of your own.
      data: "simbench" (measured profiles in the package), "synthetic" or "synthetic:SEED", a folder with MAPDN's three
        csv files, an npz of `profiles.save_profiles`, or Profiles.
      noise: add MAPDN's one-sided noise to every data row.
      barrier: what voltages cost in the reward: l1, l2, bowl, courant_beltrami or bump; the scenario's own if None.
      reward: `mapdn`, or `loss_only` which leaves voltages to the cost.
      line_weight: if given, losses in lines weigh on the reward instead of reactive power.
      voltage_weight, q_weight: of the reward's terms.
      cost: of a step: `any` bus out of the band (0 or 1), the `share` of buses out, or the sum or mean of the voltages'
        excess in p.u. (at most 1). A flow without solution costs 1.
      cost_scope: the whole `network`, each agent's own `zone`, or all `regions` apart (as many costs per agent).
      v_lower, v_upper: the band of cost and metrics; the reward's barriers have their own, as in MAPDN.
      timing: `mapdn`, whose first row serves twice and whose limit of 240 leaves 239 steps; or `plain`, one row a step.
      episode_limit: MAPDN's limit, intervals.
      history: observations stacked, oldest first.
      state_space: blocks of observation and state to keep, of demand, pv, reactive, vm_pu, va_degree.
      pv_scale, demand_scale: multiply the data.
    """

    engine = "xla"

    @typed
    def __init__(
        self,
        case: str | Scenario = "case33",
        *,
        data: str | Path | Profiles = "simbench",
        noise: bool = True,
        barrier: str | None = None,
        reward: str = "mapdn",
        line_weight: float | None = None,
        voltage_weight: float = VOLTAGE_WEIGHT,
        q_weight: float = Q_WEIGHT,
        cost: str = "any",
        cost_scope: str = "network",
        v_lower: float = 0.95,
        v_upper: float = 1.05,
        timing: str = "mapdn",
        episode_limit: int = EPISODE_LIMIT,
        history: int = 1,
        state_space: str | tuple[str, ...] = tuple(BLOCKS),
        pv_scale: float = 1.0,
        demand_scale: float = 1.0,
    ) -> None:
        scenario = load_scenario(case) if isinstance(case, str) else case
        self.scenario = scenario
        self.barrier = one_of("barrier", barrier or scenario.barrier, BARRIERS)
        self.noise = noise
        self._reward_kind = one_of("reward", reward, ("mapdn", "loss_only"))
        self._weights = (
            at_least("voltage_weight", voltage_weight, 0),
            at_least("q_weight", q_weight, 0),
            line_weight if line_weight is None else at_least("line_weight", line_weight, 0),
        )
        self._cost_kind = one_of("cost", cost, COSTS)
        self._cost_scope = one_of("cost_scope", cost_scope, SCOPES)
        self.v_lower, self.v_upper = v_lower, v_upper
        if not v_lower < v_upper:
            raise TaskError(f"v_lower must be below v_upper, but {v_lower:g} is not below {v_upper:g}")
        if not v_lower > 0:
            raise TaskError(f"v_lower must be a voltage above 0 p.u., not {v_lower:g}")
        if not pv_scale > 0:
            raise TaskError(f"pv_scale must be above 0, as the inverters' limits scale with it, not {pv_scale:g}")
        at_least("demand_scale", demand_scale, 0)
        self._first_row = 1 if one_of("timing", timing, ("mapdn", "plain")) == "mapdn" else 0
        self._history = at_least("history", history, 1)
        self._limit = at_least("episode_limit", episode_limit, 2)
        self._set_network(_blocks(state_space))
        self._set_data(load_profiles(data, scenario.name, scenario.table).scaled(pv_scale, demand_scale))
        self.spec = EnvSpec(
            name={"case33": "voltage_33", "case141": "voltage_141"}.get(scenario.name) or _slug(scenario.name),
            num_agents=self.num_agents,
            obs_dim=length(self._observed),
            action_dim=1,
            state_dim=length(self._described),
            num_costs=self._cost_masks.shape[0] if cost_scope == "regions" else 1,
            horizon=self._limit - self._first_row,
            action_mask=np.ones((self.num_agents, 1), np.float32),
            cost_limit=COST_LIMIT,
        )

    def _set_network(self, blocks: tuple[str, ...]) -> None:
        """Index tables: what agents and state see of the pool of quantities, loads and PVs by bus, buses by region."""
        table, n = self.scenario.table, self.scenario.network.n_bus
        self.num_agents = len(table["pv_bus"])
        self.num_loads = len(table["load_bus"])
        self._dtype = jnp.zeros(()).dtype  # f64 in an environment made under jax.enable_x64
        self._seen, self._stated = _views(n, table["pv_bus"], table["zone"], blocks)
        largest = max(int(np.sum(table["zone"] == zone)) for zone in table["zone"][table["pv_bus"]])
        frame = _describe(blocks, largest, 1, "of the own region")
        ages = [f", {age} steps ago" if age else "" for age in reversed(range(self._history))]
        self._observed = tuple(block._replace(name=block.name + age) for age in ages for block in frame)
        self._described = _describe(blocks, n, self.num_agents, "of all buses", angle="degree")
        self._loads_at = _by_bus(table["load_bus"], n)
        self._pvs_at = _by_bus(table["pv_bus"], n)
        regions = range(1, int(table["zone"].max()) + 1)
        region_masks = np.stack([table["zone"] == region for region in regions])
        self._cost_masks = {
            "network": np.ones((1, n), bool),
            "zone": region_masks[table["zone"][table["pv_bus"]] - 1],
            "regions": region_masks,
        }[self._cost_scope]

    def _set_data(self, profiles: Profiles) -> None:
        """The bank of data, one constant on the device however many environments read it."""
        dtype = self._dtype
        self.profiles = profiles
        bank = np.concatenate([profiles.pv, profiles.p_load, profiles.q_load], axis=1)
        self._bank = jnp.asarray(bank, dtype)
        self._noise_scale = jnp.asarray(profiles.row_std() / 100, dtype)
        self.s_max = jnp.asarray(INVERTER_HEADROOM * profiles.pv.max(axis=0), dtype)
        self._start_days = profiles.days - (self._limit // ROWS_PER_DAY + 1)
        if self._start_days < 1:
            raise TaskError(
                f"{profiles.source} spans {profiles.days} days; episodes of {self._limit} intervals need at least "
                f"{self._limit // ROWS_PER_DAY + 2}"
            )

    # The contract

    @property
    def shares_cost(self) -> bool:
        """Whether each step costs all agents the same."""
        return self._cost_scope != "zone"

    @functools.cached_property
    def declares(self) -> Declarations:
        """A map of the network, and the policies of `baselines`."""
        network = self.scenario.network
        x, y = layout(network.branch_bus, network.slack, network.n_bus)
        links = np.array([pair if x[pair[0]] <= x[pair[1]] else pair[::-1] for pair in np.asarray(network.branch_bus)])
        band = self.v_lower, self.v_upper
        return Declarations(
            observation=self._observed,
            state=self._described,
            actions=(("inverter's reactive power",),) * self.num_agents,
            picture=NetworkMap(
                self.raw, "vm_pu", band, x, y, links, agents=np.asarray(self.scenario.table["pv_bus"]), unit="p.u."
            ),
            baselines={name: functools.partial(make, self) for name, make in CONTROLLERS.items()},
        )

    def reset(self, key: jax.Array) -> State:
        """A random date at a random interval, reactive powers uniform; another one if that has no solution."""

        def draw(attempt: jax.Array) -> Carry:
            hour_key, day_key, q_key, carry_key = jax.random.split(jax.random.fold_in(key, attempt), 4)
            interval = jax.random.randint(hour_key, (), 0, ROWS_PER_DAY)
            day = jax.random.randint(day_key, (), 0, self._start_days)
            start_row = (interval + day * ROWS_PER_DAY).astype(jnp.int32)
            row, next_key = self._load_row(start_row + self._first_row, carry_key)
            share = jax.random.uniform(q_key, (self.num_agents,), self._dtype, -1.0, 1.0)
            q = share * self.scenario.action_scale * self.q_limit(row)
            return self.solve_first(start_row, q, row, next_key)

        def unsolved(c: tuple[jax.Array, Carry]) -> jax.Array:
            return (c[0] <= MAX_RESETS) & ~jnp.isfinite(c[1].line_loss_mw)

        zero = jnp.zeros((), jnp.int32)
        nothing = jax.tree.map(lambda x: jax.lax.full(x.shape, 0, x.dtype), jax.eval_shape(draw, zero))
        nothing = dataclasses.replace(nothing, line_loss_mw=jnp.full_like(nothing.line_loss_mw, jnp.nan))
        # The first draw is made in the loop, too: a draw has a power flow, which XLA then compiles once.
        _, carry = jax.lax.while_loop(unsolved, lambda c: (c[0] + 1, draw(c[0])), (zero, nothing))
        return self._observe(carry)

    def step(self, state: State, action: jax.Array) -> State:
        """3 minutes with reactive powers `action` [N, 1], 1 being the scenario's share of what a PV has to spare."""
        carry: Carry = state.carry
        q = self._reactive(carry.row, action)
        flow, p_bus, q_bus = self._solve(carry.row, q)
        solved = dataclasses.replace(
            carry,
            q=q,
            p_bus=p_bus,
            q_bus=q_bus,
            vm_pu=flow.vm_pu,
            va_rad=flow.va_rad,
            line_loss_mw=flow.line_loss_mw,
        )
        # Without a solution the grid stays in its last state, which reward and metrics then describe.
        ok = flow.converged
        solved = dataclasses.replace(
            solved, **{k: jnp.where(ok, getattr(solved, k), getattr(carry, k)) for k in _SOLVED_FIELDS}
        )
        row, key = self._load_row(carry.start_row + carry.steps, carry.key)
        after = dataclasses.replace(solved, row=row, key=key, steps=carry.steps + 1)
        return self._observe(
            after,
            reward=self._get_reward(solved) - COLLAPSE_PENALTY * ~ok,
            cost=jnp.where(ok, self._get_cost(solved.vm_pu), jnp.ones((), self._dtype)),
            terminated=~ok,
            info=self._get_info(solved, q, ok),
        )

    def restore(self, start_row: Any, q: Any, key: Any = None, **rest: Any) -> State:
        """The state right after a reset at data row `start_row` with reactive powers `q` [n_pv] in MVAr.

        Args:
          key: of later noise; without it the first row carries no noise (and the next ones that of key 0).
          **rest: the other fields of Carry (see `raw`): then any state, as it was.
        """
        start_row = jnp.asarray(start_row, jnp.int32)
        q = jnp.asarray(q, self._dtype)
        unknown = [name for name in rest if name not in Carry.__dataclass_fields__]
        if unknown:
            raise TaskError(f"restore takes no '{unknown[0]}'; known: {', '.join(Carry.__dataclass_fields__)}")
        if rest:
            key = jax.random.key(0) if key is None else key
            first = self.solve_first(start_row, q, self.data_row(start_row + self._first_row), key)
            given = {k: jnp.asarray(v, getattr(first, k).dtype) for k, v in rest.items() if v is not None}
            return self._observe(dataclasses.replace(first, key=key, **given), push="frames" not in given)
        if key is None:
            row, key = self.data_row(start_row + self._first_row), jax.random.key(0)
        else:
            row, key = self._load_row(start_row + self._first_row, key)
        return self._observe(self.solve_first(start_row, q, row, key))

    def raw(self, state: State) -> dict[str, Any]:
        """What `restore` takes."""
        return dict(vars(state.carry))

    # Data

    def data_row(self, index: jax.Array) -> jax.Array:
        """[n_pv + 2 n_load] the profiles at row `index` [], interpolated between knots, without noise.

        Before the first row the data are as there, and behind the last one as there.
        """
        per_knot = self.profiles.rows_per_knot
        index = jnp.clip(index, 0, self.profiles.num_rows - 1)
        if per_knot == 1:
            return self._bank[index]
        knot = jnp.clip(index // per_knot, 0, self._bank.shape[0] - 2)
        weight = (index - knot * per_knot).astype(self._dtype) / per_knot
        return self._bank[knot] * (1 - weight) + self._bank[knot + 1] * weight

    def _load_row(self, index: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The row with MAPDN's noise, which only ever adds, and the key for the next."""
        row = self.data_row(index)
        if not self.noise:
            return row, key
        key, noise_key = jax.random.split(key)
        return row + self._noise_scale * jnp.abs(jax.random.normal(noise_key, row.shape, row.dtype)), key

    def _parts(self, row: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """PV power [n_pv], active and reactive load [n_load] of a row."""
        n_pv, n_load = self.num_agents, self.num_loads
        return row[:n_pv], row[n_pv : n_pv + n_load], row[n_pv + n_load :]

    # Physics

    def q_limit(self, row: jax.Array) -> jax.Array:
        """[n_pv] MVAr that the inverters' ratings leave next to the active power."""
        pv = row[: self.num_agents]
        return jnp.sqrt(jnp.maximum(self.s_max**2 - pv**2, 0))

    def _reactive(self, row: jax.Array, action: jax.Array) -> jax.Array:
        """[n_pv] MVAr that `action` [N, 1] sets; clipped here and nowhere else."""
        action = jnp.clip(action[:, 0].astype(self._dtype), -1.0, 1.0)
        return action * self.scenario.action_scale * self.q_limit(row)

    def flow(self, state: State, action: jax.Array) -> PowerFlow:
        """The power flow that `step(state, action)` solves, differentiable in `action`."""
        return self.flow_of(state.carry.row, action)

    def flow_of(self, row: jax.Array, action: jax.Array) -> PowerFlow:
        """The power flow of a data row [D] under `action` [N, 1]."""
        return self._solve(row, self._reactive(row, action))[0]

    def injections(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """MW, MVAr without the plants', and the most MVAr of plants, by bus [n, ...], of data rows [..., D]."""
        pv, p_load, q_load = np.split(rows, np.cumsum([self.num_agents, self.num_loads]), axis=-1)
        most = self.scenario.action_scale * np.sqrt(np.maximum(np.asarray(self.s_max) ** 2 - pv**2, 0))
        active, reactive, limit = np.zeros((3, self.scenario.network.n_bus, *rows.shape[:-1]))
        for at, into, values in (
            ("load_bus", active, -p_load),
            ("load_bus", reactive, -q_load),
            ("pv_bus", active, pv),
            ("pv_bus", limit, most),
        ):
            np.add.at(into, self.scenario.table[at], np.moveaxis(values, -1, 0))
        return active, reactive, limit

    def _solve(self, row: jax.Array, q: jax.Array) -> tuple[PowerFlow, jax.Array, jax.Array]:
        """The power flow of a row with reactive powers `q`, and what each bus then consumes, [n] MW and MVAr."""
        pv, p_load, q_load = self._parts(row)
        p_bus = _sum_at(p_load, self._loads_at) - _sum_at(pv, self._pvs_at)
        q_bus = _sum_at(q_load, self._loads_at) - _sum_at(q, self._pvs_at)
        network = self.scenario.network
        flow = power_flow.solve(network, -p_bus, -q_bus)
        slack = network.slack
        return flow, p_bus.at[slack].set(-flow.slack_mw), q_bus.at[slack].set(-flow.slack_mvar)

    def solve_first(self, start_row: jax.Array, q: jax.Array, row: jax.Array, key: jax.Array) -> Carry:
        """The carry after a reset: `row` solved with `q`, and about to be used again."""
        flow, p_bus, q_bus = self._solve(row, q)
        if not self._first_row:  # plain timing: the next flow is already the next row's
            row, key = self._load_row(start_row + 1, key)
        frames = None
        if self._history > 1:
            frames = jnp.zeros((self._history, *self._seen.shape), self._dtype)
        steps = jnp.asarray(1 if self._first_row else 2, jnp.int32)
        return Carry(start_row, steps, key, row, q, p_bus, q_bus, flow.vm_pu, flow.va_rad, flow.line_loss_mw, frames)

    # Observations, reward and cost

    def _observe(
        self,
        carry: Carry,
        reward: Any = 0.0,
        cost: Any = 0.0,
        terminated: Any = False,
        info: dict[str, jax.Array] | None = None,
        push: bool = True,
    ) -> State:
        frame, global_state = self._get_obs(carry)
        obs = frame
        if carry.frames is not None:
            frames = jnp.concatenate([carry.frames[1:], frame[None]]) if push else carry.frames
            carry = dataclasses.replace(carry, frames=frames)
            obs = jnp.moveaxis(frames, 0, 1).reshape(self.num_agents, -1)
        return State(
            obs=obs,
            global_state=global_state,
            reward=jnp.asarray(reward, self._dtype),
            cost=jnp.broadcast_to(jnp.asarray(cost, self._dtype), (self.num_agents, self.spec.num_costs)),
            terminated=jnp.asarray(terminated, bool),
            info=self._get_info(carry, carry.q, jnp.asarray(True)) if info is None else info,
            carry=carry,
        )

    def _get_obs(self, carry: Carry) -> tuple[jax.Array, jax.Array]:
        """[N, F] and [S]: bus quantities of the last solved flow, but the PVs' active power of the row to come."""
        pv = carry.row[: self.num_agents]
        pv_at, q_at = _sum_at(pv, self._pvs_at), _sum_at(carry.q, self._pvs_at)
        degrees = jnp.rad2deg(carry.va_rad)
        zero = jnp.zeros(1, self._dtype)
        # An agent observes its region's demand: PVs added back, the active power that of the wrong row (MAPDN's quirk).
        local = [carry.p_bus + pv_at, carry.q_bus + q_at, pv, carry.q, carry.vm_pu, carry.va_rad, zero]
        whole = [carry.p_bus, carry.q_bus, pv, carry.q, carry.vm_pu, degrees]
        return jnp.concatenate(local)[self._seen], jnp.concatenate(whole)[self._stated]

    def _get_reward(self, solved: Carry) -> jax.Array:
        voltage_weight, q_weight, line_weight = self._weights
        if line_weight is None:
            effort = q_weight * jnp.mean(jnp.abs(solved.q))
        else:
            lines = int(np.count_nonzero(self.scenario.network.line))
            effort = line_weight * solved.line_loss_mw / lines
        if self._reward_kind == "loss_only":
            return -effort
        return -(voltage_weight * jnp.mean(barrier(self.barrier, solved.vm_pu)) + effort)

    def _get_cost(self, vm_pu: jax.Array) -> jax.Array:
        """[1 or N, K] in [0, 1]."""
        excess = jnp.maximum(vm_pu - self.v_upper, 0) + jnp.maximum(self.v_lower - vm_pu, 0)
        masks = jnp.asarray(self._cost_masks, self._dtype)
        out = (excess > 0).astype(self._dtype)
        size = jnp.sum(masks, axis=1)
        cost = {
            "any": lambda: jnp.max(masks * out, axis=1),
            "share": lambda: masks @ out / size,
            "excess_sum": lambda: jnp.minimum(masks @ excess, 1),
            "excess_mean": lambda: jnp.minimum(masks @ excess / size, 1),
        }[self._cost_kind]()
        return cost[None, :] if self._cost_scope == "regions" else cost[:, None]

    def _get_info(self, solved: Carry, q_tried: jax.Array, ok: jax.Array) -> dict[str, jax.Array]:
        """MAPDN's metrics under MAPDN's names."""
        v = solved.vm_pu
        lower, upper = self.v_lower, self.v_upper
        low = jnp.mean((v < lower).astype(self._dtype))
        high = jnp.mean((v > upper).astype(self._dtype))
        return {
            "totally_controllable_ratio": ((low + high <= 1e-3) & ok).astype(self._dtype),
            "total_line_loss": solved.line_loss_mw,
            "percentage_of_v_out_of_control": low + high,
            "percentage_of_lower_than_lower_v": low,
            "percentage_of_higher_than_upper_v": high,
            "average_voltage_deviation": jnp.mean(jnp.abs(v - 1)),
            "average_voltage": jnp.mean(v),
            "max_voltage_drop_deviation": jnp.max(jnp.maximum(lower - v, 0)),
            "max_voltage_rise_deviation": jnp.max(jnp.maximum(v - upper, 0)),
            "q_loss": jnp.mean(jnp.abs(q_tried)),
            "destroy": (~ok).astype(self._dtype),
        }


_SOLVED_FIELDS = ("q", "p_bus", "q_bus", "vm_pu", "va_rad", "line_loss_mw")


def barrier(kind: str, vm_pu: jax.Array) -> jax.Array:
    """MAPDN's voltage barriers, elementwise on voltages in p.u.; their limits are part of their definition."""
    off = jnp.abs(vm_pu - 1)
    if kind == "l1":
        return jnp.asarray(off)
    if kind == "l2":
        return 2 * off**2
    if kind == "bowl":
        normal = jnp.exp(-0.5 * (off / 0.1) ** 2) / (0.1 * math.sqrt(2 * math.pi))
        return jnp.where(off > 0.05, 2 * off - 0.095, 0.04 - 0.01 * normal)
    if kind == "courant_beltrami":
        return jnp.maximum(vm_pu - 1.05, 0) ** 2 + jnp.maximum(0.95 - vm_pu, 0) ** 2
    if kind == "bump":
        size = jnp.abs(vm_pu)
        fourth = jnp.where(size < 1, size, size - 2) ** 4
        inside = (size != 1) & (size < 3)
        return jnp.where(inside, jnp.exp(-1 / jnp.where(inside, 1 - fourth, 1)), 0)
    raise TaskError(f"unknown barrier '{kind}'")


def _blocks(state_space: str | tuple[str, ...]) -> tuple[str, ...]:
    names = state_space.split(",") if isinstance(state_space, str) else state_space
    if not names:
        raise TaskError(f"state_space must keep at least one of {', '.join(BLOCKS)}")
    chosen = {one_of("state_space block", str(name).strip(), BLOCKS) for name in names}
    return tuple(block for block in BLOCKS if block in chosen)


def _slug(name: str) -> str:
    """A network's name as a task's, whose name folders bear."""
    return re.sub(r"\W+", "_", name).strip("_") or "network"


def _describe(chosen: tuple[str, ...], buses: int, plants: int, whose: str, angle: str = "rad") -> Blocks:
    """What `_views` picks, of so many buses and plants; an agent sees angles in rad, the state has them in degrees."""
    found = []
    for name, unit in (pair for block in chosen for pair in BLOCKS[block]):
        of_plants = name in ("PV power", "inverter's reactive power")
        meaning = ("in the data row to come" if name == "PV power" else "") if of_plants else whose
        found.append(Block(name, plants if of_plants else buses, angle if name == "voltage angle" else unit, meaning))
    return tuple(found)


def _views(n: int, pv_bus: np.ndarray, zone: np.ndarray, blocks: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """[N, F] and [S] indices into the pool p(n) q(n) pv(n_pv) q_pv(n_pv) vm(n) va(n), for agents and one zero."""
    n_pv = len(pv_bus)
    bus, plant = np.arange(n), np.arange(n_pv)
    pool = {
        "demand": [bus, n + bus],
        "pv": [2 * n + plant],
        "reactive": [2 * n + n_pv + plant],
        "vm_pu": [2 * n + 2 * n_pv + bus],
        "va_degree": [3 * n + 2 * n_pv + bus],
    }
    stated = np.concatenate([part for block in blocks for part in pool[block]])

    def seen(agent: int) -> np.ndarray:
        if zone[pv_bus[agent]] == 0:
            raise TaskError(f"PV {agent} sits at bus {pv_bus[agent]}, which belongs to no region")
        mine = np.flatnonzero(zone == zone[pv_bus[agent]])
        own = {"pv": agent, "reactive": agent}
        return np.concatenate([np.atleast_1d(part[own.get(block, mine)]) for block in blocks for part in pool[block]])

    views = [seen(agent) for agent in range(n_pv)]
    longest = max(len(view) for view in views)
    nothing = 4 * n + 2 * n_pv
    padded = [np.pad(view, (0, longest - len(view)), constant_values=nothing) for view in views]
    return np.stack(padded).astype(np.int32), stated.astype(np.int32)


def _by_bus(bus_of: np.ndarray, n: int) -> np.ndarray:
    """[n, most] which elements sit at each bus, `len(bus_of)` if there is none."""
    sits = [np.flatnonzero(np.asarray(bus_of) == bus) for bus in range(n)]
    most = max(1, max(len(s) for s in sits))
    return np.stack([np.pad(s, (0, most - len(s)), constant_values=len(bus_of)) for s in sits]).astype(np.int32)


def _sum_at(values: jax.Array, at: np.ndarray) -> jax.Array:
    """[n] sums of `values` by bus; a gather, which every device does faster than a scatter."""
    padded = jnp.concatenate([values, jnp.zeros(1, values.dtype)])
    return padded[at[:, 0]] if at.shape[1] == 1 else jnp.sum(padded[at], axis=1)
