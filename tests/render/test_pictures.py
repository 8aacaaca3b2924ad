"""Pictures of episodes and runs: what is drawn is what happened, and pages are readable on a phone, offline."""

from __future__ import annotations

import base64
import json
import pathlib
import re
import shutil
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import headless
from by_hand import row, written
from envs.base import Declarations, Scene
from envs.voltage.layout import layout
from pmt_jax import load_config, make_setup, tasks
from pmt_jax.errors import UsageError
from pmt_jax.limits import Limits
from pmt_jax.render import episode, film, gl, network_map, page, report
from pmt_jax.studies import table
from pmt_jax.studies.rows import rows
from pmt_jax.studies.run_log import read_all


def still(name: str, raw: dict[str, np.ndarray], cost: list[float], **options: str) -> episode.Episode:
    """An episode made by hand, of the raw quantities given."""
    env = tasks.make(name, **options)
    costs = np.array(cost)
    zero = np.zeros_like(costs)
    return episode.Episode(
        env=env,
        method="mappo_l",
        seed=0,
        limits=Limits.of_task(env.spec),
        raw=raw,
        step=np.arange(len(costs)),
        reward=zero,
        cost=costs,
        reward_sum=zero,
        cost_sum=costs.cumsum(),
        info={},
        action=np.zeros((len(costs), *env.spec.action_mask.shape)),
    )


@pytest.fixture(scope="session")
def ant() -> episode.Episode:
    """The ant in the middle of the corridor, a metre on, and in the danger band, which costs."""
    qpos = np.tile(tasks.make("ant_2x4").model.qpos0, (3, 1))
    qpos[1:, 0] = 1.0
    qpos[2, 1] = 4.5
    return still("ant_2x4", {"qpos": qpos}, [0.0, 0.0, 1.0])


@pytest.fixture(scope="session")
def grid() -> episode.Episode:
    """A feeder at nominal voltage, then with one bus too high."""
    voltages = np.ones((2, 33), np.float32)
    voltages[1, 17] = 1.08
    return still("voltage_33", {"vm_pu": voltages}, [0.0, 1.0])


def data_of(text: str) -> list[dict]:
    """What the replays of a page hold."""
    return [json.loads(x) for x in re.findall(r'<script type="application/json">(.*?)</script>', text, re.DOTALL)]


def floats(packed: str, *shape: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(packed), "<f4").reshape(shape)


# ---------------------------------------------------------------------------------------------------------------------
# Episodes


@pytest.mark.full
def test_a_recorded_episode_is_what_the_environment_did(whole: pathlib.Path):
    shown = episode.record_run(whole, seed=1, number=2, deterministic=True)
    assert len(shown) == 26 and shown.seed == 1
    assert shown.cost[0] == shown.reward[0] == 0
    place = shown.info["position"]  # the lane's own rules, at every moment but the reset
    np.testing.assert_allclose(shown.reward[1:], 1 - (place[1:] - 1) ** 2, rtol=1e-5)
    np.testing.assert_array_equal(shown.cost[1:], place[1:] > 0.5)
    np.testing.assert_allclose(shown.cost_sum[-1], shown.cost.sum())
    again = episode.record_run(whole, seed=1, number=2, deterministic=True)
    np.testing.assert_array_equal(again.reward, shown.reward)
    sampled, other = (episode.record_run(whole, seed=seed, number=2) for seed in (1, 0))
    assert (sampled.reward != shown.reward).any() and (sampled.reward != other.reward).any()


def test_leaving_steps_out_hides_no_cost(ant: episode.Episode):
    cost = np.zeros(9)
    cost[[4, 8]] = 0.5, 0.25
    raw = {"qpos": np.tile(ant.raw["qpos"][:1], (9, 1))}
    assert still("ant_2x4", raw, cost.tolist()).cut(slice(0, 9, 3)).cost.tolist() == [0, 0, 0.5]
    assert still("ant_2x4", raw, cost.tolist()).cut(slice(5, 9)).cost.tolist() == [0, 0, 0, 0.25]


# ---------------------------------------------------------------------------------------------------------------------
# Scenes and maps


