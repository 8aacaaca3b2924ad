"""`pmt render`: an episode as a film (MP4, GIF) or as a page that replays it (HTML)."""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import contextlib
import importlib
import pathlib
import subprocess
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ..errors import UsageError, optional
from ..files import writing
from . import gl, grid_map, page
from .episode import Episode, record_run

FORMATS = (".mp4", ".gif", ".html")
SIZE = (640, 360)  # pixels
COLOURS = 48  # of a GIF
DANGER, PAPER, INK = (200, 64, 47), (251, 250, 248), (29, 33, 37)


def render(
    folder: pathlib.Path,
    out: pathlib.Path,
    *,
    seed: int | None = None,
    number: int = 0,
    deterministic: bool = False,
    moments: slice = slice(None),
    fps: float = page.RATE,
    size: tuple[int, int] = SIZE,
    say: Callable[[str], None] = print,
) -> None:
    """Plays one episode of a run and writes it as `out`, whose ending chooses the format.

    Args:
      folder: of the run.
      seed: of the run's seeds, its first where None.
      number: which of the fixed starts.
      deterministic: take the mean action instead of a sample.
      moments: the control steps to show, 0 being the reset.
      fps: moments shown a second.
      size: of a film, pixels.

    Raises:
      UsageError: no such run or seed, an ending other than FORMATS, a package or OpenGL missing, a task that has no
        picture (pages show any task), or a folder that cannot be written.
    """
    if out.suffix not in FORMATS:
        raise UsageError(f"cannot write {out}: its ending must be .mp4, .gif or .html")
    if out.suffix == ".mp4":
        optional("imageio_ffmpeg", "render")
    episode = record_run(folder, seed, number, deterministic).cut(moments)
    if not len(episode):
        raise UsageError("the episode has no such steps; leave --steps out to see how long it is")
    costly = int((episode.cost > 0).sum())
    task = episode.env.spec.name
    with writing(out) as partial:
        if out.suffix == ".html":
            title = f"{task}, {episode.method}"
            head = f"<h1>{title}</h1><p>One episode, seed {episode.seed}; red marks the steps that cost.</p>"
            partial.write_text(page.page(title, [head, page.replay(episode, fps)]))
        else:
            _write_film(_captioned(episode, _frames(episode, size)), partial, fps, size)
    say(f"wrote {out}: {len(episode) - 1} control steps of {task}, {costly} of them with a cost")


def _frames(episode: Episode, size: tuple[int, int]) -> Iterator[np.ndarray]:
    """[height, width, 3] pictures of an episode's moments."""
    if episode.picture.kind == "scene":
        return _bodies(episode, size, gl.choose())
    if episode.picture.kind == "map":
        return _maps(episode, size)
    raise UsageError(f"task '{episode.env.spec.name}' has no film; write a page instead: -o replay.html")


# ---------------------------------------------------------------------------------------------------------------------
# Bodies, drawn by MuJoCo


def _bodies(episode: Episode, size: tuple[int, int], platform: str) -> Iterator[np.ndarray]:
    import mujoco

    from . import scenes

    model = episode.picture.model
    width, height = size
    window = importlib.import_module(f"mujoco.{platform}").GLContext(width, height)
    window.make_current()
    before = model.vis.global_.offwidth, model.vis.global_.offheight
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    model.vis.global_.offwidth, model.vis.global_.offheight = before
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    area = mujoco.MjrRect(0, 0, width, height)
    picture = np.zeros((height, width, 3), np.uint8)
    try:
        for scene in scenes.scenes(episode):
            mujoco.mjr_render(area, scene, context)
            mujoco.mjr_readPixels(picture, None, area, context)
            yield picture[::-1]
    finally:
        context.free()
        window.free()


# ---------------------------------------------------------------------------------------------------------------------
# The voltage map, drawn by matplotlib


def _maps(episode: Episode, size: tuple[int, int]) -> Iterator[np.ndarray]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    grid = episode.picture
    x, y, (low, high), values = grid.x, -grid.y, grid.band, episode.raw[grid.quantity]
    figure = Figure(figsize=(size[0] / 100, size[1] / 100), dpi=100, facecolor="#{:02x}{:02x}{:02x}".format(*PAPER))
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.03, 0.22, 0.94, 0.72), frameon=False, xticks=[], yticks=[])
    area = 40 * min(1, 45 / len(x))  # points^2 of a bus
    rim = area**0.5 / 3
    elbows = [[(x[a], y[a]), (x[a], y[b]), (x[b], y[b])] for a, b in grid.links]
    lines: Any = axes.add_collection(LineCollection(elbows, linewidths=area**0.5 / 2.5, zorder=1))
    marks = np.isin(np.arange(len(x)), grid.agents)
    looks = ((~marks, area, "o"), (marks, 1.75 * area, "s"))
    buses: list[Any] = [axes.scatter(x[m], y[m], s=s, marker=k, zorder=2) for m, s, k in looks]
    _colour_bar(figure, grid.band)
    for v in values:
        lines.set_color(grid_map.voltage_colours(v[grid.links].mean(1), grid.band))
        for dots, chosen in zip(buses, (~marks, marks), strict=True):
            out = (v[chosen] < low) | (v[chosen] > high)
            dots.set_facecolor(grid_map.voltage_colours(v[chosen], grid.band))
            dots.set_edgecolor(np.where(out[:, None], np.array(INK) / 255, np.array(PAPER) / 255))
            dots.set_linewidth(np.where(out, rim, 0.4 * rim))
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3]


