"""The next lease's runs, first things first: names, and what follows `python`."""

import os

END = 1620.0  # seconds after asking
PROGRAMS = 2  # at a time on a GPU: with more, 20 seeds of ten million steps do not end in a lease

PMT = ["-m", "pmt_jax"]
ANT = ["train", "paper/ant_2x4", "--cost-margin=0.5", "--seed=460", "--seeds=20"]
MULTIPLIER = "--cost-estimate=average --lambda-unit=relative --lambda-lr=0.006 --lambda-max=100".split()
PID = ["--lambda-rule=pid", "--lambda-kp=0.5"]
STARTED = "/tmp/runs/runs/limits/macpo-10/config.toml"  # from .p4/d; without it the run starts anew
MACPO = "train paper/ant_2x4 --method=macpo --seed=440 --seeds=20 --cost-limit=10 --cost-margin=0.5".split()
MACPO += "--limit-lr=0.1 --kl-limit=0.03".split()
GRID = "train voltage_141 --seed=94 --seeds=5 --num-envs=128 --steps=4e6 --log-interval=20 --cost-limit=1.6".split()

# The study of limits (bench/sweeps/limits.toml) in the order of docs/appendix/preregistration.md.
JOBS = [
    ["limits/macpo-10", *PMT, *(["train", STARTED, "--resume"] if os.path.exists(STARTED) else MACPO)],
    *(
        [f"limits/{method}-{limit}", *PMT, *ANT, *MULTIPLIER, f"--method={method}", f"--cost-limit={limit}"]
        for method, limit in (("mappo_l", 10), ("f4sg", 10))
    ),
    [
        "trial/macpo-margin",
        *PMT,
        *"train paper/ant_2x4 --method=macpo --seed=90 --seeds=4 --cost-limit=1".split(),
        *"--cost-margin=0.9 --limit-lr=0.1 --kl-limit=0.01".split(),
    ],
    # 141 buses until nothing moves (docs/tasks/voltage.md): other seeds, to find the setting.
    *(
        [
            f"grid/{name}",
            *PMT,
            *GRID,
            "--lambda-max=200",
            "--lr-half-life=1e6",
            f"--lambda-unit={unit}",
            f"--lambda-lr={lr}",
        ]
        for name, unit, lr in (("slow", "limit", 0.1), ("fast", "limit", 0.5), ("relative", "relative", 0.02))
    ),
    *(
        [f"limits/{name}-{limit}", *PMT, *ANT, *MULTIPLIER, *more, f"--method={method}", f"--cost-limit={limit}"]
        for name, method, limit, more in (
            ("r4sg", "r4sg", 1, []),
            ("r4sg", "r4sg", 0.2, []),
            ("pid", "mappo_l", 1, PID),
            ("pid", "mappo_l", 0.2, PID),
        )
    ),
]
