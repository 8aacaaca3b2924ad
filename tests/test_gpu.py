"""What only a GPU can show: its engines against C's and the same bits again, and a learner that computes as on a CPU.

pytest -m gpu tests/test_gpu.py
"""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import envs
from envs import physics
from envs.ant import corridor, walls
from envs.multi_goal import models as goals
from envs.physics import warp_engine
from envs.physics.fused import gpu, threads
from envs.physics.fused.model import tables
from envs.velocity import robots
from paths import DATA, ROOT
from pmt_jax import METHODS, load_config, make_setup
from pmt_jax.learning import fused, learner, trust_region
from pmt_jax.learning.evaluation import play
from pmt_jax.learning.networks import MLP
from pmt_jax.training.run_folder import MATMUL_PRECISION
from stepping import crowded
from threads_on_cpu import compiled, runner

pytestmark = pytest.mark.gpu

EPISODES = 1000


def environment(task: str, engine: str):
    """A task on an engine; skips the test where Warp is needed and missing."""
    if engine == "warp":
        pytest.importorskip("warp")
    return envs.make(task, physics=engine)


def test_warp_repeats_the_recorded_transitions():
    with np.load(DATA / "ant_reference_2x4.npz") as data:
        rows = dict(data)
    env = environment("ant_2x4", "warp")
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


def returns(task: str, engine: str) -> list[float]:
    """Returns of `EPISODES` episodes of uniformly random actions, from starts that are the same on every engine."""
    env = envs.make(task, physics=engine)
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
    env = environment("hand_over_2x6", "warp")
    on_a_cpu(f"from test_gpu import hands_on_c; hands_on_c({str(tmp_path / 'c.npz')!r})").communicate()
    with np.load(tmp_path / "c.npz") as file:
        rows = dict(file)
    start = jax.vmap(lambda raw: env.restore(**raw))({k[4:]: x for k, x in rows.items() if k.startswith("raw_")})
    after = jax.jit(jax.vmap(env.step))(start, rows["action"]).carry.physics.qpos
    error = np.abs(np.asarray(after) - rows["after"]).max(axis=1)
    print(f"hands: median {np.median(error):.2g}, 90 % {np.quantile(error, 0.9):.2g}, largest {error.max():.2g}")
    assert np.median(error) < 1e-5


@pytest.mark.parametrize(
    ("task", "engine"),
    [("ant_2x4", "warp"), ("ant_2x4", "fused"), ("velocity_humanoid_9_8", "fused"), ("hand_over_2x6", "warp")],
)
def test_random_policy_earns_the_same_on_a_gpu_and_c(task, engine):
    environment(task, engine)
    script = f"import json; from test_gpu import returns; print(json.dumps(returns({task!r}, 'mujoco')))"
    with on_a_cpu(script) as process:
        ours = returns(task, engine)
        theirs = json.loads(process.communicate()[0].splitlines()[-1])
    p = scipy.stats.ks_2samp(ours, theirs).pvalue
    print(f"{task}: mean return {engine} {np.mean(ours):.2f}, C {np.mean(theirs):.2f}, KS p {p:.2f}")
    assert p > 0.05


def ants(count: int) -> tuple[physics.PhysicsState, jax.Array]:
    """Ants on the ground and in the air."""
    env = environment("ant_2x4", "warp")
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


@pytest.mark.parametrize(
    ("engine", "module", "most"), [("warp", warp_engine, "_MOST_CONTACTS"), ("fused", threads, "MOST_SLOTS")]
)
def test_training_stops_where_contacts_were_lost(cli, tmp_path, monkeypatch, engine, module, most):
    if engine == "warp":
        pytest.importorskip("warp")
    monkeypatch.setattr(module, most, 1)
    settings = ["--physics", engine, "--num-envs", 64, "--rollout-length", 64, "--steps", 4096 * 4, "--no-cache"]
    code, out, _ = cli("train", "ant_2x4", "--out", tmp_path / "x", *settings)
    assert code == 1 and "no room for all contacts" in out


@pytest.mark.parametrize("method", METHODS)
def test_learner_computes_the_same_as_on_a_cpu(method, monkeypatch):
    """The same states in, one update: agreement to rounding (of f32, through Adam's division) in all that comes out."""
    jax.config.update("jax_default_matmul_precision", MATMUL_PRECISION)
    run = make_setup(load_config("lane", method=method, num_envs=64, rollout_length=32, hidden=(64, 64)))

    @functools.partial(jax.jit, static_argnums=1)
    def update(key, updates):
        return learner.train_chunk(run, run.hyper, learner.init(run, run.hyper, key), updates)

    found = []
    for device in (jax.devices("cpu")[0], jax.devices("gpu")[0]):
        with jax.default_device(device), monkeypatch.context() as context:
            if device.platform == "cpu":  # the networks' kernels are compiled for what JAX has as its backend
                context.setattr(fused, "available", lambda: False)
            jax.clear_caches()  # or the program of the other device would be taken
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


