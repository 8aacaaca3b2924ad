"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

END = 1630.0  # seconds after asking

# The study of limits with the whole batch (docs/appendix/preregistration.md): 20 seeds a limit on ant 2x4, ten on 4x2.
PID = "--lambda-rule=pid --lambda-kp=0.5 --lambda-unit=relative --lambda-lr=0.005 --lambda-max=100"
PID += " --cost-estimate=average --cost-std-floor=0.1 --cost-margin=0.5 --episode-starts=spread"
CELLS = {
    f"limits/{method}": f"-m pmt_jax sweep paper/ant_2x4 --method={method} --seed=560 --seeds=20 {PID}"
    " --set cost_limit=0.2,1,10"
    for method in ("mappo_l", "f4sg")
}
# MACPO with a quarter of the batch for all ten million steps, and a margin of nine tenths.
LOWERED = "--limit-lr=0.1 --cost-estimate=rate --cost-margin=0.9 --episode-starts=spread --rollout-length=8"
LOWERED += " --log-interval=40 --kl-limit=0.01 --kl-half-life=3.4e6"
MACPO = {
    f"limits/macpo-{limit}": f"-m pmt_jax train paper/ant_2x4 --method=macpo --seed=560 --seeds=20 {LOWERED}"
    f" --cost-limit={limit}"
    for limit in ("1", "10")
}
# What Table 1's settings do with 20 seeds: the reward that the cells are compared with.
CONTROL = {"limits/control": "-m pmt_jax train paper/ant_2x4 --method=mappo_l --seed=560 --seeds=20"}
ALL_LIMITS = "--seed=560 --seeds=10 --set cost_limit=0.2,1,10,25"
OTHER_ANT = {
    f"limits_4x2/{method}": f"-m pmt_jax sweep paper/ant_4x2 --method={method} {ALL_LIMITS} {form}"
    for method, form in {"mappo_l": PID, "f4sg": PID, "macpo": LOWERED, "r4sg": PID}.items()
}
LEFT = {
    "limits/r4sg": f"-m pmt_jax sweep paper/ant_2x4 --method=r4sg {ALL_LIMITS} {PID}",
    "limits/macpo-0.2": f"-m pmt_jax train paper/ant_2x4 --method=macpo --seed=560 --seeds=20 {LOWERED}"
    " --cost-limit=0.2",
} | {
    f"limits/{method}-25": f"-m pmt_jax train paper/ant_2x4 --method={method} --seed=560 --seeds=10 {form}"
    " --cost-limit=25"
    for method, form in {"mappo_l": PID, "f4sg": PID, "macpo": LOWERED}.items()
}

# Table 1 of ant_4x2 where nobody can cheat (bench/sweeps/walls.toml).
WALLS = {
    f"walls_4x2/{walls}-{method}": f"-m pmt_jax train paper/ant_4x2 --method={method} --env walls={walls}"
    for walls in ("costly", "solid")
    for method in ("mappo_l", "f4sg", "mappo", "happo", "macpo")
}

# What a GPU holds at a time, and how much of it a run counts as; the others count as 1. A program of 60 x 384 ants
# makes 430,000 steps/s if it is alone.
PROGRAMS = 2
WEIGHTS = dict.fromkeys((*CELLS, *OTHER_ANT), 2) | dict.fromkeys(CONTROL, 1.5) | dict.fromkeys(WALLS, 0.5)
JOBS = CELLS | CONTROL | MACPO | WALLS | OTHER_ANT | LEFT
