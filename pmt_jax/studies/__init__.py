"""Many runs: sweeps, worker processes, run logs, statistics, tables, plots, the paper's tables.

Imports `policies` and what lies below it."""
