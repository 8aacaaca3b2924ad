"""The next lease's runs, first things first: names, and what follows `python`."""

END = 1620.0  # seconds after asking
PROGRAMS = 2  # at a time on a GPU: with more, 20 seeds of ten million steps do not end in a lease

PMT = ["-m", "pmt_jax"]
ANT = ["train", "paper/ant_2x4", "--cost-margin=0.5"]
MULTIPLIER = "--cost-estimate=average --lambda-unit=relative --lambda-lr=0.006 --lambda-max=100".split()
SEEDS = ["--seed=460", "--seeds=20"]
MACPO = "--limit-lr=0.1 --kl-limit=0.03".split()
TRIAL = [*MACPO, "--seed=90", "--seeds=4", "--cost-limit=1"]

# The study of limits (bench/sweeps/limits.toml) in the order of docs/appendix/preregistration.md.
JOBS = [
    *(
        [f"limits/{method}-{limit}", *PMT, *ANT, *MULTIPLIER, *SEEDS, f"--method={method}", f"--cost-limit={limit}"]
        for limit in (0.2, 1)
        for method in ("mappo_l", "f4sg")
    ),
    # What may make MACPO keep a limit of 1 (docs/results/limits.md): four times the batch, or fear as the cost.
    ["trial/macpo-batch", *PMT, *ANT, *TRIAL, "--method=macpo", "--rollout-length=128"],
    ["trial/macpo-fear", ".ci/lease/macpo_fear.py", *ANT, *TRIAL, "--method=macpo_fear"],
    ["limits/macpo-10", *PMT, *ANT, *MACPO, "--seed=440", "--seeds=20", "--method=macpo", "--cost-limit=10"],
    ["limits/mappo_l-10", *PMT, *ANT, *MULTIPLIER, *SEEDS, "--method=mappo_l", "--cost-limit=10"],
]
