"""AC power flow of a network with one slack bus, as a pure function of arrays.

With the slack voltage fixed, all other voltages obey V = V_0 + Z conj(S / V): V_0 is the voltage without load, Z the
inverse of the admittance matrix without the slack's row and column, S the complex power injected. The map on the right
contracts wherever a feeder is operated, so it is iterated (the "Z-bus" or implicit-Gauss method), sped up by Anderson
acceleration of depth 2: one matrix product per iteration, the same for every network, radial or meshed.

Examples:
  >>> import jax.numpy as jnp
  >>> network = load_network("case33")
  >>> flow = solve(network, jnp.full(33, -0.1), jnp.full(33, -0.05))     # consumption is negative
  >>> bool(flow.converged), round(float(flow.vm_pu.min()), 3)
  (True, 0.904)
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import TaskError, one_of

DATA = Path(__file__).parent / "data"
NETWORKS = ("case33", "case141")
MAX_ITERATIONS = 60  # at 0.999 of the voltage collapse 22 are needed, beyond it no number is enough
TOLERANCE = {"float32": 5e-7, "float64": 1e-11}  # p.u., largest change of a voltage in the last iteration
FIRST_ITERATIONS = 6  # written out without a test: hardly any state can do without them, and a loop has its costs
LANES = 64  # states that are solved together on a CPU
EASY_ITERATIONS = 8  # in f32, states that needed more are so close to collapse that rounding must be corrected


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Network:
    """A network prepared for `solve`: n buses, b branches, m buses where power may be injected.

    Complex quantities are stored as real ones, real parts first, and act on row vectors: `[re, im] @ matrix`.

    Attributes:
      impedance: [2m, 2m] p.u. per MVA, voltages at the injection buses from the currents injected there.
      no_load: [2m] p.u., voltages of the injection buses without any injection.
      voltage, voltage_0: [2m, 2n] and [2n], the same for all buses (the slack included).
      current, current_0: [2m, 2b] MVA at 1 p.u. per MVA and [2b], currents through the branches' series impedances.
      slack_current, slack_current_0: [2m, 2] and [2], current that the slack bus feeds in.
      branch: [b, 5] r, x, g, b (p.u. per MVA, of the whole branch) and off-nominal tap at the from-side.
      inject: [m] indices of the injection buses.
      branch_bus: [b, 2] indices of from-bus and to-bus.
      line: [b] bool, False for transformers, whose losses are no line losses.
      slack: the slack bus.
      n_bus: n.
      series_only: no shunts, no taps, no transformers, slack at 1 p.u.: losses have a closed form.
      name: for messages.
    """

    impedance: Any
    no_load: Any
    voltage: Any
    voltage_0: Any
    current: Any
    current_0: Any
    slack_current: Any
    slack_current_0: Any
    branch: Any
    inject: Any
    branch_bus: Any
    line: Any
    slack: int = dataclasses.field(metadata={"static": True})
    n_bus: int = dataclasses.field(metadata={"static": True})
    series_only: bool = dataclasses.field(metadata={"static": True})
    name: str = dataclasses.field(metadata={"static": True})


class PowerFlow(NamedTuple):
    """A solved state; every number is nan if the flow did not converge.

    Attributes:
      vm_pu, va_rad: [n] voltage magnitudes and angles (the slack's is 0).
      line_loss_mw, line_loss_mvar: [] over all lines; transformers are not lines.
      converged: [] bool.
      iterations: [] int32.
      slack_mw, slack_mvar: [] what the slack bus feeds in.
      branch_loss_mw, branch_loss_mvar: [b] of every branch, transformers included.
      residual: [] p.u., largest change of a voltage in the last iteration.
    """

    vm_pu: jax.Array
    va_rad: jax.Array
    line_loss_mw: jax.Array
    line_loss_mvar: jax.Array
    converged: jax.Array
    iterations: jax.Array
    slack_mw: jax.Array
    slack_mvar: jax.Array
    branch_loss_mw: jax.Array
    branch_loss_mvar: jax.Array
    residual: jax.Array


# Solving


def solve(
    network: Network,
    p_mw: jax.Array,
    q_mvar: jax.Array,
    *,
    tolerance: float | None = None,
    max_iterations: int = MAX_ITERATIONS,
) -> PowerFlow:
    """The voltages and losses that belong to injections `p_mw`, `q_mvar` [n], generation positive.

    Batches by `jax.vmap`; runs in the precision of its inputs. The slack's own entry is ignored. Gradients (forward and
    reverse) come from the implicit function theorem, not from the iterations. A state without solution, and one with
    power at a bus that is not one of its injection buses, comes back with `converged` False and nan everywhere.

    Args:
      tolerance: p.u.; the dtype's entry in TOLERANCE if None.
      max_iterations: of the accelerated fixed point, before a state counts as unsolvable.

    Examples:
      >>> flows = jax.vmap(lambda p: solve(load_network("case33"), p, 0.5 * p))(-jnp.ones((4, 33)) * 0.1)
      >>> flows.vm_pu.shape
      (4, 33)
    """
    p_mw, q_mvar = jnp.asarray(p_mw), jnp.asarray(q_mvar)
    dtype = jnp.promote_types(jnp.result_type(p_mw, q_mvar), jnp.float32)
    net = _cast(network, dtype)
    power = jnp.concatenate([p_mw[net.inject], q_mvar[net.inject]]).astype(dtype)
    tolerance = TOLERANCE[dtype.name] if tolerance is None else tolerance
    deviation, (iterations, residual) = _voltage_deviation(net, power, tolerance, max_iterations)
    # An iteration that stalls on rounding a little above the tolerance has still arrived; one beyond collapse stays
    # orders of magnitude away (1e-4 at 1.001 of it).
    converged = (residual <= 10 * tolerance) & _nothing_elsewhere(net, p_mw, q_mvar)
    flow = _readout(net, power, deviation)
    answer = {k: jnp.where(converged, v, jnp.nan) for k, v in flow.items()}
    return PowerFlow(**answer, converged=converged, iterations=iterations.astype(jnp.int32), residual=residual)


def _voltage_deviation(
    net: Network, power: jax.Array, tolerance: float, max_iterations: int
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    """The fixed point x [2m] of x = Z conj(S / (V_0 + x)), the iterations it took and its residual."""
    find_one = _finder(tolerance, max_iterations)

    def find(_: Any, __: Any) -> Any:
        x, iterations, residual = find_one(net.no_load, net.impedance, power)
        # as a float, because custom_root asks for tangents of all that it returns
        return x, (iterations.astype(x.dtype), residual)

    def iterate(linear: Callable[[jax.Array], jax.Array], rhs: jax.Array) -> jax.Array:
        # linear(d) = J d - d = rhs contracts as the flow itself does: d = J d - rhs.
        size = tolerance * jnp.max(jnp.abs(rhs))
        return _anderson(lambda d: linear(d) + d - rhs, -rhs, size, max_iterations)[0]

    def solve_linear(linear: Callable[[jax.Array], jax.Array], rhs: jax.Array) -> jax.Array:
        return jax.lax.custom_linear_solve(linear, rhs, iterate, iterate)

    def error(x: jax.Array) -> jax.Array:
        return _dot(_current(net.no_load + x, power), net.impedance) - x

    return jax.lax.custom_root(error, jnp.zeros_like(power), find, solve_linear, has_aux=True)  # type: ignore[return-value] (its stubs lack aux)


@functools.cache
def _finder(tolerance: float, max_iterations: int) -> Callable[..., tuple[jax.Array, jax.Array, jax.Array]]:
    """(no_load [2m], impedance [2m, 2m], power [2m]) -> x [2m], iterations [], residual [], with a vmap of its own.

    A batch is solved LANES states at a time, each group until its last one has arrived: on a CPU the vectors of a group
    then stay in the cache, which is worth a factor of two, and no state waits for the hardest of the whole batch.
    """

    def find_group(no_load: jax.Array, impedance: jax.Array, power: jax.Array) -> tuple[jax.Array, ...]:
        """The same for power [..., 2m]."""

        def image(x: jax.Array) -> jax.Array:
            return _dot(_current(no_load + x, power), impedance)

        x, iterations, residual = _anderson(image, jnp.zeros_like(power), tolerance, max_iterations, FIRST_ITERATIONS)
        if x.dtype == jnp.float32:
            hard = iterations > EASY_ITERATIONS

            def correct(c: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
                better = _polish(no_load, impedance, power, c[0], tolerance)
                return jnp.where(c[1][..., None], better, c[0]), jnp.zeros_like(c[1])

            # A loop of one turn, or of none while no state of the group is hard.
            x, _ = jax.lax.while_loop(lambda c: jnp.any(c[1]), correct, (x, hard))
        return x, iterations, residual

    @jax.custom_batching.custom_vmap
    def find_many(no_load: jax.Array, impedance: jax.Array, power: jax.Array) -> tuple[jax.Array, ...]:
        """The same for power [B, 2m], B any."""
        size = power.shape[0]
        if size <= LANES or jax.default_backend() != "cpu":
            return find_group(no_load, impedance, power)
        groups = -(-size // LANES)
        padded = jnp.pad(power, ((0, groups * LANES - size), (0, 0))).reshape(groups, LANES, -1)
        found = jax.lax.map(lambda group: find_group(no_load, impedance, group), padded)
        return tuple(x.reshape(groups * LANES, *x.shape[2:])[:size] for x in found)

    @jax.custom_batching.custom_vmap
    def find_one(no_load: jax.Array, impedance: jax.Array, power: jax.Array) -> tuple[jax.Array, ...]:
        return find_group(no_load, impedance, power)

    @find_one.def_vmap
    def _(size: int, batched: list[bool], *args: jax.Array) -> tuple[Any, Any]:
        if batched[0] or batched[1]:  # as many networks as states
            return jax.vmap(find_group, [0 if b else None for b in batched])(*args), (True,) * 3
        return find_many(*args), (True,) * 3

    @find_many.def_vmap
    def _(size: int, batched: list[bool], *args: jax.Array) -> tuple[Any, Any]:
        if batched[0] or batched[1]:
            return jax.vmap(find_group, [0 if b else None for b in batched])(*args), (True,) * 3
        no_load, impedance, power = args
        found = find_many(no_load, impedance, power.reshape(-1, power.shape[-1]))
        return tuple(x.reshape(size, -1, *x.shape[1:]) for x in found), (True,) * 3

    return find_one


def _anderson(
    image: Callable[[jax.Array], jax.Array], start: jax.Array, tolerance: Any, max_iterations: int, unroll: int = 0
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Fixed points of `image` from `start` [..., k] by Anderson acceleration of depth 2 (Walker & Ni, 2011).

    x' = g - y_1 dg_1 - y_2 dg_2, where g = image(x), f = g - x, dg_j and df_j are their last two differences, and y
    minimises |f - y_1 df_1 - y_2 df_2|. Each vector stops by itself, whatever the others do, but not
    before iteration `unroll`.

    Returns:
      The last x, the number of iterations [...], and max|f| [...] at the x before.
    """

    def advance(history: tuple[jax.Array, ...], k: int | jax.Array) -> tuple[tuple[jax.Array, ...], jax.Array]:
        x, last_g, last_f, dg_2, df_2 = history
        g = image(x)
        f = g - x
        dg_1, df_1 = g - last_g, f - last_f
        after = g
        if not (isinstance(k, int) and k == 0):
            y_1, y_2 = _least_squares(df_1, df_2, f, k)
            after = g - y_1[..., None] * dg_1 - y_2[..., None] * dg_2
        return (after, g, f, dg_1, df_1), jnp.max(jnp.abs(f), axis=-1)

    def unfinished(c: tuple[Any, jax.Array, jax.Array, jax.Array]) -> jax.Array:
        _, _, k, residual = c
        return jnp.any(residual > tolerance) & (k < max_iterations)

    def iterate(c: tuple[Any, jax.Array, jax.Array, jax.Array]) -> tuple[Any, jax.Array, jax.Array, jax.Array]:
        history, count, k, residual = c
        going = residual > tolerance
        (x, *rest), now = advance(history, k)
        if start.ndim > 1:
            x, now = jnp.where(going[..., None], x, history[0]), jnp.where(going, now, residual)
        return (x, *rest), count + going, k + 1, now

    history, residual = (start, *(jnp.zeros_like(start),) * 4), jnp.full_like(start[..., 0], jnp.inf)
    first = min(unroll, max_iterations)
    for k in range(first):
        history, residual = advance(history, k)
    count = jnp.full(residual.shape, first, jnp.int32)
    c = (history, count, jnp.asarray(first, jnp.int32), residual)
    (x, *_), iterations, _, residual = jax.lax.while_loop(unfinished, iterate, c)
    return x, iterations, residual


