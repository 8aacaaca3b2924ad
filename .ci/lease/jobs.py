"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

END = 1630.0  # seconds after asking

# The study of limits, a trial first (docs/appendix/preregistration.md): MACPO with fear, whose trust region shrinks.
# When it has ended, `choose.py` puts the cells of MACPO before what is left.
FORM = "--method=macpo_fear --limit-lr=0.1 --cost-estimate=rate --episode-starts=spread"  # in the cells too, if it wins
TRIAL = {
    "limits/shrink": ".ci/lease/macpo_shrink.py sweep paper/ant_2x4 --seed=90 --seeds=4 --cost-limit=1"
    f" --cost-margin=0.5 --set kl_limit=0.03,0.06 {FORM}"
}

# Its cells of the methods with a multiplier, with the settings that the trial of spread episodes chose.
ANT = "train paper/ant_2x4 --seeds=20 --cost-margin=0.5"
RELATIVE = "--lambda-unit=relative --lambda-lr=0.005 --lambda-max=100 --cost-std-floor=0.05 --cost-estimate=average"
RELATIVE += " --episode-starts=spread"
CELLS = {
    f"limits/{method}-{limit}": f"-m pmt_jax {ANT} --method={method} --seed=480 --cost-limit={limit} {RELATIVE}"
    for limit in ("0.2", "1", "10")
    for method in ("mappo_l", "f4sg")
}
SOON = {name: command for name, command in CELLS.items() if not name.endswith("-10")}

AT_TEN = "--method=macpo --limit-lr=0.1 --kl-limit=0.03"  # MACPO's settings of the cell at a limit of 10
OTHER_ANT = {
    "limits/macpo_4x2": f"-m pmt_jax train paper/ant_4x2 {AT_TEN} --seed=440 --seeds=20 --cost-limit=10"
    " --cost-margin=0.5"
}

# Table 1 of ant_2x4 where nobody can cheat (bench/sweeps/walls.toml); ten programs are about a lease of one GPU.
WALLS = {
    f"walls/{walls}-{method}": f"-m pmt_jax train paper/ant_2x4 --method={method} --env walls={walls}"
    for walls in ("costly", "solid")
    for method in ("macpo", "f4sg", "mappo_l", "happo", "mappo")
}

# The rows of the velocity tasks' table that ended before ten million steps, from the start.
VELOCITY = {
    f"velocity/{task}-{method}": f"-m pmt_jax train velocity_{task} --preset=benchmark --method={method}"
    for task, methods in {"hopper_3x1": ("mappo_l", "f4sg", "r4sg"), "half_cheetah_6x1": ("macpo",)}.items()
    for method in methods
}

# Does fear pay where a limit makes harm rare? 20 fresh seeds a program (docs/appendix/preregistration.md).
FEAR = {
    f"fear/{task}-{method}": f"-m pmt_jax train velocity_{task} --preset=benchmark --method={method}"
    " --seed=100 --seeds=20 --cost-limit=0.2"
    for task in ("half_cheetah_2x3", "ant_2x4")
    for method in ("f4sg", "mappo_l")
}

# What a GPU holds at a time, and how much of it a run counts as; the others count as 1. A trust region is slow, so it
# is alone. With one GPU, VELOCITY first. After these: limits of 25, the table of limits on the other ant.
PROGRAMS = 2
WEIGHTS = dict.fromkeys(VELOCITY, 0.5) | dict.fromkeys((*TRIAL, "limits/macpo-1", "limits/macpo-0.2"), 2)
JOBS = TRIAL | SOON | VELOCITY | CELLS | OTHER_ANT | WALLS | FEAR
