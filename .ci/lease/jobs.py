"""The runs of a lease, first things first: names, and what follows `python`. One with a folder already continues."""

from __future__ import annotations

END = 1630.0  # seconds after asking

# The study of limits, a trial first (docs/appendix/preregistration.md): episodes that begin evenly spread over the time
# limit, with three rules of the multiplier and three forms of MACPO, on other seeds.
TRIAL = "-m pmt_jax sweep paper/ant_2x4 --method=mappo_l --seed=90 --seeds=5 --steps=8.4e6 --episode-starts=spread"
TRIAL += " --set cost_limit=0.2,1 --cost-margin=0.5 --lambda-max=100 --cost-estimate=average"
MACPO_TRIAL = "sweep paper/ant_2x4 --seed=90 --seeds=4 --steps=8.4e6 --episode-starts=spread"
MACPO_TRIAL += " --set kl_limit=0.01,0.03 --cost-limit=1 --cost-margin=0.5 --limit-lr=0.1"
SPREAD = {
    "limits/spread-relative": f"{TRIAL} --set cost_std_floor=0.05,0.2 --lambda-unit=relative --lambda-lr=0.005",
    "limits/spread-equal": f"{TRIAL} --set cost_std_floor=0.05,0.2 --lambda-unit=limit --lambda-lr=0.02",
    "limits/spread-pid": f"{TRIAL} --set lambda_kp=2,6 --lambda-rule=pid --lambda-unit=limit --lambda-lr=0.01",
    "limits/spread-macpo-fear": f".ci/lease/macpo_fear.py {MACPO_TRIAL} --method=macpo_fear --cost-estimate=rate",
    "limits/spread-macpo-rate": f"-m pmt_jax {MACPO_TRIAL} --method=macpo --cost-estimate=rate",
    "limits/spread-macpo-average": f"-m pmt_jax {MACPO_TRIAL} --method=macpo --cost-estimate=average",
}

# When these have ended, `choose.py` puts the cells before what is left, but for BEFORE_CELLS. Until then a GPU has one
# of the larger ones, or the three of MACPO.
TRIAL_RUNS = tuple(SPREAD)
WEIGHTS = {name: 3 for name in SPREAD if "macpo" not in name}  # as how many programs they count

AT_TEN = "--method=macpo --limit-lr=0.1 --kl-limit=0.03"  # MACPO's settings of the cell at a limit of 10
OTHER_ANT = {
    "limits/macpo_4x2": f"-m pmt_jax train paper/ant_4x2 {AT_TEN} --seed=440 --seeds=20 --cost-limit=10"
    " --cost-margin=0.5"
}

# Table 1 of ant_2x4 where nobody can cheat (bench/sweeps/walls.toml); ten programs are about a lease.
WALLS = {
    f"walls/{walls}-{method}": f"-m pmt_jax train paper/ant_2x4 --method={method} --env walls={walls}"
    for walls in ("costly", "solid")
    for method in ("macpo", "f4sg", "mappo_l", "happo", "mappo")
}

# The rows of the velocity tasks' table that ended before ten million steps, from the start.
METHODS = {"macpo": "macpo", "mappo_l": "mappo_l", "happo": "happo", "mappo": "mappo", "mixed-pid": "mixed --seed=10"}
METHODS |= {
    "integral": "mappo_l --lambda-rule=integral --lambda-kp=0",
    "f4sg": "f4sg",
    "r4sg": "r4sg",
    "mixed": "mixed",
}
ROWS = [("ant_2x4", name) for name in ("macpo", "mappo_l", "mixed-pid", "happo", "mappo")]
ROWS += [("ant_4x2", name) for name in ("integral", "happo", "mappo")]
ROWS += [("hopper_3x1", name) for name in ("macpo", "mappo_l", "f4sg", "r4sg", "mixed", "happo", "mappo")]
ROWS += [("half_cheetah_6x1", name) for name in ("macpo", "mappo_l", "happo", "mappo")]
VELOCITY = {
    f"velocity/{task}-{name}": f"-m pmt_jax train velocity_{task} --preset=benchmark --method={METHODS[name]}"
    for task, name in ROWS
}

# Does fear pay where a limit makes harm rare? 20 fresh seeds a program (docs/appendix/preregistration.md).
FEAR = {
    f"fear/{task}-{method}": f"-m pmt_jax train velocity_{task} --preset=benchmark --method={method}"
    " --seed=100 --seeds=20 --cost-limit=0.2"
    for task in ("half_cheetah_2x3", "ant_2x4")
    for method in ("f4sg", "mappo_l")
}

# All methods on the same days: the 64 episodes of the certificate and of the baselines. Few minutes a program.
GRIDS = {
    f"grids/{grid}-{method}": f"-m pmt_jax train paper/voltage_{grid} --method={method} --eval-interval=15"
    " --eval-episodes=64"
    for grid in ("141", "33")
    for method in ("mixed", "f4sg", "macpo", "r4sg", "mappo_l", "happo", "mappo")
}

# Programs at a time on a GPU (three during the trial), and the runs. After these: WALLS, the other ant, limits of 25.
PROGRAMS, JOBS = 4, SPREAD | VELOCITY | GRIDS | FEAR | OTHER_ANT
BEFORE_CELLS = VELOCITY | GRIDS  # of JOBS, those that the cells wait for
