"""Pretrained policies: what comes back is what was trained, and a newcomer can use it by name."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import pathlib
import re
import shutil
import tomllib
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bench.tables import speed
from paths import ROOT
from pmt_jax import load_config, load_policy, make_setup
from pmt_jax.errors import UsageError
from pmt_jax.learning import learner
from pmt_jax.learning.maths import running_moments
from pmt_jax.learning.types import ActingState, Best, LearnerState, RunningMoments, TrainState
from pmt_jax.policies import evaluate, hub, numpy_policy, publish
from pmt_jax.training import run_folder
from pmt_jax.training.checkpoint import Checkpoints
from pmt_jax.training.provenance import Provenance

NAMES = hub.names()
WITH_THE_PACKAGE = hub.FOLDER


@pytest.fixture
def empty_hub(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> pathlib.Path:
    """An empty place for policies."""
    monkeypatch.setattr(hub, "FOLDER", tmp_path / "hub")
    return tmp_path / "hub"


def untrained(out: pathlib.Path, last: tuple[float, float], best: tuple[float, float]) -> pathlib.Path:
    """A run folder of seeds 3 and 4 on the lane, whose policies always do about the same: push so hard."""
    run = make_setup(load_config("lane", method="r4sg", seeds=2, seed=3, num_envs=4, hidden=[8]))
    hyper, keys, axes = run.vmap_arguments
    state = jax.jit(jax.vmap(functools.partial(learner.init, run), axes))(hyper, keys)

    def pushing(actions: tuple[float, float]) -> LearnerState:
        params = jax.tree.map(lambda x: x, state.actor.params)
        head = params["params"]["trunk"]["Dense_1"]
        head["bias"] = head["bias"] + jnp.array(actions)[:, None, None]
        return dataclasses.replace(state, actor=dataclasses.replace(state.actor, params=params))

    out.mkdir()
    run_folder.write_settings(out, run)
    checkpoints = Checkpoints(out)
    known = dataclasses.replace(Best.initial(state), state=pushing(best))
    checkpoints.save(100, {"last": pushing(last), "best": known}, Provenance(run.config))
    checkpoints.close()
    return out


def test_what_training_reached_stands_beside_what_a_policy_reaches(tmp_path: pathlib.Path):
    """Over the last tenth of the steps of its seed, each agent by its own limit."""
    row = {"seed": 3, "cost_limit": 1.0, "episode_reward": 5.0, "episode_cost": 0.75}
    row |= {"episode_cost/agent_0": 1.5, "episode_cost/agent_1": 0.0, "episode_cost_worst": 1.5}
    rows = [row | {"step": step, "episode_reward": float(step)} for step in range(10, 201, 10)]
    rows += [row | {"step": 200, "seed": 4, "episode_reward": 0.0}, row | {"step": 190, "episode_reward": None}]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(each) + "\n" for each in rows))
    assert publish.trained(tmp_path, 3) == {"episode_reward": 195.0, "episode_cost": 1.5, "within": False}
    assert publish.trained(tmp_path, 5) is None and publish.trained(tmp_path / "none", 3) is None


@pytest.mark.full
def test_the_best_policy_of_a_run_is_published_and_used_by_name(empty_hub: pathlib.Path, tmp_path: pathlib.Path, cli):
    # The lane's point comes to rest at twice the push; beyond 0.5 it costs, the nearer to 1 the better.
    out = untrained(tmp_path / "lane", last=(0.5, 0.0), best=(0.2, 0.1))
    facts = publish.publish(out, 8)
    assert {p.relative_to(empty_hub).as_posix() for p in empty_hub.rglob("*")} == {"lane.zip", hub.CHECKSUMS}
    assert hub.about("hub:lane/r4sg") == facts
    assert (facts["seed"], facts["which"]) == (3, "best") and facts["figures"]["episode_cost"] == [0, 0]

    mean, half = facts["figures"]["episode_reward"]
    code, text, _ = cli("eval", "hub:lane/r4sg", "--episodes", 8, "--deterministic")
    assert code == 0 and f"{mean:12.4f} +- {half:.4f}" in text and "seed 3 after 0 steps (cost limit 1" in text
    code, text, _ = cli("hub")
    assert code == 0 and re.search(rf"^hub:lane/r4sg reward +{mean:.2f} ", text, re.MULTILINE)

    obs = jax.random.normal(jax.random.key(2), (2, 8))
    action = load_policy("hub:lane/r4sg")(obs)
    np.testing.assert_allclose(action, load_policy(out, 3, "best")(obs), atol=1e-3)
    assert 0 < facts["action_change"] < 1e-3
    assert cli("export", "hub:lane/r4sg", "-o", tmp_path / "policy")[0] == 0
    np.testing.assert_allclose(numpy_policy.load(tmp_path / "policy" / "policy.npz")(np.array(obs)), action, atol=1e-5)
    assert cli("render", "hub:lane/r4sg", "-o", tmp_path / "lane.html")[0] == 0
    assert "seed 3" in (tmp_path / "lane.html").read_text()


@settings(max_examples=25, deadline=None)
@given(
    hnp.arrays(np.float32, hnp.array_shapes(min_dims=4, max_dims=4, max_side=3), elements=st.floats(-9, 9, width=32))
)
def test_packing_loses_at_most_half_a_level_of_a_kernel_and_nothing_else(kernel: np.ndarray):
    rest = jnp.asarray(kernel[..., 0, :])
    state = ActingState(
        TrainState({"kernel": jnp.asarray(kernel), "bias": rest}, None), RunningMoments(rest, rest, rest), rest
    )
    packed = hub.rounded(state)
    half = np.abs(kernel).max(-2, keepdims=True) / hub.LEVELS / 2
    assert (np.abs(packed.actor.params["kernel"] - kernel) <= half * (1 + 1e-4) + 1e-30).all()
    others = (packed.actor.params["bias"], packed.obs_moments, packed.update)
    assert all((x == rest).all() for x in jax.tree.leaves(others))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (
            ["eval", "hub:lane/r4gs"],
            "unknown policy 'hub:lane/r4gs'; did you mean 'hub:lane/r4sg'? (pmt hub lists all)",
        ),
        (["render", "hub:lane", "-o", "x.html"], "unknown policy 'hub:lane'; did you mean 'hub:lane/r4sg'?"),
        (["export", "hub:../lane/r4sg", "-o", "x"], "unknown policy 'hub:../lane/r4sg'"),
        (["render", "hub:lane/r4sg", "--seed", "7", "-o", "x.html"], "has no seed 7; it has 3"),
    ],
)
def test_names_that_are_none(arguments: list[str], says: str, empty_hub: pathlib.Path, cli, tmp_path, monkeypatch):
    run = make_setup(load_config("lane", hidden=[8]))
    actor = jax.vmap(run.nets.init_actor)(jax.random.split(jax.random.key(0), 1))
    moments = jax.tree.map(lambda x: x[None], running_moments.init((8,)))
    state = ActingState(TrainState(actor, None), moments, jnp.zeros(1, jnp.int32))
    hub.save("hub:lane/r4sg", run.config, state, {"seed": 3})
    monkeypatch.chdir(tmp_path)
    code, out, err = cli(*arguments)
    assert code == 2 and not out
    assert says in err and err.startswith("pmt: ") and err.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["hub"]


# ---------------------------------------------------------------------------------------------------------------------
# Those that come with the package


FIRST = {name.split("/")[0]: name for name in reversed(NAMES)}.values()  # of each archive


@pytest.mark.parametrize("name", [x if x in FIRST else pytest.param(x, marks=pytest.mark.full) for x in NAMES])
def test_a_policy_of_the_package(name: str):
    physics = "mujoco" if "velocity" in name else None  # which has nothing to compile
    run, state = hub.load(name, physics)
    facts = hub.about(name)
    assert f"hub:{run.config.task}/{run.config.method}" == name == f"hub:{facts['task']}/{facts['method']}"
    assert (run.config.seed, run.config.seeds, run.config.physics) == (facts["seed"], 1, physics or "auto")
    assert run.limits.total == facts["cost_limit"]
    assert int(state.update[0]) * run.config.batch_size == facts["step"]
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(state))


def test_what_is_told_about_them_and_how_large_they_are():
    found = publish.rows()
    assert NAMES and json.loads((ROOT / "bench/results/hub.json").read_text())["rows"] == found
    assert speed.hub({"hub": {"rows": found}}).count("`hub:") == len(found)
    assert sum(row["bytes"] for row in found) < 4e6


def test_their_checksums_are_as_sha256sum_writes_them(tmp_path: pathlib.Path):
    """`sha256sum -c` reads them where each archive lies unpacked in a folder of its name."""
    lines = [line.split("  ") for line in (hub.FOLDER / hub.CHECKSUMS).read_text().splitlines()]
    for file in hub.FOLDER.glob("*.zip"):
        zipfile.ZipFile(file).extractall(tmp_path / file.stem)
    files = {file: hashlib.sha256((tmp_path / file).read_bytes()).hexdigest() for _, file in lines}
    assert files == {file: checksum for checksum, file in lines}
    assert len(lines) == len(files) == len(NAMES) == len(list(tmp_path.rglob("*.npz")))


def cut(file: pathlib.Path) -> None:
    file.write_bytes(file.read_bytes()[:-1])


def replace_by_a_folder(file: pathlib.Path) -> None:
    file.unlink()
    file.mkdir()


def rewrite(file: pathlib.Path, **changes: bytes | None) -> None:
    """Other bytes for some policies of an archive, or with None no such policy."""
    with zipfile.ZipFile(file) as archive:
        policies = {member.removesuffix(".npz"): archive.read(member) for member in archive.namelist()} | changes
    with zipfile.ZipFile(file, "w") as archive:
        for method, data in policies.items():
            if data is not None:
                archive.writestr(f"{method}.npz", data)


def flip(file: pathlib.Path) -> None:
    """A bit in the middle of happo's policy."""
    data, policy = bytearray(file.read_bytes()), zipfile.ZipFile(file).read("happo.npz")
    data[data.index(policy) + len(policy) // 2] ^= 1
    file.write_bytes(data)


OF_THE_ARCHIVE = {
    "empty": lambda file: file.write_bytes(b""),
    "cut": cut,
    "text": lambda file: file.write_text("no archive"),
    "lost": lambda file: file.unlink(),
    "folder": replace_by_a_folder,
}
OF_HAPPO = {
    "flipped": flip,
    "of another method": lambda file: rewrite(file, happo=zipfile.ZipFile(file).read("mappo.npz")),
    "left out": lambda file: rewrite(file, happo=None),
}


@pytest.mark.parametrize("damage", OF_THE_ARCHIVE | OF_HAPPO)
def test_damage_costs_only_what_is_damaged(damage: str, tmp_path: pathlib.Path, monkeypatch, cli):
    shutil.copytree(hub.FOLDER, tmp_path / "hub")
    monkeypatch.setattr(hub, "FOLDER", tmp_path / "hub")
    monkeypatch.chdir(tmp_path)
    name = "hub:ant_2x4/happo"
    (OF_THE_ARCHIVE | OF_HAPPO)[damage](hub.file_of(name))
    lost = [name] if damage in OF_HAPPO else [other for other in NAMES if other.startswith("hub:ant_2x4/")]
    assert hub.names() == NAMES
    code, out, err = cli("hub")
    assert code == 0 and [line.split(" is damaged: ")[0] for line in err.splitlines()] == [
        f"left out: {each}" for each in lost
    ]
    assert [line.split()[0] for line in out.splitlines()[1:]] == [other for other in NAMES if other not in lost]
    for command in (("eval", name), ("render", name, "-o", "x.html"), ("export", name, "-o", "x"), ("train", "lane")):
        init = ("--init", name) if command[0] == "train" else ()
        code, _, err = cli(*command, *init)
        assert code == 2 and err.count("\n") == 1 and f"{name} is damaged: {hub.file_of(name)}" in err
    sound = "hub:ant_2x4/mappo" if damage in OF_HAPPO else "hub:ant_4x2/mappo"
    assert hub.about(sound)["method"] == "mappo"


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_policy_of_a_damaged_archive_is_as_it_was_or_damaged(data: st.DataObject, empty_hub: pathlib.Path):
    """Whatever bytes have changed, also those that say how an archive is packed."""
    empty_hub.mkdir(exist_ok=True)
    sums, npz = [], {method: hashlib.sha256(method.encode()).digest() for method in ("happo", "mappo")}
    with zipfile.ZipFile(empty_hub / "lane.zip", "w") as archive:
        for method, whole in npz.items():
            archive.writestr(zipfile.ZipInfo(f"{method}.npz"), whole)
            sums.append(f"{hashlib.sha256(whole).hexdigest()}  lane/{method}.npz\n")
    (empty_hub / hub.CHECKSUMS).write_text("".join(sums))
    changed = bytearray((empty_hub / "lane.zip").read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
    (empty_hub / "lane.zip").write_bytes(changed[: data.draw(st.integers(0, len(changed)))])
    for method, whole in npz.items():
        try:
            assert hub.size(f"hub:lane/{method}") == len(whole)
        except UsageError as error:
            assert f"hub:lane/{method} is damaged" in str(error)


def test_a_new_policy_leaves_the_others_of_its_task_as_they_are(empty_hub: pathlib.Path):
    shutil.copytree(WITH_THE_PACKAGE, empty_hub)
    before, facts = {name: hub.about(name) for name in NAMES}, {"episodes": 1}
    hub.store_facts("hub:ant_2x4/happo", facts)
    assert {name: hub.about(name) for name in hub.names()} == before | {"hub:ant_2x4/happo": facts}
    once = hub.file_of("hub:ant_2x4/happo").read_bytes()
    hub.store_facts("hub:ant_2x4/happo", facts)
    assert hub.file_of("hub:ant_2x4/happo").read_bytes() == once


def test_a_file_that_is_not_of_the_package_is_no_policy(empty_hub: pathlib.Path, cli):
    """Whoever puts a file there may name any task in it, a Python file too."""
    empty_hub.mkdir()
    with zipfile.ZipFile(empty_hub / "lane.zip", "w") as archive, archive.open("mine.npz", "w") as policy:
        np.savez(policy, config=np.array('task = "mine.py"'), about=np.array("{}"))  # pyright: ignore[reportArgumentType]
    assert "hub:lane/mine is damaged" in cli("eval", "hub:lane/mine")[2]


def test_they_come_with_the_wheel():
    table = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert "pmt_jax.policies.pretrained" in table["packages"]
    inside = {
        file for pattern in table["package-data"]["pmt_jax.policies.pretrained"] for file in hub.FOLDER.glob(pattern)
    }
    assert inside >= {hub.FOLDER / "SHA256SUMS", *map(hub.file_of, NAMES)}


def test_packing_costs_no_reward_and_no_safety():
    """Of many 95 % intervals, a few may miss."""
    worse = []
    for name in NAMES:
        facts = hub.about(name)
        for figure, (before, half) in facts["unpacked"].items():
            after, other_half = facts["packed"][figure]
            loss = after - before if figure.startswith("episode_cost") else before - after
            worse.append(loss > half + other_half)
        assert facts["action_change"] < 0.02
    assert np.mean(worse) <= 0.05


@pytest.mark.full
def test_a_trained_ant_runs_as_it_is_told():
    """Other episodes than the published ones, on the C engine: the two intervals meet."""
    [row] = evaluate.evaluate_run(pathlib.Path("hub:ant_2x4/mappo_l"), 8, True, physics="mujoco")
    (ours, half), stored = row["episode_reward"], hub.about("hub:ant_2x4/mappo_l")["figures"]
    assert abs(ours - stored["episode_reward"][0]) <= half + stored["episode_reward"][1]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_policy_is_as_good_as_it_is_told(name: str):
    stored = hub.about(name)
    [row] = evaluate.evaluate_run(pathlib.Path(name), stored["episodes"], True)
    for figure in ("episode_reward", "episode_cost"):
        mean, half = stored["figures"][figure]
        assert abs(row[figure][0] - mean) <= half + row[figure][1]
