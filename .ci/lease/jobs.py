"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

END = 1630.0  # seconds after asking

# Limits on ant 2x4 (docs/appendix/preregistration.md): form c, half of the batch, and form a, all of it.
PID = "--lambda-rule=pid --lambda-kp=0.5 --lambda-unit=relative --lambda-max=1000"
PID += " --cost-estimate=average --cost-std-floor=0.1 --cost-margin=0.5 --episode-starts=spread"
FORMS = {"c": f"{PID} --lambda-lr=0.004 --rollout-length=16 --log-interval=20", "a": f"{PID} --lambda-lr=0.008"}


def cell(form: str, method: str, limits: str, seeds: int) -> dict[str, str]:
    """A form's seeds at all limits, side by side in one program."""
    where = f"-m pmt_jax sweep paper/ant_2x4 --method={method} --seed=600 --seeds={seeds}"
    return {f"limits/{form}-{method}": f"{where} {FORMS[form]} --set cost_limit={limits}"}


CELLS = cell("c", "mappo_l", "0.2,1,10", 20) | cell("c", "f4sg", "0.2,1,10", 20)
REGRET = cell("c", "r4sg", "0.2,1,10,25", 10)
WHOLE = cell("a", "mappo_l", "0.2,1,10", 20) | cell("a", "f4sg", "0.2,1,10", 20)
# MACPO: at all limits on ant 4x2, ten seeds, from the start; at 0.2 on ant 2x4 it continues (.p5 and .p6).
LOWERED = "--limit-lr=0.1 --cost-estimate=rate --cost-margin=0.9 --episode-starts=spread --rollout-length=8"
LOWERED += " --log-interval=40 --kl-limit=0.01 --kl-half-life=3.4e6"
MACPO = {
    "limits_4x2/macpo": f"-m pmt_jax sweep paper/ant_4x2 --method=macpo --steps=6e6 --seed=600 --seeds=10 {LOWERED}"
    " --set cost_limit=0.2,1,10,25",
    "limits/macpo-0.2": f"-m pmt_jax train paper/ant_2x4 --method=macpo --seed=560 --seeds=20 {LOWERED}"
    " --cost-limit=0.2",
}
# What a GPU holds at a time, and how much of it a run counts as; the others count as 1. A program of 60 x 384 ants
# makes 470,000 steps/s if it is alone.
PROGRAMS = 1
WEIGHTS: dict[str, float] = {}
JOBS = CELLS | MACPO | REGRET | WHOLE
