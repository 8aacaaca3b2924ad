"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

END = 1630.0  # seconds after asking

# The trial of forms (docs/appendix/preregistration.md): cost values without a clip, and what each form changes.
PID = "--cost-value-clip=inf --cost-margin=0.5 --cost-estimate=average --episode-starts=spread --lambda-rule=pid"
PID += " --lambda-kp=0.5 --lambda-unit=relative --lambda-lr=0.005 --lambda-max=100 --cost-std-floor=0.1"
PID += " --eval-interval=820 --eval-episodes=256"
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


def trial(method: str, limits: str, settings: str) -> str:
    """Ten seeds at each limit, side by side in one program."""
    where = f"-m pmt_jax sweep paper/ant_2x4 --method={method} --steps=10e6 --seed=90 --seeds=10"
    return f"{where} {settings} --set cost_limit={limits}"


# What a GPU holds at a time, and how much of it a run counts as; the others count as 1. A program of 20 x 384 ants
# makes 330,000 steps/s if it is alone, so two of them end in time, one after the other.
PROGRAMS = 1
WEIGHTS: dict[str, float] = {}
JOBS = {f"forms/{name}": trial("mappo_l", "0.2,1", f"{PID} {form}") for name, form in FORMS.items()}
JOBS |= {f"forms/{name}": trial("macpo", "0.2", f"{LOWERED} {form}") for name, form in MACPO_FORMS.items()}