def test_a_scene_holds_walls_bands_and_the_moment_of_cost(ant: episode.Episode):
    from pmt_jax.render import scenes

    model = ant.env.model
    looks = []
    for scene in scenes.scenes(ant):
        geoms = {model.geom(g.objid).name: g for g in scene.geoms[: scene.ngeom]}
        looks.append({name: (*g.pos, *g.rgba) for name, g in geoms.items()})
    assert sum(name.startswith("wall") for name in looks[0]) == 6
    assert sum(name.startswith("danger") for name in looks[0]) == 8
    torso = np.array([look["torso_geom"] for look in looks])
    np.testing.assert_allclose(torso[:, :2], [[0, 0], [1, 0], [1, 4.5]], atol=1e-6)
    assert torso[2, 3] > 3 * torso[2, 4] and torso[1, 3] < 2 * torso[1, 4]  # red, and only then
    assert looks[2]["danger_left_1"][-1] > 1.5 * looks[1]["danger_left_1"][-1]
    assert looks[2]["wall_left_1"] == looks[1]["wall_left_1"]


@pytest.mark.parametrize(("walls", "count"), [("costly", 6), ("solid", 8)])
def test_a_scene_shows_walls_as_they_are(walls: str, count: int, ant: episode.Episode):
    """Bands reach as far as it costs, solid walls have their thickness; neither turns red with the ant."""
    from pmt_jax.render import scenes

    shown = still("ant_2x4", ant.raw, ant.cost.tolist(), walls=walls)
    looks = []
    for scene in scenes.scenes(shown):
        geoms = {shown.env.model.geom(g.objid).name: g for g in scene.geoms[: scene.ngeom]}
        looks.append({name: (g.size.tolist(), g.rgba.tolist()) for name, g in geoms.items()})
    assert sum(name.startswith("wall") for name in looks[0]) == count
    assert sum(name.startswith("danger") for name in looks[0]) == 8
    assert looks[2]["wall_left_1"] == looks[1]["wall_left_1"]
    assert looks[2]["danger_left_1"][1][3] > 1.5 * looks[1]["danger_left_1"][1][3]
    assert (looks[0]["wall_right_2"][0][1] == 0.5) == (walls == "solid")
    assert (looks[0]["danger_right_2"][0][1] > 10) == (walls == "costly")


def test_the_page_gets_the_geoms_of_the_scene(ant: episode.Episode):
    (data,) = data_of(page.replay(ant))
    scene = data["scene"]
    assert data["kind"] == "scene" and data["cost"] == [0, 0, 1]
    count = len(scene["kinds"])
    first = floats(scene["pose"]["first"], count, 7)
    moving = scene["pose"]["moving"]
    frames = floats(scene["pose"]["frames"], 3, len(moving), 7)
    torso = scene["kinds"].index("ellipsoid")
    np.testing.assert_allclose(first[torso, :3], ant.raw["qpos"][0, :3])
    np.testing.assert_allclose(frames[2, moving.index(torso), :3], ant.raw["qpos"][2, :3])
    assert scene["kinds"].count("box") == 14 and scene["kinds"].count("capsule") == 12
    assert set(moving) == {i for i, kind in enumerate(scene["kinds"]) if kind in ("ellipsoid", "capsule")}


def test_geoms_that_come_and_go_keep_their_place():
    """A decoration appended at the cost alone must not move the bodies behind it, nor stay."""
    import mujoco

    from pmt_jax.render import scenes

    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")

    def decorate(scene, raw, cost):
        if cost > 0:
            mujoco.mjv_initGeom(
                scene.geoms[scene.ngeom], 6, np.ones(3), np.ones(3), np.eye(3).ravel(), np.ones(4, "f4")
            )
            scene.ngeom += 1

    shown = still("lane", {"qpos": np.zeros((3, 0))}, [0.0, 1.0, 0.0])
    picture = Scene(lambda state: {}, model, decorate)
    object.__setattr__(shown.env, "declares", Declarations(picture=picture))
    drawn = scenes.tracks(shown)
    assert drawn["kinds"] == ["ellipsoid", "box"] and drawn["rgba"]["moving"] == [1]
    alphas = np.frombuffer(base64.b64decode(drawn["rgba"]["frames"]), np.uint8).reshape(3, 4)[:, 3]
    assert alphas.tolist() == [0, 255, 0]


@given(st.integers(2, 60), st.randoms(use_true_random=False))
@settings(max_examples=40, deadline=None)
def test_a_feeder_is_laid_out_without_crossings(count: int, random):
    branches = np.array([(random.randrange(max(0, bus - 4), bus), bus) for bus in range(1, count)])
    x, y = layout(branches, 0, count)
    assert len({(round(a, 6), round(b, 6)) for a, b in zip(x, y, strict=True)}) == count
    for a, b in branches.tolist():
        assert x[b] > x[a]  # away from the substation
        low, high = sorted((y[a], y[b]))
        crossed = (np.abs(x - x[a]) < 1e-9) & (y > low + 1e-9) & (y < high - 1e-9)
        assert not crossed.any()


