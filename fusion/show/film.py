"""A film of maps that are merged while they grow: each robot's map, the rivals, and the merged map once there is one.

What the paper's Figs. 6 and 7 show of the trial in the hospital, as it goes on.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from mapfuse.datasets import se2
from mapfuse.datasets.errors import ConfigError, OutputError
from mapfuse.datasets.maps import LandmarkMap

from ..result import FusedMap, PairResult
from .gif import GifStream
from .panel import draw_scene
from .scene import Scene, scene_of_group, scene_of_map
from .style import GREY, INK, owner, sizes
from .words import drawable, percent, shortened

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

SUFFIXES = (".mp4", ".gif")
#: Size of a frame [inches], and pixels per inch.
WIDTH, HEIGHT, DPI = 12.0, 6.75, 80
FRAMES_PER_SECOND = 8
#: Rivals that have a bar.
MOST_BARS = 6
#: Maps that have a panel of their own.
MOST_MAPS = 4


@dataclass(frozen=True, slots=True)
class Shot:
    """One moment: the maps as they are by now, the answer as it was weighed last, and where the robots are.

    ``robots``: pose (3,) of each robot in its own map's frame, by map; ``shared``: in the frame of its group.
    """

    t: float
    maps: Mapping[str, LandmarkMap]
    fused: FusedMap | None
    robots: Mapping[str, Array] = field(default_factory=dict)
    shared: Mapping[str, Array] = field(default_factory=dict)
    headline: str = ""


def check_film(path: Path) -> None:
    """Raise `ConfigError` where a film of that name can't be made here."""
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"film {str(path)!r}: its name must end in one of {', '.join(SUFFIXES)}")
    if path.suffix.lower() == ".mp4" and shutil.which(str(mpl.rcParams["animation.ffmpeg_path"])) is None:
        raise ConfigError(f"film {str(path)!r}: .mp4 needs the program ffmpeg, which isn't here; .gif needs nothing")


class Film:
    """Shots to a film, in a ``with`` block: the file is there, whole, at its end, and not at all where it failed.

    Raises `ConfigError` where that film can't be made here, `OutputError` where the file can't be written.
    """

    def __init__(self, path: str | Path, *, simulated: bool = False) -> None:
        self.path = Path(path)
        check_film(self.path)
        self.simulated = simulated
        self._figure = Figure(figsize=(WIDTH, HEIGHT), dpi=DPI)
        self._writer: _GifWriter | Any = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.frames = 0

    def __enter__(self) -> Self:
        try:
            self._folder = tempfile.TemporaryDirectory(prefix=".mapfuse-", dir=self.path.parent)
        except OSError as error:
            raise OutputError(self.path, f"can't be written: {error.strerror or error}") from error
        self._part = Path(self._folder.name) / self.path.name
        if self.path.suffix.lower() == ".gif":
            self._writer = _GifWriter(self._figure, self._part)
        else:
            from matplotlib.animation import FFMpegWriter

            self._writer = FFMpegWriter(fps=FRAMES_PER_SECOND)
            self._writer.setup(self._figure, str(self._part), dpi=DPI)
        return self

    def add(self, shot: Shot) -> None:
        """One more frame."""
        draw_shot(self._figure, shot, simulated=self.simulated)
        try:
            self._writer.grab_frame()
        except OSError as error:
            raise OutputError(self.path, f"can't be written: {error.strerror or error}") from error
        self.frames += 1

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        del rest
        assert self._folder is not None
        try:
            if kind is None and self.frames:
                self._writer.finish()
                self._part.replace(self.path)
        except OSError as error:
            raise OutputError(self.path, f"can't be written: {error.strerror or error}") from error
        finally:
            if isinstance(self._writer, _GifWriter):
                self._writer.close()
            self._folder.cleanup()


class _GifWriter:
    """As matplotlib's writers, but that no frame waits in memory."""

    def __init__(self, figure: Figure, path: Path) -> None:
        self._canvas: Any = FigureCanvasAgg(figure)
        self._stream = path.open("wb")
        self._gif = GifStream(self._stream, seconds=1 / FRAMES_PER_SECOND)

    def grab_frame(self) -> None:
        self._canvas.draw()
        self._gif.add(Image.fromarray(np.asarray(self._canvas.buffer_rgba())[..., :3]))

    def finish(self) -> None:
        self._gif.finish()
        self._stream.close()

    def close(self) -> None:
        with suppress(OSError):
            self._stream.close()


