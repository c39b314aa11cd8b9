"""Which landmark pairs may propose a T12, in which turns, and what the paper's heuristics leave of them.

Dedeoglu & Sukhatme (2000), sections 3.1 and 3.2: H1, H2, the compass gate, and the rotations in which the arms of two
landmarks coincide. Everything is vectorised over pairs; `mapfuse.datasets.arms` says the same for one pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.arms import ARM_TOLERANCE, heading_of, signature
from mapfuse.datasets.maps import SPATIAL_TYPES, Landmark, LandmarkMap

from .assignment import label_codes
from .config import MatchingConfig

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

_PAIRS_AT_ONCE = 512


@dataclass(frozen=True, slots=True)
class CandidateCounts:
    """How many landmark pairs each step leaves (the paper's Table 1: ``total`` and ``after_h1_h2``).

    ``after_compass``: a pair is gone when the compass gate drops all its turns. ``transformations``: T12s tried, one
    per turn of each pair that is left; none for pairs whose arms coincide nowhere or that have no direction.
    """

    total: int
    after_h1: int
    after_h1_h2: int
    after_compass: int
    transformations: int

    @property
    def selected(self) -> int:
        """The paper's name for what H1 and H2 leave."""
        return self.after_h1_h2


@dataclass(frozen=True, slots=True)
class ArmTable:
    """The arms of n landmarks as arrays (n, k), k the most arms that one has; NaN where there is none.

    ``headings`` [rad, map frame], counter-clockwise from the smallest; ``passable``; ``readings``: the compass' [rad]
    of each arm, see `compass_readings`. ``heading`` (n,) [rad]: of the whole landmark, NaN where it has none.
    """

    headings: Array
    passable: Mask
    readings: Array
    heading: Array

    @property
    def has_arms(self) -> Mask:
        """(n,): which landmarks have an arm of known direction."""
        return np.asarray(np.isfinite(self.headings).any(axis=1))


def compass_readings(landmark: Landmark) -> tuple[float | None, ...]:
    """The absolute direction [rad] by compass of each arm in the landmark's `signature`, or None.

    An arm is read when the robot looks or travels along it. Two robots that pass a place in opposite directions read
    opposite arms; the arm back along the travel then gets the *hypothesised* compass value of the paper, section 3.2:
    the reading of the arm opposite to it (within 30 degrees) plus half a turn.

    >>> from mapfuse.datasets.maps import Link
    >>> passed = Landmark("d1", "door", 0.0, 0.0, links=(Link("open", 0.0, compass=1.0), Link("open", np.pi)))
    >>> [round(reading, 3) for reading in compass_readings(passed)]
    [1.0, -2.142]
    """
    read = [(l.heading, l.compass) for l in landmark.links if l.heading is not None and l.compass is not None]
    arms = signature(landmark)
    if not read:
        return (None,) * len(arms.headings)
    readings: list[float | None] = []
    for heading, place in zip(arms.headings, arms.links, strict=True):
        own = landmark.links[place].compass
        off, opposite = min((abs(float(se2.wrap(h + np.pi - heading))), c) for h, c in read)
        hypothesised = float(se2.wrap(opposite + np.pi)) if off < ARM_TOLERANCE else None
        readings.append(hypothesised if own is None else own)
    return tuple(readings)


def arm_table(landmarks: LandmarkMap) -> ArmTable:
    """All landmarks' arms as arrays, in the map's order."""
    signatures = [signature(landmark) for landmark in landmarks.landmarks]
    shape = (len(signatures), max((len(s.headings) for s in signatures), default=0))
    headings, readings, passable = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, dtype=bool)
    heading = np.full(shape[0], np.nan)
    for k, (arms, landmark) in enumerate(zip(signatures, landmarks.landmarks, strict=True)):
        whole = heading_of(landmark)
        heading[k] = np.nan if whole is None else whole
        if arms.headings:
            n = len(arms.headings)
            headings[k, :n] = arms.headings
            passable[k, :n] = arms.passable
            readings[k, :n] = [np.nan if r is None else r for r in compass_readings(landmark)]
    return ArmTable(headings, passable, readings, heading)


def _spatial(landmarks: LandmarkMap) -> Mask:
    return np.isin(np.array(landmarks.types, dtype=object), SPATIAL_TYPES)


def _pairs_of(codes1: Indices, codes2: Indices) -> int:
    n = 1 + max(int(codes1.max(initial=-1)), int(codes2.max(initial=-1)))
    return int(np.bincount(codes1, minlength=n) @ np.bincount(codes2, minlength=n))


def count_selected(map1: LandmarkMap, map2: LandmarkMap, config: MatchingConfig) -> tuple[int, int, int]:
    """How many pairs there are, how many H1 leaves, and how many H1 and H2 leave, without listing them."""
    codes1, codes2 = _codes(map1, map2, config)
    after_h1 = _pairs_of(codes1, codes2)
    if config.use_h2:
        codes1, codes2 = codes1[_spatial(map1)], codes2[_spatial(map2)]
    return len(map1) * len(map2), after_h1, _pairs_of(codes1, codes2)


def _codes(map1: LandmarkMap, map2: LandmarkMap, config: MatchingConfig) -> tuple[Indices, Indices]:
    if config.use_h1:
        return label_codes(map1.types, map2.types)
    return np.zeros(len(map1), dtype=np.intp), np.zeros(len(map2), dtype=np.intp)


