"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

import pathlib

END = 1630.0  # seconds after asking
_gpus = pathlib.Path("/tmp/runs/gpus")  # setup.sh writes it
GPUS = _gpus.read_text().splitlines() if _gpus.exists() else ["H200"] * 8
KIND = (len(GPUS), "H200" if "H200" in GPUS[0] else "H100")

# The study of limits with cost values without a clip (docs/appendix/preregistration.md, a trial of forms).
PID = "--cost-value-clip=inf --cost-margin=0.5 --cost-estimate=average --episode-starts=spread --lambda-rule=pid"
PID += " --lambda-kp=0.5 --lambda-unit=relative --lambda-lr=0.005 --lambda-max=100 --cost-std-floor=0.1"
PID += " --eval-interval=730 --eval-episodes=256"  # before the last tenth, which stays training's
LOWERED = "--cost-value-clip=inf --cost-margin=0.9 --cost-estimate=rate --episode-starts=spread --limit-lr=0.1"


def ants(method: str, limits: str, seeds: tuple[int, int], settings: str, steps: float = 10e6) -> str:
    """The first seed and how many, each at each limit, side by side in one program."""
    first, many = seeds
    where = f"-m pmt_jax sweep paper/ant_2x4 --method={method} --steps={steps:.0f} --seed={first} --seeds={many}"
    return f"{where} {settings} --set cost_limit={limits}"


# The trial: every combination of three switches at two limits. It is smaller where the cells follow in the same lease
# and would not end else. A GPU has 20, 24 or 40 runs.
SEEDS, STEPS = {(8, "H200"): (10, 10e6), (8, "H100"): (10, 8e6), (4, "H200"): (6, 8e6)}.get(KIND, (10, 10e6))
TRIAL = {
    f"trial/{kl_half_life}-{entropy_coef}-{limit}": ants(
        "mappo_l",
        limit,
        (90, SEEDS),
        f"{PID} --kl-half-life={kl_half_life} --set entropy_coef={entropy_coef} --set max_grad_norm=10,inf",
        STEPS,
    )
    for limit in ("0.2", "1")
    for kl_half_life in ("inf", "3.4e6")
    for entropy_coef in (("0", "-0.01") if KIND[0] > 4 else ("0,-0.01",))
}

# The cells begin when the trial has ended: `queue_runs.py` puts what `choose.py` chooses for CHOSEN. Eight GPUs hold
# one each and two programs of MACPO, four H200 hold half of a method's seeds each, four H100 have time for the trial.
CHOSEN = f"{PID} CHOSEN"
METHODS = ("mappo_l", "f4sg")
if KIND[0] > 4:
    CELLS = {f"cells/{m}-{limit}": ants(m, limit, (660, 20), CHOSEN) for m in METHODS for limit in ("0.2", "1", "10")}
    CELLS |= {
        f"macpo/{name}": ants("macpo", "0.2", (90, 10), f"{LOWERED} {form}")
        for name, form in {
            "long": "--rollout-length=32 --kl-limit=0.03 --kl-half-life=3.4e6",
            "calm-later": "--rollout-length=8 --log-interval=40 --kl-limit=0.01 --kl-half-life=6.8e6",
        }.items()
    }
elif KIND == (4, "H200"):
    CELLS = {f"cells/{m}-{first}": ants(m, "0.2,1,10", (first, 10), CHOSEN) for first in (660, 670) for m in METHODS}
else:
    CELLS = {}

# What a GPU holds at a time, and how much of it a run counts as; the others count as 1. Alone on an H200 20 x 384 ants
# make 330,000 steps/s and 60 make 460,000; an H100 makes three quarters of that.
PROGRAMS = 1
WEIGHTS: dict[str, float] = {}
JOBS = TRIAL | CELLS
