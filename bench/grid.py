"""Power flows and environment steps per second, against the tools that grid engineers use.

  pip install pandapower lightsim2grid power-grid-model
  python -m bench.grid [--seconds 1.0] [--rounds 7] --out bench/results/grid.json
  python -m bench.grid --quick                    environment steps only, which needs none of the tools

All contestants take turns on the same random states, so that other load on the machine falls on all alike; ratios are
medians over the rounds. A power flow starts from a set of injections and ends with voltages of all buses and losses
of all lines in the caller's memory. Nobody keeps the previous solution as a start.
"""

from __future__ import annotations

import argparse
import json
import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs.vector import VectorEnv
from envs.voltage import power_flow
from pmt_jax.errors import UsageError, optional

from . import records
from .records import Rows

Run = Callable[[], Any]
TOOLS = {"pandapower": "pandapower", "lightsim2grid": "lightsim2grid", "power_grid_model": "power-grid-model"}
CASES, TASKS = ("case33", "case141"), ("voltage_33", "voltage_141")


def states(case: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """[count, n] MW and MVAr injected: daytime rows of the packaged profiles with random reactive powers."""
    env = envs.make({"case33": "voltage_33", "case141": "voltage_141"}[case])
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), count))
    p, q = -np.asarray(states.carry.p_bus, np.float64), -np.asarray(states.carry.q_bus, np.float64)
    p[:, 0] = q[:, 0] = 0
    return p, q


def ours(case: str, p: np.ndarray, q: np.ndarray, dtype: str, tolerance: float) -> tuple[Run, Callable[[], Any]]:
    table = power_flow.load_table(case)
    with jax.enable_x64(dtype == "float64"):
        network = power_flow.load_network(case, np.union1d(table["load_bus"], table["pv_bus"]).tolist())

        def flow(p: jax.Array, q: jax.Array) -> tuple[jax.Array, ...]:
            flow = power_flow.solve(network, p, q, tolerance=tolerance)
            return flow.vm_pu, flow.va_rad, flow.branch_loss_mw, flow.converged

        inputs = jnp.asarray(p, dtype), jnp.asarray(q, dtype)
        if (
            p.ndim == 2
        ):  # one JAX device per core, a slice of the batch each: XLA runs the loops of a program on one core
            mesh = jax.make_mesh((jax.device_count(),), ("batch",))
            over = jax.sharding.PartitionSpec("batch")
            compiled = jax.jit(jax.shard_map(jax.vmap(flow), mesh=mesh, in_specs=over, out_specs=over, check_vma=False))
            inputs = jax.device_put(inputs, jax.sharding.NamedSharding(mesh, over))
        else:
            compiled = jax.jit(flow)

    def run() -> tuple[jax.Array, ...]:
        if dtype == "float32":
            return jax.block_until_ready(compiled(*inputs))
        with jax.enable_x64(True):
            return jax.block_until_ready(compiled(*inputs))

    return run, lambda: np.asarray(run()[0])


def pandapower_net(case: str):
    import pandapower

    table = power_flow.load_table(case)
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


def pandapower_runs(case: str, p: np.ndarray, q: np.ndarray) -> tuple[Run, Callable[[], Any]]:
    import pandapower

    net = pandapower_net(case)
    net.load["p_mw"], net.load["q_mvar"] = -p[1:], -q[1:]
    return lambda: pandapower.runpp(net, numba=False), lambda: net.res_bus.vm_pu.to_numpy()


def lightsim_runs(case: str, p: np.ndarray, q: np.ndarray, set_power: bool) -> tuple[Run, Callable[[], Any]]:
    from lightsim2grid.lightsim2grid_cpp import AlgorithmType
    from lightsim2grid.network import init_from_pandapower

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = init_from_pandapower(pandapower_net(case))
    model.change_algorithm(AlgorithmType.NR_KLU)
    changed = np.ones(len(p) - 1, bool)
    p_load, q_load = (-p[1:]).astype(np.float32), (-q[1:]).astype(np.float32)
    model.update_loads_p(changed, p_load)
    model.update_loads_q(changed, q_load)
    flat = np.ones(len(p), complex)

    def run() -> object:
        if set_power:
            model.update_loads_p(changed, p_load)
            model.update_loads_q(changed, q_load)
        return model.ac_pf(flat, 10, 1e-8)

    return run, lambda: np.abs(np.asarray(run()))