def _least_squares(a: jax.Array, b: jax.Array, f: jax.Array, k: int | jax.Array) -> tuple[jax.Array, jax.Array]:
    """y [...] of min |f - y_1 a - y_2 b| in iteration k, where k < 2 has fewer columns; 0 if undetermined."""
    inner = jnp.dot if f.ndim == 1 else lambda v, w: jnp.sum(v * w, axis=-1)  # each is the faster on a CPU
    aa, ab, bb, af, bf = inner(a, a), inner(a, b), inner(b, b), inner(a, f), inner(b, f)
    det = aa * bb - ab * ab
    both = (k >= 2) & (det > 1e-6 * aa * bb)
    one = (k >= 1) & (aa > 0)
    det = jnp.where(both, det, 1)
    alone = jnp.where(one, af / jnp.where(one, aa, 1), 0)
    return jnp.where(both, (bb * af - ab * bf) / det, alone), jnp.where(both, (aa * bf - ab * af) / det, 0)


def _polish(no_load: jax.Array, impedance: jax.Array, power: jax.Array, x: jax.Array, tolerance: float) -> jax.Array:
    """`x` [..., 2m] corrected for rounding; near collapse f32 rounding is amplified thirtyfold.

    The correction d solves d = r + G(x + d) - G(x) with r = G(x) - x the residual, its currents to twice the precision;
    the difference of currents is formed without cancellation.
    """
    p, q = jnp.split(power, 2, axis=-1)
    s = jax.lax.complex(p, q)
    current = _current(no_load + x, power)
    residual = _voltage_error(current, _current_error(no_load, power, x, current), impedance, x)
    v = jax.lax.complex(*jnp.split(no_load + x, 2, axis=-1))

    def image(d: jax.Array) -> jax.Array:
        d_complex = jax.lax.complex(*jnp.split(d, 2, axis=-1))
        change = -jnp.conj(s * d_complex / (v * (v + d_complex)))
        return residual + _dot(jnp.concatenate([change.real, change.imag], axis=-1), impedance)

    return x + _anderson(image, residual, tolerance / 1000, MAX_ITERATIONS)[0]


