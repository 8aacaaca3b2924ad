"""The impure loop: compiling, checkpoints, the run folder, loggers, processes, signals.

Imports `learning` and what lies below it."""
