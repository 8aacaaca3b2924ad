"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

END = 1620.0  # seconds after asking

# The study of limits (bench/sweeps/limits.toml) in the order of docs/appendix/preregistration.md: 40 trials a program.
# Then 141 buses until nothing moves (docs/appendix/voltage.md), on other seeds, to find the setting.
ANT = "-m pmt_jax sweep paper/ant_2x4 --set cost_limit=0.2,1 --seed=480 --seeds=20 --cost-margin=0.5"
MULTIPLIER = "--cost-estimate=average --lambda-unit=relative --lambda-lr=0.005 --lambda-max=100"
GRID = "-m pmt_jax train voltage_141 --seed=94 --seeds=5 --num-envs=128 --steps=8e6 --log-interval=20 --cost-limit=1.6"
GRID += " --lambda-unit=limit --lr-half-life=2e6"
LIMITS = {
    "limits/mappo_l": f"{ANT} --method=mappo_l {MULTIPLIER}",
    "limits/f4sg": f"{ANT} --method=f4sg {MULTIPLIER}",
    "grid/faster": f"{GRID} --lambda-lr=2 --lambda-max=2000",
    "grid/fast": f"{GRID} --lambda-lr=0.5 --lambda-max=2000",
}

# The velocity tasks' table: a lease holds the five light robots, or the two ants, or the humanoid.
TASKS = ("half_cheetah_2x3", "half_cheetah_6x1", "swimmer_2x1", "hopper_3x1", "walker2d_2x3")
METHODS = ("mappo", "happo", "mappo_l", "macpo", "f4sg", "r4sg", "mixed", "mappo_l --lambda-rule=pid --lambda-kp=0.5")
VELOCITY = {
    f"velocity/{task}-{method.replace(' --lambda-kp=0.5', '').replace(' --lambda-rule=', '-')}": (
        f"-m pmt_jax train velocity_{task} --preset=benchmark --method={method}"
    )
    for task in TASKS
    for method in METHODS
}

# Table 1 by one command on all GPUs, timed.
TABLE1 = {"all/table1": "-m pmt_jax reproduce table1 --budget=paper --jobs=14 --no-cache"}

# Programs at a time on a GPU, and the runs. Two programs of 20 ants' seeds made 295,000 steps/s on an H100.
PROGRAMS, JOBS = 1, LIMITS
