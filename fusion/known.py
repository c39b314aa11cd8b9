"""Landmarks that the maps themselves say are the same (``same_as``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.errors import MapError, Problem, UndeterminedError
from mapfuse.datasets.maps import LandmarkMap

from .config import SolvingConfig
from .evidence import Weighed
from .growth import Growth, Pairs, compatible, grow
from .prepared import PreparedMap

Array = NDArray[np.float64]

#: What a statement of the maps adds to the odds of a hypothesis that agrees with it [nats]: one in a million is wrong.
KNOWN_NATS = float(np.log(1e6))


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
