"""Scenes, paths and matrices as plain values for a page's script: rounded, around an origin of their own.

A browser draws with single precision, so that coordinates far from zero would tremble: each frame has an ``origin``
(2,) [m] that is taken off all its coordinates and told beside them.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.maps import LandmarkMap

from ..show.scene import Scene, scene_of_map
from ..show.words import drawable

Array = NDArray[np.float64]

#: Ids and names are told up to this many characters.
LONGEST = 80
#: Points that one line of the page has at most; of more, every second, fourth, ... is drawn.
MOST_POINTS = 8000


def text(value: str) -> str:
    """Text of a file, safe to be shown: without control characters, its middle left out where it is very long.

    >>> text("a" * 10_000)[38:43], len(text("a" * 10_000))
    ('aa…aa', 80)
    """
    shown = drawable(value).replace("\n", " ")
    half = LONGEST // 2
    return shown if len(shown) <= LONGEST else f"{shown[:half]}…{shown[1 - half :]}"


def number(value: float, digits: int = 3) -> float:
    """A number with so many significant digits.

    >>> number(0.0123456), number(0.0)
    (0.0123, 0.0)
    """
    return float(f"{float(value):.{digits}g}")


def flat(points: Array, origin: Array) -> list[float]:
    """Points (k, 2) as x, y, x, y, ... to the millimetre, around an origin (2,)."""
    return [round(value, 3) for value in (points - origin).reshape(-1).tolist()]


def thinned(points: Array, most: int = MOST_POINTS) -> Array:
    """At most so many of the points (k, 2), evenly chosen, both ends among them."""
    if len(points) <= most:
        return points
    return points[np.linspace(0, len(points) - 1, most).round().astype(np.intp)]


def origin_of(positions: Array) -> Array:
    """The middle (2,) [whole metres] of positions (n, 2); zero where there are none."""
    return np.round(np.median(positions, axis=0)) if len(positions) else np.zeros(2)


def scene_plain(scene: Scene, origin: Array) -> dict[str, Any]:
    """All that a page draws of a scene."""
    covariances: list[list[float] | None] = [None] * len(scene)
    for k, C in zip(scene.covariance_of.tolist(), scene.covariances, strict=True):
        covariances[k] = [number(C[0, 0], 4), number(C[0, 1], 4), number(C[1, 1], 4)]
    arms: list[list[float]] = [[] for _ in scene.ids]
    for arm in scene.arms:
        arms[arm.landmark] += [round(arm.heading, 3), 1 if arm.passable else 0]
    return {
        "at": flat(scene.positions, origin),
        "kinds": [kind.value for kind in scene.kinds],
        "ids": [text(identifier) for identifier in scene.ids],
        "owners": scene.owners.tolist(),
        "doubtful": np.flatnonzero(scene.doubtful).tolist(),
        "arms": arms,
        "links": np.column_stack([scene.links, scene.link_owners]).reshape(-1).tolist(),
        "covariances": covariances,
        "walls": [flat(thinned(wall), origin) for wall in scene.walls if len(wall) > 1],
        "origin": origin.tolist(),
    }


def map_plain(map_: LandmarkMap, k: int) -> dict[str, Any]:
    """The scene of the k-th map, its path, and what its landmarks say of themselves."""
    origin = origin_of(map_.positions)
    plain = scene_plain(scene_of_map(map_, k), origin)
    if map_.path is not None and len(map_.path):
        plain["path"] = flat(thinned(np.asarray(map_.path)[:, 1:3]), origin)
    plain["counters"] = [[l.visit_counter, l.detection_counter] for l in map_.landmarks]
    plain["existence"] = [None if l.existence is None else round(l.existence, 4) for l in map_.landmarks]
    return plain


def pose_between(T: Array, origin1: Array, origin2: Array) -> list[float]:
    """T12 (3,) between the same frames with their origins moved to ``origin1`` and ``origin2`` (2,)."""
    x, y = se2.transform(T, origin2) - origin1
    return [round(float(x), 4), round(float(y), 4), round(float(T[2]), 6)]


def shades(values: Array, most: int = 256) -> dict[str, Any]:
    """A square matrix of values in [0, 1] as bytes, its blocks' largest ones where it has more rows than ``most``.

    >>> shades(np.eye(4), 2)["size"]
    2
    """
    step = -(-len(values) // most)
    size = -(-len(values) // step) if len(values) else 0
    padded = np.zeros((size * step, size * step))
    padded[: len(values), : len(values)] = np.clip(values, 0.0, 1.0)
    pooled = padded.reshape(size, step, size, step).max(axis=(1, 3)) if size else padded
    encoded = base64.b64encode((pooled * 255).round().astype(np.uint8).tobytes()).decode("ascii")
    return {"size": size, "step": step, "bytes": encoded}


def sigmas(covariance: Array | None) -> list[float] | None:
    """Standard deviations of a covariance, the last one of a pose in degrees."""
    if covariance is None:
        return None
    found = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return [number(s) for s in (found * [1.0, 1.0, 180 / np.pi]).tolist()]


def correlations(covariance: Array | None) -> list[list[float]] | None:
    """Correlations of a covariance, zero where nothing varies."""
    if covariance is None:
        return None
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(sigma > 0, sigma, np.inf)
    rows: list[list[float]] = np.round(covariance / scale[:, None] / scale, 3).tolist()
    return rows


def places(ids: Sequence[str], index_from_id: dict[str, int] | Any) -> list[int]:
    """Places of landmarks in their map, those that it doesn't have left out."""
    return [index_from_id[identifier] for identifier in ids if identifier in index_from_id]


def described(items: Iterable[tuple[str, str]]) -> list[list[str]]:
    """Rows of label and text."""
    return [[label, value] for label, value in items]
