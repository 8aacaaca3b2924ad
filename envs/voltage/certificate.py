"""Can any reactive powers keep every bus in the band? A dispatch for voltages alone, and a proof if there is none.

A state is a row of data. `Dispatch` looks for reactive powers by linear programs around the solved flow: one
that arrives in the band is proof enough. `impossible` proves the opposite, by bounds on the branch flow equations of a
radial network (Baran & Wu, 1989) that hold for all reactive powers at once. Few states are left that neither decides.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np
import scipy.optimize

from ..errors import TaskError

if TYPE_CHECKING:
    from .control import VoltageControl

MARGIN = 1e-6  # p.u., how far inside the band a dispatch aims, and by how much a proof must miss it
MOST_PROGRAMS = 20  # of a dispatch from one start
ROUNDS = 4  # of bounds that sharpen each other; the fourth changes nothing on the feeders of the package


class Certificate(NamedTuple):
    """What is known of states [T, E].

    Attributes:
      excess: p.u., by how much the worst bus is out of the band under the best dispatch; at most 0 if all are in.
      impossible: whether every dispatch is proven to leave some bus out.
    """

    excess: np.ndarray
    impossible: np.ndarray


def certify(env: VoltageControl, rows: np.ndarray) -> Certificate:
    """The certificate of data rows [T, E, D], E sequences of T neighbours, each of which is the start of the next."""
    proven = impossible(env, rows)
    excess, dispatch = np.full(proven.shape, np.inf), Dispatch(env)
    for episode in range(rows.shape[1]):
        action = np.zeros(env.num_agents)
        for t in range(len(rows)):
            action, excess[t, episode] = dispatch.from_several(rows[t, episode], action)
    return Certificate(excess, proven)


class Dispatch:
    """The reactive powers with the least excess of the worst voltage over the band, in linear programs.

    Args:
      env: whose network, inverters and band these are; made under `jax.enable_x64`, as all calls should be.
    """

    def __init__(self, env: VoltageControl) -> None:
        def voltages(row: jax.Array, action: jax.Array) -> jax.Array:
            return env.flow_of(row, action[:, None]).vm_pu

        self._band, self._agents = (env.v_lower, env.v_upper), env.num_agents
        self._voltages, self._slope = jax.jit(voltages), jax.jit(jax.jacfwd(voltages, 1))

    def from_several(self, row: np.ndarray, guess: np.ndarray) -> tuple[np.ndarray, float]:
        """The best action [N] from `guess`, from no reactive power and from both extremes, and its excess (p.u.)."""
        found = guess, np.inf
        for start in (guess, *(np.full(self._agents, x) for x in (0.0, -1.0, 1.0))):
            found = min(found, self(row, start), key=lambda pair: pair[1])
            if found[1] <= 0:
                break
        return found

    def __call__(self, row: np.ndarray, action: np.ndarray) -> tuple[np.ndarray, float]:
        """The action [N] in [-1, 1] at which no step lessens the excess any more, or that is in the band."""
        vm, excess = self._excess(row, action)
        reach = 2.0
        for _ in range(MOST_PROGRAMS):
            if not 0 < excess < np.inf:
                break
            there, promised = self._best_step(row, action, vm, reach)
            if promised > excess - 1e-9:
                break
            vm_there, excess_there = self._excess(row, there)
            if excess_there < excess:
                action, vm, excess = there, vm_there, excess_there
            else:
                reach /= 4
        return action, excess

    def _excess(self, row: np.ndarray, action: np.ndarray) -> tuple[np.ndarray, float]:
        """The voltages [n] and by how much the worst is out; inf if the flow has no solution."""
        vm = np.asarray(self._voltages(row, action))
        worst = np.maximum(vm - self._band[1], self._band[0] - vm).max()
        return vm, float(worst) if np.isfinite(worst) else np.inf

    def _best_step(self, row: np.ndarray, action: np.ndarray, vm: np.ndarray, reach: float) -> tuple[np.ndarray, float]:
        """The action within `reach` with the least excess if voltages were linear, and that excess."""
        slope = np.asarray(self._slope(row, action))
        one = np.ones((len(vm), 1))
        found = scipy.optimize.linprog(
            np.r_[np.zeros(self._agents), 1.0],
            A_ub=np.block([[slope, -one], [-slope, -one]]),
            b_ub=np.r_[self._band[1] - MARGIN - vm, vm - self._band[0] - MARGIN],
            bounds=[*((max(-1 - a, -reach), min(1 - a, reach)) for a in action), (-MARGIN, None)],
        )
        if found.x is None:
            return action, np.inf
        return np.clip(action + found.x[:-1], -1.0, 1.0), float(found.x[-1])


def impossible(env: VoltageControl, rows: np.ndarray) -> np.ndarray:
    """Whether every action provably leaves some bus out of the band in the data rows [..., D]: [...] bool.

    Suppose all squared voltages u lie in the band. Line j, from its bus to the parent k, carries P and Q with
      u_j = u_k + 2 (r P + x Q) - (r^2 + x^2) l,  l = (P^2 + Q^2) / u_j,
    and what arrives at k is P - r l and Q - x l. From the leaves to the slack, bounds on the injections bound P, Q and
    l; back to the leaves, these bound u. A bound beyond the band contradicts the supposition. Narrower bounds on u
    narrow those on l: the next round.

    Raises:
      TaskError: the network is not radial, or has transformers or shunts.
    """
    parent, r, x, order = _tree(env)
    active, reactive, spare = env.injections(rows)
    square_low, square_high = env.v_lower**2, env.v_upper**2
    u_low, u_high = np.full(active.shape, square_low), np.full(active.shape, square_high)
    found = np.zeros(rows.shape[:-1], bool)
    for _ in range(ROUNDS):
        p, q = np.stack([active, active]), np.stack([reactive - spare, reactive + spare])  # [2, n, ...] least and most
        loss = np.zeros_like(p)
        for j in order[:0:-1]:
            least = _least_square(p[:, j]) + _least_square(q[:, j])
            most = (p[:, j] ** 2).max(axis=0) + (q[:, j] ** 2).max(axis=0)
            loss[:, j] = least / u_high[j], most / u_low[j]
            p[:, parent[j]] += p[:, j] - r[j] * loss[::-1, j]
            q[:, parent[j]] += q[:, j] - x[j] * loss[::-1, j]
        low, high = np.ones_like(u_low), np.ones_like(u_high)
        for j in order[1:]:
            square = r[j] ** 2 + x[j] ** 2
            corners = [
                2 * (r[j] * a + x[j] * b) - square * (a * a + b * b) / u_low[j] for a in p[:, j] for b in q[:, j]
            ]  # concave in P and Q, so the least is at one of them
            low[j] = low[parent[j]] + np.min(corners, axis=0)
            high[j] = high[parent[j]] + 2 * (r[j] * p[1, j] + x[j] * q[1, j]) - square * loss[0, j]
        found |= (low > (env.v_upper + MARGIN) ** 2).any(axis=0) | (high < (env.v_lower - MARGIN) ** 2).any(axis=0)
        u_low, u_high = np.clip(low, square_low, square_high), np.clip(high, square_low, square_high)
    return found


def _least_square(ends: np.ndarray) -> np.ndarray:
    """The least square of a number between `ends` [2, ...]."""
    return np.where((ends[0] < 0) & (ends[1] > 0), 0.0, (ends**2).min(axis=0))


def _tree(env: VoltageControl) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[int]]:
    """Each bus's parent (-1 for the slack), its line's r and x (p.u. per MVA); the buses from the slack outwards."""
    network = env.scenario.network
    ends, branch = np.asarray(network.branch_bus), np.asarray(network.branch, np.float64)
    if not network.series_only or len(ends) != network.n_bus - 1:
        raise TaskError(f"network '{network.name}' is not radial, or has transformers or shunts: it has no such bounds")
    parent, r, x = np.full(network.n_bus, -1), np.zeros(network.n_bus), np.zeros(network.n_bus)
    order = [network.slack]
    for bus in order:  # grows while it is walked
        for line in np.flatnonzero((ends == bus).any(axis=1)):
            child = int(ends[line].sum() - bus)
            if child != parent[bus]:
                parent[child], r[child], x[child] = bus, *branch[line, :2]
                order.append(child)
    return parent, r, x, order
