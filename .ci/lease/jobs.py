"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

END = 1650.0  # seconds after asking; no checkpoints come home

# The study of limits with a slower multiplier (docs/appendix/preregistration.md, form f).
PID = "--cost-value-clip=inf --cost-margin=0.3 --cost-estimate=average --episode-starts=spread --lambda-rule=pid"
PID += " --lambda-kp=0.5 --lambda-unit=relative --lambda-max=100 --cost-std-floor=0.1"
LESS_NOISE = "--max-grad-norm=inf --std-half-life=0.75e6 --std-decay-start=7e6"
FORM_F = f"{PID} {LESS_NOISE} --lambda-lr=0.003"
MACPO = "--cost-value-clip=inf --cost-margin=0.9 --cost-estimate=rate --episode-starts=spread --limit-lr=0.1"
MACPO += " --rollout-length=8 --log-interval=40"
AS_BEFORE = f"{MACPO} --kl-limit=0.01 --kl-half-life=3.4e6 --std-half-life=0.5e6 --std-decay-start=8e6"
LATE_SHORT = f"{MACPO} --kl-limit=0.02 --kl-half-life=1.7e6 --std-half-life=1e6 --std-decay-start=7e6"


def ants(method: str, limits: str, settings: str, program: str = "-m pmt_jax") -> str:
    """20 seeds at each limit, side by side in one program."""
    where = f"{program} sweep paper/ant_2x4 --method={method} --steps=10e6 --seed=680 --seeds=20"
    return f"{where} {settings} --set cost_limit={limits}"


# What a GPU holds at a time, and how much of it a run counts as; the others count as 1. Four GPUs make the first four,
# each of which takes nearly all of the time.
PROGRAMS = 1
WEIGHTS: dict[str, float] = {}
JOBS = {
    "cells/f4sg": ants("f4sg", "0.2,1,10", FORM_F),
    "cells/mappo_l": ants("mappo_l", "0.2,1,10", FORM_F),
    "cells/macpo_fear-0.2": ants("macpo_fear", "0.2", AS_BEFORE, ".ci/lease/macpo_fear.py"),
    "cells/macpo-0.2": ants("macpo", "0.2", LATE_SHORT),
    "cells/macpo-1": ants("macpo", "1", LATE_SHORT),
    "cells/macpo-10": ants("macpo", "10", LATE_SHORT),
    "cells/control": ants("mappo_l", "10", f"--cost-value-clip=inf {LESS_NOISE}"),  # Table 1 with the same noise
    "parts/slower": ants("mappo_l", "0.2,1,10", f"{PID} {LESS_NOISE} --lambda-lr=0.002"),
}