# -- the engine fused --


@pytest.mark.parametrize("agents", [2, 4])
def test_fused_repeats_the_recorded_transitions(agents):
    with np.load(DATA / f"ant_reference_{agents}x{8 // agents}.npz") as data:
        rows = dict(data)
    env = envs.make(f"ant_{agents}x{8 // agents}")
    assert env.engine == "fused"
    start = jax.vmap(env.restore)(rows["qpos0"], rows["qvel0"], rows["warm0"], rows["torso_xpos0"])
    action = rows["action"].reshape(-1, agents, 8 // agents).astype(np.float32)
    after = jax.jit(jax.vmap(env.step))(start, action)
    error = np.abs(np.asarray(after.carry.physics.qpos, np.float64) - rows["qpos1"]).max(axis=1)
    print(f"qpos error: median {np.median(error):.2g}, 99 % {np.quantile(error, 0.99):.2g}, largest {error.max():.2g}")
    assert np.median(error) < 1e-6 and np.quantile(error, 0.99) < 5e-5
    np.testing.assert_array_equal(after.terminated, rows["done"])
    np.testing.assert_array_equal(after.info["cost_obj"], rows["cost_obj"])
    error = np.abs(np.asarray(after.info["reward_contact"]) - rows["reward_contact"])
    assert (rows["reward_contact"] < 0).any() and np.quantile(error, 0.99) < 1e-6


READOUT = {name: (name, slice(None)) for name in ("xpos", "xquat", "cinert", "cvel", "cfrc_ext", "qfrc_actuator")}


@functools.cache
def robot(name: str) -> tuple:
    """Tables of a robot and 200 states [n, D] that random controls lead to: qpos, qvel, warm start, ctrl."""
    ant = {"corridor": corridor.model(), "walls": walls.model("solid")}.get(name)
    model = ant or robots.model(name)
    made_of = tables(model, corridor.SUBSTEPS if ant else robots.ROBOTS[name].substeps, READOUT)
    rng, count = np.random.default_rng(0), 200
    qpos = model.qpos0 + rng.uniform(-0.1, 0.1, (count, model.nq))
    if name == "walls":
        qpos[:, 1] += rng.choice([-4.3, 4.3], count)
    if made_of.has_free:
        qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    speed, still = 0.1 * rng.normal(size=(count, model.nv)), np.zeros((count, model.nv))
    ctrl = rng.uniform(-1, 1, (31, count, model.nu)) * model.actuator_ctrlrange[:, 1]
    states, step = [jnp.asarray(x, jnp.float32) for x in (qpos, speed, still)], jax.jit(gpu.make_step(made_of))
    for controls in ctrl[:30]:
        states = step(*states, jnp.asarray(controls, jnp.float32))[:3]
    return made_of, (*states, jnp.asarray(ctrl[30], jnp.float32))


every_robot = pytest.mark.parametrize("name", ["corridor", "walls", *robots.ROBOTS])


def same(a, b) -> bool:
    """Whether two trees have the same bits, but for their shapes."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(np.ravel(x), np.ravel(y), equal_nan=True) for x, y in pairs)


@compiled
@every_robot
def test_fused_on_a_gpu_is_the_same_source_on_a_cpu(name):
    made_of, states = robot(name)
    qpos, qvel, *_, overflow, read = jax.jit(gpu.make_step(made_of))(*states)
    assert not np.asarray(overflow).any()
    found = {"qpos": qpos, "qvel": qvel}
    found["read"] = np.concatenate([np.reshape(read[field], (len(qpos), -1)) for field in made_of.readings], axis=1)
    for dtype in (np.float32, np.float64):
        right = runner(made_of, dtype)(*states)
        for field, most in (("qpos", 2e-5), ("qvel", 2e-3), ("read", 2e-2)):
            scale = np.maximum(1.0, np.abs(right[field]))
            error = (np.abs(np.asarray(found[field], np.float64) - right[field]) / scale).max(axis=1)
            print(f"{name} {dtype.__name__} {field}: median {np.median(error):.2g}, largest {error.max():.2g}")
            assert np.quantile(error, 0.95) < most


@compiled
@pytest.mark.parametrize(("name", "vases"), [("point", 2), ("point", 4), ("ant", 0), ("ant", 1), ("ant", 4)])
def test_robots_among_vases_on_a_gpu_are_the_same_source_on_a_cpu(name, vases):
    model, rows = goals.model(name, 2, vases, 1.5), crowded(name, vases, 200).astype(np.float32)
    made_of = tables(model, goals.SUBSTEPS, {"qacc": ("qacc", slice(None))}, forward=True)
    states = np.split(rows, np.cumsum([model.nq, model.nv, model.nv]), axis=1)
    qpos, qvel, _, overflow, _ = jax.jit(gpu.make_step(made_of))(*map(jnp.asarray, states))
    right = runner(made_of, np.float32)(*states)
    whole = np.asarray(overflow).ravel() == 0
    assert (~whole).mean() <= (0.09 if (name, vases) == ("ant", 4) else 0)  # as in test_fused_threads.py
    for found, expected, most in ((qpos, right["qpos"], 2e-5), (qvel, right["qvel"], 5e-3)):
        error = np.abs(np.asarray(found) - expected).max(axis=1)[whole]
        print(f"{name}, {vases} vases: median {np.median(error):.2g}, largest {error.max():.2g}")
        assert np.quantile(error, 0.9) < most


@every_robot
def test_fused_gives_the_same_bits_again_alone_and_nested(name):
    made_of, states = robot(name)
    step = jax.jit(gpu.make_step(made_of))
    found = step(*states)
    assert same(found, step(*states))
    nested = jax.jit(jax.vmap(jax.vmap(gpu.make_step(made_of))))
    assert same(found, nested(*(x.reshape(10, 20, -1) for x in states)))
    alone = step(*(x[7] for x in states))
    assert same(jax.tree.map(lambda x: x[7], found), alone)


@every_robot
def test_the_host_launches_what_xla_launches(name):
    """The name of XLA's call is its own: where this fails, `gpu.make_step` takes the second way by itself."""
    assert gpu.knows_call()
    made_of, states = robot(name)
    by_xla, by_host = (jax.jit(gpu.make_step(made_of, way)) for way in ("xla", "host"))
    assert same(by_xla(*states), by_host(*states))


def test_an_xla_without_the_call_is_noticed(monkeypatch):
    monkeypatch.setattr(gpu, "CALL", "no_such_call")
    assert not gpu.knows_call.__wrapped__()


def test_broken_states_stay_broken_and_touch_no_other():
    made_of, states = robot("humanoid")
    step = jax.jit(gpu.make_step(made_of))
    whole = step(*states)
    qpos, qvel, warm, ctrl = states
    broken = step(qpos, qvel.at[3, 5].set(jnp.nan), warm.at[5, 0].set(jnp.inf), ctrl.at[7, 2].set(-jnp.inf))
    rest = np.setdiff1d(np.arange(len(qpos)), [3, 5, 7])
    for before, after in zip(jax.tree.leaves(whole), jax.tree.leaves(broken), strict=True):
        np.testing.assert_array_equal(np.asarray(after)[rest], np.asarray(before)[rest])
    for after in jax.tree.leaves((broken[:3], broken[4])):
        assert np.isnan(np.asarray(after)[[3, 5, 7]]).all()


@pytest.mark.skipif(jax.device_count() < 2, reason="one GPU")
def test_devices_share_a_batch():
    made_of, states = robot("corridor")
    step, mesh = gpu.make_step(made_of), jax.make_mesh((2,), ("env",), (jax.sharding.AxisType.Auto,))
    parts = jax.sharding.PartitionSpec("env")
    shared = jax.jit(jax.shard_map(step, mesh=mesh, in_specs=parts, out_specs=parts, check_vma=False))
    assert same(jax.jit(step)(*states), shared(*states))


def test_a_seed_beside_others_moves_as_it_does_alone():
    env = envs.make("ant_2x4")
    assert env.engine == "fused"
    starts = jax.jit(jax.vmap(jax.vmap(env.reset)))(jax.random.split(jax.random.key(0), (3, 64)))
    keys = jax.random.split(jax.random.key(1), 3)

    def after(state, key):
        """Where 100 steps of random actions lead."""

        def step(state, key):
            return jax.vmap(env.step)(state, jax.random.uniform(key, (64, 2, 4), minval=-1.0, maxval=1.0)), None

        return jax.lax.scan(step, state, jax.random.split(key, 100))[0].carry.physics

    together = jax.jit(jax.vmap(after))(starts, keys)
    alone = jax.jit(after)(jax.tree.map(lambda x: x[1], starts), keys[1])
    assert same(jax.tree.map(lambda x: x[1], together), alone)


def test_training_repeats_bit_for_bit():
    run = make_setup(load_config("ant_2x4", num_envs=64, rollout_length=16, hidden=(64, 64)))
    assert run.vector.env.engine == "fused"
    update = jax.jit(lambda key: learner.train_chunk(run, run.hyper, learner.init(run, run.hyper, key), 3))
    first, again = (jax.device_get(update(jax.random.key(0))) for _ in range(2))
    assert same(jax.tree.map(as_numbers, first), jax.tree.map(as_numbers, again))


def as_numbers(leaf):
    return np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)