def _current(voltage: jax.Array, power: jax.Array) -> jax.Array:
    """conj(S / V) [..., 2m] = conj(S) V / |V|^2 of `power` and `voltage` [..., 2m]."""
    (e, f), (p, q) = jnp.split(voltage, 2, axis=-1), jnp.split(power, 2, axis=-1)
    inverse = 1 / (e * e + f * f)
    return jnp.concatenate([(p * e + q * f) * inverse, (p * f - q * e) * inverse], axis=-1)


def _current_error(no_load: jax.Array, power: jax.Array, x: jax.Array, current: jax.Array) -> jax.Array:
    """What `current` [..., 2m] lacks: (conj(S) - I conj(V)) / conj(V), the numerator from exact products and sums."""
    (i_re, i_im), (x_re, x_im) = jnp.split(current, 2, axis=-1), jnp.split(x, 2, axis=-1)
    (p, q), (base_re, base_im) = jnp.split(power, 2, axis=-1), jnp.split(no_load, 2, axis=-1)

    def times(a: jax.Array, b: jax.Array, sign: int = -1) -> list[jax.Array]:
        (a_high, a_low), (b_high, b_low) = _split(a), _split(b)
        return [sign * a_high * b_high, sign * a_high * b_low, sign * a_low * b_high, sign * a_low * b_low]

    def twice(a: jax.Array, b_1: jax.Array, b_2: jax.Array, sign: int = -1) -> list[jax.Array]:
        return times(a, b_1, sign) + times(a, b_2, sign)

    e_re = _sum([p, *twice(i_re, base_re, x_re), *twice(i_im, base_im, x_im)])
    e_im = _sum([-q, *twice(i_im, base_re, x_re), *twice(i_re, base_im, x_im, 1)])
    return _current(no_load + x, jnp.concatenate([e_re, -e_im], axis=-1))


