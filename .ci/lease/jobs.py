"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

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


CELLS = cell("mappo_l", "0.2,1,10") | cell("f4sg", "0.2,1,10")
MACPO = cell("macpo", "0.2")
CONTROL = {"limits/control": f"-m pmt_jax train paper/ant_2x4 --method=mappo_l --seed=640 --seeds=20 {FREE}"}
OTHER_ANT = other_ant("mappo_l") | other_ant("f4sg") | other_ant("r4sg") | other_ant("macpo")
# What a GPU holds at a time, and how much of it a run counts as; the others count as 1. A program of 60 x 384 ants
# makes 470,000 steps/s if it is alone.
PROGRAMS = 1
WEIGHTS: dict[str, float] = {}
JOBS = CELLS | MACPO | CONTROL | OTHER_ANT | cell("macpo", "1,10")
