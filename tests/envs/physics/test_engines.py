"""The engines: what they promise beyond the numbers of one task."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import threading
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs import physics
from envs.ant import corridor, walls
from envs.errors import TaskError
from envs.hands import hand_over
from envs.physics import contract, mjx_patches, thread_team, warp_engine
from envs.physics.fused import nvrtc
from paths import ROOT
from stepping import assert_batches_agree, assert_same, compiled

READOUT = {"torso": ("xpos", 1), "forces": ("cfrc_ext", slice(None))}
PLAIN = {"torso": ("xpos", 1), "motors": ("qfrc_actuator", slice(6, 14, 2))}
# The C engine steps on threads of Python where a readout needs forces after constraints, else on a native batch.
both = pytest.mark.parametrize("readout", [READOUT, PLAIN], ids=["threads", "batch"])


def engine(readout=READOUT, **options):
    return physics.make_engine(corridor.model(), substeps=5, readout=readout, **{"physics": "mujoco", **options})


def starts(count: int, seed: int = 0):
    """States [count] in the air and on the ground, moving, and random controls."""
    rng = np.random.default_rng(seed)
    qpos = np.tile(corridor.model().qpos0, (count, 1)) + rng.uniform(-0.1, 0.1, (count, 15))
    qpos[:, 2] = rng.uniform(0.3, 0.8, count)
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    qvel, ctrl = rng.normal(size=(count, 14)), rng.uniform(-1.2, 1.2, (count, 8))
    f32 = jnp.float32
    state = physics.PhysicsState(jnp.asarray(qpos, f32), jnp.asarray(qvel, f32), jnp.zeros((count, 14), f32))
    return state, jnp.asarray(ctrl, f32)


def run(script: str, timeout: float = 180.0) -> subprocess.CompletedProcess[str]:
    """A script in a process of its own, with a working directory that is not written to."""
    command = [sys.executable, "-c", textwrap.dedent(script)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=timeout, check=False)


@both
def test_numbers_do_not_depend_on_threads_order_or_neighbours(readout):
    state, ctrl = starts(37)
    lone = jax.jit(jax.vmap(engine(readout, threads=1).step))(state, ctrl)
    for threads in (2, 5):
        assert_same(lone, jax.jit(jax.vmap(engine(readout, threads=threads).step))(state, ctrl))
    back = jax.tree.map(lambda x: x[::-1], (state, ctrl))
    assert_same(lone, jax.tree.map(lambda x: x[::-1], jax.jit(jax.vmap(engine(readout, threads=2).step))(*back)))


def test_nested_vmap_unbatched_arguments_and_no_vmap_agree():
    state, ctrl = starts(6)
    assert_batches_agree(engine().step, state, ctrl)


@both
def test_c_engine_is_a_plain_loop_over_mujoco(readout):
    state, ctrl = starts(4)
    after, out = jax.vmap(engine(readout).step)(state, ctrl)
    model = corridor.model()
    data = mujoco.MjData(model)
    for i in range(4):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = state.qpos[i], state.qvel[i], ctrl[i]
        mujoco.mj_step(model, data, 5)
        mujoco.mj_rnePostConstraint(model, data)
        np.testing.assert_array_equal(after.qpos[i], data.qpos.astype(np.float32))
        np.testing.assert_array_equal(after.warmstart[i], data.qacc_warmstart.astype(np.float32))
        for name, (field, index) in readout.items():
            np.testing.assert_array_equal(out[name][i], getattr(data, field)[index].astype(np.float32))


@both
@pytest.mark.parametrize("substeps", [0, 3])
def test_a_forward_pass_makes_readouts_those_of_the_new_state(readout, substeps):
    state, ctrl = starts(3)
    readout = {**readout, "acceleration": ("qacc", slice(None))}
    made = physics.make_engine(corridor.model(), substeps=substeps, readout=readout, forward=True, physics="mujoco")
    after, out = jax.vmap(made.step)(state, ctrl)
    model = corridor.model()
    data = mujoco.MjData(model)
    for i in range(3):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = state.qpos[i], state.qvel[i], ctrl[i]
        mujoco.mj_step(model, data, substeps)
        mujoco.mj_forward(model, data)
        mujoco.mj_rnePostConstraint(model, data)
        np.testing.assert_array_equal(after.qpos[i], data.qpos.astype(np.float32))
        for name, (field, index) in readout.items():
            np.testing.assert_array_equal(out[name][i], getattr(data, field)[index].astype(np.float32))
    np.testing.assert_array_equal(out["torso"], after.qpos[:, :3])  # which RK4 alone leaves a stage behind


@compiled
def test_auto_takes_fused_for_steps_with_a_forward_pass():
    assert contract.obstacle("fused", corridor.model(), {}, forward=True) is None
    assert physics.resolve("auto", corridor.model(), {}, forward=True) == "fused"


@both
def test_broken_rows_stay_broken_and_leave_their_neighbours_alone(readout, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    state, ctrl = starts(8)
    step = jax.jit(jax.vmap(engine(readout, threads=1).step))
    healthy = step(state, ctrl)
    broken = physics.PhysicsState(
        state.qpos.at[2, 4].set(jnp.nan), state.qvel.at[4].set(1e9).at[5, 0].set(3e38), state.warmstart
    )
    after, out = step(broken, ctrl.at[6, 0].set(jnp.inf))
    assert not np.isfinite(after.qpos[2]).any() and not np.isfinite(after.qpos[6]).any()
    for row in (4, 5):  # blows up on the way; C would reset it without a word
        assert not (np.isfinite(after.qpos[row]).all() and np.abs(after.qpos[row]).max() < 1e3)
    for row in (0, 1, 3, 7):
        assert_same(
            jax.tree.map(lambda x, row=row: x[row], (after, out)), jax.tree.map(lambda x, row=row: x[row], healthy)
        )
    assert_same(step(state, ctrl), healthy)
    assert not list(tmp_path.iterdir()), "MuJoCo wrote its log into the working directory"


@pytest.mark.full
def test_large_batches_in_long_programs_do_not_deadlock():
    step = jax.vmap(jax.vmap(engine(threads=2).step))
    state, ctrl = jax.tree.map(lambda x: x.reshape(2, 1024, -1), starts(2048))

    @jax.jit
    def roll(state):
        return jax.lax.scan(lambda s, _: (step(s, ctrl)[0], None), state, None, length=3)[0]

    assert np.isfinite(jax.block_until_ready(roll(state)).qpos).all()


@both
def test_two_programs_at_once_share_the_threads(readout):
    state, ctrl = starts(24)
    step = jax.jit(jax.vmap(engine(readout, threads=3).step))
    alone = step(state, ctrl)
    results = []
    threads = [threading.Thread(target=lambda: results.append(step(state, ctrl))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 4
    for result in results:
        assert_same(result, alone)


def test_team_does_each_piece_once_and_leaves_nobody_behind():
    team = thread_team.Team()
    for threads in (1, 2, 5):
        queue, taken, at_work = iter(range(50)), [], []

        def work(queue=queue, taken=taken, at_work=at_work):
            at_work.append(None)
            for piece in queue:
                time.sleep(1e-4)
                taken.append(piece)
            at_work.pop()

        team.share(work, queue, threads)
        assert sorted(taken) == list(range(50)) and not at_work


def test_calls_at_the_same_time_have_helpers_of_their_own():
    team, everyone, done = thread_team.Team(), threading.Barrier(4), []

    def call():
        team.share(lambda: done.append(everyone.wait(60)), iter(()), 2)  # nobody passes before all four are there

    callers = [threading.Thread(target=call) for _ in range(2)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert sorted(done) == [0, 1, 2, 3]


@pytest.mark.parametrize("devices", [1, 3, 16])
def test_devices_share_the_threads(devices: int, monkeypatch: pytest.MonkeyPatch):
    shared = engine(PLAIN, threads=8)
    monkeypatch.setattr(jax, "local_device_count", lambda: devices)
    assert shared.runner.threads == {1: 8, 3: 3, 16: 1}[devices]


@pytest.mark.parametrize("guilty", ["the caller", "a helper"])
def test_team_passes_errors_on_and_stops(guilty):
    team, queue, caller, taken = thread_team.Team(), iter(range(1000)), threading.get_ident(), []

    def work():
        for piece in queue:
            time.sleep(1e-3)
            taken.append(piece)
            if (threading.get_ident() == caller) is (guilty == "the caller"):
                raise ZeroDivisionError(guilty)

    with pytest.raises(ZeroDivisionError, match=guilty):
        team.share(work, queue, 2)
    done = len(taken)
    time.sleep(0.02)
    assert len(taken) == done and next(queue, None) is None


@pytest.mark.full
def test_double_precision_goes_through():
    done = run("""
        import jax, numpy as np
        jax.config.update("jax_enable_x64", True)
        import envs
        env = envs.make("ant_2x4", physics="mujoco")
        state = jax.jit(env.step)(jax.jit(env.reset)(jax.random.key(0)), np.zeros((2, 4)))
        assert state.obs.dtype == state.reward.dtype == np.float64, state.obs.dtype
        print("ok")
    """)
    assert done.stdout.strip().endswith("ok"), done.stderr


ROLL = """
import os, signal, sys, threading, time
import jax, jax.numpy as jnp, envs
env = envs.make("ant_2x4", physics="mujoco", threads=2)
state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 16))
zero = jnp.zeros((16, *env.spec.action_mask.shape))
roll = jax.jit(lambda s, n: jax.lax.fori_loop(0, n, lambda _, s: jax.vmap(env.step)(s, zero), s))
jax.block_until_ready(roll(state, 2))
"""


@pytest.mark.full
@pytest.mark.parametrize("task", ["ant_2x4", "hand_over_2x6"])
def test_leaves_cleanly_while_a_program_runs(task):
    done = run(ROLL.replace("ant_2x4", task) + "later = roll(state, 100000)\nprint('leaving')\n")
    assert done.returncode == 0 and "leaving" in done.stdout, done.stderr


@pytest.mark.skipif(not hasattr(__import__("os"), "fork"), reason="no fork here")
def test_forked_child_has_its_own_threads():
    done = run("""
        import gc, os, sys
        import numpy as np
        from envs import physics
        from envs.ant import corridor
        readouts = {"forces": ("cfrc_ext", slice(None))}, {"torso": ("xpos", 1)}
        options = dict(substeps=5, physics="mujoco", threads=2)
        engines = [physics.make_engine(corridor.model(), readout=readout, **options) for readout in readouts]
        rows = np.tile(np.concatenate([corridor.model().qpos0, np.zeros(36)]), (16, 1)).astype(np.float32)
        def advance():
            out = [np.zeros((16, engine.width), np.float32) for engine in engines]
            for engine, result in zip(engines, out):
                engine.advance(rows, result)
            return np.concatenate(out, axis=1)
        ours = advance()
        child = os.fork()
        if child == 0:
            same = np.array_equal(advance(), ours)
            engines.clear()
            gc.collect()  # frees what the child inherited
            os._exit(0 if same else 1)
        assert os.waitpid(child, 0)[1] == 0
        assert np.array_equal(advance(), ours)
        print("ok")
    """)
    assert done.stdout.strip().endswith("ok"), done.stderr


@pytest.mark.full
def test_interrupt_reaches_python_between_programs():
    done = run(
        ROLL
        + textwrap.dedent("""
        threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
        begin = time.time()
        try:
            while time.time() - begin < 30:
                state = jax.block_until_ready(roll(state, 20))
        except KeyboardInterrupt:
            print("interrupted", time.time() - begin < 10)
    """)
    )
    assert done.returncode == 0 and "interrupted True" in done.stdout, done.stderr


@pytest.mark.full
def test_interrupt_inside_a_step_never_passes_for_a_result():
    """XLA runs short programs on the main thread, so Ctrl-C lands in our host function."""
    done = run(
        ROLL
        + textwrap.dedent("""
        step = jax.jit(env.step)
        one = jax.tree.map(lambda x: x[0], state)
        jax.block_until_ready(step(one, zero[0]))
        for delay in (0.3, 0.4, 0.5):
            threading.Timer(delay, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
            begin = time.time()
            try:
                while time.time() - begin < 20:
                    jax.block_until_ready(step(one, zero[0]))
                print("lost")
            except KeyboardInterrupt:
                print("interrupted")
            except (RuntimeError, ValueError) as error:  # jax 0.9 raises the one, jax 0.12 at times the other
                assert "interrupted" in str(error), error
                print("interrupted")
    """)
    )
    assert done.stdout.split().count("interrupted") == 3, done.stdout + done.stderr


def test_hooks_are_where_we_expect_them():
    mjx_patches.check_hooks()


def test_hooks_are_put_back_after_tracing():
    mjx_patches.import_mjx()
    from mujoco.mjx._src import collision_driver, solver

    before = dict(collision_driver._COLLISION_FUNC), solver._while_loop_scan
    with pytest.raises(ZeroDivisionError), mjx_patches.patched():
        assert solver._while_loop_scan is not before[1]
        raise ZeroDivisionError
    assert (collision_driver._COLLISION_FUNC, solver._while_loop_scan) == before


def test_missing_hooks_are_a_clear_error(monkeypatch):
    mjx_patches.import_mjx()
    from mujoco.mjx._src import solver

    monkeypatch.delattr(solver, "_while_loop_scan")
    with pytest.raises(TaskError, match="lacks the private hooks"):
        mjx_patches.check_hooks()


@pytest.mark.parametrize(
    ("found", "said"),
    [
        ({"mujoco": "4.0.0", "mujoco-mjx": "3.17.0"}, "found mujoco 4.0.0, mujoco-mjx 3.17.0; pip install"),
        ({"mujoco": "3.17.0", "mujoco-mjx": None}, "mujoco-mjx missing"),
        ({"mujoco": "3.17.0", "mujoco-mjx": "3.17.1"}, "of the same 3.17"),
    ],
)
def test_wrong_versions_are_refused(monkeypatch, found, said):
    monkeypatch.setattr(contract, "installed_version", found.get)
    with pytest.raises(TaskError, match=said):
        physics.check_versions()


def test_jax_that_deadlocks_is_refused(monkeypatch):
    monkeypatch.setattr(jax, "__version__", "0.10.1")
    with pytest.raises(TaskError, match="deadlocks"):
        physics.check_versions()


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="says what a CPU lacks")
def test_warp_without_a_gpu_is_one_sentence():
    with pytest.raises(TaskError, match="physics 'warp' needs an NVIDIA GPU; found cpu"):
        engine(physics="warp")
    assert physics.explain()["mujoco"] is None and physics.explain()["warp"] is not None
    assert physics.resolve("auto") == ("mujoco" if physics.obstacle("fused") else "fused")


def test_warp_without_its_package_is_one_sentence(monkeypatch):
    class Gpu:
        platform, device_kind = "gpu", "NVIDIA H200"

    monkeypatch.setattr(jax, "devices", lambda: [Gpu])
    monkeypatch.setattr(contract, "installed_version", lambda _: None)
    with pytest.raises(TaskError, match=r"needs warp-lang; found none; install it with pip install 'pmt-jax\[warp\]'"):
        physics.resolve("warp")
    monkeypatch.setattr(nvrtc, "obstacle", lambda: None)
    assert physics.resolve("auto") == "fused"
    monkeypatch.setattr(nvrtc, "obstacle", lambda: "needs NVIDIA's run-time compiler")
    assert physics.resolve("auto") == "mjx"
    with pytest.raises(TaskError, match="'fused' needs NVIDIA's run-time compiler"):
        physics.resolve("fused")
    with pytest.raises(TaskError, match="runs on CPUs only"):
        physics.resolve("mujoco")


def test_fused_on_another_accelerator_is_one_sentence(monkeypatch):
    class Gpu:
        platform, device_kind = "gpu", "AMD Instinct MI300X"

    monkeypatch.setattr(jax, "devices", lambda: [Gpu])
    with pytest.raises(TaskError, match="'fused' runs on CPUs and NVIDIA GPUs; found AMD"):
        physics.resolve("fused")
    assert physics.resolve("auto") == "mjx"


def test_on_a_gpu_warp_takes_what_fused_cannot_step(monkeypatch):
    class Gpu:
        platform, device_kind = "gpu", "NVIDIA H100"

    monkeypatch.setattr(jax, "devices", lambda: [Gpu])
    monkeypatch.setattr(nvrtc, "obstacle", lambda: None)
    monkeypatch.setattr(contract, "installed_version", lambda _: "1.18")
    assert physics.resolve("auto", walls.model()) == "fused"
    assert physics.resolve("auto", walls.model("solid")) == "fused"
    hands = hand_over.model()
    assert physics.resolve("auto", hands) == "warp"
    with pytest.raises(TaskError, match=r"cannot step this model: .* \(take 'warp'\)"):
        physics.resolve("fused", hands)


def test_room_for_contacts_in_warp():
    assert warp_engine.room(corridor.model()) == (25, 108)  # 13 pairs with the floor; 8 limits


def test_flattened_turns_any_vmap_into_one_batch():
    doubled = contract.flattened(lambda x, y: (2 * x + y, jnp.full_like(x, x.shape[0])))

    def lone(x, y):
        return jax.tree.map(lambda leaf: leaf[0], doubled(x[None], y[None]))

    x, y = jnp.arange(6.0).reshape(2, 3), jnp.arange(3.0)
    value, batch = jax.jit(jax.vmap(jax.vmap(lone), in_axes=(0, None)))(x, y)
    np.testing.assert_array_equal(value, 2 * x + y)
    np.testing.assert_array_equal(batch, np.full((2, 3), 6.0))
