"""Where a robot has been: cells of floor that it travelled, so that what it should have seen there can be looked up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Array = NDArray[np.float64]

#: Side [m] of the cells; larger where the map would have more than this many.
_CELL_M = 0.5
_MOST_CELLS = 16_000_000
#: A landmark this close [m] to a travelled way was passed, if the noise isn't larger.
_WIDTH_M = 1.0
#: A landmark this close [m] to the end of a way is not passed but reached.
_END_MARGIN_M = 1.0
#: Directions of ways are told apart in so many.
DIRECTIONS = 8
#: Distance [m] between the samples of a way.
_SAMPLE_M = 3.0
_MOST_SAMPLES = 2_000_000
#: So many samples are painted at once, so that what is worked out for them stays small.
_PAINTED_AT_ONCE = 1024


@dataclass(frozen=True, eq=False)
class Travelled:
    """Cells of floor that a robot has seen: ``low`` (2,) [m] is the corner of cell (0, 0), ``size`` [m] their side.

    ``cells`` (nx, ny): bit d is set where a way in direction d of `DIRECTIONS` (of half a turn) was travelled; without
    links all bits, around the landmarks. ``samples`` (m, 3): x, y, direction [rad] of places on the ways, each standing
    for ``step`` [m] of them (``step`` squared metres without links); ``length``: of all ways [m], or area
    [m^2]; ``width`` [m]: how far across from a way its cells reach.
    """

    low: Array
    size: float
    cells: NDArray[np.uint8]
    samples: Array
    step: float
    length: float
    width: float
    has_links: bool


def travelled(xy: Array, links: NDArray[np.int32], variance: Array) -> Travelled:
    """Cells around the ways between landmarks ``links`` (m, 2) at ``xy`` (n, 2), or around the landmarks if no links.

    As wide as the noise of two landmarks needs (``variance`` (n,) [m^2]), 1 m at least.
    """
    if not len(xy):
        cells, samples = np.zeros((1, 1), dtype=np.uint8), np.zeros((0, 3))
        cells.flags.writeable = samples.flags.writeable = False
        return Travelled(np.zeros(2), 1.0, cells, samples, 1.0, 0.0, 1.0, False)
    width = max(_WIDTH_M, 2 * float(np.sqrt(2 * np.median(variance))))
    samples, step, length = _along(xy, links) if len(links) else _around(xy)
    around = width if len(links) else 0.0
    at = samples[:, :2] if len(samples) else xy[:1]
    low, high = at.min(axis=0) - around - 1e-6, at.max(axis=0) + around + 1e-6
    area = float(np.prod(np.maximum(high - low, 1.0)))
    size = max(_CELL_M, float(np.sqrt(area / _MOST_CELLS)), 0.0 if len(links) else step)
    if not len(links):
        low, high = low - size / 2, high + size / 2
    n_cells = np.maximum(np.ceil((high - low) / size).astype(np.intp), 1)
    if n_cells.prod() > 4 * _MOST_CELLS:
        size = float((high - low).max()) / np.sqrt(_MOST_CELLS)
        n_cells = np.maximum(np.ceil((high - low) / size).astype(np.intp), 1)
    cells = np.zeros(n_cells, dtype=np.uint8)
    if len(links):
        _paint(cells, low, size, samples, width)
    else:
        place = np.clip(((samples[:, :2] - low) / size).astype(np.intp), 0, n_cells - 1)
        cells[place[:, 0], place[:, 1]] = 255
    samples = np.ascontiguousarray(samples)
    cells.flags.writeable = samples.flags.writeable = False
    return Travelled(low, size, cells, samples, step, length, width, bool(len(links)))


def _along(xy: Array, links: NDArray[np.int32]) -> tuple[Array, float, float]:
    """Samples of all ways inside their ends, what each stands for, and the length of all."""
    off_centre = np.hypot(*(xy - xy.mean(axis=0)).T)
    swap = off_centre[links[:, 0]] > off_centre[links[:, 1]]
    start, end = xy[np.where(swap, links[:, 1], links[:, 0])], xy[np.where(swap, links[:, 0], links[:, 1])]
    # in an order that neither frame nor file has a say in: every so many of the samples may be taken later
    order = np.lexsort(
        (np.hypot(*((start + end) / 2 - xy.mean(axis=0)).T).round(6), np.hypot(*(end - start).T).round(6))
    )
    start, end = start[order], end[order]
    length = np.hypot(*(end - start).T)
    step = max(_SAMPLE_M, float(length.sum()) / _MOST_SAMPLES)
    count = np.floor(np.maximum(length - 2 * _END_MARGIN_M, 0) / step).astype(np.intp) + (length > 2 * _END_MARGIN_M)
    way = np.repeat(np.arange(len(links)), count)
    place = np.arange(len(way)) - np.repeat(np.cumsum(count) - count, count)
    inside = np.maximum(length - 2 * _END_MARGIN_M, 0)
    along = (_END_MARGIN_M + (place + 0.5) * inside[way] / np.maximum(count[way], 1)) / np.maximum(length[way], 1e-9)
    at = start[way] + along[:, None] * (end - start)[way]
    direction = np.arctan2(end[way, 1] - start[way, 1], end[way, 0] - start[way, 0])
    return np.column_stack([at, direction]), step, float(length.sum())


def _paint(cells: NDArray[np.uint8], low: Array, size: float, samples: Array, width: float) -> None:
    """Mark what lies within ``width`` [m] across each sample, as long as the sample's stretch."""
    unit = np.stack([np.cos(samples[:, 2]), np.sin(samples[:, 2])], axis=1)
    normal = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    direction = np.floor(samples[:, 2] / (np.pi / DIRECTIONS)).astype(np.intp) % DIRECTIONS
    bit = np.left_shift(np.uint8(1), direction.astype(np.uint8))
    fine = size / 2
    flat, last = cells.reshape(-1), np.array(cells.shape) - 1
    across = np.arange(-width, width + fine / 2, fine)[:, None, None, None]
    along = np.arange(-0.5, 0.51, fine / _SAMPLE_M)[:, None, None] * _SAMPLE_M
    for begin in range(0, len(samples), _PAINTED_AT_ONCE):
        some = slice(begin, begin + _PAINTED_AT_ONCE)
        at = samples[some, :2] + across * normal[some] + along * unit[some]
        place = np.clip(np.floor((at - low) / size).astype(np.intp), 0, last)
        index = place[..., 0] * cells.shape[1] + place[..., 1]
        np.bitwise_or.at(flat, index, np.broadcast_to(bit[some], index.shape))


def _around(xy: Array) -> tuple[Array, float, float]:
    """Without links: a robot is taken to have seen what is no further from a landmark than the third nearest other."""
    k = min(4, len(xy))
    reach = np.asarray(KDTree(xy).query(xy, k=k)[0]).reshape(len(xy), -1)[:, -1]
    reach = np.clip(reach, 0.5, 3 * max(float(np.median(reach)), 0.5))
    step = max(float(np.median(reach)) / 2, 0.5)
    ring = np.arange(-6, 7)
    offset = np.stack(np.meshgrid(ring, ring, indexing="ij"), axis=-1).reshape(-1, 2)
    offset = offset[np.argsort(np.hypot(*offset.T), kind="stable")]
    found = []
    cell = np.floor(xy / step).astype(np.int64)
    for o in offset:
        near = np.hypot(*o) * step <= reach
        found.append(cell[near] + o)
    seen = np.unique(np.concatenate(found), axis=0)
    at = (seen + 0.5) * step
    return np.column_stack([at, np.zeros(len(at))]), step, float(len(at)) * step**2
