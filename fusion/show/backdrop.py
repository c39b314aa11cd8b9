"""`Backdrop`: what lies beneath a map: the true building, where the robot was and thought it was, what it detected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.logs import LogTruth

from .journey import Journey, corrected, sensed_at
from .style import ALARM, BUILDING, INK, MAPPED, ODOMETRY, SENSED, Sizes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

#: Names under which the artists are found again (``artist.get_gid()``).
WALLS, TRUE_PATH, MAPPED_PATH, DEAD_RECKONING, POINTS = (
    "building",
    "true path",
    "mapped path",
    "odometry",
    "scan points",
)
DETECTIONS, FALSE_ALARMS, PLACES = "detections", "false alarms", "places"


@dataclass(frozen=True, eq=False, slots=True)
class Backdrop:
    """Everything in one frame [m]; what isn't known is empty.

    ``walls`` (n, 2, 2): the true building's, ``places`` (p, 2): its landmarks. ``true_path``, ``odometry``, and
    ``mapped``, the path that a map has (n, 2). ``points`` (s, 2): what scans hit. ``detections`` (m, 2), of which those
    that are ``false`` (m,) weren't there.
    """

    walls: Array
    places: Array
    true_path: Array
    odometry: Array
    mapped: Array
    points: Array
    detections: Array
    false: NDArray[np.bool_]

    @property
    def spots(self) -> tuple[Array, ...]:
        """All that must be in the picture, as points (k, 2).

        Scan points may reach beyond its edge, and so may odometry, which drifts away, where anything better is known.
        """
        better = self.walls.reshape(-1, 2), self.places, self.true_path, self.mapped
        known = any(len(points) for points in better)
        return (*better, self.detections) if known else (self.odometry, self.detections)

    def moved(self, T: ArrayLike) -> Backdrop:
        """The same in another frame: ``T`` (3,) takes this frame's coordinates there."""
        return replace(
            self,
            walls=se2.transform(T, self.walls),
            places=se2.transform(T, self.places),
            true_path=se2.transform(T, self.true_path),
            odometry=se2.transform(T, self.odometry),
            mapped=se2.transform(T, self.mapped),
            points=se2.transform(T, self.points),
            detections=se2.transform(T, self.detections),
        )


def backdrop(
    drive: Journey | None = None,
    truth: LogTruth | None = None,
    *,
    walls: ArrayLike = (),
    places: ArrayLike = (),
    path: Array | None = None,
    sensed: bool = True,
) -> Backdrop:
    """What is known of a drive, in the world where there is a truth, else in the frame of the robot's start.

    ``walls`` and ``places``: the true ones, in the world. ``path`` (n, 4): time and poses of a map in the frame of the
    start, by which detections are placed where there is no truth; without it they are placed by odometry.
    ``sensed`` False: without detections and scan points.
    """
    start = np.zeros(3) if truth is None or not len(truth.path) else truth.path[0, 1:]
    none = np.zeros((0, 2))
    if path is not None and drive is not None:
        path = corrected(drive.odometry, path)
    odometry = none if drive is None else se2.transform(start, drive.odometry[:, 1:3])
    true_path = none if truth is None else truth.path[:, 1:3]
    points, detections = none, none
    if sensed and drive is not None:
        if truth is not None:
            points, detections = (sensed_at(truth.path, of) for of in (drive.points, drive.detections))
        else:
            by = drive.odometry if path is None else path
            points, detections = (se2.transform(start, sensed_at(by, of)) for of in (drive.points, drive.detections))
    false = np.zeros(len(detections), dtype=bool)
    if truth is not None and len(truth.detections) == len(detections):
        false = np.array([place is None for place in truth.detections], dtype=bool)
    return Backdrop(
        np.asarray(walls, dtype=float).reshape(-1, 2, 2),
        np.asarray(places, dtype=float).reshape(-1, 2),
        true_path,
        odometry,
        none if path is None else se2.transform(start, path[:, 1:3]),
        points,
        detections,
        false,
    )


def draw_backdrop(axes: Axes, ground: Backdrop, size: Sizes) -> None:
    """The building, its landmarks, paths, scan points and detections, from below."""
    from matplotlib.collections import LineCollection

    axes.add_collection(
        LineCollection(list(ground.walls), colors=BUILDING, linewidths=2.2, zorder=0.5, gid=WALLS), autolim=False
    )
    _scatter(axes, ground.points, POINTS, marker=".", s=0.6, c=SENSED, linewidths=0, zorder=0.8)
    if len(ground.true_path):
        axes.plot(*ground.true_path.T, color=INK, linewidth=0.7, alpha=0.75, zorder=2.2, gid=TRUE_PATH)
    if len(ground.odometry):
        axes.plot(*ground.odometry.T, color=ODOMETRY, linewidth=0.7, linestyle=(0, (4, 2)), zorder=2.1,
                  gid=DEAD_RECKONING)  # fmt: skip
    if len(ground.mapped):
        axes.plot(*ground.mapped.T, color=MAPPED, linewidth=0.7, linestyle=(0, (1, 1)), zorder=2.3, gid=MAPPED_PATH)
    dot = float(np.clip(60 / np.sqrt(max(len(ground.detections), 1)), 0.2, 0.55)) * size.marker
    _scatter(axes, ground.places, PLACES, marker="+", s=(1.3 * size.marker) ** 2, c=INK, linewidths=0.7, zorder=6.5)
    _scatter(axes, ground.detections[~ground.false], DETECTIONS, marker="o", s=dot**2, c=SENSED, linewidths=0,
             alpha=0.8, zorder=2.5)  # fmt: skip
    _scatter(axes, ground.detections[ground.false], FALSE_ALARMS, marker="x", s=(1.4 * dot) ** 2, c=ALARM,
             linewidths=0.8, zorder=2.6)  # fmt: skip


def _scatter(axes: Axes, points: Array, gid: str, **looks: object) -> None:
    if len(points):
        axes.scatter(*points.T, gid=gid, **looks)  # type: ignore[arg-type]


def extent(parts: Sequence[Array]) -> tuple[Array, Array] | None:
    """Lower and upper corner (2,) of points (k, 2); None where there are none."""
    points = np.concatenate([part.reshape(-1, 2) for part in parts]) if parts else np.zeros((0, 2))
    return (points.min(axis=0), points.max(axis=0)) if len(points) else None