def _voltage_error(current: jax.Array, missing: jax.Array, impedance: jax.Array, x: jax.Array) -> jax.Array:
    """(current + missing) @ impedance - x [..., 2m], where rounding in the product's sums would be as large as that.

    Matrix and vector are cut into leading bits and rest; the product of the leading bits, 7 and 8 below the largest
    entry, is exact in f32 for up to 2^9 terms in any order of summation, and cancels against x before the rest comes.
    """
    top, rest = _leading_bits(impedance, jnp.max(jnp.abs(impedance), axis=0), 7)
    head, tail = _leading_bits(current, jnp.max(jnp.abs(current), axis=-1, keepdims=True), 8)
    return (_dot(head, top) - x) + (_dot(tail, top) + _dot(current, rest) + _dot(missing, impedance))


def _leading_bits(a: jax.Array, largest: jax.Array, bits: int) -> tuple[jax.Array, jax.Array]:
    """`a` as a multiple of 2^-bits of the power of two above `largest`, and what is left of it."""
    unit = jnp.ldexp(jnp.ones_like(largest), jnp.frexp(largest)[1] - bits)
    leading = jnp.round(a / unit) * unit
    return leading, a - leading


def _split(a: jax.Array) -> tuple[jax.Array, jax.Array]:
    """`a` as a sum of two f32 of 12 significant bits each, whose products are exact."""
    high = jax.lax.reduce_precision(a, 8, 11)
    return high, a - high


