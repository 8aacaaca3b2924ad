"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

END = 1650.0  # seconds after asking; no checkpoints come home

# The study of limits with steps that shorten with the noise (docs/appendix/preregistration.md, form g).
PID = "--cost-value-clip=inf --cost-margin=0.2 --cost-estimate=average --episode-starts=spread --lambda-rule=pid"
PID += " --lambda-kp=0.5 --lambda-unit=relative --lambda-max=100 --cost-std-floor=0.1"
LESS_NOISE = "--max-grad-norm=inf --std-half-life=0.5e6 --actor-lr-half-life=0.5e6 --std-decay-start=8e6 --steps=10e6"
FORM_G = f"{PID} {LESS_NOISE} --lambda-lr=0.0045"
MACPO = "--cost-value-clip=inf --cost-margin=0.9 --cost-estimate=rate --episode-starts=spread --limit-lr=0.1"
MACPO += " --rollout-length=8 --log-interval=40 --kl-limit=0.01 --kl-half-life=3.4e6 --std-half-life=1e6"
MACPO += " --steps=8e6"


def ants(method: str, limits: str, settings: str) -> str:
    """20 seeds at each limit (and of what `settings` sweep), side by side in one program."""
    where = f"-m pmt_jax sweep paper/ant_2x4 --method={method} --seed=700 --seeds=20"
    return f"{where} {settings} --set cost_limit={limits}"


# What a GPU holds at a time, and how much of it a run counts as; the others count as 1. Four GPUs make the first four,
# each of which takes nearly all of the time.
PROGRAMS = 1
WEIGHTS: dict[str, float] = {}
JOBS = {
    "cells/f4sg": ants("f4sg", "0.2,1,10", FORM_G),
    "cells/mappo_l": ants("mappo_l", "0.2,1,10", FORM_G),
    "cells/macpo": ants("macpo", "1,10", f"{MACPO} --std-decay-start=6e6"),
    "cells/macpo-0.2": ants("macpo", "0.2", f"{MACPO} --set std_decay_start=6e6,5e6"),
    "cells/control": ants("mappo_l", "10", f"--cost-value-clip=inf {LESS_NOISE}"),  # Table 1, same noise
    "parts/slower": ants("mappo_l", "0.2,1,10", f"{FORM_G} --lambda-lr=0.003"),
    "parts/long_steps": ants("mappo_l", "0.2,1,10", f"{FORM_G} --actor-lr-half-life=inf"),
}
