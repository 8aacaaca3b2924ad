"""Python inside compiled programs: values, shapes, errors, threads and the compile cache."""

from __future__ import annotations

import ctypes
import functools
import gc
import operator
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.physics import host_call
from paths import ROOT


def run(script: str, timeout: float = 240.0, **environment: str) -> subprocess.CompletedProcess[str]:
    """A script in a process of its own; one that hangs fails."""
    command = [sys.executable, "-c", textwrap.dedent(script)]
    env = {**os.environ, **environment}
    return subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=timeout, check=False)


def sums(operand: np.ndarray, result: np.ndarray) -> None:
    """Sum, largest and smallest along the last axis."""
    result[..., 0], result[..., 1], result[..., 2] = operand.sum(-1), operand.max(-1), operand.min(-1)


@pytest.fixture(scope="module")
def call():
    name = host_call.register(sums)
    return lambda x: host_call.host_call(name, x, 3)


def expected(x) -> np.ndarray:
    x = np.asarray(x)
    return np.stack([x.sum(-1), x.max(-1), x.min(-1)], -1)


def test_values_with_and_without_jit_and_vmap(call):
    x = jax.random.normal(jax.random.key(0), (2, 3, 5))
    np.testing.assert_allclose(call(x[0, 0]), expected(x[0, 0]), rtol=1e-6)
    np.testing.assert_allclose(call(x), expected(x), rtol=1e-6)
    nested = jax.jit(jax.vmap(jax.vmap(call)))
    np.testing.assert_allclose(nested(x), expected(x), rtol=1e-6)
    np.testing.assert_allclose(jax.vmap(call, 1, 1)(x), expected(x), rtol=1e-6)


def test_a_batch_is_one_call():
    calls = []

    def count(operand: np.ndarray, result: np.ndarray) -> None:
        calls.append(operand.shape)
        result[:] = 0

    name = host_call.register(count)
    program = jax.vmap(jax.vmap(lambda x: host_call.host_call(name, x, 1)))
    jax.block_until_ready(jax.jit(program)(jnp.zeros((4, 6, 2))))
    assert calls == [(4, 6, 2)]


@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_dtypes(call, dtype):
    x = np.arange(-3, 9, dtype=dtype).reshape(3, 4)
    out = jax.jit(call)(x)
    assert out.dtype == dtype
    np.testing.assert_array_equal(out, expected(x))


@pytest.mark.full
def test_wide_dtypes():
    done = run("""
        import jax, jax.numpy as jnp, numpy as np
        jax.config.update("jax_enable_x64", True)
        from envs.physics import host_call
        def double(operand, result):
            result[:] = 2 * operand
        name = host_call.register(double)
        for x in (jnp.array([1e-300, 1e300]), jnp.array([2**60 + 1, -5])):
            out = jax.jit(lambda x: host_call.host_call(name, x, 2))(x)
            assert out.dtype == x.dtype and np.array_equal(out, 2 * x), (out, x)
        print("ok")
    """)
    assert done.stdout.strip() == "ok", done.stderr


@pytest.mark.parametrize("shape", [(0, 4), (3, 0, 4)])
def test_empty_batches(call, shape):
    assert jax.jit(call)(jnp.zeros(shape)).shape == (*shape[:-1], 3)
    assert jax.jit(jax.vmap(call))(jnp.zeros(shape)).shape == (*shape[:-1], 3)


def failing(error: BaseException):
    def fail(operand: np.ndarray, result: np.ndarray) -> None:
        raise error

    name = host_call.register(fail)
    return jax.jit(lambda x: host_call.host_call(name, x, 1))


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ValueError("the ant is on fire"), "ValueError: the ant is on fire"),
        (ValueError("lone \udc80 surrogate"), "ValueError: lone"),
        (KeyboardInterrupt(), "KeyboardInterrupt"),
        (SystemExit(3), "SystemExit: 3"),
        (host_call.GivenUp("enough"), "GivenUp: enough"),
    ],
)
def test_whatever_a_function_raises_is_the_programs_error(error, said):
    program = failing(error)
    for _ in range(2):  # and the process lives on
        with pytest.raises((RuntimeError, ValueError), match=said):
            jax.block_until_ready(program(jnp.zeros(2)))


def test_tracebacks_are_printed_for_mistakes_only(capfd):
    for error, printed in ((ZeroDivisionError("oops"), True), (host_call.GivenUp("enough"), False)):
        with pytest.raises((RuntimeError, ValueError)):
            jax.block_until_ready(failing(error)(jnp.zeros(2)))
        assert ("Traceback" in capfd.readouterr().err) is printed


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # ctypes prints what struck `entry`
def test_ctrl_c_on_the_way_in_is_an_error():
    """A signal that waits when XLA calls strikes at the first bytecode, which is before any `try` of ours."""
    host_call.register(sums)
    handler, messages = host_call.handlers[-1], []

    @ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(host_call.ErrorArguments))
    def create_error(arguments):
        messages.append(arguments[0].message.decode())
        return 1

    def strike(*_):
        raise KeyboardInterrupt

    api = host_call.Api(create_error=ctypes.cast(create_error, ctypes.c_void_p))
    frame = ctypes.pointer(host_call.Frame(api=ctypes.addressof(api)))
    assert handler(frame) is None
    send, before = ctypes.CDLL(None)["raise"], signal.signal(signal.SIGUSR1, strike)
    gc.disable()  # it may call Python, of hypothesis for example, which the signal would strike instead
    try:  # `map` runs no bytecode between the signal and the call
        _, answer = map(operator.call, (functools.partial(send, signal.SIGUSR1), functools.partial(handler, frame)))
    finally:
        signal.signal(signal.SIGUSR1, before)
        gc.enable()
    assert answer == 1 and messages == ["GivenUp: interrupted (Ctrl-C)"]


