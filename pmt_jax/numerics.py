"""What of a process's environment changes numbers, or keeps JAX from computing as pmt-jax needs it.

JAX reads its settings from variables (JAX_THREEFRY_PARTITIONABLE=0). Each is of one kind: what programs cannot run with
is refused before anything is compiled (`REFUSED`), what may change numbers is recorded with a run and compared when it
continues (`RECORDED`, and every variable that is not known to be harmless), and the rest is ignored (`HARMLESS`).
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import traceback
from collections.abc import Callable, Mapping
from typing import Any

from .errors import UsageError
from .probe import NO_ANSWER, run_python

# Of these, other random numbers are drawn: a run begun with one value is another run with the other.
DRAWS = (
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_random_seed_offset",
    "jax_high_dynamic_range_gumbel",
)
# These choose other programs for the same numbers, which may differ in the last bits.
_PROGRAMS = (
    "jax_allow_f16_reductions",
    "jax_default_dtype_bits",
    "jax_disable_most_optimizations",
    "jax_exec_time_optimization_effort",
    "jax_memory_fitting_effort",
    "jax_memory_fitting_level",
    "jax_optimization_level",
    "jax_softmax_custom_jvp",
    "jax_threefry_gpu_kernel_lowering",
    "jax_use_direct_linearize",
    "jax_use_magma",
    "jax_use_shardy_partitioner",
)
RECORDED = DRAWS + _PROGRAMS

_DEBUG = "it stops JAX at values that are never used; --debug stops training at the first number that is not finite"
_STRICT = "pmt-jax and its libraries rely on JAX's usual promotion"
_HIDDEN = "arrays of small constants are moved to the device all the time"
REFUSED: dict[str, tuple[Callable[[Any], bool], str]] = {  # when it is refused, and why
    "jax_enable_x64": (bool, "pmt-jax computes in 32 bits"),
    "jax_disable_jit": (bool, "pmt-jax runs compiled programs"),
    "jax_no_tracing": (bool, "pmt-jax traces its programs"),
    "jax_no_execution": (bool, "pmt-jax runs its programs"),
    "jax_numpy_dtype_promotion": (lambda x: _plain(x) != "standard", _STRICT),
    "jax_numpy_rank_promotion": (lambda x: x == "raise", _STRICT),
    "jax_use_simplified_jaxpr_constants": (bool, "it is an experiment that JAX's own programs fail with"),
    "jax_debug_nans": (bool, _DEBUG),
    "jax_debug_infs": (bool, _DEBUG),
    "jax_debug_key_reuse": (bool, "it does not know all that pmt-jax does with keys"),
    **{
        f"jax_transfer_guard{which}": (lambda x: str(x).startswith("disallow"), _HIDDEN)
        for which in ("", "_host_to_device", "_device_to_host", "_device_to_device")
    },
    **{
        f"jax_error_checking_behavior_{which}": (lambda x: x == "raise", "its checks do not go with vmap")
        for which in ("nan", "oob", "divide")
    },
}

HARMLESS = re.compile(  # where programs run, what is logged, kept or shown; no number depends on it
    "jax_("
    "platforms|platform_name|num_cpu_devices|cuda_visible_devices|rocm_visible_devices|default_device|"
    "default_matmul_precision|"  # set and recorded by every run
    "compilation_cache_.*|persistent_cache_.*|enable_compilation_cache|raise_persistent_cache_errors|"
    "log_.*|logging_level|debug_log_modules|distributed_debug|explain_cache_misses|compiler_detailed_logging_.*|"
    "dump_ir_.*|include_.*|hlo_source_file_.*|traceback_.*|tracer_error_.*|send_traceback_.*|pprint_.*|"
    "captured_constants_.*|pallas_verbose_errors|check_.*|enable_checks|legacy_prng_key|numpy_rank_promotion|"
    "cpu_enable_async_dispatch|cpu_get_.*|cross_host_.*|share_binary_.*|enable_preemption_service|"
    "remove_custom_partitioning_ptr_from_cache_key"
    ")"
)
# Not JAX's own: XLA's options, and what NVIDIA's libraries and TPUs round by.
_VARIABLES = ("XLA_FLAGS", "LIBTPU_INIT_ARGS", "NVIDIA_TF32_OVERRIDE", "TF_CUDNN_DETERMINISTIC", "TF_DETERMINISTIC_OPS")
_PARSE_FLAGS = """
try:
    from jaxlib.xla_client import CompileOptions
except ImportError:  # another version's; then nothing is known
    raise SystemExit(0)
