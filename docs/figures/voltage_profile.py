"""The picture of the voltage tasks: the feeder at noon and a day of it, before and after control.

    python -m docs.figures.voltage_profile [--task voltage_33] [--policy opf] [--day 142] [--out FILE.png]

Left: voltages along the feeder, by electrical distance from the substation, at the moment of the day when they are
worst without control. Right: the lowest and highest voltage of all buses over the day. Grey is the band to keep.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs.voltage.baselines import CONTROLLERS, Controller
from envs.voltage.control import VoltageControl
from envs.voltage.profiles import ROWS_PER_DAY
from pmt_jax.studies.plot import BLUE, RED


def day_of_voltages(env: VoltageControl, policy: Controller, start_row: int) -> np.ndarray:
    """[480, n] p.u. over the day that begins at `start_row`."""

    def step(state, _):
        state = env.step(state, policy(state))
        return state, state.carry.vm_pu

    start = env.restore(start_row=start_row, q=jnp.zeros(env.spec.num_agents))
    return np.asarray(jax.jit(lambda s: jax.lax.scan(step, s, None, ROWS_PER_DAY)[1])(start))


def distance(table: dict[str, np.ndarray]) -> np.ndarray:
    """[n] p.u. impedance between the substation and each bus."""
    length = np.zeros(len(table["parent"]))
    for bus in table["order"][1:]:
        length[bus] = length[table["parent"][bus]] + np.hypot(table["r"][bus], table["x"][bus])
    return length


def draw(env: VoltageControl, before: np.ndarray, after: np.ndarray, policy: str, out: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    table, far = env.scenario.table, distance(env.scenario.table)
    worst = int(np.abs(before - 1).max(axis=1).argmax())
    figure, (feeder, day) = pyplot.subplots(1, 2, figsize=(10, 3.6), sharey=True, width_ratios=(1, 1.3))
    hours = np.arange(ROWS_PER_DAY) / 20
    for voltages, colour, name in ((before, RED, "no control"), (after, BLUE, policy)):
        for bus, parent in enumerate(table["parent"]):
            if parent >= 0:
                feeder.plot(far[[parent, bus]], voltages[worst, [parent, bus]], color=colour, lw=1.2)
        feeder.plot(far[table["pv_bus"]], voltages[worst, table["pv_bus"]], "o", color=colour, ms=5, label=name)
        day.fill_between(hours, voltages.min(axis=1), voltages.max(axis=1), color=colour, alpha=0.35, lw=0, label=name)
        out_share = np.mean((voltages < env.v_lower) | (voltages > env.v_upper))
        print(f"{name}: {100 * out_share:.1f} % of bus voltages out of the band over the day")
    for axes in (feeder, day):
        axes.axhspan(env.v_lower, env.v_upper, color="0.9", zorder=0)
        axes.spines[["top", "right"]].set_visible(False)
    day.axvline(hours[worst], color="0.5", lw=0.8, ls=":")
    day.set(xlabel="hour of the day", xlim=(0, 24), xticks=range(0, 25, 4))
    feeder.set(xlabel="impedance to the substation, p.u.", ylabel="voltage, p.u.")
    feeder.set_title(
        f"along the feeder at {int(hours[worst]):02d}:{int(hours[worst] % 1 * 60):02d} (dots: the agents)", fontsize=10
    )
    day.set_title("lowest to highest bus over a day", fontsize=10)
    day.legend(frameon=False, loc="upper left")
    figure.tight_layout()
    figure.savefig(out, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="voltage_33", choices=("voltage_33", "voltage_141"))
    parser.add_argument("--policy", default="opf", choices=tuple(CONTROLLERS))
    parser.add_argument("--data", default="simbench")
    parser.add_argument("--day", type=int, default=142, help="of the data; in the packaged year a sunny one in May")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "voltage_profile.png")
    args = parser.parse_args()
    env = envs.make(args.task, data=args.data, noise=False)
    assert isinstance(env, VoltageControl)
    if not 0 <= args.day < env.profiles.days:
        parser.error(f"--day must be from 0 to {env.profiles.days - 1}, not {args.day}")
    row = args.day * ROWS_PER_DAY
    before, after = (day_of_voltages(env, CONTROLLERS[name](env), row) for name in ("zero", args.policy))
    draw(env, before, after, "optimal dispatch" if args.policy == "opf" else args.policy, args.out)


if __name__ == "__main__":
    main()