def draw_shot(figure: Figure, shot: Shot, *, simulated: bool = False) -> None:
    """A moment drawn into a figure, which is emptied first."""
    figure.clear()
    told = " (simulated)" if simulated else ""
    figure.text(0.012, 0.965, f"{_clock(shot.t)}{told}", fontsize=13, weight="bold", color=INK, va="center")
    figure.text(0.2, 0.965, _headline(shot), fontsize=11, color=INK, va="center", parse_math=False)
    names = list(shot.maps)[:MOST_MAPS]
    rows = max(1, (len(names) + 1) // 2) if len(names) > 2 else len(names)
    columns = 1 if len(names) <= 2 else 2
    height = 0.9 / max(rows, 1)
    width = 0.36 / columns
    number = {name: k for k, name in enumerate(shot.maps)}
    for k, name in enumerate(names):
        row, column = k // columns, k % columns
        box = (0.03 + column * width, 0.93 - (row + 1) * height + 0.03, width - 0.035, height - 0.075)
        scene = scene_of_map(shot.maps[name], number[name])
        robot = shot.robots.get(name)
        count = len(shot.maps[name])
        title = f"{shortened(name, 28)}: {count} landmark{'' if count == 1 else 's'}"
        _panel(figure, box, scene, title, [] if robot is None else [(robot, number[name])])
    _bars(figure, (0.39, 0.06, 0.16, 0.8), _telling(shot.fused))
    _merged(figure, (0.585, 0.05, 0.405, 0.85), shot, number)


def _clock(t: float) -> str:
    return f"{int(t // 60)}:{int(t % 60):02d}"


def _headline(shot: Shot) -> str:
    if shot.headline:
        return shortened(shot.headline, 120)
    if shot.fused is None or len(shot.fused.maps) < 2:
        return "not weighed yet"
    if shot.fused.decision == "merged":
        return f"merged, probability {percent(shot.fused.probability)}"
    return {"partial": "some maps are merged", "ambiguous": "not decided", "no_overlap": "no overlap seen"}[
        shot.fused.decision
    ]


def _panel(
    figure: Figure,
    box: tuple[float, float, float, float],
    scene: Scene,
    title: str,
    robots: Sequence[tuple[Array, int]],
) -> None:
    axes = figure.add_axes(box)
    points = [scene.positions, *(robot[None, :2] for robot, _ in robots), np.zeros((1, 2))]
    every = np.concatenate(points)
    low, high = every.min(axis=0) - 2.0, every.max(axis=0) + 2.0
    middle, reach = (low + high) / 2, (high - low) / 2
    wide, tall = box[2] * WIDTH, box[3] * HEIGHT
    scale = max(reach[0] * 2 / wide, reach[1] * 2 / tall, 8.0 / wide)
    axes.set_xlim(middle[0] - scale * wide / 2, middle[0] + scale * wide / 2)
    axes.set_ylim(middle[1] - scale * tall / 2, middle[1] + scale * tall / 2)
    _plain(axes)
    axes.set_title(title, fontsize=9, loc="left", color=INK, pad=3, parse_math=False)
    draw_scene(axes, scene, sizes(scene.positions, wide, tall, scale / 72.0, False), scale / 72.0)
    for pose, k in robots:
        _robot(axes, pose, k, scale / 72.0)


def _robot(axes: Axes, pose: Array, k: int, metres_per_point: float) -> None:
    """A robot as a pointed triangle."""
    shape = np.array([(9.0, 0.0), (-6.0, 5.0), (-3.0, 0.0), (-6.0, -5.0)]) * metres_per_point
    corners = se2.transform(pose, shape)
    axes.fill(corners[:, 0], corners[:, 1], facecolor=owner(k).line, edgecolor=INK, linewidth=0.6, zorder=9)


def _plain(axes: Axes) -> None:
    axes.tick_params(labelsize=6, colors=GREY, length=2, width=0.5)
    for spine in axes.spines.values():
        spine.set_color("#9a9a9a")
        spine.set_linewidth(0.6)


def _telling(fused: FusedMap | None) -> PairResult | None:
    """The pair whose rivals are shown: of those that aren't merged the one that is nearest to it."""
    if fused is None or not fused.pairs:
        return None
    return max(fused.pairs, key=lambda pair: (pair.decision != "merged", pair.probability))


def _bars(figure: Figure, box: tuple[float, float, float, float], pair: PairResult | None) -> None:
    """Probabilities of rivals and of no overlap."""
    axes = figure.add_axes(box)
    _plain(axes)
    axes.set_xlim(0, 1)
    axes.set_ylim(-0.6, MOST_BARS + 0.6)
    axes.set_yticks([])
    axes.set_xlabel("probability", fontsize=7, color=GREY, labelpad=1)
    title = "rivals" if pair is None else f"{shortened(pair.maps[1], 16)} on\n{shortened(pair.maps[0], 16)}"
    axes.set_title(title, fontsize=8, loc="left", color=INK, pad=3, parse_math=False)
    if pair is None:
        return
    shown = pair.hypotheses[:MOST_BARS]
    for k, h in enumerate(shown):
        axes.barh(MOST_BARS - k, h.probability, height=0.5, color=INK if k == 0 else GREY)
        degrees = np.degrees(h.T12.theta)
        words = f"{h.count} match, {h.T12.x:.0f}, {h.T12.y:.0f} m, {degrees:.0f}°: {percent(h.probability)}"
        axes.text(0.02, MOST_BARS - k + 0.32, words, fontsize=6.5, color=INK, va="bottom", clip_on=True)
    axes.barh(0, pair.no_overlap_probability, height=0.5, color="#d0d0d0")
    axes.text(0.02, 0.32, f"no overlap: {percent(pair.no_overlap_probability)}", fontsize=6.5, color=INK, va="bottom")


def _merged(figure: Figure, box: tuple[float, float, float, float], shot: Shot, number: Mapping[str, int]) -> None:
    """The largest group's merged map; a statement where nothing is merged."""
    group = None
    if shot.fused is not None:
        sizes_of = [(len(names), -k) for k, names in enumerate(shot.fused.groups)]
        largest, minus = max(sizes_of)
        group = -minus if largest > 1 else None
    if group is None or shot.fused is None:
        axes = figure.add_axes(box)
        _plain(axes)
        axes.set_xticks([])
        axes.set_yticks([])
        axes.text(0.5, 0.5, "nothing is merged", transform=axes.transAxes, ha="center", color=GREY, fontsize=11)
        return
    names = shot.fused.groups[group]
    robots = [(shot.shared[name], number[name]) for name in names if name in shot.shared and name in number]
    title = drawable("merged: " + ", ".join(shortened(name, 18) for name in names))
    _panel(figure, box, scene_of_group(shot.fused, group), title, robots)


__all__ = ["Film", "Shot", "check_film", "draw_shot"]
