"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

END = 1650.0  # seconds after asking; no checkpoints come home

# MACPO in the study of limits, with noise that is left at the end (docs/appendix/preregistration.md, form i).
FORM_I = "--cost-value-clip=inf --cost-margin=0.9 --cost-estimate=rate --episode-starts=spread --limit-lr=0.1"
FORM_I += " --rollout-length=8 --log-interval=40 --kl-limit=0.02 --kl-half-life=1.7e6 --limit-windup=3 --steps=10e6"
LATE = f"{FORM_I} --std-decay-start=7e6 --std-half-life=2e6"
EARLY = f"{FORM_I} --std-decay-start=6e6 --std-half-life=3e6"


def ants(limits: str, settings: str) -> str:
    """MACPO with 20 seeds at each limit, side by side in one program."""
    where = "-m pmt_jax sweep paper/ant_2x4 --method=macpo --seed=740 --seeds=20"
    return f"{where} {settings} --set cost_limit={limits}"


# What a GPU holds at a time, and how much of it a run counts as; the others count as 1. Four GPUs make the first four,
# with eight others say what else may do: less recovery and more, form e's trust region, and noise that falls later.
PROGRAMS = 1
WEIGHTS: dict[str, float] = {}
JOBS = {
    "cells/macpo-0.2": ants("0.2", LATE),
    "cells/macpo-1": ants("1", LATE),
    "cells/macpo-10": ants("10", LATE),
    "cells/macpo-early": ants("0.2", EARLY),
    "parts/windup-1": ants("0.2", f"{LATE} --limit-windup=1"),
    "parts/windup-6": ants("0.2", f"{LATE} --limit-windup=6"),
    "parts/wide": ants("0.2", f"{LATE} --kl-limit=0.01 --kl-half-life=3.4e6"),
    "parts/later": ants("0.2", f"{FORM_I} --std-decay-start=8e6 --std-half-life=1.5e6"),
}
