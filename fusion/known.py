"""What the user knows already: landmarks that are the same (``same_as``), about where maps lie, maps that are exact."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.errors import MapError, MapfuseError, Problem, UndeterminedError
from mapfuse.datasets.maps import JointCovariance, LandmarkMap
from mapfuse.datasets.transform import Transform

from .config import SolvingConfig
from .evidence import Weighed
from .growth import Growth, Pairs, compatible, grow
from .prepared import PreparedMap

Array = NDArray[np.float64]

#: What a statement of the maps adds to the odds of a hypothesis that agrees with it [nats]: one in a million is wrong.
KNOWN_NATS = float(np.log(1e6))
#: Probability that what the user knows of a transformation is wrong altogether.
KNOWN_WRONG = 1e-3
#: Standard deviation [rad] of a heading in a map that is exact.
EXACT_HEADING = 0.002


@dataclass(frozen=True, slots=True)
class KnownTransform:
    """About where one map lies in another, from a dock, a GPS, or somebody who was there.

    ``T12`` takes coordinates of the second of ``maps`` into the first; its covariance says how well it is known, and
    must be positive definite: raises MapfuseError otherwise. It decides between placements; where exactly the maps
    lie is left to the maps.

    >>> KnownTransform(("D7", "D9"), Transform(3.0, -2.0, 1.5, np.diag([4.0, 4.0, 0.1]))).maps
    ('D7', 'D9')
    """

    maps: tuple[str, str]
    T12: Transform

    def __post_init__(self) -> None:
        C = self.T12.covariance
        if len(set(self.maps)) != 2:
            raise MapfuseError(f"what is known of a transformation must be of two maps, not of {self.maps}")
        if C is None or not np.isfinite(C).all() or np.linalg.eigvalsh(C).min() <= 0:
            raise MapfuseError(
                f"what is known of T12 of {' and '.join(self.maps)} needs a positive definite covariance"
            )

    def between(self, first: str, second: str) -> Transform | None:
        """The transformation of map ``second`` into map ``first``, if it is of these two."""
        if self.maps == (first, second):
            return self.T12
        return self.T12.inverse() if self.maps == (second, first) else None


def check_known_maps(known: Sequence[KnownTransform], names: Collection[str]) -> None:
    """Raises MapfuseError where something is known of a map that isn't there, or of one pair twice."""
    for stated in known:
        for name in stated.maps:
            if name not in names:
                raise MapfuseError(f"a transformation is known of map {name!r}, which isn't among those to fuse")
    pairs = [frozenset(stated.maps) for stated in known]
    twice = next((stated.maps for stated in known if pairs.count(frozenset(stated.maps)) > 1), None)
    if twice is not None:
        raise MapfuseError(f"the transformation of {' and '.join(twice)} is known twice")


def stated_odds(m1: PreparedMap, m2: PreparedMap, T12: Transform, stated: Transform) -> float:
    """How well a placement agrees with what the user knows of it, against any placement [nats].

    The density of the difference under both covariances, against one uniform over all turns and over the shifts that
    let the two maps touch; what is known may be wrong altogether (`KNOWN_WRONG`).
    """
    assert T12.covariance is not None
    assert stated.covariance is not None
    off = T12.array - stated.array
    off[2] = se2.wrap(off[2])
    S = T12.covariance + stated.covariance
    log_density = -0.5 * float(off @ np.linalg.solve(S, off)) - 0.5 * float(np.linalg.slogdet(2 * np.pi * S)[1])
    reach = sum(
        float(np.linalg.norm(m.positions - m.positions.mean(axis=0), axis=1).max(initial=1.0)) for m in (m1, m2)
    )
    anywhere = -float(np.log(2 * np.pi * np.pi * reach**2))
    return float(np.logaddexp(np.log1p(-KNOWN_WRONG) + log_density - anywhere, np.log(KNOWN_WRONG)))


def agreeing(w: Weighed, m1: PreparedMap, m2: PreparedMap, stated: Transform | None) -> Weighed:
    """The hypothesis with what the user knows of its transformation added to its odds."""
    if stated is None:
        return w
    joined = w.growth.joined
    odds = stated_odds(m1, m2, Transform.from_array(joined.T12, joined.T12_covariance), stated)
    return replace(w, terms=replace(w.terms, stated=odds), apart=w.apart + odds - w.terms.stated)