def select_pairs(map1: LandmarkMap, map2: LandmarkMap, config: MatchingConfig) -> tuple[Indices, Indices]:
    """Places (index1, index2), each (k,), of the pairs that H1 and H2 leave, by index1, then index2.

    H1: landmarks of one ``type`` only. H2: spatial features only (corner or end, junction), never doors or points.
    """
    codes1, codes2 = _codes(map1, map2, config)
    eligible1 = np.flatnonzero(_spatial(map1)) if config.use_h2 else np.arange(len(map1))
    eligible2 = np.flatnonzero(_spatial(map2)) if config.use_h2 else np.arange(len(map2))
    row, column = np.nonzero(codes1[eligible1][:, None] == codes2[eligible2])
    return eligible1[row], eligible2[column]


@dataclass(frozen=True, slots=True)
class Turns:
    """Rotations of T12 [rad] that pairs propose: ``pair`` (m,) is the place in the list of pairs, ascending.

    ``agrees`` (m,): False where the compass readings of the arms that coincide speak against the turn.
    """

    pair: Indices
    rotation: Array
    agrees: Mask


def turns_of_pairs(table1: ArmTable, table2: ArmTable, index1: Indices, index2: Indices, gate_rad: float) -> Turns:
    """All turns of the pairs (index1, index2): one per symmetry of the arms, as `mapfuse.datasets.arms.turns`.

    Where one of the two has no arms, the difference of the landmarks' own headings is the only turn; a pair without
    directions has none. The compass gate of ``gate_rad`` [rad] compares the readings, actual or hypothesised
    (`compass_readings`), of all arms that coincide: a turn disagrees when more of them differ by more than the gate
    than don't. Turns without comparable readings agree.
    """
    both = table1.has_arms[index1] & table2.has_arms[index2]
    by_heading = se2.wrap(table1.heading[index1] - table2.heading[index2])
    plain = np.flatnonzero(~both & ~np.isnan(by_heading))
    parts = [(plain, by_heading[plain], np.ones(len(plain), dtype=bool))]
    with_arms = np.flatnonzero(both)
    for begin in range(0, len(with_arms), _PAIRS_AT_ONCE):
        pairs = with_arms[begin : begin + _PAIRS_AT_ONCE]
        place, rotation, agrees = _arm_turns(table1, table2, index1[pairs], index2[pairs], gate_rad)
        parts.append((pairs[place], rotation, agrees))
    pair, rotation, agrees = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((rotation, pair))
    return Turns(pair[order], rotation[order], agrees[order])


def _arm_turns(
    table1: ArmTable, table2: ArmTable, index1: Indices, index2: Indices, gate_rad: float
) -> tuple[Indices, Array, Mask]:
    headings1, headings2 = table1.headings[index1], table2.headings[index2]
    difference = _wrapped(headings1[:, :, None] - headings2[:, None, :])  # (pair, arm 1, arm 2)
    start = difference.reshape(len(index1), -1)  # (pair, turn): each arm on each arm
    off = _wrapped(difference[:, None] - start[:, :, None, None])  # (pair, turn, arm 1, arm 2)
    distance = np.abs(off)
    if np.isnan(difference).any():
        distance[np.isnan(distance)] = np.inf
    nearest = np.argmin(distance, axis=2)  # (pair, turn, arm 2): the arm 1 that it meets
    met_first = nearest[:, :, None]
    meets = np.take_along_axis(distance, met_first, axis=2)[:, :, 0] < ARM_TOLERANCE
    row = np.arange(len(index1))[:, None, None]
    same = table1.passable[index1][row, nearest] == table2.passable[index2][:, None]
    coincide = np.sum(meets & same, axis=2)
    contradict = np.sum(meets & ~same, axis=2)
    shift = np.sum(np.where(meets, np.take_along_axis(off, met_first, axis=2)[:, :, 0], 0.0), axis=2) / np.maximum(
        meets.sum(axis=2), 1
    )
    rotation = _wrapped(start + shift)
    found = _first_of_each(rotation, (coincide > 0) & (contradict == 0))
    found &= coincide == np.max(np.where(found, coincide, 0), axis=1, keepdims=True)

    place, turn = np.nonzero(found)
    reading1 = table1.readings[index1[place][:, None], nearest[place, turn]]
    apart = np.abs(_wrapped(reading1 - table2.readings[index2[place]]))
    comparable = meets[place, turn] & ~np.isnan(apart)
    disagree = np.sum(comparable & (apart > gate_rad), axis=1)
    return place, se2.wrap(rotation[place, turn]), disagree <= comparable.sum(axis=1) - disagree


def _first_of_each(rotation: Array, valid: Mask) -> Mask:
    """Valid turns (pair, turn) that no valid one before them nearly equals."""
    found = valid.copy()
    for turn in range(1, rotation.shape[1]):
        near = np.abs(_wrapped(rotation[:, turn, None] - rotation[:, :turn])) < ARM_TOLERANCE
        found[:, turn] &= ~np.any(near & found[:, :turn], axis=1)
    return found


def through(p1: Array, p2: Array, rotation: Array) -> Array:
    """T12s (k, 3) of given rotations (k,) [rad] that take the points p2 (k, 2) onto p1 (k, 2).

    >>> through(np.array([[1.0, 1.0]]), np.array([[2.0, 0.0]]), np.array([np.pi / 2])).round(3).tolist()
    [[1.0, -1.0, 1.571]]
    """
    turned = se2.transform(np.stack([np.zeros_like(rotation), np.zeros_like(rotation), rotation], axis=1), p2)
    return np.concatenate([p1 - turned, rotation[:, None]], axis=1)


def _wrapped(angle: Array) -> Array:
    """Angle [rad] in [-pi, pi], several times faster than `wrap`; the ends of the interval are one angle anyway."""
    wrapped: Array = angle - np.round(angle / (2 * np.pi)) * (2 * np.pi)
    return wrapped
