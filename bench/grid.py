"""Power flows by our solver and by the tools that grid engineers use, on the same random states.

A power flow starts from a set of injections and ends with voltages of all buses and losses of all lines in the
caller's memory. Nothing keeps the previous solution as a start. All must agree with ours in 64 bits.

    pip install -e ".[bench]"     brings the tools
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs.physics import usable_cpus
from envs.voltage import power_flow
from pmt_jax.errors import optional

from .cases import Build, Case, Program

Solver = tuple[Callable[[], Any], Callable[[], np.ndarray]]  # one call; one call's voltages in p.u.

TASKS = {"case33": "voltage_33", "case141": "voltage_141"}
STATES = 1024
AGREE = 1e-4  # p.u.
TOLERANCE = {"float32": 1e-6, "float64": 1e-8}


def prepare() -> None:
    """Two settings that matter on a CPU; before JAX is used."""
    jax.config.update("jax_num_cpu_devices", usable_cpus())
    # Handing work to another thread takes 20 us, which a caller that waits for every single answer can save.
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def flow(case: Case) -> Build:
    """Power flows of a batch of states, or of one state alone, by the tool that the case names."""
    p, q = (x if case.num_envs > 1 else x[0] for x in states(case.task))

    def build() -> Program:
        call, voltages = _solver(case, p, q)
        found, right = np.asarray(voltages()), _reference(case.task)
        apart = float(np.abs(found - (right if case.num_envs > 1 else right[0])).max())
        if apart > AGREE:
            raise ArithmeticError(f"{case.what} is {apart:g} p.u. off")
        return Program(call, case.num_envs, {"largest_difference_pu": apart})

    return build


@functools.cache
def states(network: str) -> tuple[np.ndarray, np.ndarray]:
    """[STATES, n] MW and MVAr injected: daytime rows of the packaged profiles with random reactive powers."""
    env = envs.make(TASKS[network])
    found = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), STATES))
    p, q = -np.asarray(found.carry.p_bus, np.float64), -np.asarray(found.carry.q_bus, np.float64)
    p[:, 0] = q[:, 0] = 0
    return p, q


@functools.cache
def _reference(network: str) -> np.ndarray:
    return _ours(network, *states(network), "float64")[1]()


def _solver(case: Case, p: np.ndarray, q: np.ndarray) -> Solver:
    tool, _, how = case.what.partition(" ")
    if tool == "ours":
        return _ours(case.task, p, q, how.replace("f", "float"))
    if tool == "power-grid-model":
        return _power_grid_model(case.task, p, q, how)
    if tool == "pandapower":
        return _pandapower(case.task, p, q)
    return _lightsim2grid(case.task, p, q, set_power=not how)


def _ours(network: str, p: np.ndarray, q: np.ndarray, dtype: str) -> Solver:
    table = power_flow.load_table(network)
    with jax.enable_x64(dtype == "float64"):
        grid = power_flow.load_network(network, np.union1d(table["load_bus"], table["pv_bus"]).tolist())

        def solve(p: jax.Array, q: jax.Array) -> tuple[jax.Array, ...]:
            flow = power_flow.solve(grid, p, q, tolerance=TOLERANCE[dtype])
            return flow.vm_pu, flow.va_rad, flow.branch_loss_mw, flow.converged

        inputs = jnp.asarray(p, dtype), jnp.asarray(q, dtype)
        program = jax.jit(solve)
        if p.ndim == 2:  # a slice of the batch on every core: XLA runs the loops of a program on one
            mesh = jax.make_mesh((jax.device_count(),), ("batch",))
            over = jax.sharding.PartitionSpec("batch")
            program = jax.jit(jax.shard_map(jax.vmap(solve), mesh=mesh, in_specs=over, out_specs=over, check_vma=False))
            inputs = jax.device_put(inputs, jax.sharding.NamedSharding(mesh, over))

    def call() -> tuple[jax.Array, ...]:
        if dtype == "float32":
            return jax.block_until_ready(program(*inputs))
        with jax.enable_x64(True):
            return jax.block_until_ready(program(*inputs))

    return call, lambda: np.asarray(call()[0])


def _net(network: str) -> Any:
    """A network with a load at every bus, as pandapower has it."""
    pandapower: Any = optional("pandapower", "bench")
    table = power_flow.load_table(network)
    kv, ohm = float(table["vn_kv"]), float(table["vn_kv"]) ** 2 / float(table["base_mva"])
    net = pandapower.create_empty_network(sn_mva=float(table["base_mva"]))
    for _ in table["parent"]:
        pandapower.create_bus(net, kv)
    pandapower.create_ext_grid(net, 0)
    for bus, parent in enumerate(table["parent"]):
        if parent >= 0:
            r, x = table["r"][bus] * ohm, table["x"][bus] * ohm
            pandapower.create_line_from_parameters(net, int(parent), bus, 1.0, r, x, 0.0, 1e3)
            pandapower.create_load(net, bus, 0.0, 0.0)
    return net


def _pandapower(network: str, p: np.ndarray, q: np.ndarray) -> Solver:
    pandapower: Any = optional("pandapower", "bench")
    net = _net(network)
    net.load["p_mw"], net.load["q_mvar"] = -p[1:], -q[1:]

    def call() -> np.ndarray:
        pandapower.runpp(net, numba=False)
        return net.res_bus.vm_pu.to_numpy()

    return call, call


def _lightsim2grid(network: str, p: np.ndarray, q: np.ndarray, set_power: bool) -> Solver:
    optional("lightsim2grid", "bench")
    from lightsim2grid.lightsim2grid_cpp import AlgorithmType
    from lightsim2grid.network import init_from_pandapower

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = init_from_pandapower(_net(network))
    model.change_algorithm(AlgorithmType.NR_KLU)
    changed, flat = np.ones(len(p) - 1, bool), np.ones(len(p), complex)
    p_load, q_load = (-p[1:]).astype(np.float32), (-q[1:]).astype(np.float32)

    def update() -> None:
        model.update_loads_p(changed, p_load)
        model.update_loads_q(changed, q_load)

    def call() -> Any:
        if set_power:
            update()
        return model.ac_pf(flat, 10, 1e-8)

    update()
    return call, lambda: np.abs(np.asarray(call()))


def _power_grid_model(network: str, p: np.ndarray, q: np.ndarray, method: str) -> Solver:
    pgm: Any = optional("power_grid_model", "bench")
    table = power_flow.load_table(network)
    n, volts = len(table["parent"]), float(table["vn_kv"]) * 1e3
    ohm, ids = float(table["vn_kv"]) ** 2 / float(table["base_mva"]), np.arange(len(table["parent"]))

    def array(kind: str, size: int, **values: Any) -> np.ndarray:
        new = pgm.initialize_array("input", kind, size)
        for key, value in values.items():
            new[key] = value
        return new

    ends: dict[str, Any] = {"from_node": table["parent"][1:], "to_node": ids[1:], "from_status": 1, "to_status": 1}
    lines = ends | {"r1": table["r"][1:] * ohm, "x1": table["x"][1:] * ohm, "c1": 0.0, "tan1": 0.0, "i_n": 1e3}
    loads: dict[str, Any] = {"node": ids[1:], "status": 1, "type": 0, "p_specified": 0.0, "q_specified": 0.0}
    model = pgm.PowerGridModel(
        {
            "node": array("node", n, id=ids, u_rated=volts),
            "line": array("line", n - 1, id=n + ids[1:], **lines),
            "source": array("source", 1, id=3 * n, node=0, status=1, u_ref=1.0, sk=1e20),
            "sym_load": array("sym_load", n - 1, id=4 * n + ids[1:], **loads),
        }
    )
    update = pgm.initialize_array("update", "sym_load", (len(p), n - 1))
    update["id"] = 4 * n + ids[1:]
    update["p_specified"], update["q_specified"] = -p[:, 1:] * 1e6, -q[:, 1:] * 1e6
    wanted = {"node": ["u_pu", "u_angle"], "line": ["p_from", "p_to"]}

    def call() -> Any:
        return model.calculate_power_flow(
            update_data={"sym_load": update},
            threading=usable_cpus(),
            error_tolerance=1e-6,
            calculation_method=pgm.CalculationMethod[method],
            output_component_types=wanted,
        )

    return call, lambda: np.asarray(call()["node"]["u_pu"])
