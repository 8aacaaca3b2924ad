"""The next lease's runs, first things first: names, and what follows `python`. One with a folder already continues."""

END = 1620.0  # seconds after asking
PROGRAMS = 1  # at a time on a GPU; two of 20 seeds made 295,000 steps/s on an H100

ANT = "-m pmt_jax sweep paper/ant_2x4 --set cost_limit=0.2,1 --seed=480 --seeds=20 --cost-margin=0.5"
MULTIPLIER = "--cost-estimate=average --lambda-unit=relative --lambda-lr=0.005 --lambda-max=100"
GRID = "-m pmt_jax train voltage_141 --seed=94 --seeds=5 --num-envs=128 --steps=8e6 --log-interval=20 --cost-limit=1.6"
GRID += " --lambda-unit=limit --lr-half-life=2e6"

# The study of limits (bench/sweeps/limits.toml) in the order of docs/appendix/preregistration.md: 40 trials a program.
# Then 141 buses until nothing moves (docs/appendix/voltage.md), on other seeds, to find the setting.
JOBS = {
    "limits/mappo_l": f"{ANT} --method=mappo_l {MULTIPLIER}",
    "limits/f4sg": f"{ANT} --method=f4sg {MULTIPLIER}",
    "grid/faster": f"{GRID} --lambda-lr=2 --lambda-max=2000",
    "grid/fast": f"{GRID} --lambda-lr=0.5 --lambda-max=2000",
}