def _sum(terms: Sequence[jax.Array]) -> jax.Array:
    """The sum of `terms` with its rounding errors carried along (Neumaier, Knuth)."""
    total, error = terms[0], jnp.zeros_like(terms[0])
    for term in terms[1:]:
        after = total + term
        part = after - total
        error = error + ((total - (after - part)) + (term - part))
        total = after
    return total + error


def _readout(net: Network, power: jax.Array, x: jax.Array) -> dict[str, jax.Array]:
    """The fields of a PowerFlow, from the differences `x` [2m] of the injection buses."""
    n, m = net.n_bus, power.shape[0] // 2
    current = _current(net.no_load + x, power)
    v = _dot(current, net.voltage) + net.voltage_0
    re, im = v[:n], v[n:]
    vm = jnp.sqrt(re * re + im * im)
    loss_mw, loss_mvar = _branch_losses(net, _dot(current, net.current) + net.current_0, re, im)
    if net.series_only:  # sum of (V - V_0) conj(I): one product of vectors for all lines together
        i_re, i_im, x_re, x_im = current[:m], current[m:], x[:m], x[m:]
        total_mw, total_mvar = x_re @ i_re + x_im @ i_im, x_im @ i_re - x_re @ i_im
    else:
        total_mw, total_mvar = jnp.sum(loss_mw * net.line), jnp.sum(loss_mvar * net.line)
    feed = _dot(current, net.slack_current) + net.slack_current_0
    s_re, s_im = re[net.slack], im[net.slack]
    return {
        "vm_pu": vm,
        "va_rad": jnp.arctan2(im, re),
        "line_loss_mw": total_mw,
        "line_loss_mvar": total_mvar,
        "slack_mw": s_re * feed[0] + s_im * feed[1],
        "slack_mvar": s_im * feed[0] - s_re * feed[1],
        "branch_loss_mw": loss_mw,
        "branch_loss_mvar": loss_mvar,
    }


