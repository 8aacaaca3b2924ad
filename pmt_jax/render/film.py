"""`pmt render`: an episode as a film (MP4, GIF) or as a page that replays it (HTML)."""

from __future__ import annotations

import contextlib
import html
import itertools
import pathlib
import subprocess
from collections.abc import Callable, Iterator

import numpy as np

from ..errors import UsageError, optional
from ..files import check_writable, writing
from . import network_map, page
from .episode import Episode, record_run
from .network_map import INK, PAPER

FORMATS = (".mp4", ".gif", ".html")
SIZE = (640, 360)  # pixels
COLOURS = 48  # of a GIF
GIF_FPS = 50  # readers show shorter frames than 20 ms as they like
DANGER = (200, 64, 47)


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
      seed: of the run's seeds, its first if None.
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
    if out.suffix == ".gif" and fps > GIF_FPS:
        raise UsageError(f"a GIF shows at most {GIF_FPS} frames a second, not {fps:g}; lower --fps, or write an .mp4")
    check_writable(out)
    if out.suffix == ".mp4":
        optional("imageio_ffmpeg", "render")
    whole = record_run(folder, seed, number, deterministic)
    episode = whole.cut(moments)
    if not len(episode):
        raise UsageError(f"--steps chooses none of the episode's steps, which are 0 to {len(whole) - 1}")
    costly = int((episode.cost > 0).sum())
    task = episode.env.spec.name
    with writing(out) as partial:
        if out.suffix == ".html":
            title = f"{task}, {episode.method}"
            head = (
                f"<h1>{html.escape(title)}</h1><p>One episode, seed {episode.seed}; red marks the steps that cost.</p>"
            )
            partial.write_text(page.page(title, [head, page.replay(episode, fps)]))
        else:
            _write_film(_captioned(episode, _frames(episode, size)), len(episode), partial, fps, size)
    say(f"wrote {out}: {np.count_nonzero(episode.step)} control steps of {task}, {costly} of them with a cost")


def _frames(episode: Episode, size: tuple[int, int]) -> Iterator[np.ndarray]:
    """[height, width, 3] pictures of an episode's moments."""
    if episode.picture.kind == "plain":
        raise UsageError(f"task '{episode.env.spec.name}' has no film; write a page instead: -o replay.html")
    if episode.picture.kind == "map":
        return network_map.frames(episode, size)
    from . import scenes  # MuJoCo, which only its tasks need

    return scenes.frames(episode, size)


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
        sums = f"reward {episode.reward_sum[t]:.1f}   cost {episode.cost_sum[t]:g} (limit {episode.limits})"
        words = f"step {episode.step[t]}   {sums}"
        font = ImageFont.load_default(size)
        box = (0, top - 1.7 * size, draw.textlength(words, font) + size, top)
        draw.rectangle(box, fill=DANGER if costs_now else PAPER)
        draw.text((size / 2, top - 1.5 * size), words, font=font, fill=PAPER if costs_now else INK)
        if costs_now:
            draw.rectangle((0, 0, width - 1, height - 1), outline=DANGER, width=max(3, height // 90))
        yield np.asarray(picture)


def durations(count: int, fps: float) -> list[int]:
    """[count] ms that a GIF shows each frame; it counts in 10 ms, so that some are longer for the mean to be right."""
    ends = [round(100 * frame / fps) for frame in range(count + 1)]
    return [10 * (end - begin) for begin, end in itertools.pairwise(ends)]


def _write_film(frames: Iterator[np.ndarray], count: int, out: pathlib.Path, fps: float, size: tuple[int, int]) -> None:
    if out.suffix == ".gif":
        from PIL import Image

        # Few colours and no dithering: what does not move stays equal from frame to frame, and costs no bytes.
        pictures = (Image.fromarray(f).quantize(COLOURS, dither=Image.Dither.NONE) for f in frames)
        first = next(pictures)
        first.save(out, save_all=True, append_images=pictures, duration=durations(count, fps), loop=0, optimize=True)
        return
    ffmpeg = optional("imageio_ffmpeg", "render").get_ffmpeg_exe()
    taken = f"-f rawvideo -pix_fmt rgb24 -s {size[0]}x{size[1]} -r {fps:g} -i -"
    made = "-an -c:v libx264 -pix_fmt yuv420p -crf 23 -vf pad=ceil(iw/2)*2:ceil(ih/2)*2 -movflags +faststart"
    command = [ffmpeg, "-v", "error", "-y", *taken.split(), *made.split(), str(out)]
    film = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    assert film.stdin is not None
    with contextlib.suppress(BrokenPipeError):  # ffmpeg has ended; its error is reported below
        for frame in frames:
            film.stdin.write(np.ascontiguousarray(frame))
    _, complaint = film.communicate()
    if film.returncode:
        raise UsageError(f"cannot write {out}: {complaint.decode(errors='replace').strip().splitlines()[-1]}")
