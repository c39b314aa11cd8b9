"""What is known of one method's merge of one pair, by itself and against the truth."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.errors import UndeterminedError
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.transform import Transform
from mapfuse.datasets.truth import Truth

from ..result import PairDecision
from ..score import LEAST_RIGHT, MOST_OFF_M
from .method import Merge
from .rigid import corridors_of, was_passed

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class AgainstTruth:
    """A merge against the truth.

    ``right``: reported correspondences that are true, ``common``: all true ones. ``error_m`` [m], ``error_rad`` [rad]:
    of T12, at the origin of map 2; None without one. Of the merged map, None where nothing was merged: ``rms`` [m] of
    all recorded landmarks that are true places, from these, in the frame of map 1; ``rms_aligned`` [m]: after the rigid
    motion that fits the whole merged map best, None where the landmarks leave that open; ``displacement`` [m]: mean
    distance of the common ones in the frame of map 1, and ``own_displacement`` [m] as map 1 alone has them.

    ``false_alarms``: landmarks of both maps that aren't there; ``passed_alarms``: those that the other robot passed, so
    that it could tell; ``eliminated``: of these the ones that the merge doesn't keep; ``lost_places``: landmarks that
    are there and that it doesn't keep.
    """

    right: int
    common: int
    error_m: float | None
    error_rad: float | None
    rms: float | None
    rms_aligned: float | None
    displacement: float | None
    own_displacement: float | None
    false_alarms: int
    passed_alarms: int
    eliminated: int | None
    lost_places: int | None


@dataclass(frozen=True, slots=True)
class Evaluation:
    """One method on one pair.

    ``candidates``, ``selected``: pairs of landmarks, and those that the paper's H1 and H2 leave. ``gained``, ``lost``:
    matches that it has and the first method hasn't, and the reverse. ``error``: why there is no merge, else empty.
    """

    maps: tuple[str, str]
    method: str
    candidates: int
    selected: int
    merge: Merge | None
    gained: int | None
    lost: int | None
    seconds: float | None
    truth: AgainstTruth | None = None
    error: str = ""

    @property
    def count(self) -> int | None:
        """Reported matches."""
        return None if self.merge is None else len(self.merge.correspondences)

    @property
    def decision(self) -> PairDecision | None:
        """What the method says; None where it failed."""
        return None if self.merge is None else self.merge.decision

    @property
    def correctness(self) -> float | None:
        """Share of the reported matches that are true; None without truth or matches."""
        return self.truth.right / self.count if self.truth is not None and self.count else None

    @property
    def eliminated_share(self) -> float | None:
        """Share of the false alarms that the other robot passed which the merge doesn't keep; None without any."""
        t = self.truth
        return (
            t.eliminated / t.passed_alarms if t is not None and t.eliminated is not None and t.passed_alarms else None
        )

    @property
    def best_is_right(self) -> bool | None:
        """Whether the best placement is: as for a merge, whatever was decided."""
        if self.truth is None or self.merge is None:
            return None
        return bool(self.count and self.truth.right >= LEAST_RIGHT * self.count)

    @property
    def merged_wrongly(self) -> bool | None:
        """A merge with too few right correspondences, or its common landmarks too far off."""
        if self.truth is None or self.decision is None:
            return None
        off, own = self.truth.displacement, self.truth.own_displacement or 0.0
        return self.decision == "merged" and not (self.best_is_right and off is not None and off - own <= MOST_OFF_M)


