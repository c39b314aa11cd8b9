"""What several looks at one grid, each time turned differently, agree on: how repeatable each landmark is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arms import wrap
from .config import ExtractConfig
from .grid import Grid
from .merging import merged_grid
from .places import SAME_ARM, Arm, Place, places_of

Array = NDArray[np.float64]

#: Turn of the grid [rad] from one look to the next: the golden angle, so that no two looks share an axis.
_TURN = np.pi * (3 - np.sqrt(5))
#: Resolutions are rarely whole fractions of each other to the last digit.
_WHOLE = 1e-6
#: Arms stand in the map that this share of a place's sightings have; of others nothing is said.
_PASSABLE, _BLOCKED = 0.6, 0.75


@dataclass(frozen=True, eq=False, slots=True)
class Agreed:
    """A place on which looks agree: median of all sightings, their ``covariance`` (2, 2) [m^2], ``share`` of looks."""

    place: Place
    covariance: Array
    share: float


def agreed(grid: Grid, config: ExtractConfig) -> tuple[Agreed, ...]:
    """Places of a grid that are found again when the grid is turned."""
    grid = grid.trimmed()
    grid = grid.coarser(max(1, int(config.cell_m / grid.resolution + _WHOLE)))
    base = places_of(grid, config)
    looks = [_turned(grid, k * _TURN, config) for k in range(1, config.looks)]
    sightings = _sightings(base, looks, config.same_m)
    shares = np.array([(1 + len(seen)) / config.looks for seen in sightings])
    kept = np.flatnonzero(shares >= config.agreement).tolist()
    joined = _joined_past(base, set(kept))
    number = {k: n for n, k in enumerate(kept)}
    return tuple(_mean(joined[k], sightings[k], float(shares[k]), number) for k in kept)


def _turned(grid: Grid, turn: float, config: ExtractConfig) -> tuple[Place, ...]:
    """Places found in the grid turned by ``turn`` [rad], in the map's frame."""
    pose = np.array([0.0, 0.0, turn])
    back = se2.inverse(pose)
    return tuple(
        replace(
            place,
            xy=se2.transform(back, place.xy),
            arms=tuple(replace(arm, direction=wrap(arm.direction - turn)) for arm in place.arms),
        )
        for place in places_of(merged_grid([grid], [pose]), config)
    )


def _sightings(base: Sequence[Place], looks: Sequence[Sequence[Place]], reach: float) -> list[list[Place]]:
    """Of each place what it is in the other looks: of the same type, and each the other's nearest within ``reach``."""
    found: list[list[Place]] = [[] for _ in base]
    for look in looks:
        for type_ in {place.type for place in base}:
            ours = [k for k, place in enumerate(base) if place.type == type_]
            theirs = [place for place in look if place.type == type_]
            if not theirs:
                continue
            apart = np.array([[np.hypot(*(base[k].xy - other.xy)) for other in theirs] for k in ours])
            nearest, back = apart.argmin(axis=1), apart.argmin(axis=0)
            for row, k in enumerate(ours):
                if back[nearest[row]] == row and apart[row, nearest[row]] <= reach:
                    found[k].append(theirs[nearest[row]])
    return found


def _joined_past(base: Sequence[Place], kept: set[int]) -> list[Place]:
    """The places with ways that lead straight past places that aren't kept."""

    def beyond(arm: Arm, start: int) -> int | None:
        here, way, seen = arm.to, arm.direction, {start}
        while here is not None and here not in kept:
            if here in seen:
                return None
            seen.add(here)
            on = [a for a in base[here].arms if a.passable and abs(wrap(a.direction - way)) < SAME_ARM]
            if len(on) != 1:
                return None
            here, way = on[0].to, on[0].direction
        return here if here != start else None

    return [replace(p, arms=tuple(replace(arm, to=beyond(arm, k)) for arm in p.arms)) for k, p in enumerate(base)]


def _mean(place: Place, seen: Sequence[Place], share: float, number: dict[int, int]) -> Agreed:
    """The place with the median position of all its sightings, and the arms that most of them have."""
    xy = np.array([place.xy, *(other.xy for other in seen)])
    off = xy - np.median(xy, axis=0)
    arms = []
    for arm in place.arms:
        same = [near for other in seen for near in other.arms if _same(arm, near)]
        certain = _PASSABLE if arm.passable else _BLOCKED
        if arm.to is not None or 1 + len(same) >= certain * (1 + len(seen)):
            turn = float(np.mean([0.0, *(wrap(near.direction - arm.direction) for near in same)]))
            to = None if arm.to is None else number[arm.to]
            arms.append(Arm(wrap(arm.direction + turn), arm.passable, to))
    mean = Place(place.type, np.median(xy, axis=0), place.clearance, tuple(arms))
    return Agreed(mean, off.T @ off / max(1, len(off) - 1), share)


def _same(a: Arm, b: Arm) -> bool:
    return a.passable == b.passable and abs(wrap(a.direction - b.direction)) < SAME_ARM