def test_the_map_shows_voltages_against_the_band(grid: episode.Episode):
    (data,) = data_of(page.replay(grid))
    assert data["kind"] == "map" and data["map"]["band"] == [0.95, 1.05]
    assert len(data["map"]["links"]) == 32 and len(data["map"]["agents"]) == 6
    np.testing.assert_array_equal(floats(data["map"]["values"], 2, 33), grid.raw["vm_pu"])
    low, middle, high = network_map.colours(np.array([0.94, 1.0, 1.06]), (0.95, 1.05))
    assert low[2] > 1.5 * low[0] and high[0] > 1.5 * high[2] and np.ptp(middle) < 0.05


# ---------------------------------------------------------------------------------------------------------------------
# Films


def test_a_film_of_the_grid(grid: episode.Episode, tmp_path: pathlib.Path, monkeypatch):
    from PIL import Image

    monkeypatch.setattr(film, "record_run", lambda *_: grid)
    out = tmp_path / "grid.gif"
    film.render(tmp_path, out, size=(320, 180), say=lambda _: None)
    picture = Image.open(out)
    assert picture.size == (320, 180) and picture.n_frames == 2
    corners = []
    for frame in range(2):
        picture.seek(frame)
        corners.append(picture.convert("RGB").getpixel((0, 0)))
    assert corners[0][1] > 200 and corners[1][0] > 1.5 * corners[1][1]  # framed in red where it costs
    assert [p.name for p in tmp_path.iterdir()] == ["grid.gif"]


def test_an_episode_has_the_limit_of_its_true_costs():
    """Whatever share of them the team noticed."""
    setup = make_setup(load_config("lane", cost_seen=0.1))
    moments = {"raw": {}, "reward": np.zeros(3), "cost": np.ones((3, 2)), "info": {}, "action": np.zeros((3, 2, 2))}
    found = episode._whole(setup, 0, moments | {"terminated": np.zeros(3, bool)})
    assert str(found.limits) == "1" and found.cost_sum.tolist() == [1, 2, 3]


@pytest.mark.parametrize("fps", [0.5, 7, 20, 30, 40, 50])
def test_a_gif_shows_as_many_frames_a_second_as_asked_for(fps: float):
    """Its times are whole hundredths of a second."""
    shown = film.durations(200, fps)
    assert len(shown) == 200 and all(ms % 10 == 0 and ms >= 20 for ms in shown)
    np.testing.assert_allclose(np.cumsum(shown), 1000 / fps * np.arange(1, 201), atol=5.01)


@pytest.mark.full
@pytest.mark.skipif(sys.platform != "linux", reason="which OpenGL there is depends on the machine")
def test_a_film_of_the_ant(ant: episode.Episode, tmp_path: pathlib.Path, monkeypatch):
    """With OpenGL, the picture is red where it costs; without, a sentence names the way out."""
    from PIL import Image

    monkeypatch.setattr(film, "record_run", lambda *_: ant)
    out = tmp_path / "ant.gif"
    try:
        gl.choose()
    except UsageError as error:
        assert "-o replay.html" in str(error)
        pytest.skip("no OpenGL on this machine")
    film.render(tmp_path, out, size=(320, 180), say=lambda _: None)
    picture = Image.open(out)
    redness = []
    for frame in range(3):
        picture.seek(frame)
        pixels = np.asarray(picture.convert("RGB"), float)[60:120, 100:220]
        redness.append((pixels[..., 0] - pixels[..., 1]).mean())
    assert redness[2] > 2 * redness[0] + 5


