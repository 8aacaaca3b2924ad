"""The persistent compile cache, the programs of a run, and whether they fit into memory."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import functools
import itertools
import math
import os
import pathlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .. import tasks
from ..errors import UsageError
from ..files import to_stderr
from ..learning import debug, learner, sharding
from ..learning.evaluation import evaluate
from ..learning.maths import running_moments
from ..learning.setup import Setup
from ..learning.types import ActingState, Hyper, LearnerState, Metrics
from ..output import Say
from . import chunks, final

ANEW = "every start compiles anew"
FLOAT = 4  # bytes
KERNEL_LINES = 5.0  # seconds between two of them
KERNEL_THREADS = max(1, min(8, (os.cpu_count() or 1) - 1))  # one CPU is XLA's; Warp writes one source at a time


class Programs(NamedTuple):
    """The compiled programs of a run; states have a leading [seeds].

    Attributes:
      chunk: state, updates -> the state so many updates later, and metrics [seeds, chunks.most(config)], of which the
        first `updates` count, with those of `_health`, [seeds]. Any number up to that runs the same program.
      where_seed: chosen [seeds] bool, old (which it consumes), new -> old, with the chosen seeds' states from new.
      evaluate: state -> metrics of `evaluate` [seeds, episodes], under mean actions; None if the run never evaluates.
      measures: the names of these metrics.
      final: as `evaluate`, of the episodes that end a run (see final.py); compiled when it is called.
      close: ends what runs next to this process for them.
    """

    chunk: Callable[[LearnerState, int], tuple[LearnerState, Metrics]]
    where_seed: Callable[[np.ndarray, LearnerState, LearnerState], LearnerState]
    evaluate: Callable[[LearnerState], Metrics] | None = None
    measures: tuple[str, ...] = ()
    final: Callable[[LearnerState], Metrics] | None = None
    close: Callable[[], object] = lambda: None


def cache_folder() -> pathlib.Path:
    """Where compiled programs are kept between starts, unless JAX is set to another place."""
    chosen = getattr(jax.config, "jax_compilation_cache_dir", None)
    return pathlib.Path(chosen or tasks.native().cache_of_user())


def can_keep(folder: pathlib.Path) -> bool:
    """Whether programs can be written into the folder, which need not be there yet."""
    return os.access(next(path for path in (folder, *folder.parents) if path.exists()), os.W_OK)


def use_cache() -> None:
    """Keeps compiled programs in `cache_folder()`; nowhere if the user has no home, or one that cannot be written."""
    if not getattr(jax.config, "jax_compilation_cache_dir", None):
        try:
            folder = cache_folder()
        except RuntimeError:
            return
        if not can_keep(folder):
            to_stderr(f"compiled programs are not kept, for {folder} cannot be written; {ANEW}")
            return
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def check_memory(setup: Setup) -> None:
    """Refuses a run that cannot fit: observations of one batch, or weights and Adam's moments, exceed the memory.

    Raises:
      UsageError: names what is too large.
    """
    config, spec = setup.config, setup.vector.spec
    memory = device_memory() * (setup.mesh.size if setup.mesh else 1)
    observed = spec.num_agents * spec.obs_dim * (2 if setup.own_critics else 1)
    batch = config.batch_size * (observed + spec.state_dim)
    widths = (spec.obs_dim, *config.hidden, spec.action_dim)
    networks = 3 * spec.num_agents * sum(x * y for x, y in itertools.pairwise(widths))
    for what, floats in (
        (f"a batch of num_envs * rollout_length = {config.num_envs} * {config.rollout_length} steps", batch),
        (f"networks with hidden = {list(config.hidden)}", networks),
    ):
        needed = config.seeds * floats * FLOAT
        if needed > memory:
            raise UsageError(
                f"{what} needs at least {needed / 1e9:,.0f} GB for {config.seeds} seed(s), but there are "
                f"{memory / 1e9:,.0f} GB here; ask for less"
            )


def device_memory() -> float:
    """Bytes of one device, or of the machine if devices share its memory."""
    stats = jax.local_devices()[0].memory_stats() or {}
    if "bytes_limit" in stats or not hasattr(os, "sysconf"):  # Windows has none
        return stats.get("bytes_limit", math.inf)
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


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


def compile_run(setup: Setup, say: Say) -> tuple[LearnerState, Programs]:
    """The first state of all seeds, and the compiled programs that advance and evaluate it."""
    say(f"compiling {setup.label} on {setup.vector.spec.name} ...")
    begin = time.monotonic()
    with compiling(_kernels(setup, say), say), tasks.announcing(say):
        state, programs, found = _compile_programs(setup, say)
        later = "; the first row compiles the checks of --debug" if setup.debug else ""
        say(f"compiled in {time.monotonic() - begin:.1f} s (compile cache {found}){later}")
    return state, programs


def _compile_programs(setup: Setup, say: Say) -> tuple[LearnerState, Programs, str]:
    """`compile_run`'s state and programs, and what the compile cache had of them: hit, miss or off."""
    config = setup.config
    hyper, keys, axes = setup.vmap_arguments
    init = _over_seeds(setup, functools.partial(learner.init, setup), axes)
    placement = sharding.placement(setup.mesh, jax.eval_shape(init, hyper, keys)) if setup.mesh else None
    everywhere = sharding.replicated(setup.mesh)
    state = jax.jit(init, out_shardings=placement).lower(hyper, keys).compile(xla_options(once=True))(hyper, keys)

    def chunk(hyper: Any, state: LearnerState, updates: jax.Array) -> tuple[LearnerState, Metrics]:
        state, metrics = learner.train_some(setup, hyper, state, updates, chunks.most(config))
        return state, {**metrics, **_health(state)}

    # The state is not donated: a seed that breaks returns to it, and a run that fails saves it.
    program = jax.jit(_over_seeds(setup, chunk, (*axes, None)), out_shardings=(placement, everywhere))
    with sharding.use_mesh(setup.mesh), cache_events() as events:
        one = np.int32(1)
        compiled = debug.checked(program) if setup.debug else program.lower(hyper, state, one).compile(xla_options())
    programs = Programs(
        functools.partial(_run_chunk, compiled, hyper),
        jax.jit(where_seed, donate_argnums=1),
        final=_final(setup),
    )
    if config.eval_interval:
        say(f"compiling the evaluation, {config.eval_episodes} episodes a seed ...")
        program = jax.jit(evaluate_seeds(setup, config.eval_episodes, deterministic=True), out_shardings=everywhere)
        with sharding.use_mesh(setup.mesh):
            evaluation = program.lower(state).compile(xla_options())
        programs = programs._replace(evaluate=evaluation, measures=tuple(evaluation.out_info))
    found = "hit" if "cache_hits" in events else "miss" if events else "off"
    return state, programs, found


