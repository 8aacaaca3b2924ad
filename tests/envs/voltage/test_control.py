"""Voltage control against rollouts recorded from the genuine MAPDN class, and everything the recordings do not show."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.errors import TaskError
from envs.voltage import profiles
from paths import DATA, ROOT

FOLDER = DATA / "mapdn_format_case33"
ROWS_A_DAY = 480


@functools.cache
def recorded(tag: str) -> dict[str, np.ndarray]:
    with np.load(DATA / "grid_env_reference_case33.npz") as file:
        return {k.split("/")[-1]: file[k] for k in file.files if f"/{tag}/" in k}


def start_row(data: dict[str, np.ndarray]) -> int:
    day, hour, interval = data["start"]
    return int(interval + hour * 20 + day * ROWS_A_DAY)


def worst(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(np.abs(np.asarray(ours, np.float64) - theirs).max())


@pytest.mark.parametrize(
    ("tag", "options", "dtype", "tolerance"),
    [
        ("full_nonoise", {}, "float64", 1e-7),
        pytest.param("full_nonoise", {}, "float32", 1e-5, marks=pytest.mark.full),
        pytest.param("bowl", {"barrier": "bowl"}, "float64", 1e-7, marks=pytest.mark.full),
        pytest.param("history3", {"history": 3}, "float32", 1e-5, marks=pytest.mark.full),
    ],
)
def test_recorded_rollouts_are_replayed(tag: str, options: dict, dtype: str, tolerance: float) -> None:
    data = recorded(tag)
    with jax.enable_x64(dtype == "float64"):
        env = envs.make("voltage_33", noise=False, data=FOLDER, **options)
        state = jax.jit(env.restore)(start_row=start_row(data), q=data["q_prev"][0])
        actions = jnp.asarray(data["action"] / 0.8, dtype)[..., None]
        _, states = jax.jit(lambda s, a: jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, s, a))(state, actions)
        assert state.obs.dtype == dtype
    frames, flows = len(data["obs"]) - 1, len(data["vm"])
    errors = {
        "obs": max(worst(state.obs, data["obs"][0]), worst(states.obs[:frames], data["obs"][1:])),
        "state": max(
            worst(state.global_state, data["state"][0]), worst(states.global_state[:frames], data["state"][1:])
        ),
        "reward": worst(states.reward, data["reward"]),
        "vm": worst(states.carry.vm_pu[:flows], data["vm"]),
        "va": worst(np.rad2deg(states.carry.va_rad[:flows]), data["va"]),
        "pbus": worst(states.carry.p_bus[:flows], data["pbus"]),
        "qbus": worst(states.carry.q_bus[:flows], data["qbus"]),
        "line_loss": worst(states.carry.line_loss_mw[:flows], data["line_loss"].sum(axis=1)),
        "pv_next": worst(states.carry.row[-1, :6], data["pv_next"]),
        "pl_next": worst(states.carry.row[-1, 6:38], data["pl_next"]),
        **{f"info {k}": worst(states.info[k], data["info"][:, i]) for i, k in enumerate(data["info_keys"])},
    }
    print({k: f"{e:.1e}" for k, e in errors.items()})
    assert set(data["info_keys"]) == set(states.info)
    assert {k: e for k, e in errors.items() if not e <= tolerance} == {}


@functools.cache
def folder_env(**options):
    return envs.make("voltage_33", data=FOLDER, **{"noise": False, **options})


@functools.cache
def stepper(env):
    return jax.jit(env.step)


def first(env, **raw):
    return jax.jit(env.restore)(**{"start_row": 603, "q": np.zeros(env.spec.num_agents), **raw})


@pytest.mark.full
def test_specs_are_mapdns() -> None:
    small, large = envs.make("voltage_33").spec, envs.make("voltage_141").spec
    assert (small.num_agents, small.obs_dim, small.state_dim, small.horizon) == (6, 50, 144, 239)
    assert (large.num_agents, large.obs_dim, large.state_dim, large.horizon) == (22, 98, 608, 239)
    assert (small.action_dim, small.num_costs, small.cost_limit) == (1, 1, 4.8)


@pytest.mark.full
@pytest.mark.parametrize("timing", ["mapdn", "plain"])
def test_raw_is_the_inverse_of_restore_in_mid_episode_and_with_noise(timing: str) -> None:
    env = folder_env(noise=True, history=2, timing=timing)
    step = jax.jit(env.step)
    state = step(jax.jit(env.reset)(jax.random.key(3)), jnp.full((6, 1), 0.3))
    again = jax.jit(lambda state: env.restore(**env.raw(state)))(state)
    for ours, theirs in zip(
        (state.obs, state.global_state, step(state, jnp.ones((6, 1))).obs),
        (again.obs, again.global_state, step(again, jnp.ones((6, 1))).obs),
        strict=True,
    ):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.full
def test_reset_is_within_the_data_and_differs_by_key() -> None:
    env = folder_env()
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 200))
    rows = np.asarray(states.carry.start_row)
    assert rows.min() >= 0 and rows.max() + 241 < env.profiles.num_rows and len(np.unique(rows)) > 150
    assert len(np.unique(rows // ROWS_A_DAY)) == 4  # 5 whole days between first and last row, less one for the episode
    limit = 0.8 * np.asarray(jax.vmap(env.q_limit)(states.carry.row))
    share = np.asarray(states.carry.q) / limit
    assert share.min() < -0.95 and share.max() > 0.95 and np.abs(share).max() <= 1 + 1e-6
    assert not states.terminated.any() and not states.cost.any() and not states.reward.any()


@pytest.mark.full
def test_a_date_without_solution_is_drawn_again(monkeypatch: pytest.MonkeyPatch) -> None:
    keys = jax.random.split(jax.random.key(0), 16)
    env = folder_env()
    before = jax.jit(jax.vmap(env.reset))(keys).carry
    solve = env.solve_first

    def of_odd_rows(row: jax.Array, *rest: jax.Array):
        carry = solve(row, *rest)
        return dataclasses.replace(carry, line_loss_mw=jnp.where(row % 2 == 1, carry.line_loss_mw, jnp.nan))

    monkeypatch.setattr(env, "solve_first", of_odd_rows)
    after = jax.jit(jax.vmap(env.reset))(keys).carry
    odd = np.asarray(before.start_row) % 2 == 1
    assert 0 < odd.sum() < 16 and (after.start_row % 2 == 1).all() and np.isfinite(after.line_loss_mw).all()
    np.testing.assert_array_equal(after.start_row[odd], before.start_row[odd])
    np.testing.assert_array_equal(after.q[odd], before.q[odd])


def test_state_structure_never_changes() -> None:
    env = folder_env(noise=True)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    after = jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((6, 1), jnp.float32))
    described = [[(x.shape, x.dtype, x.weak_type) for x in jax.tree.leaves(s)] for s in (state, after)]
    assert described[0] == described[1] and not any(weak for _, _, weak in described[0])


@pytest.mark.full
def test_rows_come_as_in_mapdn_or_one_a_step() -> None:
    knots = folder_env().profiles.p_load

    def used(env) -> list[int]:
        state, rows, step = first(env), [], stepper(env)
        for _ in range(4):
            rows.append(int(np.abs(knots[:, :4] - np.asarray(state.carry.row[6:10])).sum(axis=1).argmin()) - 603)
            state = step(state, jnp.zeros((6, 1)))
        return rows

    assert used(folder_env()) == [1, 1, 2, 3]
    plain = folder_env(timing="plain")
    assert used(plain) == [1, 2, 3, 4] and plain.spec.horizon == 240


def test_actions_are_clipped_and_scaled() -> None:
    env = folder_env()
    state = first(env)
    step = stepper(env)
    far, edge = (step(state, jnp.full((6, 1), a)) for a in (7.0, 1.0))
    np.testing.assert_array_equal(far.carry.q, edge.carry.q)
    np.testing.assert_allclose(edge.carry.q, 0.8 * np.sqrt(env.s_max**2 - state.carry.row[:6] ** 2), rtol=1e-6)


@pytest.mark.full
def test_noise_only_adds_and_has_the_columns_size() -> None:
    quiet, noisy = folder_env(), folder_env(noise=True)
    keys = jax.random.split(jax.random.key(0), 2000)
    rows = jax.jit(jax.vmap(lambda key: noisy.restore(start_row=603, q=np.zeros(6), key=key).carry.row))(keys)
    extra = np.asarray(rows) - np.asarray(first(quiet).carry.row)
    assert extra.min() >= -1e-7
    with np.load(DATA / "grid_env_reference_case33.npz") as file:
        names = ("pv_std", "active_demand_std", "reactive_demand_std")
        std = np.concatenate([file[f"case33/{name}"] for name in names])
    np.testing.assert_allclose(noisy.profiles.row_std() / 100, std, rtol=1e-6)
    np.testing.assert_allclose(extra.mean(axis=0), std * np.sqrt(2 / np.pi), rtol=0.1, atol=1e-7)


def test_a_flow_without_solution_ends_the_episode_in_the_state_before() -> None:
    env = folder_env()
    state = first(env)
    heavy = dict(env.raw(state)) | {"row": state.carry.row.at[6:38].multiply(60.0)}
    before = first(env, **heavy)
    after = stepper(env)(before, jnp.full((6, 1), 0.5))
    assert after.terminated and (after.cost == 1).all()
    np.testing.assert_array_equal(after.carry.vm_pu, before.carry.vm_pu)
    np.testing.assert_array_equal(after.carry.q, before.carry.q)
    judged = -(np.abs(np.asarray(before.carry.vm_pu) - 1).mean() + 0.1 * np.abs(np.asarray(before.carry.q)).mean())
    assert float(after.reward) == pytest.approx(judged - 200, abs=1e-4)
    assert after.info["destroy"] == 1 and after.info["totally_controllable_ratio"] == 0
    assert after.info["q_loss"] > 0.3, "the reactive power that was tried, not the one that is kept"
    assert all(np.isfinite(x).all() for x in (after.obs, after.global_state, after.reward))


def test_barriers_are_as_specified() -> None:
    from envs.voltage.control import barrier

    v = jnp.array([0.9, 0.9501, 0.99, 1.0, 1.04, 1.08])
    normal = np.exp(-0.5 * ((np.asarray(v) - 1) / 0.1) ** 2) / (0.1 * np.sqrt(2 * np.pi))
    expected = {
        "l1": [0.1, 0.0499, 0.01, 0, 0.04, 0.08],
        "l2": [0.02, 0.00498, 0.0002, 0, 0.0032, 0.0128],
        "courant_beltrami": [0.0025, 0, 0, 0, 0, 0.0009],
        "bowl": [0.105, *(0.04 - 0.01 * normal[1:5]), 0.065],
        "bump": [
            np.exp(-1 / (1 - x**4)) if x < 1 else 0 if x == 1 else np.exp(-1 / (1 - (x - 2) ** 4))
            for x in np.asarray(v, np.float64)
        ],
    }
    for kind, values in expected.items():
        np.testing.assert_allclose(barrier(kind, v), values, atol=1e-6, err_msg=kind)


def test_costs() -> None:
    """From one voltage profile, all costs by hand."""
    env = folder_env()
    zone = env.scenario.table["zone"]
    v = np.ones(33, np.float32)
    v[[7, 19, 20, 30]] = 0.93, 1.07, 1.06, 1.5  # regions 1, 2, 2, 4
    cost = {
        (kind, scope): np.asarray(folder_env(cost=kind, cost_scope=scope)._get_cost(jnp.asarray(v)))
        for kind in ("any", "share", "excess_sum", "excess_mean")
        for scope in ("network", "zone", "regions")
    }
    assert cost["any", "network"].shape == (1, 1) and cost["any", "regions"].shape == (1, 4)
    np.testing.assert_array_equal(cost["any", "regions"][0], [1, 1, 0, 1])
    np.testing.assert_array_equal(cost["any", "zone"][:, 0], [1, 1, 1, 0, 1, 1])
    np.testing.assert_allclose(cost["share", "network"], [[4 / 33]], rtol=1e-6)
    np.testing.assert_allclose(cost["share", "regions"][0], [1 / 12, 2 / 4, 0, 1 / 8], rtol=1e-6)
    np.testing.assert_allclose(cost["excess_sum", "regions"][0], [0.02, 0.03, 0, 0.45], atol=1e-6)
    np.testing.assert_allclose(cost["excess_mean", "network"], [[0.5 / 33]], rtol=1e-5)
    assert (zone[[7, 19, 20, 30]] == [1, 2, 2, 4]).all()
    spec = folder_env(cost_scope="regions").spec
    state = jax.eval_shape(folder_env(cost_scope="regions").reset, jax.random.key(0))
    assert spec.num_costs == 4 and state.cost.shape == (6, 4)


@pytest.mark.full
def test_reward_options_and_blocks() -> None:
    state = first(folder_env())
    step = jnp.full((6, 1), 0.4)
    full = stepper(folder_env())(state, step)
    effort = 0.1 * np.abs(np.asarray(full.carry.q)).mean()
    assert float(folder_env(reward="loss_only")._get_reward(full.carry)) == pytest.approx(-effort, rel=1e-5)
    lines = float(folder_env(reward="loss_only", line_weight=2.0)._get_reward(full.carry))
    assert lines == pytest.approx(-2.0 * float(full.carry.line_loss_mw) / 32, rel=1e-5)
    few = folder_env(state_space=("pv", "vm_pu"))
    assert few.spec.state_dim == 6 + 33 and few.spec.obs_dim == 1 + 12
    np.testing.assert_array_equal(first(few).global_state, np.r_[state.global_state[66:72], state.global_state[78:111]])


@pytest.mark.full
def test_profiles_in_the_package() -> None:
    for name, task in (("case33", "voltage_33"), ("case141", "voltage_141")):
        for data in ("simbench", "synthetic:3"):
            env = envs.make(task, data=data)
            table, found = env.scenario.table, env.profiles
            np.testing.assert_allclose(env.s_max, table["s_max"], rtol=1e-6)
            assert found.days >= 365 and found.pv.min() == 0
            assert found.p_load.sum(axis=1).max() == pytest.approx(profiles.PEAK_LOAD[data.split(":")[0], name])
    again = profiles.synthetic_profiles("case141", table, seed=3)
    np.testing.assert_array_equal(again.p_load, found.p_load)


def test_rows_between_knots_are_on_straight_lines(tmp_path: Path) -> None:
    env = envs.make("voltage_33", noise=False)
    knots = np.concatenate([env.profiles.pv, env.profiles.p_load, env.profiles.q_load], axis=1)
    rows = jax.jit(jax.vmap(env.data_row))(jnp.array([100, 102, 105]))
    np.testing.assert_allclose(rows[0], knots[20], rtol=1e-6)
    np.testing.assert_allclose(rows[1], 0.6 * knots[20] + 0.4 * knots[21], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(rows[2], knots[21], rtol=1e-6)
    outside = jax.jit(jax.vmap(env.data_row))(jnp.array([-5, env.profiles.num_rows - 1, env.profiles.num_rows + 900]))
    np.testing.assert_array_equal(outside[0], knots[0].astype(np.float32))
    np.testing.assert_array_equal(outside[1:], np.tile(knots[-1].astype(np.float32), (2, 1)))
    few = profiles.Profiles(env.profiles.pv[:21], env.profiles.p_load[:21], env.profiles.q_load[:21], rows_per_knot=5)
    at = np.arange(few.num_rows) / 5

    def rows_of(x: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(at, np.arange(21), column) for column in x.T], axis=1)

    dense = profiles.Profiles(rows_of(few.pv), rows_of(few.p_load), rows_of(few.q_load))
    np.testing.assert_allclose(few.row_std(), dense.row_std(), rtol=1e-9, atol=1e-12)
    profiles.save_profiles(tmp_path / "few.npz", dense)
    back = profiles.load_profiles(tmp_path / "few.npz", "case33", env.scenario.table)
    assert back.rows_per_knot == 5
    np.testing.assert_allclose(back.p_load, few.p_load, atol=1e-12)


def broken(tmp_path: Path, file: str, change) -> Path:
    for name in profiles.FILES:
        lines = (FOLDER / name).read_text().splitlines()[:700]
        (tmp_path / name).write_text("\n".join(change(lines) if name == file else lines) + "\n")
    return tmp_path


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("pv_active.csv", lambda x: [line.rsplit(",", 1)[0] for line in x], "6 columns, expected a time and 6 values"),
        ("load_reactive.csv", lambda x: x[:-5], "699 rows, load_reactive.csv has 694; they must be equal"),
        ("load_active.csv", lambda x: x[:50] + x[51:], "6 minutes from row 49 to 50, expected 3"),
        ("load_active.csv", lambda x: [x[0]] + ["noon" + y[19:] for y in x[1:]], "'noon' is not a time|need pandas"),
        ("load_active.csv", lambda x: [x[0]] + [y.replace(",0.0", ",500.0") for y in x[1:]], "looks like kW"),
        ("pv_active.csv", lambda x: [x[0]] + [y.replace(",0.", ",-0.") for y in x[1:]], "must not be negative"),
        ("pv_active.csv", lambda x: [x[0]] + [y.replace(",0.", ",a.") for y in x[1:]], "cannot be read as numbers"),
    ],
)
def test_malformed_folders_are_refused_in_a_sentence(tmp_path: Path, file: str, change, message: str) -> None:
    with pytest.raises(TaskError, match=message):
        envs.make("voltage_33", data=broken(tmp_path, file, change))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"data": "nowhere"}, "neither 'simbench'"),
        ({"data": "synthetic:x"}, "whole number"),
        ({"barrier": "bowll"}, "did you mean 'bowl'"),
        ({"cost_scope": "zones"}, "did you mean 'zone'"),
        ({"history": 0}, "at least 1"),
        ({"state_space": "pv,volt"}, "unknown state_space block 'volt'"),
        ({"data": FOLDER, "episode_limit": 480 * 6}, "need at least"),
    ],
)
def test_mistakes_in_options_are_told(options: dict, message: str) -> None:
    with pytest.raises(TaskError, match=message):
        envs.make("voltage_33", **options)


def test_the_141_bus_net_needs_its_own_folder() -> None:
    with pytest.raises(TaskError, match="33 columns, expected a time and 84 values"):
        envs.make("voltage_141", data=FOLDER)


@pytest.mark.full
def test_baselines_order_as_they_should() -> None:
    from envs.voltage.baselines import CONTROLLERS
    from pmt_jax.learning.evaluation import play

    env = envs.make("voltage_33", episode_limit=11)

    policies = [jax.vmap(make(env)) for make in CONTROLLERS.values()]

    @jax.jit  # the environment compiles once for all policies
    def figures(number: int) -> dict[str, jax.Array]:
        return {k: x.mean() for k, x in play(env, lambda s, _: jax.lax.switch(number, policies, s), 16).items()}

    found = {name: figures(number) for number, name in enumerate(CONTROLLERS)}
    rate = {name: f["info/totally_controllable_ratio"] for name, f in found.items()}
    loss = {name: f["info/total_line_loss"] for name, f in found.items()}
    assert rate["random"] < rate["zero"] < rate["droop"] <= rate["opf"]
    assert loss["opf"] < loss["droop"] < loss["random"]  # without control less is lost, but voltages are out
    np.testing.assert_allclose(rate["zero"], 1 - found["zero"]["violation_rate"], atol=1e-6)


@pytest.mark.full
def test_the_example_of_a_whole_grid_changes_what_agents_see_and_nothing_else():
    regions, whole = envs.make("voltage_141"), envs.make(f"{ROOT / 'docs/examples/whole_grid.py'}:make")
    buses = regions.scenario.network.n_bus - 1  # without the slack
    assert whole.spec.obs_dim == 4 * buses + 2 > regions.spec.obs_dim
    assert whole.spec.state_dim == regions.spec.state_dim
    np.testing.assert_array_equal(whole.profiles.pv, regions.profiles.pv)
    np.testing.assert_array_equal(whole.s_max, regions.s_max)
    assert whole.spec.cost_limit == regions.spec.cost_limit
    assert whole.barrier == regions.barrier
