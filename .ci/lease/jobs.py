"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

END = 1630.0  # seconds after asking

# The rows of the velocity tasks' table that ended before ten million steps, from the start.
VELOCITY = {
    f"velocity/{task}-{method}": f"-m pmt_jax train velocity_{task} --preset=benchmark --method={method}"
    for task, methods in {"hopper_3x1": ("mappo_l", "f4sg", "r4sg"), "half_cheetah_6x1": ("macpo",)}.items()
    for method in methods
}

# The study of limits with a quarter of the batch and a trust region that shrinks (docs/appendix/preregistration.md).
# Two trials first: what a bound on a step halves in, and MACPO without and with fear. When one has ended, `choose.py`
# puts its cells before what is left.
SIZES = "paper/ant_2x4 --rollout-length=8 --steps=5e6 --lr-half-life=3.375e6 --log-interval=40"
SIZES += " --cost-margin=0.5 --episode-starts=spread"
RELATIVE = "--lambda-unit=relative --lambda-lr=0.0025 --lambda-max=100 --cost-estimate=average"
LOWERED = "--limit-lr=0.1 --cost-estimate=rate --kl-half-life=1.7e6"
MACPO = {"macpo": "-m pmt_jax", "macpo_fear": ".ci/lease/macpo_fear.py"}  # the method on trial needs its own program
TRIALS = {
    "multiplier": {
        "limits/trial-mappo_l": f"-m pmt_jax sweep {SIZES} --method=mappo_l {RELATIVE} --seed=90 --seeds=4"
        " --set cost_limit=0.2,1 --set kl_half_life=0.85e6,1.7e6,3.4e6"
    },
    "macpo": {
        f"limits/trial-{method}": f"{program} sweep {SIZES} --method={method} {LOWERED} --seed=90 --seeds=4"
        " --cost-limit=1 --set kl_limit=0.01,0.03"
        for method, program in MACPO.items()
    },
}

# The cells, 20 seeds of a method at a limit; a program has several limits. `choose.py` adds what a trial has chosen.
CELLS = f"sweep {SIZES} --seed=540"
WITH_MULTIPLIER = {
    f"limits/{method}": f"-m pmt_jax {CELLS} --seeds=20 --method={method} {RELATIVE} --set cost_limit=0.2,1,10"
    for method in ("f4sg", "mappo_l")
} | {
    "limits/r4sg": f"-m pmt_jax {CELLS} --seeds=10 --method=r4sg {RELATIVE} --set cost_limit=0.2,1,10,25",
    "limits/pid": f"-m pmt_jax {CELLS} --seeds=10 --method=mappo_l {RELATIVE} --lambda-rule=pid --lambda-kp=0.5"
    " --set cost_limit=0.2,1,10,25",
    "limits/mappo_l-25": f"-m pmt_jax {CELLS} --seeds=10 --method=mappo_l {RELATIVE} --set cost_limit=25",
    "limits/f4sg-25": f"-m pmt_jax {CELLS} --seeds=10 --method=f4sg {RELATIVE} --set cost_limit=25",
}
WITH_TRUST_REGION = {
    f"limits/macpo-{name}": f"{CELLS} {LOWERED} {limits}"
    for name, limits in {
        "1-0.2": "--seeds=20 --set cost_limit=0.2,1",
        "10": "--seeds=20 --set cost_limit=10",
        "25": "--seeds=10 --set cost_limit=25",
    }.items()
}
# The other ant at 10, with the settings of the cell at 10 before the batch was cut.
OTHER_ANT = {
    "limits/macpo_4x2": "-m pmt_jax train paper/ant_4x2 --method=macpo --limit-lr=0.1 --kl-limit=0.03 --seed=440"
    " --seeds=20 --cost-limit=10 --cost-margin=0.5"
}

# Table 1 of ant_2x4 where nobody can cheat (bench/sweeps/walls.toml); ten programs are about a lease of one GPU.
WALLS = {
    f"walls/{walls}-{method}": f"-m pmt_jax train paper/ant_2x4 --method={method} --env walls={walls}"
    for walls in ("costly", "solid")
    for method in ("macpo", "f4sg", "mappo_l", "happo", "mappo")
}

# Does fear pay where a limit makes harm rare? 20 fresh seeds a program (docs/appendix/preregistration.md).
FEAR = {
    f"fear/{task}-{method}": f"-m pmt_jax train velocity_{task} --preset=benchmark --method={method}"
    " --seed=100 --seeds=20 --cost-limit=0.2"
    for task in ("half_cheetah_2x3", "ant_2x4")
    for method in ("f4sg", "mappo_l")
}

# What a GPU holds at a time, and how much of it a run counts as; the others count as 1. With one GPU, VELOCITY first.
# After these: the table of limits on the other ant.
PROGRAMS = 2
BIG = ("limits/f4sg", "limits/mappo_l", "limits/macpo-1-0.2", "limits/macpo-10", *OTHER_ANT)
WEIGHTS = dict.fromkeys(VELOCITY, 0.5) | dict.fromkeys(WALLS, 0.66)
WEIGHTS |= dict.fromkeys((*BIG, *(name for trial in TRIALS.values() for name in trial)), 2)
JOBS = {name: command for trial in TRIALS.values() for name, command in trial.items()} | VELOCITY
BESIDE = OTHER_ANT | WALLS  # while trials run, if there are GPUs for it, else after them
LATER = FEAR
