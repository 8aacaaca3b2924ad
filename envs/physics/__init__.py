"""One physics contract and three engines behind it. Imports MuJoCo and JAX; knows no task."""