def pgm_runs(case: str, p: np.ndarray, q: np.ndarray, method: str, threads: int) -> tuple[Run, Callable[[], Any]]:
    import power_grid_model as pgm

    table = power_flow.load_table(case)
    n, volts = len(table["parent"]), float(table["vn_kv"]) * 1e3
    ohm = float(table["vn_kv"]) ** 2 / float(table["base_mva"])
    part = pgm.initialize_array

    def array(kind: str, size: int, **values: object) -> np.ndarray:
        new = part("input", kind, size)
        for key, value in values.items():
            new[key] = value
        return new

    ids = np.arange(n)
    model = pgm.PowerGridModel(
        {
            "node": array("node", n, id=ids, u_rated=volts),
            "line": array(
                "line",
                n - 1,
                id=n + ids[1:],
                from_node=table["parent"][1:],
                to_node=ids[1:],
                from_status=1,
                to_status=1,
                r1=table["r"][1:] * ohm,
                x1=table["x"][1:] * ohm,
                c1=0.0,
                tan1=0.0,
                i_n=1e3,
            ),
            "source": array("source", 1, id=3 * n, node=0, status=1, u_ref=1.0, sk=1e20),
            "sym_load": array(
                "sym_load", n - 1, id=4 * n + ids[1:], node=ids[1:], status=1, type=0, p_specified=0.0, q_specified=0.0
            ),
        }
    )
    update = part("update", "sym_load", (len(p), n - 1))
    update["id"] = 4 * n + ids[1:]
    update["p_specified"], update["q_specified"] = -p[:, 1:] * 1e6, -q[:, 1:] * 1e6
    wanted: Any = {"node": ["u_pu", "u_angle"], "line": ["p_from", "p_to"]}
    changes: Any = {"sym_load": update}

    def run() -> Any:
        return model.calculate_power_flow(
            update_data=changes,
            threading=threads,
            error_tolerance=1e-6,
            calculation_method=pgm.CalculationMethod[method],
            output_component_types=wanted,
        )

    return run, lambda: np.asarray(run()["node"]["u_pu"])


def rate(run: Run, seconds: float, flows: int) -> float:
    """Power flows per second of about `seconds` of running."""
    count, start = 0, time.perf_counter()
    while (spent := time.perf_counter() - start) < seconds:
        run()
        count += 1
    return count * flows / spent


def power_flows(case: str, rounds: int, seconds: float) -> Rows:
    """A row per contestant, then one per ratio between two of them."""
    p, q = states(case, 1024)
    threads = len(os.sched_getaffinity(0))
    contestants = {
        ("ours f32", 1024): ours(case, p, q, "float32", 1e-6),
        ("ours f64", 1024): ours(case, p, q, "float64", 1e-8),
        ("power-grid-model iterative_current", 1024): pgm_runs(case, p, q, "iterative_current", threads),
        ("power-grid-model newton_raphson", 1024): pgm_runs(case, p, q, "newton_raphson", threads),
        ("ours f32", 1): ours(case, p[0], q[0], "float32", 1e-6),
        ("ours f64", 1): ours(case, p[0], q[0], "float64", 1e-8),
        ("lightsim2grid", 1): lightsim_runs(case, p[0], q[0], True),
        ("lightsim2grid, solve only", 1): lightsim_runs(case, p[0], q[0], False),
        ("pandapower", 1): pandapower_runs(case, p[0], q[0]),
    }
    reference = np.asarray(contestants["ours f64", 1024][1]())
    errors = {}
    for (name, batch), (run, voltages) in contestants.items():
        run()
        errors[name, batch] = float(np.max(np.abs(np.asarray(voltages()) - (reference if batch > 1 else reference[0]))))
        assert errors[name, batch] < 1e-4, f"{name} disagrees by {errors[name, batch]}"
    rates = {key: np.zeros(rounds) for key in contestants}
    for i in range(rounds):
        for (name, batch), (run, _) in contestants.items():
            rates[name, batch][i] = rate(run, seconds if batch > 1 else seconds / 2, batch)
    rows = [
        {
            "case": case,
            "what": name,
            "batch": batch,
            "flows_per_second": round(float(np.median(found)), 1),
            "largest_difference_pu": errors[name, batch],
        }
        for (name, batch), found in rates.items()
    ]
    return [*rows, *({"case": case, **row} for row in ratios(rates))]


