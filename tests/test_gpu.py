"""What only a GPU can show: MJX-Warp against the C engine, and a learner that computes the same as on a CPU.

pytest -m gpu tests/test_gpu.py
"""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import envs
from envs import physics
from envs.ant import corridor
from envs.physics import warp_engine
from places import DATA, ROOT
from pmt_jax import METHODS, load_config, make_setup
from pmt_jax.learning import learner
from pmt_jax.learning.evaluation import play
from pmt_jax.training.run_folder import MATMUL_PRECISION

pytestmark = pytest.mark.gpu

EPISODES = 1000


def test_warp_repeats_the_recorded_transitions():
    with np.load(DATA / "ant_reference_2x4.npz") as data:
        rows = dict(data)
    env = envs.make("ant_2x4", physics="warp")
    start = jax.vmap(env.restore)(rows["qpos0"], rows["qvel0"], rows["warm0"], rows["torso_xpos0"])
    after = jax.jit(jax.vmap(env.step))(start, rows["action"].reshape(-1, 2, 4).astype(np.float32))
    error = np.abs(np.asarray(after.carry.physics.qpos, np.float64) - rows["qpos1"]).max(axis=1)
    print(f"qpos error: median {np.median(error):.2g}, 90 % {np.quantile(error, 0.9):.2g}, largest {error.max():.2g}")
    assert np.median(error) < 1e-6 and np.quantile(error, 0.99) < 5e-5
    np.testing.assert_array_equal(after.terminated, rows["done"])
    np.testing.assert_array_equal(after.info["cost_obj"], rows["cost_obj"])
    # Of forces that the engine works out in the last substep.
    error = np.abs(np.asarray(after.info["reward_contact"]) - rows["reward_contact"])
    assert (rows["reward_contact"] < 0).any() and np.quantile(error, 0.8) < 1e-6


def on_a_cpu(script: str) -> subprocess.Popen[bytes]:
    """A script in a process without the GPU, where the C engine runs."""
    path = os.pathsep.join([str(ROOT / "tests"), str(ROOT), *sys.path])
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": path}
    return subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, env=environment, stdout=subprocess.PIPE)


def returns(task: str) -> list[float]:
    """Returns of `EPISODES` episodes of uniformly random actions, from starts that are the same on every engine."""
    env = envs.make(task)
    shape = (EPISODES, env.spec.num_agents, env.spec.action_dim)

    def act(_, t):
        return jax.random.uniform(jax.random.fold_in(jax.random.key(1), t), shape, minval=-1.0, maxval=1.0)

    return np.asarray(jax.jit(lambda: play(env, act, EPISODES))()["episode_reward"]).tolist()


def hands_on_c(out: str) -> None:
    """Writes 1,000 states of a random policy on the hands, actions, and where the C engine goes from there."""
    env = envs.make("hand_over_2x6")
    shape = (EPISODES, env.spec.num_agents, env.spec.action_dim)
    draw = functools.partial(jax.random.uniform, shape=shape, minval=-1.0, maxval=1.0)
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), EPISODES))
    keys = jax.random.split(jax.random.key(1), 20)
    roll = jax.jit(lambda state: jax.lax.scan(lambda s, key: (jax.vmap(env.step)(s, draw(key)), None), state, keys)[0])
    state, action = roll(state), draw(jax.random.key(2))
    after = jax.jit(jax.vmap(env.step))(state, action).carry.physics.qpos
    np.savez(out, action=action, after=after, **{f"raw_{k}": x for k, x in jax.vmap(env.raw)(state).items()})


def test_one_step_of_the_hands_is_that_of_c(tmp_path):
    on_a_cpu(f"from test_gpu import hands_on_c; hands_on_c({str(tmp_path / 'c.npz')!r})").communicate()
    with np.load(tmp_path / "c.npz") as file:
        rows = dict(file)
    env = envs.make("hand_over_2x6", physics="warp")
    start = jax.vmap(lambda raw: env.restore(**raw))({k[4:]: x for k, x in rows.items() if k.startswith("raw_")})
    after = jax.jit(jax.vmap(env.step))(start, rows["action"]).carry.physics.qpos
    error = np.abs(np.asarray(after) - rows["after"]).max(axis=1)
    print(f"hands: median {np.median(error):.2g}, 90 % {np.quantile(error, 0.9):.2g}, largest {error.max():.2g}")
    assert np.median(error) < 1e-5