def test_ctrl_c_in_mid_program_never_makes_numbers_up():
    done = run("""
        import signal, jax, jax.numpy as jnp, numpy as np
        jax.config.update("jax_cpu_enable_async_dispatch", False)  # programs run on the main thread
        from envs.physics import host_call
        def strike(*_):
            raise KeyboardInterrupt
        signal.signal(signal.SIGALRM, strike)
        def arm(operand, result):
            signal.setitimer(signal.ITIMER_REAL, 2e-3)
            result[:] = operand
        def one(operand, result):
            result[:] = 1
        first, second = host_call.register(arm), host_call.register(one)
        @jax.jit
        def program(x):
            x = host_call.host_call(first, x, 400)
            x = jax.lax.fori_loop(0, 4, lambda _, m: jnp.tanh(m @ m), jnp.broadcast_to(x, (400, 400)))
            return host_call.host_call(second, x[0], 3)
        def attempt():
            try:
                out = np.asarray(program(jnp.full(400, 0.01)))
                return "number" if (out == 1).all() else "garbage"
            except (RuntimeError, ValueError) as error:
                known = "interrupted (Ctrl-C)", "KeyboardInterrupt"  # struck on the way in, or in a function
                return "error" if any(words in str(error) for words in known) else repr(error)
        seen = []
        for _ in range(20):
            try:  # the signal strikes once a round, wherever it likes: here too
                seen.append(attempt())
                signal.setitimer(signal.ITIMER_REAL, 0)
            except KeyboardInterrupt:
                seen.append("interrupt")
        print(*sorted(set(seen)))
    """)
    assert done.returncode == 0, done.stderr
    assert set(done.stdout.split()) <= {"error", "number", "interrupt"}, done.stdout + done.stderr


STRESS = """
import os, sys, threading
if "{cpus}" == "one":
    os.sched_setaffinity(0, [sorted(os.sched_getaffinity(0))[0]])
import jax, jax.numpy as jnp, numpy as np
from envs.physics import host_call
def half(operand, result):
    result[:] = 0.5 * operand
name = host_call.register(half)
weights = jax.random.normal(jax.random.key(0), (64, 64)) / 8
@jax.jit
def program(x):
    def step(x, _):
        x = jnp.tanh(x @ weights)
        return jax.vmap(lambda row: host_call.host_call(name, row, 64))(x) @ weights.T, x.mean()
    return jax.lax.scan(step, x, length=30)[0]
x = jax.random.normal(jax.random.key(1), (4096, 64))
lone = np.asarray(program(x))
results = {{}}
def work(i):
    results[i] = np.asarray(program(x))
threads = [threading.Thread(target=work, args=[i]) for i in range(3)]
for thread in threads: thread.start()
for thread in threads: thread.join()
assert np.isfinite(lone).all() and all(np.array_equal(r, lone) for r in results.values()) and len(results) == 3
print("ok")
"""


@pytest.mark.parametrize(
    "cpus",
    ["all", pytest.param("one", marks=pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="Linux"))],
)
@pytest.mark.full
def test_large_batches_among_matmuls_and_threads_do_not_deadlock(cpus):
    done = run(STRESS.format(cpus=cpus))
    assert done.stdout.strip() == "ok", done.stderr


@pytest.mark.full
def test_programs_with_calls_are_cached_on_disk(tmp_path):
    script = """
        import jax, jax.numpy as jnp
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
        from envs.physics import host_call
        events = []
        jax.monitoring.register_event_listener(lambda event, **_: events.append(event.rsplit("/", 1)[1]))
        def triple(operand, result):
            result[:] = 3 * operand
        name = host_call.register(triple)
        program = jax.jit(jax.vmap(lambda x: host_call.host_call(name, x, 2) + 1)).lower(jnp.zeros((3, 2)))
        events.clear()
        compiled = program.compile()
        print("hit" if "cache_hits" in events else "miss", float(compiled(jnp.ones((3, 2))).sum()))
    """
    said = [run(script, JAX_COMPILATION_CACHE_DIR=str(tmp_path)) for _ in range(2)]
    assert [done.stdout.split() for done in said] == [["miss", "24.0"], ["hit", "24.0"]], said


def test_xla_accepts_the_abi_we_speak():
    """XLA asks each target for its version when it is registered, and refuses those it no longer supports."""
    include = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    defined = dict(
        line.split()[1:3] for line in include.read_text().splitlines() if "API_M" in line and "#define" in line
    )
    major, minor = (int(defined[f"XLA_FFI_API_{part}"]) for part in ("MAJOR", "MINOR"))
    assert host_call.ABI[0] == major and host_call.ABI[1] <= minor
    extension, metadata = host_call.Extension(), host_call.Metadata()
    extension.type, extension.metadata = host_call.METADATA, ctypes.pointer(metadata)
    assert host_call.describe(ctypes.addressof(extension))
    assert (metadata.version.major, metadata.version.minor) == host_call.ABI
    extension.type += 1
    assert not host_call.describe(ctypes.addressof(extension))


def test_structures_are_laid_out_as_in_the_header():
    sizes = {name: ctypes.sizeof(getattr(host_call, name)) for name in ("Buffer", "Buffers", "Frame", "Version")}
    assert sizes == {"Buffer": 48, "Buffers": 40, "Frame": 128 - 8, "Version": 24}
