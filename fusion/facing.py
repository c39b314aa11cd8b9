"""Walls of two maps that face each other under a hypothesis: where the one's offset from the other can be measured.

Each piece hangs on the keyframe that saw it. Two pieces face each other where they run alike, lie next to each other,
and were seen from the same side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Keyframes
from mapfuse.factors.walls import Facing

Array = NDArray[np.float64]
Places = NDArray[np.intp]
Two = tuple[Array, Array]

#: Pieces that face each other on less than `LEAST_M` [m] say nothing, on less than `SHORT_M` no more than their middle.
LEAST_M, SHORT_M = 0.75, 2.0
#: Pieces run alike where the cosine of the angle between their normals is above this.
ALIKE = 0.96


@dataclass(frozen=True, eq=False, slots=True)
class Pieces:
    """Straight pieces (p,) of wall: ends (p, 2, 2) [m] in the frame of the keyframe ``at`` (p,) that saw them.

    ``seen`` (p,): 1 where the keyframe lies to the left of the piece, else -1.
    """

    ends: Array
    at: Places
    seen: Array

    def __len__(self) -> int:
        return len(self.at)


def pieces_of(keyframes: Keyframes) -> Pieces:
    """The walls that keyframes saw, none shorter than `LEAST_M`."""
    ends = keyframes.walls[:, 1:].reshape(-1, 2, 2)
    long = np.hypot(*(ends[:, 1] - ends[:, 0]).T) >= LEAST_M
    ends, at = ends[long], keyframes.walls[long, 0].astype(np.intp)
    along = ends[:, 1] - ends[:, 0]
    left = along[:, 1] * ends[:, 0, 0] - along[:, 0] * ends[:, 0, 1]  # cross(along, -a)
    return Pieces(ends, at, np.where(left > 0, 1.0, -1.0))


def faced(pieces1: Pieces, pieces2: Pieces, placed1: Array, placed2: Array, gate_m: float) -> Facing:
    """Where pieces face each other, ``placed1`` (k1, 3), ``placed2`` (k2, 3) being the keyframes' poses in one frame.

    Each piece faces that one of the other map which it runs beside the longest, whatever their distance: choosing by
    distance would have walls agree with wherever they are supposed. ``gate_m``: how far apart they may lie.
    """
    a1, a2 = (se2.transform(k[p.at][:, None], p.ends) for k, p in ((placed1, pieces1), (placed2, pieces2)))
    low, high, beside = _beside(a1, a2, gate_m)
    n1, n2 = _normals(a1) * pieces1.seen[:, None], _normals(a2) * pieces2.seen[:, None]
    shared = np.where(beside & (n1 @ n2.T > ALIKE), high - low, 0.0)
    chosen = np.zeros(shared.shape, dtype=bool)
    if shared.size:
        chosen[np.arange(len(pieces1)), shared.argmax(axis=1)] = True
        chosen[shared.argmax(axis=0), np.arange(len(pieces2))] = True
    i, j = np.nonzero(chosen & (shared >= LEAST_M))
    short = shared[i, j] < SHORT_M
    ends = np.column_stack([low[i, j], high[i, j]])
    ends[short] = ends[short].mean(axis=1, keepdims=True)
    k = np.concatenate([np.arange(len(i)), np.flatnonzero(~short)])
    return _faced(
        i[k], j[k], np.concatenate([ends[:, 0], ends[~short, 1]]), (a1, a2), (pieces1, pieces2), (placed1, placed2)
    )


def _beside(a1: Array, a2: Array, gate_m: float) -> tuple[Array, Array, NDArray[np.bool_]]:
    """From where to where [m] along each piece of map 1 (p1, p2) those of map 2 run, and whether these are near it."""
    u, length = _along(a1)
    rel = a2[None] - a1[:, None, None, 0]
    along, off = np.einsum("ijkc,ic->ijk", rel, u), np.einsum("ijkc,ic->ijk", rel, _normals(a1))
    low = np.maximum(along.min(axis=2), 0.0)
    high = np.minimum(along.max(axis=2), length[:, None])
    run = along[..., 1] - along[..., 0]
    slope = (off[..., 1] - off[..., 0]) / np.where(np.abs(run) > 1e-9, run, 1.0)
    middle = off[..., 0] + slope * ((low + high) / 2 - along[..., 0])
    return low, high, np.abs(middle) < gate_m


def _normals(ends: Array) -> Array:
    u, _ = _along(ends)
    return np.column_stack([-u[:, 1], u[:, 0]])


def _along(ends: Array) -> tuple[Array, Array]:
    d = ends[:, 1] - ends[:, 0]
    length = np.hypot(*d.T)
    return d / length[:, None], length


def _faced(i: Places, j: Places, s: Array, ends: Two, pieces: tuple[Pieces, Pieces], placed: Two) -> Facing:
    """Places ``s`` (k,) [m] along pieces i of map 1, and those abreast of them on pieces j of map 2."""
    a1, a2 = ends[0][i], ends[1][j]
    u, _ = _along(a1)
    v, _ = _along(a2)
    p1 = a1[:, 0] + s[:, None] * u
    t = np.einsum("ki,ki->k", p1 - a2[:, 0], u) / np.einsum("ki,ki->k", v, u)
    p2 = a2[:, 0] + t[:, None] * v
    at1, at2 = pieces[0].at[i], pieces[1].at[j]
    k1 = placed[0][at1]
    n = np.einsum("kji,kj->ki", se2.rotation(k1[:, 2]), _normals(a1))
    seen1, seen2 = se2.transform(se2.inverse(k1), p1), se2.transform(se2.inverse(placed[1][at2]), p2)
    return Facing(seen1, seen2, at1, at2, n)
