"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

import pathlib

END = 1630.0  # seconds after asking
_gpus = pathlib.Path("/tmp/runs/gpus")  # setup.sh writes it
GPUS = _gpus.read_text().splitlines() if _gpus.exists() else ["H200"] * 8
FAST, MANY = "H200" in GPUS[0], len(GPUS) > 4

# The trial of forms (docs/appendix/preregistration.md): cost values without a clip, and what each form changes.
PID = "--cost-value-clip=inf --cost-margin=0.5 --cost-estimate=average --episode-starts=spread --lambda-rule=pid"
PID += " --lambda-kp=0.5 --lambda-unit=relative --lambda-lr=0.005 --lambda-max=100 --cost-std-floor=0.1"
PID += " --eval-interval=730 --eval-episodes=256"  # before the last tenth, which stays training's
LOWERED = "--cost-value-clip=inf --cost-margin=0.9 --cost-estimate=rate --episode-starts=spread --limit-lr=0.1"
QUIET, UNCUT, CALM = "--entropy-coef=-0.01", "--max-grad-norm=inf", "--kl-half-life=3.4e6"
FORMS = {  # four GPUs make eight of them
    "plain": "",
    "quiet": QUIET,
    "uncut": UNCUT,
    "quiet-uncut": f"{QUIET} {UNCUT}",
    "calm": CALM,
    "slow": "--lr-half-life=3.4e6",
    "quiet-calm": f"{QUIET} {CALM}",
    "less-noise-uncut": f"--entropy-coef=-0.003 {UNCUT}",
    "quieter": "--entropy-coef=-0.03",
    "quieter-uncut": f"--entropy-coef=-0.03 {UNCUT}",
    "uncut-calm": f"{UNCUT} {CALM}",
    "quiet-uncut-calm": f"{QUIET} {UNCUT} {CALM}",
    "quiet-floor": f"{QUIET} --cost-std-floor=0.05",
}
MACPO_FORMS = {
    "macpo-long": f"--rollout-length=32 --kl-limit=0.03 {CALM}",
    "macpo-calm-later": "--rollout-length=8 --log-interval=40 --kl-limit=0.01 --kl-half-life=6.8e6",
}


def ants(method: str, limits: str, settings: str, seeds: str, steps: str = "10e6") -> str:
    """Each seed at each limit, side by side in one program."""
    return (
        f"-m pmt_jax sweep paper/ant_2x4 --method={method} --steps={steps} {seeds} {settings} --set cost_limit={limits}"
    )


TRIAL = "--seed=90 --seeds=10"
_steps = "8e6" if MANY and not FAST else "10e6"  # eight H100 would not end the trial and its cells
_forms = {
    f"forms/{name}": ants("mappo_l", "0.2,1", f"{PID} {form}", TRIAL, _steps)
    for name, form in [*FORMS.items()][: 12 if FAST and not MANY else 8]
}
_macpo = {f"forms/{name}": ants("macpo", "0.2", f"{LOWERED} {form}", TRIAL) for name, form in MACPO_FORMS.items()}

# With eight GPUs the cells begin when the trial of forms has ended: `queue_runs.py` puts what `choose.py` chooses of
# it for CHOSEN. Four GPUs have time for the trial only.
CHOSEN = "CHOSEN"
CELLS = {
    f"cells/{method}-{limit}": ants(method, limit, CHOSEN, "--seed=660 --seeds=20")
    for method in ("mappo_l", "f4sg")
    for limit in ("0.2", "1", "10")
}

# What a GPU holds at a time, and how much of it a run counts as; the others count as 1. A program of 20 x 384 ants
# makes 330,000 steps/s alone on an H200, three together 430,000; two together make 295,000 on an H100.
PROGRAMS = 1 if MANY else 3 if FAST else 2
WEIGHTS: dict[str, float] = {}
JOBS = {**_forms, **(CELLS | _macpo if MANY else {})}
