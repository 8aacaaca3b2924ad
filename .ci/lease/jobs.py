"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

END = 1650.0  # seconds after asking; no checkpoints come home

# MACPO in the study of limits, with more recovery at the end (docs/appendix/preregistration.md, form h).
FORM_H = "--cost-value-clip=inf --cost-margin=0.9 --cost-estimate=rate --episode-starts=spread --limit-lr=0.1"
FORM_H += " --rollout-length=8 --log-interval=40 --kl-limit=0.02 --kl-half-life=1.7e6 --std-half-life=1e6"
FORM_H += " --std-decay-start=6e6 --limit-windup=3 --steps=10e6"


def ants(limits: str, settings: str) -> str:
    """MACPO with 20 seeds at each limit, side by side in one program."""
    where = "-m pmt_jax sweep paper/ant_2x4 --method=macpo --seed=720 --seeds=20"
    return f"{where} {settings} --set cost_limit={limits}"


# What a GPU holds at a time, and how much of it a run counts as; the others count as 1. Four GPUs make the first four.
# With eight, the others say what else may do: less recovery, and form e's trust region.
PROGRAMS = 1
WEIGHTS: dict[str, float] = {}
JOBS = {
    "cells/macpo-0.2": ants("0.2", FORM_H),
    "cells/macpo-1": ants("1", FORM_H),
    "cells/macpo-10": ants("10", FORM_H),
    "cells/macpo-late": ants("0.2", f"{FORM_H} --std-decay-start=7e6"),
    "parts/windup-1.5": ants("0.2", f"{FORM_H} --limit-windup=1.5"),
    "parts/windup-6": ants("0.2", f"{FORM_H} --limit-windup=6"),
    "parts/wide": ants("0.2", f"{FORM_H} --kl-limit=0.01 --kl-half-life=3.4e6"),
}