def evaluated(map1: LandmarkMap, map2: LandmarkMap, merge: Merge, truth: Truth) -> AgainstTruth:
    """A merge of two maps against the truth, which knows both. Raises KeyError for a map that it doesn't know.

    >>> from mapfuse.datasets.simulation.pairs import simulated_pair
    >>> from mapfuse.fusion.compare.heuristic import merge_by_heuristic
    >>> map1, map2, truth = simulated_pair(1)
    >>> against = evaluated(map1, map2, merge_by_heuristic(map1, map2), truth)
    >>> against.right <= against.common, against.rms_aligned <= against.rms
    (True, True)
    """
    names = map1.name, map2.name
    true_pairs = set(truth.true_pairs(*names))
    error_m = error_rad = None
    if merge.T12 is not None:
        error_m, error_rad = _error_of(merge.T12, truth.T12(*names))
    passed_alarms = _passed_alarms(map1, map2, truth)
    gone = {(names[r], i) for l in merge.landmarks if not l.kept for r, ids in ((0, l.ids1), (1, l.ids2)) for i in ids}
    alarms = {(name, i) for name in names for i, place in truth.landmarks[name].items() if place is None}
    rms = aligned = displacement = None
    if merge.landmarks:
        rms, aligned, displacement = _off(merge, names, truth, true_pairs)
    return AgainstTruth(
        len(true_pairs & set(merge.correspondences)),
        len(true_pairs),
        error_m,
        error_rad,
        rms,
        aligned,
        displacement,
        _own_displacement(map1, truth, {i for i, _ in true_pairs}),
        len(alarms),
        len(passed_alarms),
        len(passed_alarms & gone) if merge.landmarks else None,
        len(gone - alarms) if merge.landmarks else None,
    )


def _error_of(T12: Transform, expected: Transform) -> tuple[float, float]:
    off = T12.array - expected.array
    return float(np.hypot(off[0], off[1])), abs(float(se2.wrap(off[2])))


def _off(
    merge: Merge, names: tuple[str, str], truth: Truth, true_pairs: set[tuple[str, str]]
) -> tuple[float | None, float | None, float | None]:
    """rms, rms after the best rigid motion, and mean of the common ones [m]; every recorded landmark counts once."""
    common = {(name, i) for pair in true_pairs for name, i in zip(names, pair, strict=True)}
    into_frame1 = se2.inverse(truth.frames[names[0]])
    at, true, is_common = [], [], []
    for landmark in merge.landmarks:
        for name, ids in zip(names, (landmark.ids1, landmark.ids2), strict=True):
            for i in ids:
                place = truth.landmarks[name].get(i)
                if place is not None:
                    at.append((landmark.x, landmark.y))
                    true.append(se2.transform(into_frame1, truth.places[place]))
                    is_common.append((name, i) in common)
    if not at:
        return None, None, None
    where, expected = np.array(at), np.array(true)
    apart = np.hypot(*(where - expected).T)
    try:
        aligned = float(np.sqrt(np.mean(np.sum(se2.align(expected, where).residuals ** 2, axis=1))))
    except UndeterminedError:
        aligned = None
    of_common = float(np.mean(apart[is_common])) if any(is_common) else None
    return float(np.sqrt(np.mean(apart**2))), aligned, of_common


def _own_displacement(map1: LandmarkMap, truth: Truth, common: set[str]) -> float | None:
    """Mean distance [m] of the common landmarks from their true places as map 1 alone has them."""
    off = []
    for i in sorted(common):
        there = truth.position(map1.name, i)
        assert there is not None
        off.append(np.hypot(*(map1.positions[map1.index_from_id[i]] - there)))
    return float(np.mean(off)) if off else None


def _passed_alarms(map1: LandmarkMap, map2: LandmarkMap, truth: Truth) -> set[tuple[str, str]]:
    """False alarms (map, id) that the other robot really passed, by the truth."""
    found: set[tuple[str, str]] = set()
    for one, other in ((map1, map2), (map2, map1)):
        alarms = [i for i in one.ids if truth.landmarks[one.name].get(i) is None]
        if alarms:
            there = _in_world(one, truth)[[one.index_from_id[i] for i in alarms]]
            by = was_passed(there, corridors_of(other, _in_world(other, truth)))
            found |= {(one.name, i) for i, was in zip(alarms, by.tolist(), strict=True) if was}
    return found


def _in_world(map_: LandmarkMap, truth: Truth) -> Array:
    """Where a map's landmarks really are (n, 2) [m]; false alarms where the map, laid on the truth, has them."""
    of = truth.landmarks[map_.name]
    true = {k: truth.places[place] for k, i in enumerate(map_.ids) if (place := of.get(i)) is not None}
    frame = truth.frames[map_.name]
    known = list(true)
    if len(known) >= 2:
        with suppress(UndeterminedError):
            frame = se2.align(np.array(list(true.values())), map_.positions[known]).T12
    world = np.array(se2.transform(frame, map_.positions)).reshape(-1, 2)
    if known:
        world[known] = list(true.values())
    return world