def _final(setup: Setup) -> Callable[[LearnerState], Metrics]:
    """See `Programs`."""
    plain = dataclasses.replace(setup, debug=False)
    function = evaluate_seeds(plain, final.episodes(setup), deterministic=True)
    program = jax.jit(function, out_shardings=sharding.replicated(setup.mesh), compiler_options=xla_options())

    def run(state: LearnerState) -> Metrics:
        with sharding.use_mesh(setup.mesh):
            return jax.device_get(program(state))

    return run


def _run_chunk(
    program: Callable[..., tuple[LearnerState, Metrics]], hyper: Hyper, state: LearnerState, updates: int
) -> tuple[LearnerState, Metrics]:
    return program(hyper, state, np.int32(updates))


def xla_options(once: bool = False) -> dict[str, str | bool] | None:
    """XLA's options for a run's programs, and for what runs `once`. Whoever sets a level in XLA_FLAGS gets that.

    On a GPU it would time several kernels for every matrix product. That took a quarter of the time to compile, and
    training was no faster for it (docs/results/speed.md). On a CPU it would optimise the code that draws the first
    weights and states for longer than that code runs. With less of it the weights are the same to the last bit, and the
    voltages of a grid to 1e-7.
    """
    backend = jax.default_backend()
    if backend == "gpu":
        option, level = "xla_gpu_autotune_level", "0"
    elif backend == "cpu" and once:
        option, level = "xla_backend_optimization_level", "1"
    else:
        return None
    return None if option in os.environ.get("XLA_FLAGS", "") else {option: level}


def _kernels(setup: Setup, say: Say) -> Sequence[Callable[[], Any]]:
    """What the physics needs besides XLA's programs."""
    try:
        return tasks.declarations(setup.vector.env).kernels()
    except Exception as error:  # found through private places of Warp; without them it compiles as it goes
        say(f"the first update compiles the physics' kernels: {error}")
        return []


@contextlib.contextmanager
def compiling(kernels: Sequence[Callable[[], Any]], say: Say) -> Iterator[None]:
    """Compiles the physics' kernels on threads while the block runs, and waits for them at its end.

    One that cannot be compiled raises when it is first launched.
    """
    begin = said = time.monotonic()
    done = itertools.count(1)

    def show(_: Any) -> None:
        nonlocal said
        count, now = next(done), time.monotonic()
        if count == len(kernels):
            say(f"{count} kernels ready after {now - begin:.1f} s")
        elif now - said >= KERNEL_LINES:
            said = now
            say(f"compiling kernels: {count} of {len(kernels)} ...")

    with concurrent.futures.ThreadPoolExecutor(KERNEL_THREADS) as pool:
        for kernel in kernels:
            pool.submit(kernel).add_done_callback(show)
        try:
            yield
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _health(state: LearnerState) -> Metrics:
    """Whether all that a seed has learned is finite, and the moments of its returns in units of reward and cost."""
    learned = [
        x for x in jax.tree.leaves(dataclasses.replace(state, rollout=None)) if jnp.issubdtype(x.dtype, jnp.floating)
    ]
    found = {"finite": jnp.stack([jnp.isfinite(x).all() for x in learned]).all()}
    for name in ("critic", "cost_critic"):
        mean, std = running_moments.centre_and_scale(getattr(state, name).returns)
        found |= {f"{name}/return_mean": mean.mean(), f"{name}/return_std": std.mean()}
    return found


def evaluate_seeds(
    setup: Setup, episodes: int, deterministic: bool, fresh: bool = False, record: bool = False
) -> Callable[[ActingState], Metrics]:
    """`evaluate` of all seeds: state with a leading [seeds] -> metrics [seeds, episodes]."""
    hyper, _, (axis, _) = setup.vmap_arguments

    def one_seed(hyper: Hyper, state: ActingState) -> Metrics:
        how = {"deterministic": deterministic, "fresh": fresh, "record": record}
        return evaluate(setup, state, episodes, hyper=hyper, **how)

    return functools.partial(_over_seeds(setup, one_seed, (axis, 0)), hyper)


def _over_seeds(setup: Setup, function: Callable[..., Any], axes: Any) -> Callable[..., Any]:
    axis_name = debug.SEEDS if setup.debug else None
    return jax.vmap(function, axes, axis_name=axis_name, spmd_axis_name=sharding.SEED if setup.mesh else None)


def where_seed(chosen: jax.Array, old: LearnerState, new: LearnerState) -> LearnerState:
    """See `Programs`."""
    return jax.vmap(lambda yes, x, y: jax.tree.map(functools.partial(jnp.where, yes), y, x))(chosen, old, new)