CompileOptions()
"""


def check() -> None:
    """Whether pmt-jax can compute in this process; to be called before anything is compiled.

    Raises:
      UsageError: a setting of JAX or XLA that programs cannot run with, or no device.
    """
    check_settings()
    check_devices()


def check_settings() -> None:
    """The first half of `check`, which starts nothing: a process may still join others afterwards.

    Raises:
      UsageError: a setting of JAX or XLA that programs cannot run with.
    """
    if found := flags_obstacle(os.environ.get("XLA_FLAGS", "")) or obstacle():
        raise UsageError(found)


def check_devices() -> None:
    """The second half of `check`, which starts JAX's backends.

    Raises:
      UsageError: JAX finds no device.
    """
    if found := device_obstacle():
        raise UsageError(found)


def obstacle() -> str | None:
    """The first of JAX's settings that programs cannot run with, in a sentence; None if there is none."""
    import jax

    for name, (refused, why) in REFUSED.items():
        value = jax.config.values.get(name)
        if value is not None and refused(value):
            setting = f"{name.upper()}={_typed(value)}"
            return f"with {setting} nothing can be trained or evaluated: {why}; unset it"
    return None


def device_obstacle() -> str | None:
    """Why JAX finds no device, in a sentence; None if it finds one. It starts JAX's backends."""
    import jax

    try:
        jax.devices()
    except Exception as error:  # a RuntimeError, or an AssertionError without words
        named = {name: os.environ[name] for name in ("JAX_PLATFORMS", "JAX_PLATFORM_NAME") if os.environ.get(name)}
        given = "".join(f" with {name}={value}" for name, value in named.items())
        reason = (str(error).splitlines() or [""])[0].partition(" (set JAX_PLATFORMS")[0].rstrip(".")
        advice = f"unset {' and '.join(named)}, or name a platform that is here" if named else "pmt doctor shows more"
        return f"JAX finds no device{given}{f': {reason}' if reason else ''}; {advice}"
    return None


@functools.cache
def flags_obstacle(flags: str) -> str | None:
    """What XLA does not take of XLA_FLAGS, in a sentence; None if it takes all. Here it would end the process."""
    failure = run_python(_PARSE_FLAGS, XLA_FLAGS=flags, JAX_PLATFORMS="cpu") if flags else None
    if failure in (None, NO_ANSWER):
        return None
    reason = failure.rpartition("] ")[2].rstrip(".") if "XLA_FLAGS" in failure else "a value does not fit its flag"
    return f"XLA does not take XLA_FLAGS={flags}: {reason}; correct or unset it"


def is_bad_variable(error: BaseException) -> bool:
    """Whether JAX raised it when it was imported, because a variable has a value that it does not take."""
    frames = traceback.extract_tb(error.__traceback__)
    return isinstance(error, ValueError) and bool(frames) and frames[-1].filename.endswith("jax/_src/config.py")


# ---------------------------------------------------------------------------------------------------------------------
# What a run records


def record() -> dict[str, Any]:
    """What may change the numbers of this process, for versions.json: JAX's settings, and variables that are set."""
    import jax

    names = {name.upper() for name in jax.config.values}
    ours = {name.upper() for name in (*RECORDED, *REFUSED)}
    other = [x for x in names & os.environ.keys() if x not in ours and not HARMLESS.fullmatch(x.lower())]
    variables = sorted({*other, *(x for x in _VARIABLES if os.environ.get(x))})
    values = {name: x for name, x in jax.config.values.items() if name in RECORDED}
    return {
        "jax_settings": {name: _plain(x) for name, x in sorted(values.items())},
        "variables": {name: os.environ[name] for name in variables},
    }


def changes(old: Mapping[str, Any], new: Mapping[str, Any], run: object) -> list[str]:
    """What of `record` differs from what a run has recorded, as `name old -> new`; of older runs nothing is known.

    Raises:
      UsageError: the run would continue with other random numbers.
    """
    found = []
    for part in ("jax_settings", "variables"):
        before, now = old.get(part), new[part]
        if not isinstance(before, dict):
            continue
        common = before.keys() & now.keys() if part == "jax_settings" else before.keys() | now.keys()
        for name in sorted(common):
            if before.get(name) == now.get(name):
                continue
            if name in DRAWS:
                raise UsageError(
                    f"the run in {run} draws its random numbers with {name.upper()}={_typed(before[name])}, not "
                    f"{_typed(now[name])}; set that variable to continue it, or choose another --out"
                )
            found.append(f"{name} {_typed(before.get(name))} -> {_typed(now.get(name))}")
    return found


def keys_of(versions: Mapping[str, Any]) -> contextlib.AbstractContextManager[object]:
    """Inside, keys are of the kind that a run has recorded in its versions.json, whatever this process draws with."""
    import jax

    settings = versions.get("jax_settings")
    kind = settings.get("jax_default_prng_impl") if isinstance(settings, dict) else None
    known = kind in ("threefry2x32", "rbg", "unsafe_rbg")
    return jax.default_prng_impl(kind) if known else contextlib.nullcontext()


def _plain(value: Any) -> bool | int | float | str:
    """A setting's value as JSON has it; some are members of an enumeration."""
    return value if isinstance(value, bool | int | float) else str(getattr(value, "value", value))


def _typed(value: Any) -> str:
    """A value as a variable has it; `unset` for one that has none."""
    if value is None:
        return "unset"
    return str(int(value) if isinstance(value, bool) else _plain(value))