def test_without_opengl_a_sentence_names_the_way_out(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(gl, "PROBE", "raise SystemExit(1)  # {0}")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    with pytest.raises(UsageError, match=r"no OpenGL works here \(tried .*-o replay.html"):
        gl.choose()


# ---------------------------------------------------------------------------------------------------------------------
# Pages


@pytest.fixture(scope="session")
def pages(whole: pathlib.Path, ant: episode.Episode, grid: episode.Episode, tmp_path_factory: pytest.TempPathFactory):
    """A report, and a page with the replay of each kind of picture."""
    folder = tmp_path_factory.mktemp("pages")
    report.report([whole], folder / "report.html", episodes=2, say=lambda _: None)
    (folder / "ant.html").write_text(page.page("ant", [page.replay(ant, play=False)]))
    (folder / "grid.html").write_text(page.page("grid", [page.replay(grid, play=False)]))
    return folder


def test_a_report_tells_all_there_is(pages: pathlib.Path, whole: pathlib.Path):
    text = (pages / "report.html").read_text()
    assert text.count("<figure aria-label") == 8  # four metrics of training, four of fear
    assert "seed 0, sampled" in text and "seed 1, mean" in text and " ± " in text
    for words in ("lambda_lr", "matmul_precision", "1,600 environment steps a seed", "All metrics of the task"):
        assert words in text
    assert data_of(text)[0]["kind"] == "plain" and len(data_of(text)[0]["reward"]) == 26
    assert not re.search(r'(?:src|href)="(?!data:|#)|@import|url\((?!#)', text)  # nothing that lies elsewhere


def test_limits_of_several_costs_are_no_metric_of_a_report(monkeypatch: pytest.MonkeyPatch):
    result = {
        "seed": 0,
        "step": 1,
        "cost_limit": 3.0,
        "cost_limit/0": 1.0,
        "cost_limit/1": 2.0,
        "episode_reward": (1.0, 0.5),
        "info/speed": (2.0, 0.1),
        "faults": "",
    }
    monkeypatch.setattr(report.evaluate, "evaluate_run", lambda *_: [result])
    text = "".join(report.evaluation(pathlib.Path("x"), 2))
    assert "1.00 ± 0.50" in text and "2.00 ± 0.10" in text and "limit" not in text


def test_what_a_run_lacks_is_told_in_its_place(tmp_path: pathlib.Path):
    half = written(tmp_path / "half", [row(10, 0, 1.0)])
    report.report([half], tmp_path / "report.html", say=lambda _: None)
    text = (tmp_path / "report.html").read_text()
    assert "there is no finished checkpoint" in text and "<svg" in text


@pytest.fixture(scope="session")
def tab(tmp_path_factory: pytest.TempPathFactory):
    if headless.executable() is None:
        pytest.skip("no Chromium on this machine (apt-get install chromium)")
    with headless.browser(tmp_path_factory.mktemp("profile")) as one:
        yield one


# A copy is read: Chromium warns of reading back from a canvas that was not made for it.
PIXELS = """(canvas) => { const { width, height } = canvas;
  const copy = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  copy.drawImage(canvas, 0, 0); return copy.getImageData(0, 0, width, height).data; }"""
INKED = f"""[...document.querySelectorAll("canvas")].map({PIXELS})
  .map((data) => new Set(new Uint32Array(data.buffer)).size)"""
RED = f"""(() => {{ const data = ({PIXELS})(document.querySelector(".view")); let count = 0;
  for (let i = 0; i < data.length; i += 4) count += data[i] > 2.5 * data[i + 1];
  return count / data.length * 4; }})()"""
FRAMES = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))"


@pytest.mark.parametrize("name", ["report", "ant", "grid"])
def test_pages_on_a_phone(name: str, pages: pathlib.Path, tab: headless.Page):
    """No wider than the screen, no complaint on the console, no request, every canvas drawn, dark or light."""
    tab.problems.clear()
    for dark in (False, True):
        tab.open(pages / f"{name}.html", 375, 812, dark)
        tab.evaluate(FRAMES)
        assert tab.evaluate("document.documentElement.scrollWidth") == 375
        assert all(colours >= 4 for colours in tab.evaluate(INKED))
        paper = tab.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (int(re.findall(r"\d+", paper)[0]) < 128) == dark
    assert not tab.problems


