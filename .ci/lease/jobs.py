"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

END = 1650.0  # seconds after asking; no checkpoints come home

# MACPO in the study of limits, with steps that shorten with the noise (docs/appendix/preregistration.md, form j).
FORM_J = "--cost-value-clip=inf --cost-margin=0.9 --cost-estimate=rate --episode-starts=spread --limit-lr=0.1"
FORM_J += " --rollout-length=8 --log-interval=40 --kl-limit=0.02 --kl-half-life=1.7e6 --limit-windup=inf"
FORM_J += " --std-decay-start=6.6e6 --std-half-life=0.3e6 --actor-lr-half-life=0.3e6 --steps=8e6"


def ants(limits: str, settings: str) -> str:
    """MACPO with 20 seeds at each limit, side by side in one program."""
    where = "-m pmt_jax sweep paper/ant_2x4 --method=macpo --seed=740 --seeds=20"
    return f"{where} {settings} --set cost_limit={limits}"


# What a GPU holds at a time, and how much of it a run counts as; the others count as 1. Two GPUs hold all at once.
PROGRAMS = 2
WEIGHTS: dict[str, float] = {}
JOBS = {
    "cells/macpo-0.2": ants("0.2", FORM_J),
    "cells/macpo-1": ants("1", FORM_J),
    "cells/macpo-10": ants("10", FORM_J),
    "parts/windup-1": ants("0.2", f"{FORM_J} --limit-windup=1"),
}
