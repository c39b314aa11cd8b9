"""Maps and results drawn into axes that exist already, as in a notebook: `plot_map`, `plot_fused`, `plot_pair`, ...

As matplotlib's own methods do, each takes the axes first, adds to what they show, and returns the artists it added.
Axes that show nothing yet get equal scales and limits that fit; call ``ax.legend()`` to name what has a ``label``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from mapfuse.datasets.errors import ConfigError
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.transform import Transform

from ..result import FusedMap, PairResult
from .backdrop import Backdrop
from .layout import Panel
from .scene import Scene, laid_together, scene_of_group, scene_of_map

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from mapfuse.datasets.simulation.building import Building

    from .log_page import Drive


def plot_map(
    ax: Axes,
    map_: LandmarkMap,
    T: Transform | None = None,
    *,
    look: int = 0,
    label: str | None = None,
    ids: bool | None = None,
    ellipse_scale: float = 1.0,
) -> list[Artist]:
    """Draws a map in its own frame, or where ``T`` lays it: walls, ellipses, links, arms, landmarks.

    ``look``: maps that are drawn together get different ones, 0, 1, ...; ``label``: for the legend; ``ids``: whether
    landmarks are labelled, by itself where they are few; ``ellipse_scale``: 95 % ellipses drawn that much larger.

    >>> from matplotlib.figure import Figure
    >>> from mapfuse.datasets.maps import Landmark, LandmarkMap
    >>> ax = Figure().add_subplot()
    >>> artists = plot_map(ax, LandmarkMap("D1", (Landmark("c1", "corner", 0.0, 0.0),)), label="D1")
    >>> ax.get_legend_handles_labels()[1], all(artist in ax.get_children() for artist in artists)
    (['D1'], True)
    """
    scene = scene_of_map(map_, look)
    return _plot(ax, scene if T is None else scene.moved(T.array), label=label, ids=ids, ellipse_scale=ellipse_scale)


def plot_fused(
    ax: Axes,
    fused: FusedMap,
    group: int = 0,
    *,
    label: str | None = None,
    ids: bool | None = None,
    ellipse_scale: float = 1.0,
) -> list[Artist]:
    """Draws a group's merged map in the frame of its first map; common landmarks are ringed, doubtful ones hollow.

    Raises ConfigError where there is no such group. Other parameters as for `plot_map`.
    """
    if not 0 <= group < len(fused.groups):
        raise ConfigError(f"there is no group {group}: the result has {len(fused.groups)}, counted from 0")
    return _plot(ax, scene_of_group(fused, group), label=label, ids=ids, ellipse_scale=ellipse_scale)


def plot_pair(
    ax: Axes,
    fused: FusedMap,
    maps: tuple[str, str] | None = None,
    hypothesis: int = 0,
    *,
    label: str | None = None,
    ellipse_scale: float = 1.0,
) -> list[Artist]:
    """Draws map 2 of a pair laid onto map 1 under one of its hypotheses, nothing merged, matches joined by lines.

    ``maps``: the pair's names in either order, by default those of the first pair. Raises ConfigError where there is
    no such pair or hypothesis, or where the recorded maps aren't embedded. Other parameters as for `plot_map`.
    """
    pair = pair_of(fused, maps)
    if not 0 <= hypothesis < len(pair.hypotheses):
        raise ConfigError(f"there is no hypothesis {hypothesis}: {' and '.join(pair.maps)} have {len(pair.hypotheses)}")
    if missing := [name for name in pair.maps if name not in fused.sources]:
        raise ConfigError(f"the recorded map {missing[0]} isn't embedded in this result, so it can't be drawn")
    chosen = pair.hypotheses[hypothesis]
    first, second = (scene_of_map(fused.sources[name], fused.maps.index(name)) for name in pair.maps)
    laid = second.moved(chosen.T12.array)
    artists = _plot(ax, laid_together(first, laid), label=label, ids=False, ellipse_scale=ellipse_scale)
    matched = chosen.correspondences or (pair.correspondences if hypothesis == 0 else ())
    if matched:
        from matplotlib.collections import LineCollection

        index1, index2 = (fused.sources[name].index_from_id for name in pair.maps)
        ends = [(first.positions[index1[a]], laid.positions[index2[b]]) for a, b in matched]
        lines = LineCollection(np.array(ends).tolist(), colors="#B000B0", linewidths=1.6, zorder=8, gid="matches")
        artists.append(ax.add_collection(lines, autolim=False))
    return artists


def pair_of(fused: FusedMap, maps: tuple[str, str] | None) -> PairResult:
    """The pair of these maps, named in either order; the first one for None.

    Raises ConfigError where there is none.
    """
    found = [pair for pair in fused.pairs if maps is None or set(pair.maps) == set(maps)]
    if not found:
        asked = "a pair" if maps is None else f"the pair {' and '.join(maps)}"
        raise ConfigError(f"there isn't {asked} in this result; its maps are {', '.join(fused.maps)}")
    return found[0]


def plot_log(ax: Axes, drive: Drive, *, label: str | None = None, ids: bool | None = None) -> list[Artist]:
    """Draws a drive: path by odometry, detections, scan points, and truth and map where they are known."""
    from .log_page import log_panel

    panel = log_panel(drive)
    return _plot(ax, panel.scene, panel.ground, label=label, ids=ids)


def plot_building(ax: Axes, building: Building) -> list[Artist]:
    """Draws a building's walls and its true landmarks."""
    from .backdrop import backdrop

    ground = backdrop(walls=building.walls, places=building.floor.positions)
    return _plot(ax, scene_of_map(LandmarkMap(building.name)), ground)


