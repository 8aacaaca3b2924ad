"""Pure functions of arrays, one file a topic, each with the equation it computes. Imports JAX alone."""