def _branch_losses(net: Network, current: jax.Array, re: jax.Array, im: jax.Array) -> tuple[jax.Array, jax.Array]:
    """[b] MW and MVAr lost: in the series impedance from its `current` [2b], in the shunts from the end voltages."""
    b = net.branch.shape[0]
    r, x, g, susceptance, tap = (net.branch[:, i] for i in range(5))
    square = current[:b] ** 2 + current[b:] ** 2
    if net.series_only:
        return r * square, x * square
    power = re * re + im * im
    ends = (power[net.branch_bus[:, 0]] / tap**2 + power[net.branch_bus[:, 1]]) / 2
    return r * square + g * ends, x * square - susceptance * ends


def _nothing_elsewhere(net: Network, p_mw: jax.Array, q_mvar: jax.Array) -> jax.Array:
    """False if power is injected at a bus that is neither the slack nor among the network's injection buses."""
    elsewhere = np.setdiff1d(np.arange(net.n_bus), [net.slack]).size != net.inject.shape[0]
    if not elsewhere:
        return jnp.asarray(True)
    allowed = jnp.zeros(net.n_bus, bool).at[net.inject].set(True).at[net.slack].set(True)
    return jnp.all(allowed | ((p_mw == 0) & (q_mvar == 0)))


def _dot(x: jax.Array, matrix: jax.Array) -> jax.Array:
    return jnp.dot(x, matrix, precision=jax.lax.Precision.HIGHEST)  # TF32 would cost four digits


def _cast(network: Network, dtype: Any) -> Network:
    def cast(x: Any) -> jax.Array:
        return jnp.asarray(x, dtype) if jnp.issubdtype(jnp.result_type(x), jnp.floating) else jnp.asarray(x)

    return jax.tree.map(cast, network)


# Building networks


def load_network(name: str, inject: Sequence[int] | None = None) -> Network:
    """A network of the package: "case33" (Baran & Wu, 1989) or "case141" (Khodr et al., 2008).

    Args:
      name: one of NETWORKS.
      inject: the buses that may inject or consume power; all but the slack if None. Fewer buses solve faster.
    """
    table = load_table(name)
    return radial_network(table["parent"], table["r"], table["x"], float(table["base_mva"]), inject=inject, name=name)


def load_table(name: str) -> dict[str, np.ndarray]:
    """The facts of a shipped network, as data/README.md lists them."""
    with np.load(DATA / f"grid_{one_of('network', name, NETWORKS)}.npz") as file:
        return dict(file)


def radial_network(
    parent: Any, r: Any, x: Any, base_mva: float, inject: Sequence[int] | None = None, name: str = "radial"
) -> Network:
    """A feeder without shunts or transformers.

    Args:
      parent: [n] bus that feeds each bus, -1 for the slack.
      r, x: [n] p.u. on `base_mva`, of the line from the parent (the slack's entry is ignored).
      base_mva: power base.
      inject: as in `load_network`.
    """
    parent, r, x = (np.asarray(value) for value in (parent, r, x))
    if not parent.shape == r.shape == x.shape == (parent.size,):
        raise TaskError(
            f"a radial network has a parent, r and x for each bus, not {parent.size}, {r.size} and {x.size}"
        )
    if np.count_nonzero(parent < 0) != 1:
        raise TaskError(f"a radial network has one bus without parent, this one has {np.count_nonzero(parent < 0)}")
    slack = int(np.flatnonzero(parent < 0)[0])
    child = np.flatnonzero(parent >= 0)
    branches = [Branch(int(parent[i]), int(i), float(r[i]), float(x[i])) for i in child]
    return branch_network(len(parent), branches, base_mva, slack=slack, inject=inject, name=name)


class Branch(NamedTuple):
    """A line or transformer between two buses, as MATPOWER models it.

    Attributes:
      from_bus, to_bus: indices.
      r, x: p.u. series impedance.
      b: p.u. charging susceptance, half of it at each end.
      g: p.u. shunt conductance, half of it at each end (the iron losses of a transformer).
      tap, shift: off-nominal ratio and phase shift in radians at the from-side.
      is_line: False for a transformer.
    """

    from_bus: int
    to_bus: int
    r: float
    x: float
    b: float = 0.0
    g: float = 0.0
    tap: float = 1.0
    shift: float = 0.0
    is_line: bool = True


