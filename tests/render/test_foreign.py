"""What others wrote: tasks without a picture of their own, and names that are code in a page."""

from __future__ import annotations

import json
import pathlib
import re
from types import SimpleNamespace

import numpy as np
import pytest

from by_hand import row, written
from paths import ROOT
from pmt_jax.limits import Limits
from pmt_jax.render import episode, film, report

EXAMPLE = ROOT / "docs" / "examples" / "my_env.py"
SIZES = ("--num-envs", 4, "--rollout-length", 25, "--log-interval", 2, "--hidden", 8, "--minibatches", 1)
SCRIPT = "</script><script>alert(1)</script>"


@pytest.fixture(scope="module")
def pole(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A run of the example of a task of one's own, which has no `raw` and declares nothing."""
    from pmt_jax.cli import main

    out = tmp_path_factory.mktemp("own") / "pole"
    words = ("train", EXAMPLE, *SIZES, "--method", "happo", "--steps", 200, "--out", out)
    assert main([str(a) for a in words]) == 0
    return out


@pytest.mark.full
def test_an_own_task_is_a_page_of_its_metrics_and_actions(pole: pathlib.Path, tmp_path: pathlib.Path, cli):
    page = tmp_path / "pole.html"
    code, out, err = cli("render", pole, "-o", page, "--steps", "1:36")
    assert code == 0, err
    assert "35 control steps of pole" in out
    (data,) = [json.loads(x) for x in re.findall(r'<script type="application/json">(.*?)</script>', page.read_text())]
    assert data["kind"] == "plain" and data["step"] == list(range(1, 36))
    lines = {panel["name"]: panel["lines"] for panel in data["panels"]}
    assert list(lines) == ["reward so far", "cost so far", "tilt", "actions of agent 0", "actions of agent 1"]
    assert all(len(line) == 35 for panel in lines.values() for line in panel)
    assert len(lines["actions of agent 0"]) == 1 and len(set(lines["actions of agent 0"][0])) > 30
    assert np.diff(lines["cost so far"][0]) == pytest.approx(data["cost"][1:])


@pytest.mark.full
def test_an_own_task_has_a_report(pole: pathlib.Path, tmp_path: pathlib.Path, cli):
    page = tmp_path / "report.html"
    code, _, err = cli("report", pole.parent, "--episodes", 1, "-o", page)
    assert code == 0, err
    text = page.read_text()
    assert "happo on pole" in text and "actions of agent 1" in text and "± -" in text  # one episode has no interval
    assert "seeds within" in text


def test_names_are_no_code_in_a_replay(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    env = SimpleNamespace(spec=SimpleNamespace(name=SCRIPT, action_mask=np.ones((2, 2))))
    zero = np.zeros(3)
    shown = episode.Episode(
        env=env,
        method="<b>",
        seed=0,
        limits=Limits((1.0,)),
        raw={},
        step=np.arange(3),
        reward=zero,
        cost=zero,
        reward_sum=zero,
        cost_sum=zero,
        info={SCRIPT: zero},
        action=np.zeros((3, 2, 2)),
    )
    monkeypatch.setattr(film, "record_run", lambda *_: shown)
    film.render(tmp_path, tmp_path / "x.html", say=lambda _: None)
    text = (tmp_path / "x.html").read_text()
    assert "alert(1)" in text and "<script>alert" not in text and "<b>" not in text


def test_names_are_no_code_in_a_report(tmp_path: pathlib.Path):
    """The task, the method, the folder, settings, versions, and a name that looks like mathematics to matplotlib."""
    named = {"task": f"$\\x {SCRIPT}", "method": "<i>", "episode_cost": 1.0, "violation_rate": 0.0}
    config = f'task = "{SCRIPT}.py"\n[env]\ntitle = "{SCRIPT}"\n'
    folder = written(tmp_path / "<img src=x>", [row(10, 0, 1.0, **named)], config)
    (folder / "versions.json").write_text(json.dumps({SCRIPT: SCRIPT}))
    report.report([folder], tmp_path / "x.html", say=lambda _: None)
    text = (tmp_path / "x.html").read_text()
    assert text.count("alert(1)") > 5
    assert "<script>alert" not in text and "<img src=x>" not in text and "<i>" not in text


def test_a_report_names_a_seed_that_broke(tmp_path: pathlib.Path):
    lines = [row(10, 0, 1.0), row(10, 1, 1.0, broken="a weight"), row(20, 0, 1.0), row(20, 1, None, broken="a weight")]
    folder = written(tmp_path / "run", lines)
    report.report([folder], tmp_path / "x.html", say=lambda _: None)
    assert "Seed 1 broke by step 10 and was not trained on." in (tmp_path / "x.html").read_text()