def _plot(
    ax: Axes,
    scene: Scene,
    ground: Backdrop | None = None,
    *,
    label: str | None = None,
    ids: bool | None = None,
    ellipse_scale: float = 1.0,
) -> list[Artist]:
    from .backdrop import draw_backdrop
    from .panel import draw_scene
    from .style import sizes

    def draw() -> None:
        width, height, metres_per_point = _fitted(ax, Panel("", scene, ground=ground))
        size = sizes(scene.positions, width, height, metres_per_point, ids)
        if ground is not None:
            draw_backdrop(ax, ground, size)
        draw_scene(ax, scene, size, metres_per_point, ellipse_scale)

    artists = _added(ax, draw)
    if label is not None and artists:
        marked = [artist for artist in artists if artist.get_gid() in ("landmarks", "doubtful")]
        (marked or artists)[0].set_label(label)
    return artists


def _added(ax: Axes, draw: Callable[[], None]) -> list[Artist]:
    """What the call adds to the axes."""
    before: Sequence[Artist] = ax.get_children()
    known = set(map(id, before))
    draw()
    return [artist for artist in ax.get_children() if id(artist) not in known]


def _fitted(ax: Axes, panel: Panel) -> tuple[float, float, float]:
    """Width and height [inches] of the axes and metres per point; limits are widened so that the panel is inside."""
    from .layout import scale

    box, dpi = ax.get_window_extent(), ax.get_figure(root=True).dpi  # type: ignore[union-attr]
    width, height = box.width / dpi, box.height / dpi
    low, high = panel.extent
    if ax.has_data() and not ax.get_autoscale_on():
        shown = np.array([ax.get_xlim(), ax.get_ylim()]).T
        inside = (low >= shown.min(axis=0)).all() and (high <= shown.max(axis=0)).all()
        low, high = np.minimum(low, shown.min(axis=0)), np.maximum(high, shown.max(axis=0))
        if inside:
            return width, height, float((high - low).max() / (72 * max(width, height)))
    fitting = max((high - low)[0] / max(width - 0.4, 0.5), (high - low)[1] / max(height - 0.4, 0.5))
    metres_per_inch = float(fitting) if ax.has_data() else scale(panel, width, height)
    centre, reach = (low + high) / 2, np.array([width, height]) * metres_per_inch / 2
    ax.set_xlim(centre[0] - reach[0], centre[0] + reach[0])
    ax.set_ylim(centre[1] - reach[1], centre[1] + reach[1])
    ax.set_aspect("equal", adjustable="box")
    return width, height, metres_per_inch / 72.0