@pytest.mark.parametrize("task", ["ant_2x4", "hand_over_2x6"])
def test_random_policy_earns_the_same_on_warp_and_c(task):
    with on_a_cpu(f"import json; from test_gpu import returns; print(json.dumps(returns({task!r})))") as process:
        ours = returns(task)
        theirs = json.loads(process.communicate()[0].splitlines()[-1])
    p = scipy.stats.ks_2samp(ours, theirs).pvalue
    print(f"{task}: mean return warp {np.mean(ours):.2f}, C {np.mean(theirs):.2f}, KS p {p:.2f}")
    assert p > 0.05


def ants(count: int) -> tuple[physics.PhysicsState, jax.Array]:
    """Ants on the ground and in the air."""
    env = envs.make("ant_2x4", physics="warp")
    start = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), count)).carry.physics
    return start, jax.random.uniform(jax.random.key(1), (count, 8), minval=-1.0, maxval=1.0)


def test_nested_vmap_is_one_batch():
    state, ctrl = ants(32)
    step = physics.make_engine(corridor.model(), substeps=5, readout={}, physics="warp").step
    flat, _ = jax.jit(jax.vmap(step))(state, ctrl)
    nested, _ = jax.jit(jax.vmap(jax.vmap(step)))(*jax.tree.map(lambda x: x.reshape(4, 8, -1), (state, ctrl)))
    np.testing.assert_allclose(nested.qpos.reshape(32, -1), flat.qpos, atol=1e-4)


@pytest.mark.parametrize(("contacts", "lost"), [(None, False), (1, True)])
def test_lost_contacts_show(contacts, lost):
    """Ants on all fours touch the floor in more than one place."""
    state, ctrl = ants(64)
    on_the_ground = physics.PhysicsState(state.qpos.at[:, 2].set(0.35), state.qvel, state.warmstart)
    engine = physics.make_engine(corridor.model(), substeps=5, readout={}, physics="warp", contacts=contacts)
    _, out = jax.jit(jax.vmap(engine.step))(on_the_ground, ctrl)
    assert bool(out["overflow"].any()) == lost


def test_training_stops_where_contacts_were_lost(cli, tmp_path, monkeypatch):
    monkeypatch.setattr(warp_engine, "_MOST_CONTACTS", 1)
    settings = ["--num-envs", 64, "--rollout-length", 64, "--steps", 4096 * 4, "--no-cache"]
    code, out, _ = cli("train", "ant_2x4", "--out", tmp_path / "x", *settings)
    assert code == 1 and "no room for all contacts" in out


@pytest.mark.parametrize("method", METHODS)
def test_learner_computes_the_same_as_on_a_cpu(method):
    """The same states in, one update: agreement to rounding (of f32, through Adam's division) in all that comes out."""
    jax.config.update("jax_default_matmul_precision", MATMUL_PRECISION)
    run = make_setup(load_config("lane", method=method, num_envs=64, rollout_length=32, hidden=(64, 64)))

    @functools.partial(jax.jit, static_argnums=1)
    def update(key, updates):
        return learner.train_chunk(run, run.hyper, learner.init(run, run.hyper, key), updates)

    found = []
    for device in (jax.devices("cpu")[0], jax.devices("gpu")[0]):
        with jax.default_device(device):
            state, metrics = update(jax.random.key(0), 1)
        found.append(jax.device_get((state.actor.params, state.critic.net.params, metrics)))
    pairs = zip(jax.tree.leaves(found[0]), jax.tree.leaves(found[1]), strict=True)
    worst = max(float(np.nanmax(np.abs(x - y) / (1e-2 + np.abs(x)), initial=0.0)) for x, y in pairs)
    print(f"{method}: largest relative difference {worst:.2g}")
    assert worst < 5e-3


def test_controls_may_come_straight_from_a_scans_inputs():
    """XLA would hand such a slice to Warp without a copy, which ended in an illegal address."""
    state, ctrl = ants(64)
    step = jax.vmap(physics.make_engine(corridor.model(), substeps=5, readout={}, physics="warp").step)
    controls = jnp.stack([ctrl, -ctrl, ctrl])
    after, _ = jax.jit(lambda state, controls: jax.lax.scan(lambda s, c: (step(s, c)[0], None), state, controls))(
        state, controls
    )
    assert np.isfinite(jax.block_until_ready(after).qpos).all()