def branch_network(
    n_bus: int,
    branches: Sequence[Branch],
    base_mva: float,
    *,
    slack: int = 0,
    slack_vm: float = 1.0,
    slack_va: float = 0.0,
    shunt: Any = None,
    inject: Sequence[int] | None = None,
    name: str = "network",
) -> Network:
    """Any network whose admittance matrix without the slack can be inverted.

    Args:
      branches: in p.u. on `base_mva`; closed ones only.
      slack_vm, slack_va: p.u. and radians.
      shunt: [n] complex p.u. admittance to ground at each bus.
      inject: as in `load_network`.

    Raises:
      TaskError: a bus that no branch reaches, a branch without impedance, an index out of range, a number that is not
        finite or has a sign that it cannot have, or branches that cancel.
    """
    f, t, z, half, ratio = _branch_arrays(n_bus, branches, name)
    shunts = np.zeros(n_bus, complex) if shunt is None else np.asarray(shunt, complex)
    _check_numbers(n_bus, branches, base_mva, (slack, slack_vm, slack_va), shunts, name)
    to_series, y_bus = _admittance(n_bus, f, t, 1 / z, half, ratio, shunts)
    _check_connected(n_bus, f, t, slack, name)
    where = np.setdiff1d(np.arange(n_bus), [slack]) if inject is None else _injection_buses(inject, n_bus, slack)
    slack_v = slack_vm * np.exp(1j * slack_va)
    z_all, v_0 = _solved_for_voltage(y_bus, slack, slack_v, name)
    series, series_0 = to_series @ z_all[:, where], to_series @ v_0
    feed, feed_0 = y_bus[slack] @ z_all[:, where], y_bus[slack] @ v_0
    lines = np.array([branch.is_line for branch in branches])
    plain = not half.any() and np.all(ratio == 1) and lines.all() and slack_v == 1 and not shunts.any()
    if plain:  # exactly 1 and 0, which the inverse only nearly is
        v_0, series_0, feed_0 = np.ones(n_bus), np.zeros(len(branches)), np.zeros(())
    return Network(
        impedance=_real_matrix(z_all[np.ix_(where, where)] / base_mva),
        no_load=_real(v_0[where]),
        voltage=_real_matrix(z_all[:, where] / base_mva),
        voltage_0=_real(v_0),
        current=_real_matrix(series),
        current_0=_real(series_0 * base_mva),
        slack_current=_real_matrix(feed[None]),
        slack_current_0=_real(np.atleast_1d(feed_0 * base_mva)),
        branch=np.stack(
            [z.real / base_mva, z.imag / base_mva, 2 * half.real * base_mva, 2 * half.imag * base_mva, abs(ratio)], 1
        ),
        inject=where.astype(np.int32),
        branch_bus=np.stack([f, t], 1).astype(np.int32),
        line=lines,
        slack=slack,
        n_bus=n_bus,
        series_only=bool(plain),
        name=name,
    )


def _solved_for_voltage(y_bus: np.ndarray, slack: int, slack_v: complex, name: str) -> tuple[np.ndarray, np.ndarray]:
    """z [n, n] and v_0 [n], p.u., with V = z I + v_0; the slack's row and column of z are 0: no current moves it."""
    others = np.setdiff1d(np.arange(len(y_bus)), [slack])
    z_all = np.zeros(y_bus.shape, complex)
    try:
        z_all[np.ix_(others, others)] = np.linalg.inv(y_bus[np.ix_(others, others)])
    except np.linalg.LinAlgError:
        raise TaskError(f"network '{name}': its admittances cancel, so voltages do not follow from currents") from None
    v_0 = -z_all @ y_bus[:, slack] * slack_v
    v_0[slack] = slack_v
    return z_all, v_0


