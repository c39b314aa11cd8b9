"""Walls that the robot saw again later: two lines that lie on each other within their covariance are one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se2
from .association import chi2_beyond
from .smooth import Smoothed
from .walltracks import Walls

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Lines are one only where they run beside each other on so much [m], and the offset between them is known to so much.
LEAST, KNOWN = 1.0, 0.5
#: One wall, seen twice, is one line up to this [m, rad].
_ROUGH = (0.02, 0.005)
#: Normals of one wall point alike: the cosine of what they differ by.
_ALIKE = 0.97
#: Tail beyond which two lines are not one, and beyond which the map doesn't bear what was joined.
_TAIL, _RISE = 1e-3, 1e-4
_ROUNDS = 6


@dataclass(frozen=True, slots=True)
class Join:
    """Two lines that may be one: the squared distance [sigmas], and what the offset between them is known to [m]."""

    first: int
    second: int
    squared: float
    sigma: float


def joins(walls: Walls, smoothed: Smoothed) -> list[Join]:
    """All pairs of lines that run beside each other, seen from the same side, within the gate; surest first."""
    lines, anchors = smoothed.estimate.lines, walls.points.anchors
    at = smoothed.line_rows
    C = smoothed.covariance[at:, at:]
    normals = np.column_stack([np.cos(lines[:, 0]), np.sin(lines[:, 0])])
    along = np.column_stack([normals[:, 1], -normals[:, 0]])
    placed = walls.seen.placed(smoothed.estimate.poses)
    ends = [placed[walls.of == w].reshape(-1, 2) for w in range(len(lines))]
    found = []
    for i, j in zip(*np.nonzero(np.triu(normals @ normals.T > _ALIKE, 1)), strict=True):
        own, other = (ends[k] @ along[i] for k in (i, j))
        low, high = max(own.min(), other.min()), min(own.max(), other.max())
        if high - low < LEAST:
            continue
        # half way on the first line
        p = (low + high) / 2 * along[i] + (normals[i] @ anchors[i] + lines[i, 1]) * normals[i]
        off = normals[j] @ (p - anchors[j]) - lines[j, 1]
        r = np.array([-off, float(se2.wrap(lines[i, 0] - lines[j, 0]))])
        H = np.array([[-along[i] @ (p - anchors[i]), -1.0, along[j] @ (p - anchors[j]), 1.0], [1.0, 0.0, -1.0, 0.0]])
        rows = np.array([2 * i, 2 * i + 1, 2 * j, 2 * j + 1])
        S = H @ C[np.ix_(rows, rows)] @ H.T + np.diag(np.square(_ROUGH))
        squared = float(r @ np.linalg.solve(S, r))
        if S[0, 0] < KNOWN**2 and squared < chi2_beyond(_TAIL, 2):
            found.append(Join(int(i), int(j), squared, float(np.sqrt(S[0, 0]))))
    return sorted(found, key=lambda join: (join.sigma, join.first, join.second))


def without_rivals(found: list[Join]) -> list[Join]:
    """Those whose lines may be one with each other alone, or with others that may be one themselves.

    A line that may be either of two walls is left until more is known.
    """
    may = {frozenset((join.first, join.second)) for join in found}
    partners: dict[int, set[int]] = {}
    for join in found:
        partners.setdefault(join.first, set()).add(join.second)
        partners.setdefault(join.second, set()).add(join.first)
    unclear = {
        line for line, others in partners.items() if any({a, b} not in may for a in others for b in others if a < b)
    }
    return [join for join in found if not {join.first, join.second} & unclear]


def joined(of: Indices, chosen: list[Join]) -> Indices:
    """The wall of each piece (n,) after those pairs have become one."""
    name = np.arange(of.max(initial=-1) + 1)
    for join in chosen:
        a, b = name[join.first], name[join.second]
        name[name == b] = a
    return np.where(of >= 0, name[of], -1)


def seen_again(walls: Walls, smoothed: Smoothed, solve: Callable[[Walls], Smoothed]) -> tuple[Walls, Smoothed]:
    """Walls joined where they were seen again, and the map solved with that, until there is nothing more to join.

    ``solve`` solves the map with walls. What the map doesn't bear (its error rises by more than the chi-square of as
    many measurements allows) is not joined; of many pairs the surer half is tried then.
    """
    refused: set[frozenset[int]] = set()
    for _ in range(_ROUNDS):
        chosen = [j for j in without_rivals(joins(walls, smoothed)) if frozenset((j.first, j.second)) not in refused]
        while chosen:
            new = Walls.numbered(walls.seen, joined(walls.of, chosen), smoothed.estimate.poses)
            after = solve(new)
            dof = 2 * (len(walls.lines) - len(new.lines))
            if after.converged and 2 * (after.error - smoothed.error) < chi2_beyond(_RISE, dof) + dof:
                break
            refused |= {frozenset((j.first, j.second)) for j in chosen[len(chosen) // 2 :]}
            chosen = chosen[: len(chosen) // 2]
        else:
            break
        walls, smoothed, refused = new.at(after.estimate), after, set()
    return walls, smoothed
