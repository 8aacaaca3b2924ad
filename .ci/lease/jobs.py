"""The next lease's runs, first things first: names, and what follows `python -m`."""

END = 1620.0  # seconds after asking
PROGRAMS = 2  # at a time on a GPU: with more, 20 seeds of ten million steps do not end in a lease

ANT = ["pmt_jax", "train", "paper/ant_2x4", "--cost-margin=0.5"]
MULTIPLIER = "--cost-estimate=average --lambda-unit=relative --lambda-lr=0.006 --lambda-max=100".split()
SEEDS = ["--seed=460", "--seeds=20"]
MACPO = "--method=macpo --limit-lr=0.1 --kl-limit=0.03 --seed=440 --seeds=20".split()

# The study of limits (bench/sweeps/limits.toml) in the order of docs/appendix/preregistration.md.
JOBS = [
    *(
        [f"limits/{method}-{limit}", *ANT, *MULTIPLIER, *SEEDS, f"--method={method}", f"--cost-limit={limit}"]
        for limit in (0.2, 1)
        for method in ("mappo_l", "f4sg")
    ),
    ["limits/macpo-10", *ANT, *MACPO, "--cost-limit=10"],
    ["limits/mappo_l-10", *ANT, *MULTIPLIER, *SEEDS, "--method=mappo_l", "--cost-limit=10"],
]