def ratios(rates: dict[tuple[str, int], np.ndarray]) -> Rows:
    """A row per ratio: median and lowest over rounds; power-grid-model counts with the faster of its two methods."""
    pgm = np.maximum(*(rates[f"power-grid-model {m}", 1024] for m in ("iterative_current", "newton_raphson")))
    found = {
        ("ours f32 / power-grid-model", 1024): rates["ours f32", 1024] / pgm,
        ("ours f64 / power-grid-model", 1024): rates["ours f64", 1024] / pgm,
        ("ours f32 / lightsim2grid", 1): rates["ours f32", 1] / rates["lightsim2grid", 1],
        ("ours f64 / lightsim2grid", 1): rates["ours f64", 1] / rates["lightsim2grid", 1],
        ("ours f32 / lightsim2grid, solve only", 1): rates["ours f32", 1] / rates["lightsim2grid, solve only", 1],
        ("ours f32 / pandapower", 1024): rates["ours f32", 1024] / rates["pandapower", 1],
    }
    return [
        {"what": what, "batch": batch, "ratio": round(float(np.median(x)), 2), "lowest": round(float(x.min()), 2)}
        for (what, batch), x in found.items()
    ]


def steps(task: str, rounds: int, seconds: float, batch: int = 256, length: int = 60) -> Rows:
    """Environment steps per second with random actions, noise, auto-reset, observation and state."""
    vector = VectorEnv(envs.make(task), batch)
    actions = (batch, vector.spec.num_agents, 1)

    @jax.jit
    def unroll(state, key):
        def step(state, key):
            state, out = vector.step(state, jax.random.uniform(key, actions, minval=-1, maxval=1))
            return state, (jnp.sum(out.next_obs), jnp.sum(out.next_global_state), jnp.sum(out.reward))

        return jax.lax.scan(step, state, jax.random.split(key, length))

    stepped = jax.jit(vector.step)
    state = vector.reset(jax.random.key(0))
    action = jax.random.uniform(jax.random.key(1), actions, minval=-1, maxval=1)
    jax.block_until_ready(stepped(state, action)[1].next_obs)
    box = [unroll(vector.reset(jax.random.key(0)), jax.random.key(1))[0]]

    def scan() -> None:
        box[0], sums = unroll(box[0], jax.random.key(2))
        jax.block_until_ready(sums)

    rates = {"in a scan": [], "one call a step": []}
    for _ in range(rounds):
        rates["in a scan"].append(rate(scan, seconds, batch * length))
        rates["one call a step"].append(
            rate(lambda: jax.block_until_ready(stepped(state, action)[1].next_obs), seconds, batch)
        )
    return [
        {
            "task": task,
            "what": what,
            "batch": batch,
            "steps_per_second": round(np.median(found)),
            "lowest": round(min(found)),
        }
        for what, found in rates.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=1.0, help="of each slice")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--quick", action="store_true", help="environment steps only")
    parser.add_argument("--out", type=Path, help="a JSON file for the rows")
    args = parser.parse_args()
    jax.config.update("jax_num_cpu_devices", len(os.sched_getaffinity(0)))
    # Handing work to another thread takes 20 us, which a caller that waits for every single answer can save.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    rows: Rows = []
    if not args.quick:
        try:
            for module in TOOLS:
                optional(module, "bench")
        except UsageError as error:
            raise SystemExit(f"bench.grid: {error}") from error
        for case in CASES:
            rows += power_flows(case, args.rounds, args.seconds)
    for task in TASKS:
        rows += steps(task, args.rounds, args.seconds)
    for row in rows:
        print(json.dumps(row))
    if args.out is not None:
        settings = {"rounds": args.rounds, "seconds": args.seconds}
        records.write(args.out, rows, tuple(TOOLS.values()), settings=settings)


if __name__ == "__main__":
    main()
