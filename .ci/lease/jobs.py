"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

END = 1630.0  # seconds after asking

# The study of limits, a trial first (docs/appendix/preregistration.md): episodes that begin evenly spread over the time
# limit, with three rules of the multiplier and with MACPO, on other seeds.
TRIAL = "-m pmt_jax sweep paper/ant_2x4 --method=mappo_l --seed=90 --seeds=5 --steps=8.4e6 --episode-starts=spread"
TRIAL += " --set cost_limit=0.2,1 --cost-margin=0.5 --lambda-max=100 --cost-estimate=average"
SPREAD = {
    "limits/spread-relative": f"{TRIAL} --set cost_std_floor=0.05,0.2 --lambda-unit=relative --lambda-lr=0.005",
    "limits/spread-equal": f"{TRIAL} --set cost_std_floor=0.05,0.2 --lambda-unit=limit --lambda-lr=0.02",
    "limits/spread-pid": f"{TRIAL} --set lambda_kp=2,6 --lambda-rule=pid --lambda-unit=limit --lambda-lr=0.01",
    "limits/spread-macpo": "-m pmt_jax sweep paper/ant_2x4 --method=macpo --seed=90 --seeds=4 --steps=8.4e6"
    " --episode-starts=spread --set kl_limit=0.01,0.03 --cost-limit=1 --cost-margin=0.5 --cost-estimate=average"
    " --limit-lr=0.1",
}

# The cells (bench/sweeps/limits.toml), with the settings that the trial chooses: 40 trials a program, one on each GPU.
MULTIPLIER = "--cost-estimate=average --lambda-unit=relative --lambda-lr=0.005 --lambda-max=100 --cost-std-floor=0.1"
ANT = "-m pmt_jax sweep paper/ant_2x4 --set cost_limit=0.2,1 --seed=480 --seeds=20 --cost-margin=0.5"
CELLS = {f"limits/{method}": f"{ANT} --method={method} {MULTIPLIER}" for method in ("mappo_l", "f4sg")}
MACPO = "--method=macpo --limit-lr=0.1 --kl-limit=0.03 --seed=440 --seeds=20 --cost-limit=10 --cost-margin=0.5"
OTHER_ANT = {"limits/macpo_4x2": f"-m pmt_jax train paper/ant_4x2 {MACPO}"}

# Table 1 of ant_2x4 where nobody can cheat (bench/sweeps/walls.toml); ten programs are about a lease.
WALLS = {
    f"walls/{walls}-{method}": f"-m pmt_jax train paper/ant_2x4 --method={method} --env walls={walls}"
    for walls in ("costly", "solid")
    for method in ("macpo", "f4sg", "mappo_l", "happo", "mappo")
}

# The velocity tasks' table. All rows have run (bench/results), but these twelve, at once, to 5.6 of ten million steps:
# one lease and a half from the start, if their checkpoints come home.
METHODS = {"macpo": "macpo", "r4sg": "r4sg", "mixed": "mixed", "f4sg": "f4sg", "mappo_l": "mappo_l"}
METHODS |= {"integral": "mappo_l --lambda-rule=integral --lambda-kp=0", "happo": "happo", "mappo": "mappo"}
ROWS = [("humanoid_9_8", name) for name in METHODS]
ROWS += [("ant_4x2", name) for name in ("mappo_l", "integral", "happo", "mappo")]
VELOCITY = {
    f"velocity/{task}-{name}": f"-m pmt_jax train velocity_{task} --preset=benchmark --method={METHODS[name]}"
    for task, name in ROWS
}

# And PID for the other methods with a multiplier on the first three tasks, which ran with the integral rule.
PID = {
    f"velocity/{task}-{method}-pid": f"-m pmt_jax train velocity_{task} --preset=benchmark --method={method} --seed=10"
    for task in ("half_cheetah_2x3", "half_cheetah_6x1", "ant_2x4")
    for method in ("r4sg", "mixed", "f4sg")
}

# Limits of 5 and 0.2, ten trials a program.
TIGHT = {
    f"tight/{task}-{method}": f"-m pmt_jax sweep velocity_{task} --preset=benchmark --method={method}"
    " --seed=20 --seeds=5 --set cost_limit=5,0.2"
    for task in ("half_cheetah_2x3", "ant_2x4")
    for method in ("macpo", "r4sg", "mixed", "f4sg", "mappo_l")
}

# Programs at a time on a GPU, and the runs, long ones first. After these: SPREAD and OTHER_ANT, CELLS, WALLS.
PROGRAMS, JOBS = 6, TIGHT | VELOCITY | PID

# One by one on the last GPU, before it takes others: what follows `python`. The training of a robot takes some 45 s.
ROBOTS = ("humanoid_9_8", "ant_2x4", "half_cheetah_2x3", "hopper_3x1", "walker2d_2x3", "swimmer_2x1")
FIRST = {f"training/{robot}": f".ci/lease/robots.py velocity_{robot},training" for robot in ROBOTS}
