"""One panel: a scene drawn into axes whose scale [metres per point] is fixed beforehand."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.markers import MarkerStyle
from numpy.typing import NDArray

from mapfuse.datasets.arms import Kind

from .labels import place_labels
from .scene import COMMON_OWNER, Scene
from .style import CHI2_95, COMMON, GREY, INK, MARKER_FROM_KIND, WALL, Owner, Sizes, owner

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

#: Names under which the artists of a panel are found again (``artist.get_gid()``).
RINGS, MARKERS, DOUBTFUL_MARKERS, ELLIPSES, LINKS = "common", "landmarks", "doubtful", "ellipses", "links"


def look(k: int) -> Owner:
    """How what the k-th map recorded looks, or what several maps did."""
    return COMMON if k == COMMON_OWNER else owner(k)


def ellipse_axes(covariances: Array) -> tuple[Array, Array, Array]:
    """Full widths and heights [m] of the 95 % ellipses of (n, 2, 2) [m^2] and the angle [degrees] of the width.

    Half an axis is ``sqrt(5.991 * eigenvalue)``, 5.991 being the 95 % quantile of chi-square with 2 degrees.

    >>> width, height, angle = ellipse_axes(np.array([[[4.0, 0.0], [0.0, 1.0]]]))
    >>> float(width[0].round(3)), float(height[0].round(3))
    (9.791, 4.895)
    """
    values, vectors = np.linalg.eigh(covariances)
    full = 2.0 * np.sqrt(CHI2_95 * np.maximum(values, 0.0))
    return full[:, 1], full[:, 0], np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))


def draw_scene(axes: Axes, scene: Scene, size: Sizes, metres_per_point: float, ellipse_scale: float = 1.0) -> None:
    """Walls, ellipses, links, arms, landmarks, rings and ids, in that order from below."""
    _draw_walls(axes, scene)
    _draw_ellipses(axes, scene, ellipse_scale)
    _draw_links(axes, scene, size)
    _draw_arms(axes, scene, size, metres_per_point)
    _draw_landmarks(axes, scene, size)
    _draw_rings(axes, scene, size)
    if size.label is not None:
        place_labels(axes, scene, size, metres_per_point)


def _draw_walls(axes: Axes, scene: Scene) -> None:
    walls = [wall for wall in scene.walls if len(wall) > 1]
    axes.add_collection(LineCollection(walls, colors=WALL, linewidths=0.6, zorder=1), autolim=False)


def _draw_ellipses(axes: Axes, scene: Scene, scale: float) -> None:
    width, height, angle = ellipse_axes(scene.covariances)
    axes.add_collection(
        EllipseCollection(
            width * scale,
            height * scale,
            angle,
            units="xy",
            offsets=scene.positions[scene.covariance_of],
            offset_transform=axes.transData,
            facecolors="#00000014",
            edgecolors=GREY,
            linewidths=0.6,
            zorder=2,
            gid=ELLIPSES,
        ),
        autolim=False,
    )


def _draw_links(axes: Axes, scene: Scene, size: Sizes) -> None:
    for k in np.unique(scene.link_owners):
        style = look(int(k))
        axes.add_collection(
            LineCollection(
                list(scene.positions[scene.links[scene.link_owners == k]]),
                colors=style.line,
                linestyles=[style.linestyle],
                linewidths=size.line,
                alpha=0.9,
                zorder=3,
                gid=LINKS,
            ),
            autolim=False,
        )


def _draw_arms(axes: Axes, scene: Scene, size: Sizes, metres_per_point: float) -> None:
    """Ticks into the corridors that go on, bars across those that are blocked."""
    if not scene.arms:
        return
    place = np.array([arm.landmark for arm in scene.arms])
    heading = np.array([arm.heading for arm in scene.arms])
    passable = np.array([arm.passable for arm in scene.arms])
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    across = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    outside = np.where(scene.common[place], size.ring, size.marker)[:, None] / 2
    at = scene.positions[place]
    tip = at + ahead * (outside + 0.55 * size.marker) * metres_per_point
    bar = at + ahead * (outside + 0.25 * size.marker) * metres_per_point
    half = across * 0.45 * size.marker * metres_per_point
    ticks, bars = np.stack([at, tip], axis=1), np.stack([bar - half, bar + half], axis=1)
    segments = np.where(passable[:, None, None], ticks, bars)
    colours = [look(int(k)).line for k in scene.owners[place]]
    axes.add_collection(LineCollection(list(segments), colors=colours, linewidths=size.line, zorder=4), autolim=False)


def _groups(scene: Scene) -> Iterator[tuple[Kind, int, bool, NDArray[np.intp]]]:
    """Landmarks that look alike: kind, owner, doubtful, and their places."""
    keys = list(zip(scene.kinds, scene.owners.tolist(), scene.doubtful.tolist(), strict=True))
    for key in sorted(set(keys), key=lambda key: (key[1], key[2], key[0].value)):
        yield (*key, np.array([k for k, other in enumerate(keys) if other == key], dtype=np.intp))


def _draw_landmarks(axes: Axes, scene: Scene, size: Sizes) -> None:
    for kind, k, doubtful, where in _groups(scene):
        style = look(k)
        # A hollow marker takes the map's own line colour: an edge in the common ink would hide who recorded it.
        axes.scatter(
            scene.positions[where, 0],
            scene.positions[where, 1],
            s=size.marker**2,
            marker=MarkerStyle(MARKER_FROM_KIND[kind]),
            facecolors="#ffffff" if doubtful else style.fill,
            edgecolors=style.line if doubtful else style.edge,
            linewidths=max(0.8, 0.18 * size.marker) if doubtful else 0.1 * size.marker,
            zorder=6,
            gid=DOUBTFUL_MARKERS if doubtful else MARKERS,
        )


def _draw_rings(axes: Axes, scene: Scene, size: Sizes) -> None:
    if not scene.common.any():
        return
    axes.scatter(
        scene.positions[scene.common, 0],
        scene.positions[scene.common, 1],
        s=size.ring**2,
        marker="o",
        facecolors="none",
        edgecolors=INK,
        linewidths=max(0.7, 0.14 * size.marker),
        zorder=7,
        gid=RINGS,
    )
