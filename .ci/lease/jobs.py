"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

import pathlib

END = 552.0  # seconds after asking
_gpus = pathlib.Path("/tmp/runs/gpus")  # setup.sh writes it
GPUS = _gpus.read_text().splitlines() if _gpus.exists() else ["H200"] * 8
KIND = (len(GPUS), "H200" if "H200" in GPUS[0] else "H100")

# The study of limits with cost values without a clip (docs/appendix/preregistration.md, a trial of forms).
PID = "--cost-value-clip=inf --cost-margin=0.5 --cost-estimate=average --episode-starts=spread --lambda-rule=pid"
PID += " --lambda-kp=0.5 --lambda-unit=relative --lambda-lr=0.005 --lambda-max=100 --cost-std-floor=0.1"
LOWERED = "--cost-value-clip=inf --cost-margin=0.9 --cost-estimate=rate --episode-starts=spread --limit-lr=0.1"


def ants(method: str, limits: str, seeds: tuple[int, int], settings: str, steps: float = 10e6) -> str:
    """The first seed and how many, each at each limit, side by side in one program."""
    first, many = seeds
    where = f"-m pmt_jax sweep paper/ant_2x4 --method={method} --steps={steps:.0f} --seed={first} --seeds={many}"
    return f"{where} {settings} --set cost_limit={limits}"


# The second trial: noise that halves. A GPU has 12 runs, or ten of MACPO, and time for some seven million steps.
_macpo = f"{LOWERED} --rollout-length=8 --log-interval=40 --kl-limit=0.01 --kl-half-life=3.4e6"
_cut = {"uncut": "--max-grad-norm=inf --set std_half_life=1.7e6,3.4e6", "cut": "--set std_half_life=1.7e6,3.4e6"}
_cut["uncut-others"] = "--max-grad-norm=inf --set std_half_life=0.85e6,6.8e6"
JOBS = {f"noise/{name}": ants("mappo_l", "0.2,1", (90, 3), f"{PID} {form}", 7e6) for name, form in _cut.items()}
JOBS["noise/macpo"] = ants("macpo", "0.2", (90, 5), f"{_macpo} --set std_half_life=1.7e6,3.4e6", 7e6)

# What a GPU holds at a time, and how much of it a run counts as; the others count as 1. Alone on an H200 20 x 384 ants
# make 330,000 steps/s and 60 make 460,000; an H100 makes three quarters of that.
PROGRAMS = 1
WEIGHTS: dict[str, float] = {}
