"""The persistent compile cache, and the programs of a run."""

from __future__ import annotations

import contextlib
import functools
import os
import pathlib
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..learning import learner, sharding
from ..learning.evaluation import evaluate
from ..learning.setup import Setup
from ..learning.types import ActingState, Hyper, LearnerState, Metrics


class Programs(NamedTuple):
    """The compiled programs of a run; states have a leading [seeds].

    Attributes:
      chunk: state (which it consumes) -> the state `log_interval` updates later, and metrics [seeds, updates].
      evaluate: state -> figures of `evaluate` [seeds, episodes], under mean actions; None where the run never asks.
      take: improved [seeds] bool, best (which it consumes), state -> best, with the improved seeds' states.
    """

    chunk: Callable[[LearnerState], tuple[LearnerState, Metrics]]
    evaluate: jax.stages.Compiled | None
    take: Callable[[np.ndarray, LearnerState, LearnerState], LearnerState]


def cache_folder() -> pathlib.Path:
    """Where compiled programs are kept between starts, unless JAX was told another place."""
    home = pathlib.Path(os.environ.get("XDG_CACHE_HOME", pathlib.Path.home() / ".cache"))
    return pathlib.Path(getattr(jax.config, "jax_compilation_cache_dir", None) or home / "pmt-jax")


def use_cache() -> None:
    """Keeps compiled programs in `cache_folder()`."""
    if not getattr(jax.config, "jax_compilation_cache_dir", None):
        jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@contextlib.contextmanager
def cache_events() -> Iterator[list[str]]:
    """Yields the list that the compile cache's events (`cache_hits`, `cache_misses`, ...) are appended to."""
    events: list[str] = []

    def listen(event: str, **_: Any) -> None:
        if event.startswith("/jax/compilation_cache/"):
            events.append(event.rsplit("/", 1)[1])

    jax.monitoring.register_event_listener(listen)
    try:
        yield events
    finally:
        jax.monitoring.unregister_event_listener(listen)


def compile_run(setup: Setup, say: Callable[[str], None]) -> tuple[LearnerState, Programs]:
    """The first state of all seeds, and the compiled programs that advance and evaluate it."""
    config = setup.config
    say("compiling ...")
    begin = time.monotonic()
    hyper, keys, axes = setup.vmap_arguments
    init = _over_seeds(setup, functools.partial(learner.init, setup), axes)
    placement = sharding.placement(setup.mesh, jax.eval_shape(init, hyper, keys))
    everywhere = sharding.replicated(setup.mesh)
    state = jax.jit(init, out_shardings=placement)(hyper, keys)

    def chunk(hyper: Any, state: LearnerState) -> tuple[LearnerState, Metrics]:
        return learner.train_chunk(setup, hyper, state, config.log_interval)

    program = jax.jit(_over_seeds(setup, chunk, axes), donate_argnums=1, out_shardings=(placement, everywhere))
    with sharding.use_mesh(setup.mesh):
        lowered = program.lower(hyper, state)
    with cache_events() as events:
        compiled = lowered.compile()
    evaluation = None
    if config.eval_interval:
        program = jax.jit(evaluate_seeds(setup, config.eval_episodes, deterministic=True), out_shardings=everywhere)
        with sharding.use_mesh(setup.mesh):
            evaluation = program.lower(state).compile()
    found = "hit" if "cache_hits" in events else "miss" if events else "off"
    say(f"compiled in {time.monotonic() - begin:.1f} s (compile cache {found})")
    return state, Programs(functools.partial(compiled, hyper), evaluation, jax.jit(_take, donate_argnums=1))


def evaluate_seeds(setup: Setup, episodes: int, deterministic: bool) -> Callable[[ActingState], Metrics]:
    """`evaluate` of all seeds: state with a leading [seeds] -> metrics [seeds, episodes]."""
    hyper, _, (axis, _) = setup.vmap_arguments

    def one_seed(hyper: Hyper, state: ActingState) -> Metrics:
        return evaluate(setup, state, episodes, deterministic=deterministic, hyper=hyper)

    return functools.partial(_over_seeds(setup, one_seed, (axis, 0)), hyper)


def _over_seeds(setup: Setup, function: Callable[..., Any], axes: Any) -> Callable[..., Any]:
    return jax.vmap(function, axes, spmd_axis_name=sharding.SEED if setup.mesh else None)


def _take(improved: jax.Array, best: LearnerState, state: LearnerState) -> LearnerState:
    return jax.vmap(lambda yes, new, old: jax.tree.map(lambda x, y: jnp.where(yes, x, y), new, old))(
        improved, state, best
    )
