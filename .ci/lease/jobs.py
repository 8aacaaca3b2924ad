"""The next lease's runs, first things first: names, and what follows `python`. One with a folder already continues."""

END = 1620.0  # seconds after asking
PROGRAMS = 2  # at a time on a GPU: with more, 20 seeds of ten million steps do not end in a lease

ANT = "-m pmt_jax train paper/ant_2x4"
MACPO = f"{ANT} --method=macpo --limit-lr=0.1"
MULTIPLIER = "--cost-estimate=average --lambda-unit=relative --lambda-lr=0.006 --lambda-max=100"
STUDY = f"{ANT} --cost-margin=0.5 --seed=460 --seeds=20 {MULTIPLIER}"
PID = "--lambda-rule=pid --lambda-kp=0.5"
GRID = "-m pmt_jax train voltage_141 --seed=94 --seeds=5 --num-envs=128 --steps=4e6 --log-interval=20 --cost-limit=1.6"
GRID += " --lambda-max=200 --lr-half-life=1e6"

# The study of limits (bench/sweeps/limits.toml) in the order of docs/appendix/preregistration.md. Between its cells:
# 141 buses until nothing moves (docs/appendix/voltage.md), on other seeds, to find the setting.
JOBS = {
    "limits/macpo-10": f"{MACPO} --seed=440 --seeds=20 --cost-limit=10 --cost-margin=0.5 --kl-limit=0.03",
    "limits/mappo_l-10": f"{STUDY} --method=mappo_l --cost-limit=10",
    "trial/macpo-margin": f"{MACPO} --seed=90 --seeds=4 --cost-limit=1 --cost-margin=0.9 --kl-limit=0.01",
    "grid/fast": f"{GRID} --lambda-unit=limit --lambda-lr=0.5",
    "limits/f4sg-10": f"{STUDY} --method=f4sg --cost-limit=10",
    "grid/slow": f"{GRID} --lambda-unit=limit --lambda-lr=0.1",
    "grid/relative": f"{GRID} --lambda-unit=relative --lambda-lr=0.02",
    "limits/r4sg-1": f"{STUDY} --method=r4sg --cost-limit=1",
    "limits/r4sg-0.2": f"{STUDY} --method=r4sg --cost-limit=0.2",
    "limits/pid-1": f"{STUDY} --method=mappo_l --cost-limit=1 {PID}",
    "limits/pid-0.2": f"{STUDY} --method=mappo_l --cost-limit=0.2 {PID}",
}
