"""Policies loaded and exported are those that were evaluated."""

from __future__ import annotations

import importlib.util
import json
import pathlib
import re
import subprocess
import sys

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

from pmt_jax import load_config, load_policy, make_setup
from pmt_jax.errors import UsageError
from pmt_jax.learning.maths import running_moments
from pmt_jax.policies import load, numpy_policy, onnx_policy
from pmt_jax.policies.export import weights


@pytest.mark.full
def test_a_loaded_policy_is_what_was_evaluated(whole: pathlib.Path):
    run, state = load.load_run(whole)
    obs = jax.random.normal(jax.random.key(0), (5, 2, 8)) * 3
    moments, params = jax.tree.map(lambda x: x[1], (state.obs_moments, state.actor.params))
    expected = run.nets.policies(params, running_moments.normalise_obs(moments, obs))[0]
    policy = load_policy(whole, seed=1)
    np.testing.assert_allclose(jax.jit(jax.vmap(policy))(obs), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(policy(obs[2]), expected[2], rtol=1e-5, atol=1e-6)
    assert np.abs(np.asarray(load_policy(whole, seed=0)(obs[2]) - expected[2])).max() > 1e-3
    for seed in (7, -1, 0.5, "last"):
        with pytest.raises(UsageError, match=f"has no seed {seed}; it has 0, 1"):
            load_policy(whole, seed=seed)  # pyright: ignore[reportArgumentType]
    with pytest.raises(UsageError, match=re.escape("that end in (2, 8), not (8,)")):
        policy(obs[0, 0])


def test_an_exported_policy(whole: pathlib.Path, tmp_path: pathlib.Path, cli):
    code, out, _ = cli("export", whole, "-o", tmp_path, "--seed", 1, "--which", "best")
    assert code == 0 and str(tmp_path) in out
    obs = np.asarray(jax.random.normal(jax.random.key(0), (5, 2, 8)))
    expected = jax.vmap(load_policy(whole, seed=1, which="best"))(obs)
    exported = jax.export.deserialize((tmp_path / "policy.stablehlo").read_bytes())
    np.testing.assert_allclose(exported.call(obs), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(exported.call(obs[:2]), expected[:2], rtol=1e-5, atol=1e-6)
    code = "import sys, numpy, numpy_policy; policy = numpy_policy.load('policy.npz'); assert 'jax' not in sys.modules;"
    code += "print(policy(numpy.ones((2, 8))).tolist())"
    alone = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    expected = load_policy(whole, seed=1, which="best")(jnp.ones((2, 8)))
    np.testing.assert_allclose(json.loads(alone.stdout), expected, rtol=1e-5, atol=1e-6)
    with pytest.raises(ValueError, match=re.escape("that end in (2, 8), not (3, 8)")):
        numpy_policy.load(tmp_path / "policy.npz")(np.ones((3, 8)))


def test_a_policy_exported_as_onnx(whole: pathlib.Path, tmp_path: pathlib.Path, cli):
    runtime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    code, text, _ = cli("export", whole, "-o", tmp_path, "--seed", 1, "--onnx")
    assert code == 0 and "numpy_policy.py and policy.onnx into" in text
    session = runtime.InferenceSession(tmp_path / "policy.onnx", providers=["CPUExecutionProvider"])
    for batch in (1, 5):
        obs = 3 * np.asarray(jax.random.normal(jax.random.key(batch), (batch, 2, 8)))
        (found,) = session.run(["action"], {"obs": obs})
        np.testing.assert_allclose(found, jax.vmap(load_policy(whole, seed=1))(obs), rtol=1e-5, atol=1e-5)


def test_an_onnx_policy_that_differs_is_refused(tmp_path: pathlib.Path):
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    run = make_setup(load_config("lane", hidden=[8]))
    made = weights(run, run.nets.init_actor(jax.random.key(0)), running_moments.init((8,)))
    onnx_policy.write(made, tmp_path / "policy.onnx")
    np.savez(tmp_path / "policy.npz", **made)
    obs = np.ones((3, 2, 8), np.float32)
    action = numpy_policy.load(tmp_path / "policy.npz")(obs)
    onnx_policy.check(tmp_path / "policy.onnx", [obs], [action])
    with pytest.raises(ValueError, match="differ from the policy's by 0.001"):
        onnx_policy.check(tmp_path / "policy.onnx", [obs], [action + 1e-3])


def test_onnx_without_its_extra(whole: pathlib.Path, tmp_path: pathlib.Path, cli, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    code, _, error = cli("export", whole, "-o", tmp_path / "out", "--onnx")
    assert code == 2 and "this needs onnx, which is missing here: pip install 'pmt-jax[onnx]'" in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "changes",
    [
        {"method": "mappo", "layer_norm": True, "activation": "elu"},
        pytest.param({"obs_norm": "layernorm", "layer_norm": True, "activation": "relu"}, marks=pytest.mark.full),
        pytest.param({"obs_norm": "layernorm", "layer_norm": False}, marks=pytest.mark.full),
        {"obs_norm": "none", "hidden": [8, 4]},
    ],
)
def test_weights_in_numpy_for_every_kind_of_network(changes: dict, tmp_path: pathlib.Path):
    run = make_setup(load_config("lane", **{"hidden": [8], **changes}))
    noise = jax.random.normal(jax.random.key(1), (50, 8))
    moments = running_moments.accumulate(running_moments.init((8,)), 3 * noise + 1)
    params = jax.tree.map(lambda x: x + noise[0, 0], jax.jit(run.nets.init_actor)(jax.random.key(0)))
    np.savez(tmp_path / "policy.npz", **weights(run, params, moments))
    obs = 5 * jax.random.normal(jax.random.key(2), (4, 3, 2, 8))
    expected = run.nets.policies(params, run.scale(moments, obs))[0]
    np.testing.assert_allclose(numpy_policy.load(tmp_path / "policy.npz")(obs), expected, rtol=2e-5, atol=2e-5)
    if all(map(importlib.util.find_spec, ("onnx", "onnxruntime"))):
        onnx_policy.write(weights(run, params, moments), tmp_path / "policy.onnx")
        obs, expected = (np.asarray(x).reshape(12, 2, -1) for x in (obs, expected))
        onnx_policy.check(tmp_path / "policy.onnx", [obs], [expected])