def _check_numbers(
    n_bus: int,
    branches: Sequence[Branch],
    base_mva: float,
    slack: tuple[int, float, float],
    shunts: np.ndarray,
    name: str,
) -> None:
    """Raises TaskError for numbers that no network has; r of a transformer, as a part of a star, may be below 0."""
    bus, vm, va = slack
    if not (np.isfinite(base_mva) and base_mva > 0):
        raise TaskError(f"network '{name}': base_mva = {base_mva} must be above 0")
    if not 0 <= bus < n_bus:
        raise TaskError(f"network '{name}': the slack bus {bus} is not among 0 to {n_bus - 1}")
    if not (np.isfinite([vm, va]).all() and vm > 0):
        raise TaskError(f"network '{name}': the slack's voltage {vm} p.u. at {va} rad must be finite and above 0")
    if shunts.shape != (n_bus,) or not np.isfinite(shunts).all():
        raise TaskError(f"network '{name}': shunt needs a finite admittance for each of {n_bus} buses")
    for i, branch in enumerate(branches):
        if not np.isfinite(branch).all():
            raise TaskError(f"network '{name}': branch {i} has a number that is not finite: {branch}")
        if branch.tap <= 0:
            raise TaskError(f"network '{name}': branch {i} has a tap of {branch.tap}; it must be above 0")
        if branch.is_line and branch.r < 0:
            raise TaskError(f"network '{name}': branch {i} is a line of negative resistance, r = {branch.r}")


def _branch_arrays(n_bus: int, branches: Sequence[Branch], name: str) -> tuple[Any, ...]:
    """from-bus, to-bus, series impedance, half the shunt admittance and complex ratio of each branch."""
    f, t = (np.array([branch[i] for branch in branches], int) for i in (0, 1))
    if f.size == 0 or min(f.min(), t.min()) < 0 or max(f.max(), t.max()) >= n_bus:
        raise TaskError(f"network '{name}': branches must join buses 0 to {n_bus - 1}")
    z = np.array([complex(branch.r, branch.x) for branch in branches])
    if np.any(z == 0):
        i = int(np.flatnonzero(z == 0)[0])
        raise TaskError(f"network '{name}': branch {i} has no impedance; merge buses {f[i]} and {t[i]}")
    half = np.array([complex(branch.g, branch.b) / 2 for branch in branches])
    ratio = np.array([branch.tap * np.exp(1j * branch.shift) for branch in branches])
    return f, t, z, half, ratio


def _admittance(
    n_bus: int, f: np.ndarray, t: np.ndarray, y: np.ndarray, half: np.ndarray, ratio: np.ndarray, shunt: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """[b, n] currents through the series impedances from the voltages, and [n, n] bus admittances (MATPOWER, ch. 3)."""
    b = np.arange(len(f))
    to_series = np.zeros((len(f), n_bus), complex)
    np.add.at(to_series, (b, f), y / ratio)
    np.add.at(to_series, (b, t), -y)
    y_bus = np.diag(shunt)
    np.add.at(y_bus, (f, f), (y + half) / abs(ratio) ** 2)
    np.add.at(y_bus, (t, t), y + half)
    np.add.at(y_bus, (f, t), -y / np.conj(ratio))
    np.add.at(y_bus, (t, f), -y / ratio)
    return to_series, y_bus


def _check_connected(n_bus: int, f: np.ndarray, t: np.ndarray, slack: int, name: str) -> None:
    reached = np.zeros(n_bus, bool)
    reached[slack] = True
    for _ in range(n_bus):
        more = reached.copy()
        more[t[reached[f]]] = True
        more[f[reached[t]]] = True
        if np.array_equal(more, reached):
            break
        reached = more
    if not reached.all():
        raise TaskError(f"network '{name}': no path from the slack bus {slack} to bus {int(np.argmin(reached))}")


def _injection_buses(inject: Sequence[int], n_bus: int, slack: int) -> np.ndarray:
    where = np.unique(np.asarray(inject, int))
    if where.size == 0 or where[0] < 0 or where[-1] >= n_bus or slack in where:
        raise TaskError(f"injection buses must be among 0 to {n_bus - 1} without the slack {slack}")
    return where


def _real(x: Any) -> np.ndarray:
    return np.concatenate([x.real, x.imag])


def _real_matrix(matrix: Any) -> np.ndarray:
    """The real matrix M for which [re, im](matrix @ x) = [re, im](x) @ M."""
    return np.block([[matrix.real, -matrix.imag], [matrix.imag, matrix.real]]).T