# -- the networks --


SHAPES = [  # hidden, outputs, activation, layer norm, input norm, inputs, rows: widths of whole tiles and of parts
    ((128, 128), 1, "relu", True, False, 29, 2048),
    ((128, 128), 4, "tanh", True, True, 31, 100),
    ((64,), 2, "elu", True, False, 7, 1000),
    ((256, 256, 256), 20, "relu", False, True, 400, 5000),
    ((40, 24), 3, "tanh", False, False, 5, 17),
    ((500,), 30, "relu", True, False, 600, 4097),
    ((), 3, "relu", True, False, 10, 300),
]


@pytest.fixture
def float32_products():
    """Products by XLA in float32, as in training."""
    with jax.default_matmul_precision(MATMUL_PRECISION):
        yield


def network_of(hidden, outputs, activation, layer_norm, input_norm, inputs):
    """A network whose weights are neither 0 nor 1."""
    module = MLP(hidden, outputs, 1.0, activation, layer_norm, input_norm)
    params = module.init(jax.random.key(0), jnp.zeros(inputs))
    return module, jax.tree.map(lambda x: x + 0.1 * jax.random.normal(jax.random.key(x.size), x.shape), params)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: "-".join(map(str, (shape[5], *shape[0], shape[1]))))
def test_a_networks_kernels_compute_what_xla_computes(shape, float32_products):
    *about, rows = shape
    module, params = network_of(*about)
    x, target = (jax.random.normal(jax.random.key(k), (rows, width)) for k, width in ((1, about[-1]), (2, about[1])))

    def loss(apply, params):
        out = apply(params, x)
        return jnp.mean((out - target) ** 2), out

    def both(apply):
        return jax.jit(jax.value_and_grad(functools.partial(loss, apply), has_aux=True))

    ((_, out), gradient), ((_, expected), exactly) = (
        both(apply)(params) for apply in (functools.partial(fused.apply, module), module.apply)
    )
    np.testing.assert_allclose(out, expected, rtol=0, atol=1e-5 * np.abs(expected).max())
    largest = max(np.abs(z).max() for z in jax.tree.leaves(exactly))
    errors = [np.abs(x - y) for x, y in zip(jax.tree.leaves(gradient), jax.tree.leaves(exactly), strict=True)]
    errors = np.concatenate([np.ravel(error) for error in errors]) / largest
    # A unit of relu whose input is 0 but for rounding may be on for one and off for the other, in one row of many.
    allowed = 1e-3 if "relu" in about else 5e-5
    assert errors.max() <= allowed and np.quantile(errors, 0.99) <= 5e-5
    stacked = jax.tree.map(lambda x: jnp.stack([1.1 * x, x]), params)
    beside = jax.jit(jax.vmap(functools.partial(fused.apply, module), (0, None)))(stacked, jnp.asarray(x))[1]
    assert same(beside, jax.jit(functools.partial(fused.apply, module))(params, jnp.asarray(x)))


