"""What the search among landmarks without heading needs of one map: neighbours, density, a grid; once per map."""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from .landmark_arrays import Codes, LandmarkArrays

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Neighbours listed of each landmark: so many pairs in all, between the least and the most of each.
_LISTED, _FEWEST, _MOST = 32_000, 24, 60
_DENSITY_NEIGHBOURS = 6
_REACH_NEIGHBOURS = 3
_MOST_CELLS = 1 << 20
#: Angles are whole numbers of this many to a turn, so that differences wrap by themselves.
ANGLE_STEPS = 65536


@dataclass(frozen=True, eq=False)
class SpatialGrid:
    """Landmarks in square cells: those of cell (column, row) are ``members[start[c]:start[c + 1]]``, c = column *
    rows + row. ``box`` (3,): corner x, y and side [m]; ``shape`` (2,): columns, rows."""

    start: Codes
    members: Codes
    box: Array
    shape: Codes


def spatial_grid(xy: Array, side: float) -> SpatialGrid:
    """Landmarks (n, 2) in cells of that side [m] or larger: at most about a million of them."""
    low, extent = xy.min(axis=0), np.ptp(xy, axis=0)
    side = max(side, 1e-9, float(extent.max()) / _MOST_CELLS, float(np.sqrt(extent.prod() / _MOST_CELLS)))
    shape = np.floor(extent / side).astype(np.int32) + 1
    cell = np.minimum(((xy - low) / side).astype(np.int32), shape - 1)
    index = cell[:, 0].astype(np.int64) * shape[1] + cell[:, 1]
    start = np.zeros(int(shape[0]) * int(shape[1]) + 1, dtype=np.int32)
    np.cumsum(np.bincount(index, minlength=len(start) - 1), out=start[1:])
    members = np.argsort(index, kind="stable").astype(np.int32)
    return SpatialGrid(start, members, np.array([*low, side]), shape)


@dataclass(frozen=True, eq=False)
class PointArrays:
    """One map's n landmarks, in an order that neither its frame nor its file has a say in; lengths in metres.

    ``order`` (n,): the place of each in the map. ``xy`` (n, 2), ``variance`` (n,) [m^2 per axis], ``label`` (n,): into
    the map's labels, ``recorded`` (n,): probability that a place is in the map and a landmark is there. ``near``
    (n, k), ``length``, ``angle``: each one's nearest others, how far, and in which direction, seen from
    that of the nearest (`ANGLE_STEPS` a turn); ``direction`` (n,): of the nearest, in the map's frame [rad].
    ``density`` (n,) [1 / m^2]: of landmarks around each; ``share`` (n,): of those, what its label has in the map.
    ``reach`` (n,): how far around each the robot has looked, as far as its neighbours tell.
    """

    order: Indices
    xy: Array
    variance: Array
    label: Codes
    recorded: Array
    near: Codes
    length: Array
    angle: Codes
    direction: Array
    density: Array
    share: Array
    reach: Array

    def __len__(self) -> int:
        return len(self.xy)

    @cached_property
    def key(self) -> tuple[float, ...]:
        """What tells two maps apart, whatever their frames."""
        return (float(len(self)), *np.round(self.length.mean(axis=0), 6).tolist())

    @cached_property
    def reach_grid(self) -> SpatialGrid:
        """Cells in which all landmarks that may have been looked around are found next door."""
        return spatial_grid(self.xy, float(self.reach.max()))

    @cached_property
    def _grids(self) -> dict[float, SpatialGrid]:
        return {}

    def grid(self, side: float) -> SpatialGrid:
        """Cells of that side; the last few are kept."""
        found = self._grids.get(side)
        if found is None:
            if len(self._grids) > 3:
                self._grids.clear()
            found = self._grids[side] = spatial_grid(self.xy, side)
        return found


_kept: weakref.WeakKeyDictionary[LandmarkArrays, PointArrays | None] = weakref.WeakKeyDictionary()


def point_arrays(arrays: LandmarkArrays) -> PointArrays | None:
    """The value of a map, worked out at the first call and kept; None for a map without two places."""
    if arrays not in _kept:
        _kept[arrays] = _read(arrays)
    return _kept[arrays]


def _read(arrays: LandmarkArrays) -> PointArrays | None:
    xy = arrays.xy
    places, one_of, heap = np.unique(xy, axis=0, return_index=True, return_inverse=True)
    n, n_places = len(xy), len(places)
    if n_places < 2:
        return None
    k = min(int(np.clip(_LISTED // n, _FEWEST, _MOST)), n - 1)
    near, length = _neighbours(xy, k) if n_places == n else _of_heaps(places, one_of, heap.reshape(-1), k)
    nearest = length[:, : min(_DENSITY_NEIGHBOURS, length.shape[1])]
    # At one spot the density would be infinite; closer than their noise they can't be told apart anyway.
    furthest = np.maximum(nearest[:, -1], 2 * np.sqrt(arrays.variance))
    density = nearest.shape[1] / (np.pi * furthest**2)
    share = np.bincount(arrays.label)[arrays.label] / n
    reach = length[:, min(_REACH_NEIGHBOURS, length.shape[1]) - 1]
    reach = np.clip(reach, 1e-6, 4 * max(float(np.median(reach)), 1e-6))
    digits = np.round(nearest, 7)
    order = np.lexsort((xy[:, 1], xy[:, 0], *digits.T[::-1], arrays.label))
    rank = np.empty(n, dtype=np.int32)
    rank[order] = np.arange(n, dtype=np.int32)
    offset = xy[near] - xy[:, None]
    angle = np.arctan2(offset[..., 1], offset[..., 0])
    direction = angle[:, 0].copy()
    angle = np.floor((angle - direction[:, None]) * (ANGLE_STEPS / (2 * np.pi)))
    angle = (angle.astype(np.int32) % ANGLE_STEPS).astype(np.int32)
    ordered = [np.ascontiguousarray(values[order]) for values in (arrays.label, rank[near], angle)]
    label, listed, angle = ordered
    xy, variance, recorded, length = (
        np.ascontiguousarray(values[order]) for values in (xy, arrays.variance, arrays.recorded, length)
    )
    return PointArrays(
        order,
        xy,
        variance,
        label,
        recorded,
        listed,
        length,
        angle,
        direction[order],
        density[order],
        share[order],
        reach[order],
    )


def _neighbours(xy: Array, k: int) -> tuple[Indices, Array]:
    """The k nearest others of each (n, 2): (n, k) places and distances."""
    length, near = (np.asarray(values) for values in KDTree(xy).query(xy, k=k + 1))
    return near[:, 1:].astype(np.intp), length[:, 1:]


def _of_heaps(places: Array, one_of: Indices, heap: Indices, k: int) -> tuple[Indices, Array]:
    """The same where several are at one spot: one stands for each spot; none is listed with those at its own."""
    near, length = _neighbours(places, min(k, len(places) - 1))
    return one_of[near][heap], length[heap]