def _colour_bar(figure: Any, band: tuple[float, float]) -> None:
    """Beneath the map: which colour means which voltage, the band marked."""
    low, high = band
    reach = np.linspace(low - (high - low) / 2, high + (high - low) / 2, 200)
    axes = figure.add_axes((0.56, 0.175, 0.4, 0.025))
    axes.imshow(grid_map.voltage_colours(reach, band)[None], aspect="auto", extent=(reach[0], reach[-1], 0, 1))
    axes.set(yticks=[], xticks=[low, (low + high) / 2, high])
    axes.set_xticklabels([f"{low:g}", f"{(low + high) / 2:g} p.u.", f"{high:g}"], fontsize=8)
    axes.tick_params(length=2, pad=1)
    axes.set_frame_on(False)


# ---------------------------------------------------------------------------------------------------------------------
# Films


def _captioned(episode: Episode, frames: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    """Pictures with the sums so far in words, a red frame while it costs, and all costs as marks on a time line."""
    from PIL import Image, ImageDraw, ImageFont

    last = max(1, len(episode) - 1)
    for t, frame in enumerate(frames):
        picture = Image.fromarray(np.ascontiguousarray(frame))
        width, height = picture.size
        draw, size = ImageDraw.Draw(picture), max(10, height // 24)
        top = height - size // 2
        draw.rectangle((0, top, width, height), fill=(226, 224, 219))
        for k in np.flatnonzero(episode.cost > 0):
            draw.rectangle((k / last * width - 1, top, (k + 1) / last * width - 1, height), fill=DANGER)
        draw.rectangle((t / last * width - 2, top - 2, t / last * width + 1, height), fill=INK)
        costs_now = episode.cost[t] > 0
        sums = f"reward {episode.reward_sum[t]:.1f}   cost {episode.cost_sum[t]:g} (limit {episode.cost_limit:g})"
        words = f"step {episode.step[t]}   {sums}"
        font = ImageFont.load_default(size)
        box = (0, top - 1.7 * size, draw.textlength(words, font) + size, top)
        draw.rectangle(box, fill=DANGER if costs_now else PAPER)
        draw.text((size / 2, top - 1.5 * size), words, font=font, fill=PAPER if costs_now else INK)
        if costs_now:
            draw.rectangle((0, 0, width - 1, height - 1), outline=DANGER, width=max(3, height // 90))
        yield np.asarray(picture)


def _write_film(frames: Iterator[np.ndarray], out: pathlib.Path, fps: float, size: tuple[int, int]) -> None:
    if out.suffix == ".gif":
        from PIL import Image

        # Few colours and no dithering: what does not move stays equal from frame to frame, and costs no bytes.
        pictures = (Image.fromarray(f).quantize(COLOURS, dither=Image.Dither.NONE) for f in frames)
        first = next(pictures)
        first.save(out, save_all=True, append_images=pictures, duration=1000 / fps, loop=0, optimize=True)
        return
    ffmpeg = optional("imageio_ffmpeg", "render").get_ffmpeg_exe()
    taken = f"-f rawvideo -pix_fmt rgb24 -s {size[0]}x{size[1]} -r {fps:g} -i -"
    made = "-an -c:v libx264 -pix_fmt yuv420p -crf 23 -vf pad=ceil(iw/2)*2:ceil(ih/2)*2 -movflags +faststart"
    command = [ffmpeg, "-v", "error", "-y", *taken.split(), *made.split(), str(out)]
    film = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    assert film.stdin is not None
    with contextlib.suppress(BrokenPipeError):  # it has given up, and says below why
        for frame in frames:
            film.stdin.write(np.ascontiguousarray(frame))
    _, complaint = film.communicate()
    if film.returncode:
        raise UsageError(f"cannot write {out}: {complaint.decode(errors='replace').strip().splitlines()[-1]}")