def test_a_replay_plays_scrubs_and_flags_the_cost(pages: pathlib.Path, tab: headless.Page):
    tab.open(pages / "ant.html", 375, 812)
    tab.evaluate(FRAMES)
    calm = tab.evaluate(RED)
    assert "cost 0 (limit 10)" in tab.evaluate("document.querySelector('output').value")
    tab.evaluate("(() => { const seek = document.querySelector('input'); seek.value = 2; seek.oninput(); })()")
    tab.evaluate(FRAMES)
    assert tab.evaluate(RED) > calm + 0.005  # the ant has turned red
    assert "costs now" in tab.evaluate("document.querySelector('output').value")
    assert tab.evaluate("document.querySelector('.view').classList.contains('costs')")
    before = tab.evaluate("document.querySelector('.view').toDataURL()")
    tab.evaluate("""(() => { const view = document.querySelector(".view"); view.setPointerCapture = () => {};
      const at = (x) => ({ pointerId: 1, clientX: x, clientY: 0 });
      view.onpointerdown(at(0)); view.onpointermove(at(60)); view.onpointerup(at(60)); })()""")
    tab.evaluate(FRAMES)
    assert tab.evaluate("document.querySelector('.view').toDataURL()") != before  # the drag turned the view
    tab.evaluate("document.querySelector('button').click()")  # from the end it starts again
    tab.evaluate("new Promise(done => setTimeout(() => done(1), 600))")
    assert tab.evaluate("document.querySelector('.replay').dataset.drawn") == "2"
    assert not tab.problems


# ---------------------------------------------------------------------------------------------------------------------
# Mistakes


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["render", "none"], "none is not a run folder"),
        (
            ["render", "RUN", "-o", "x.gif", "--fps", "60"],
            "a GIF shows at most 50 frames a second, not 60",
        ),
        (["render", "RUN", "-o", "x.avi"], "cannot write x.avi: its ending must be .mp4, .gif or .html"),
        (["render", "RUN", "-o", "x.gif"], "task 'lane' has no film; write a page instead: -o replay.html"),
        (["render", "RUN", "--seed", "7"], "has no seed 7; it has 0, 1"),
        (["render", "RUN", "--steps", "7"], "--steps must be FROM:TO or FROM:TO:EVERY"),
        (["render", "RUN", "--steps", "90:"], "--steps chooses none of the episode's steps, which are 0 to 25"),
        (["render", "RUN", "--steps", "5:3"], "--steps chooses none of the episode's steps, which are 0 to 25"),
        (["render", "RUN", "--size", "big"], "--size must be WIDTHxHEIGHT"),
        (["render", "RUN", "-o", "file/x.html"], "cannot write file/x.html"),
        (["plot"], "the following arguments are required: RUN"),
        (["plot", "RUN", "-o", "x.txt"], "its ending must be .png, .svg or .pdf"),
        (["report", "RUN", "-o", "x.pdf"], "the ending of a report must be .html"),
        (["report", "RUN", "--episodes", "none"], "--episodes must be a whole number of at least 1"),
    ],
)
def test_mistakes_get_one_sentence(arguments: list[str], says: str, whole: pathlib.Path, cli, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    code, _, err = cli(*(whole if a == "RUN" else a for a in arguments))
    assert code == 2 and says in err and err.startswith("pmt: ") and err.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_missing_package_is_named_with_the_command_that_brings_it(whole: pathlib.Path, cli, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    code, _, err = cli("render", whole, "-o", tmp_path / "x.mp4")
    assert code == 2 and "which is missing here: pip install 'pmt-jax[render]'" in err


def test_a_run_is_drawn_from_a_folder_that_cannot_be_written(whole: pathlib.Path, tmp_path: pathlib.Path, cli):
    copy = tmp_path / "copy"
    shutil.copytree(whole, copy)
    before = sorted(p for p in copy.rglob("*"))
    assert cli("render", copy, "-o", tmp_path / "x.html")[0] == 0
    assert sorted(p for p in copy.rglob("*")) == before
    (data,) = data_of((tmp_path / "x.html").read_text())
    assert data["title"] == "lane, f4sg, seed 0" and data["panels"][2]["name"] == "position"


# ---------------------------------------------------------------------------------------------------------------------
# The scores of a report


def test_limit_seeds_within_and_worst_seed_come_first(whole: pathlib.Path):
    logs = read_all([whole])
    head, lines, _ = table.cells(rows(logs))
    _, scores, _ = report.scores(logs)
    heads = re.findall(r"<th(?: [^>]*)?>(.*?)</th>", scores)
    assert heads[:5] == ["method", "task", "limit", "seeds within", "worst seed"]
    assert sorted(heads) == sorted(head) and "mean-action seeds within" in heads
    cells = [cell.replace("\u00a0", " ") for cell in re.findall(r"<td[^>]*>(.*?)</td>", scores)]
    assert dict(zip(heads, cells, strict=True)) == dict(zip(head, lines[0], strict=True))
    assert '<div class="scores">' in scores
