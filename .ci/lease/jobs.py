"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

END = 1590.0  # seconds after asking

# The study of limits, a trial first (docs/appendix/preregistration.md): episodes that begin evenly spread over the time
# limit, with three rules of the multiplier, on other seeds.
TRIAL = "-m pmt_jax sweep paper/ant_2x4 --method=mappo_l --seed=90 --seeds=5 --steps=8.4e6 --episode-starts=spread"
TRIAL += " --set cost_limit=0.2,1 --cost-margin=0.5 --lambda-max=100 --cost-estimate=average"
SPREAD = {
    "limits/spread-relative": f"{TRIAL} --set cost_std_floor=0.05,0.2 --lambda-unit=relative --lambda-lr=0.005",
    "limits/spread-equal": f"{TRIAL} --set cost_std_floor=0.05,0.2 --lambda-unit=limit --lambda-lr=0.02",
    "limits/spread-pid": f"{TRIAL} --set lambda_kp=2,6 --lambda-rule=pid --lambda-unit=limit --lambda-lr=0.01",
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

# The velocity tasks' table, whole tasks first, what takes longest first in each. Five tasks have run (bench/results).
# After the walker: ant_4x2 and humanoid_9_8.
METHODS = {"macpo": "macpo", "r4sg": "r4sg", "mixed": "mixed", "f4sg": "f4sg", "mappo_l": "mappo_l"}
METHODS |= {"integral": "mappo_l --lambda-rule=integral --lambda-kp=0", "happo": "happo", "mappo": "mappo"}
ROBOTS = ("walker2d_2x3",)
VELOCITY = {
    f"velocity/{task}-{name}": f"-m pmt_jax train velocity_{task} --preset=benchmark --method={method}"
    for task in ROBOTS
    for name, method in METHODS.items()
}

# A lower bound of the standard deviation, a trial of 15 seeds a program (docs/appendix/preregistration.md).
TUNED = "--preset=benchmark --method=mappo_l --seed=90 --seeds=5"
BOUND = f"{TUNED} --set std_min=0,0.05,0.1"
STD = {f"std/{task}": f"-m pmt_jax sweep velocity_{task} {BOUND}" for task in ("swimmer_2x1", "hopper_3x1")}

# And an entropy bonus; on the swimmer and the hopper the runs without one are those of STD.
ENTROPY = {
    "entropy/swimmer_2x1": f"-m pmt_jax train velocity_swimmer_2x1 {TUNED} --entropy-coef=0.03",
    "entropy/hopper_3x1": f"-m pmt_jax train velocity_hopper_3x1 {TUNED} --entropy-coef=0.03",
    "entropy/walker2d_2x3": f"-m pmt_jax sweep velocity_walker2d_2x3 {TUNED} --set entropy_coef=0,0.03",
    "entropy/half_cheetah_2x3": f"-m pmt_jax sweep velocity_half_cheetah_2x3 {TUNED} --set entropy_coef=0,0.03",
}

# Programs at a time on a GPU, and the runs. After these: VELOCITY's other tasks, WALLS, OTHER_ANT, SPREAD, CELLS.
PROGRAMS, JOBS = 4, STD | ENTROPY | VELOCITY

# Alone on the machine afterwards, 25 to 40 s each; `16` is all that a word of --only may say of 16,384.
UNMEASURED = ("ant_2x4", "half_cheetah_2x3", "humanoid_9_8")
LAST = {f"bench-{task}": f"-m bench run robots --only velocity_{task},environment,16" for task in UNMEASURED}