def as_reference(plan: LandmarkMap) -> LandmarkMap:
    """A map as a reference that is exact, such as a floor plan: what it shows is there, and stands where it stands.

    Its positions get no uncertainty, its headings `EXACT_HEADING`; it has nothing false and misses nothing.

    >>> from mapfuse.datasets.maps import Landmark
    >>> as_reference(LandmarkMap("plan", (Landmark("c1", "corner", 1.0, 2.0),))).noise.detection_rate
    1.0
    """
    noise = replace(
        plan.noise,
        heading_sigma=EXACT_HEADING,
        detection_rate=1.0,
        door_detection_rate=1.0,
        false_alarm_rate=0.0,
        door_false_alarm_rate=0.0,
    )
    exact = JointCovariance(plan.ids, 2, np.zeros((2 * len(plan), 2 * len(plan)))) if len(plan) else None
    landmarks = tuple(replace(l, covariance=None, existence=None) for l in plan.landmarks)
    return plan.replace(noise=noise, joint_covariance=exact, landmarks=landmarks)


def known_pairs(map1: LandmarkMap, map2: LandmarkMap) -> Pairs:
    """Places (in map 1, in map 2) of the landmarks that either map's ``same_as`` says are the same.

    Raises `MapError` for a landmark that the other map doesn't have, and for one that would be two.
    """
    found: set[tuple[int, int]] = set()
    for one, other, swapped in ((map1, map2, False), (map2, map1, True)):
        for own, elsewhere in one.same_as.items():
            name = elsewhere.get(other.name)
            if name is None:
                continue
            if name not in other.index_from_id:
                reason = f"names {name!r}, which map {other.name!r} doesn't have"
                raise MapError(one.name, (Problem(f"same_as.{own}.{other.name}", reason),))
            pair = (one.index_from_id[own], other.index_from_id[name])
            found.add(pair[::-1] if swapped else pair)
    pairs = tuple(sorted(found))
    for side, recorded in enumerate((map1, map2)):
        places = [pair[side] for pair in pairs]
        twice = next((recorded.ids[k] for k in places if places.count(k) > 1), None)
        if twice is not None:
            raise MapError(recorded.name, (Problem("same_as", f"{twice!r} would be two landmarks of the other map"),))
    return pairs


def grow_known(m1: PreparedMap, m2: PreparedMap, known: Pairs, config: SolvingConfig) -> Growth | None:
    """The hypothesis that the known pairs propose, grown; None where they don't place map 2."""
    T12 = _placed(m1, m2, known)
    return None if T12 is None else grow(m1, m2, T12, known, config, compatible(m1, m2, known), known)


def credited(w: Weighed, known: Pairs) -> Weighed:
    """The hypothesis with what the maps' own statements add to its odds, where it agrees with them."""
    if not known or not agrees(w, known) or w.terms.known:
        return w
    return replace(w, terms=replace(w.terms, known=KNOWN_NATS), apart=w.apart + KNOWN_NATS)


def agrees(w: Weighed, known: Pairs) -> bool:
    """Whether all known pairs are matched."""
    return set(known) <= set(zip(w.growth.i.tolist(), w.growth.j.tolist(), strict=True))


def check_known(ranked: Sequence[Weighed], m1: PreparedMap, m2: PreparedMap, known: Pairs) -> None:
    """Raise where what the maps say is the same can't be so.

    `UndeterminedError` where it places map 2 nowhere; `MapError` where the maps fit better without it, or as well not
    overlapping: a statement that is wrong must not pass for a merge.
    """
    if not known:
        return
    if not any(agrees(w, known) for w in ranked):
        landmarks = tuple((m1.map.name, m1.map.ids[i]) for i, _ in known)
        raise UndeterminedError("what is known to be the same (same_as) does not place one map in the other", landmarks)
    if agrees(ranked[0], known) and ranked[0].log_odds > 0:
        return
    said = ", ".join(f"{m1.map.ids[i]!r} is {m2.map.ids[j]!r}" for i, j in known)
    reason = f"says that {said}, which everything else in the maps speaks against"
    raise MapError(f"{m1.map.name} and {m2.map.name}", (Problem("same_as", reason),))


def _placed(m1: PreparedMap, m2: PreparedMap, known: Pairs) -> Array | None:
    """T12 (3,) by two known pairs or more, or by the headings of one."""
    if not known:
        return None
    i, j = np.array(known, dtype=np.intp).T
    if len(known) > 1:
        try:
            return se2.align(m1.positions[i], m2.positions[j]).T12
        except UndeterminedError:
            return None
    theta = float(se2.wrap(m1.headings[i[0]] - m2.headings[j[0]]))
    if np.isnan(theta):
        return None
    turned = se2.transform([0.0, 0.0, theta], m2.positions[j[0]])
    return np.array([*(m1.positions[i[0]] - turned), theta])
