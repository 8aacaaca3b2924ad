"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

END = 1630.0  # seconds after asking

# Limits with a faster multiplier (docs/appendix/preregistration.md): two forms, 20 seeds a limit on ant 2x4.
INTEGRAL = "--lambda-unit=relative --lambda-lr=0.008 --lambda-max=1000"
INTEGRAL += " --cost-estimate=average --cost-std-floor=0.1 --cost-margin=0.5 --episode-starts=spread"
PID = f"{INTEGRAL} --lambda-rule=pid --lambda-kp=0.5"
FORMS = {"a": PID, "b": f"{PID} --kl-half-life=5e6"}
CELLS = {
    f"limits/{form}-{method}": f"-m pmt_jax sweep paper/ant_2x4 --method={method} --seed=600 --seeds=20 {settings}"
    " --set cost_limit=0.2,1,10"
    for form, settings in FORMS.items()
    for method in ("mappo_l", "f4sg")
}
# All methods and limits on ant 4x2, ten seeds, with the first form.
LOWERED = "--limit-lr=0.1 --cost-estimate=rate --cost-margin=0.9 --episode-starts=spread --rollout-length=8"
LOWERED += " --log-interval=40 --kl-limit=0.01 --kl-half-life=3.4e6"
ALL_LIMITS = "--steps=6e6 --seed=600 --seeds=10 --set cost_limit=0.2,1,10,25"
OTHER_ANT = {
    f"limits_4x2/{name}": f"-m pmt_jax sweep paper/ant_4x2 --method={method} {ALL_LIMITS} {form}"
    for name, method, form in (
        ("mappo_l", "mappo_l", PID),
        ("integral", "mappo_l", INTEGRAL),
        ("f4sg", "f4sg", PID),
        ("r4sg", "r4sg", PID),
        ("macpo", "macpo", LOWERED),
    )
}
# MACPO at 0.2 with the settings that keep 1.
MACPO = {
    "limits/macpo-0.2": f"-m pmt_jax train paper/ant_2x4 --method=macpo --seed=560 --seeds=20 {LOWERED}"
    " --cost-limit=0.2"
}
# Table 1 of ant_4x2 where nobody can cheat (bench/sweeps/walls.toml). MAPPO-Lagrangian has ended where walls cost.
WALLS = {
    f"walls_4x2/{walls}-{method}": f"-m pmt_jax train paper/ant_4x2 --method={method} --env walls={walls}"
    for walls, methods in {
        "solid": ("mappo_l", "f4sg", "mappo", "happo", "macpo"),
        "costly": ("f4sg", "mappo", "happo", "macpo"),
    }.items()
    for method in methods
}

# What a GPU holds at a time, and how much of it a run counts as; the others count as 1. A program of 60 x 384 ants
# makes 470,000 steps/s if it is alone.
PROGRAMS = 2
WEIGHTS = dict.fromkeys(CELLS, 2) | dict.fromkeys(WALLS, 0.4)
JOBS = OTHER_ANT | MACPO | WALLS