def test_the_fisher_products_of_tensor_cores_are_those_of_float32(monkeypatch, float32_products):
    module, params = network_of((128, 128), 4, "relu", True, False, 29)
    start, unravel = jax.flatten_util.ravel_pytree(params)
    obs, step = jax.random.normal(jax.random.key(1), (4096, 29)), jax.random.normal(jax.random.key(2), start.shape)

    def policy(flat):
        mean = module.apply(unravel(flat), obs)
        return mean, jnp.ones_like(mean)

    def divergence(mean, std):
        return jnp.mean((mean - jax.lax.stop_gradient(policy(start)[0])) ** 2 / std)

    assert fused.available()
    found = jax.jit(lambda v: trust_region.fisher(policy, divergence, start)(v))(step)
    monkeypatch.setattr(trust_region.gpu, "available", lambda: False)
    expected = jax.jit(lambda v: trust_region.fisher(policy, divergence, start)(v))(step)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-5 * float(np.abs(expected).max()))


@pytest.mark.parametrize("method", ["mappo_l", "macpo", "mixed", "mappo", "ippo_l"])
def test_an_update_learns_what_xla_learns(method, monkeypatch, float32_products):
    config = load_config("lane", method=method, num_envs=32, rollout_length=16, steps=1024, log_interval=1)
    assert fused.available()
    found = jax.jit(lambda key: learner.make_train(config)(key))(jax.random.key(0))
    monkeypatch.setattr(fused, "available", lambda: False)
    expected = jax.jit(lambda key: learner.make_train(config)(key))(jax.random.key(0))
    assert found[1].keys() == expected[1].keys()
    for net in ("critic", "cost_critic", "actor"):
        pairs = zip(*(jax.tree.leaves(getattr(state, net)) for state, _ in (found, expected)), strict=True)
        for x, y in pairs:
            np.testing.assert_allclose(x, y, rtol=0, atol=2e-3 * max(1.0, float(np.abs(y).max())))
