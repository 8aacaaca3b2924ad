"""Everything that is traced: rollout, advantages, emotions, updates. Nothing here touches a file or a clock.

Imports `config`, `tasks` and `errors` only; `maths` holds the pure functions of arrays and imports JAX alone."""
