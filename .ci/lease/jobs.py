"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

import pathlib

END = 1630.0  # seconds after asking

# Limits with cost values that are not clipped (docs/appendix/preregistration.md).
FREE = "--cost-value-clip=inf"
PID = "--lambda-rule=pid --lambda-kp=0.5 --lambda-unit=relative --lambda-lr=0.005 --lambda-max=100"
PID += f" --cost-estimate=average --cost-std-floor=0.1 --cost-margin=0.5 --episode-starts=spread {FREE}"
LOWERED = "--limit-lr=0.1 --cost-estimate=rate --cost-margin=0.9 --episode-starts=spread --rollout-length=8"
LOWERED += f" --log-interval=40 --kl-limit=0.01 --kl-half-life=3.4e6 {FREE}"


def cell(method: str, limits: str, ant: str = "ant_2x4", seeds: int = 20, steps: str = "10e6") -> dict[str, str]:
    """A method's seeds at all limits, side by side in one program."""
    where = f"-m pmt_jax sweep paper/{ant} --method={method} --steps={steps} --seed=640 --seeds={seeds}"
    settings = LOWERED if method == "macpo" else PID
    return {f"limits/{ant}-{method}-{limits.replace(',', '-')}": f"{where} {settings} --set cost_limit={limits}"}


def other_ant(method: str) -> dict[str, str]:
    """Ten seeds at four limits on ant 4x2."""
    return cell(method, "0.2,1,10,25", ant="ant_4x2", seeds=10, steps="6e6")


GPUS = pathlib.Path("/tmp/runs/gpus")  # by setup.sh
NAMES = GPUS.read_text().splitlines() if GPUS.exists() else []
SLOW = "H100" in " ".join(NAMES)  # 60 seeds do not end in time there, 40 do
LIMITS = ["0.2,1", "10"] if SLOW else ["0.2,1,10"]
CELLS = {key: value for limits in LIMITS for m in ("mappo_l", "f4sg") for key, value in cell(m, limits).items()}
CONTROL = {"limits/control": f"-m pmt_jax train paper/ant_2x4 --method=mappo_l --seed=640 --seeds=20 {FREE}"}
# With eight GPUs MACPO's long cells must begin at once; with four they would take the place of the other ant.
LONG = cell("macpo", "1") | ({} if SLOW else cell("macpo", "10")) | other_ant("macpo")
OTHER_ANT = other_ant("mappo_l") | other_ant("f4sg") | other_ant("r4sg")
# What a GPU holds at a time, and how much of it a run counts as; the others count as 1. A program of 60 x 384 ants
# makes 470,000 steps/s if it is alone.
PROGRAMS = 1
WEIGHTS: dict[str, float] = {}
JOBS = CELLS | cell("macpo", "0.2") | CONTROL | (LONG | OTHER_ANT if len(NAMES) == 8 else OTHER_ANT | LONG)
JOBS |= cell("macpo", "10")
