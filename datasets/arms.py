"""Arm signature: what kind of place a landmark is, which way it faces, and in which turns two of them coincide.

A landmark's kind follows from its arms (paper, section 2.1): two neighbouring blocked arms make a corner, three an
end of corridor. Nothing here assumes right angles: oblique corridors, and arms listed in any order, are normal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from math import cos, pi, radians

from .maps import DOOR, SPATIAL_TYPES, Landmark, Link

#: Arms of two landmarks are the same arm when their directions agree within this [rad].
ARM_TOLERANCE = radians(30.0)

QUARTER = pi / 2


def wrap(angle: float) -> float:
    """`se2.wrap` of one plain number; arms come by twos and threes, too few for arrays to pay."""
    if -pi < angle <= pi:
        return angle
    turned = pi - (pi - angle) % (2 * pi)
    return turned if turned > -pi else pi


class Kind(StrEnum):
    """What the arms say a landmark is; each with the rotations that map its arms onto themselves."""

    CORNER = "corner"
    T_JUNCTION = "T-junction"
    CROSSING = "crossing"
    END = "end of corridor"
    DOOR = "door"
    CORRIDOR = "corridor"
    UNKNOWN = "unknown arms"
    POINT = "point"


@dataclass(frozen=True, slots=True)
class ArmSignature:
    """Arms of one landmark whose direction is known, counter-clockwise from the smallest heading.

    ``headings`` [rad, map frame] and ``passable`` (open or door: a corridor goes on there) are parallel, as are
    ``links``: the place of each arm among the landmark's links. ``heading`` [rad, map frame]: direction of the
    landmark, that of its reference arm, averaged over all arms (`_direction`); None without arms.
    """

    kind: Kind
    headings: tuple[float, ...]
    passable: tuple[bool, ...]
    links: tuple[int, ...]
    heading: float | None

    @property
    def symmetry(self) -> int:
        """Number of turns (of quarter or half circle) that map the kind onto itself: a crossing has four."""
        return {Kind.CROSSING: 4, Kind.CORRIDOR: 2}.get(self.kind, 1)


def _direction(passable: Sequence[bool], headings: Sequence[float]) -> float | None:
    """Direction [rad, map frame] of a landmark: that of its reference arm, averaged over all arms; None without arms.

    The mean of what each arm says, modulo quarter turns, so that each arm's error counts 1/k where corridors
    meet at right angles. An arm that is off the quarter turns by r counts ``max(0, cos 4r)``: rounding alone
    would let the heading of a 45 degree bend jump by 22.5 degrees with the noise.
    """
    if not headings:
        return None
    reference = headings[_reference_arm(passable, headings)]
    total = counted = 0.0
    for heading in headings:
        off = heading - reference
        left = off - QUARTER * round(off / QUARTER)
        weight = max(0.0, cos(4 * left))
        total, counted = total + weight * left, counted + weight
    return wrap(reference + total / counted)


def _reference_arm(passable: Sequence[bool], headings: Sequence[float]) -> int:
    """The arm whose direction stands for the landmark: the passable one that follows the widest gap without one.

    For an end the open arm, for a corner the clockwise one of its two; where all gaps are alike (a crossing) the
    first in the map's frame, any of them being as good.
    """
    ways = [k for k, p in enumerate(passable) if p] or list(range(len(headings)))
    gaps = [(headings[k] - headings[ways[i - 1]]) % (2 * pi) or 2 * pi for i, k in enumerate(ways)]
    if max(gaps) - min(gaps) < QUARTER / 2:
        return ways[0]
    return ways[gaps.index(max(gaps))]


def is_passable(link: Link) -> bool | None:
    """Whether a corridor goes on along this arm; None where it was not sensed."""
    if link.connected_to_id is not None or link.type in ("open", "door"):
        return True
    return False if link.type == "blocked" else None


def _kind(type_: str, headings: list[float], passable: list[bool]) -> Kind:
    if type_ == DOOR:
        return Kind.DOOR
    n_open, n_blocked = sum(passable), len(passable) - sum(passable)
    if not passable:
        return Kind.UNKNOWN if type_ in SPATIAL_TYPES else Kind.POINT
    if n_open >= 4:
        return Kind.CROSSING
    if n_open == 3:
        return Kind.T_JUNCTION
    if n_open == 2:
        first, second = (h for h, p in zip(headings, passable, strict=True) if p)
        bent = abs(wrap(second - first)) < pi - ARM_TOLERANCE
        return Kind.CORNER if bent else Kind.CORRIDOR
    return Kind.END if n_open == 1 and n_blocked >= 2 else Kind.UNKNOWN


@lru_cache(maxsize=65536)
def _signature(type_: str, links: tuple[tuple[float | None, bool | None], ...]) -> ArmSignature:
    known = sorted((wrap(h), p, k) for k, (h, p) in enumerate(links) if h is not None and p is not None)
    headings, passable = [h for h, _, _ in known], [p for _, p, _ in known]
    kind = _kind(type_, headings, passable)
    places, heading = tuple(k for _, _, k in known), _direction(passable, headings)
    return ArmSignature(kind, tuple(headings), tuple(passable), places, heading)


def signature(landmark: Landmark) -> ArmSignature:
    """The arm signature of a landmark.

    >>> from mapfuse.datasets.maps import Landmark, Link
    >>> arms = (Link("open", 0.0), Link("open", 1.57), Link("blocked", 3.14), Link("blocked", -1.57))
    >>> signature(Landmark("c1", "corner", 0.0, 0.0, links=arms)).kind.value
    'corner'
    """
    return _signature(landmark.type, tuple((link.heading, is_passable(link)) for link in landmark.links))


def heading_of(landmark: Landmark) -> float | None:
    """Direction of a landmark [rad, map frame]: of its arms where it has any, else its own heading, else None."""
    from_arms = signature(landmark).heading
    return landmark.heading if from_arms is None else from_arms


def contradiction(landmark: Landmark) -> str | None:
    """What its arms say against the type of a landmark, or None; an arm that wasn't sensed contradicts nothing.

    >>> from mapfuse.datasets.maps import Landmark, Link
    >>> contradiction(Landmark("c1", "corner", 0.0, 0.0, links=tuple(Link("open", a) for a in (0, 1.57, 3.14))))
    'three passable arms'
    """
    if landmark.type not in SPATIAL_TYPES:
        return None
    ways = [link.heading for link in landmark.links if is_passable(link)]
    if landmark.type == "corner":
        if len(ways) > 2:
            return f"{('three', 'four')[min(len(ways), 4) - 3]} passable arms"
        if len(ways) == 2 and ways[0] is not None and ways[1] is not None:
            return "two passable arms in line" if abs(wrap(ways[1] - ways[0])) >= pi - ARM_TOLERANCE else None
        return None
    blocked = sum(is_passable(link) is False for link in landmark.links)
    return f"{('two', 'three', 'four')[min(blocked, 4) - 2]} blocked arms" if blocked >= 2 else None


@dataclass(frozen=True, slots=True)
class Turn:
    """A rotation that lays the arms of landmark 2 onto those of landmark 1.

    ``rotation`` [rad]: of T12. ``coincide``: arms that meet one of the same passability; ``contradict``: arms that
    meet one of the other; ``pairs``: (arm of 1, arm of 2) that meet, as places in the signatures.
    """

    rotation: float
    coincide: int
    contradict: int
    pairs: tuple[tuple[int, int], ...]


def overlay(arms1: ArmSignature, arms2: ArmSignature, rotation: float) -> Turn:
    """Which arms meet when those of landmark 2 are turned by ``rotation`` [rad], and whether they agree."""
    pairs: list[tuple[int, int]] = []
    for k2, h2 in enumerate(arms2.headings):
        off = [abs(wrap(h2 + rotation - h1)) for h1 in arms1.headings]
        if off and min(off) < ARM_TOLERANCE:
            pairs.append((off.index(min(off)), k2))
    same = sum(arms1.passable[k1] == arms2.passable[k2] for k1, k2 in pairs)
    shifts = [wrap(arms1.headings[k1] - arms2.headings[k2] - rotation) for k1, k2 in pairs]
    shift = sum(shifts) / len(shifts) if shifts else 0.0
    return Turn(wrap(rotation + shift), same, len(pairs) - same, tuple(pairs))


def turns(arms1: ArmSignature, arms2: ArmSignature, contradictions: int = 0) -> tuple[Turn, ...]:
    """All distinct rotations that lay arms of 2 onto arms of 1 with at most that many contradictions.

    "Requiring the arm-type attributes to coincide" (paper, section 3.2): kept are the turns in which most arms
    coincide; a crossing on a crossing has four, a corner on a corner one.

    >>> from mapfuse.datasets.maps import Landmark, Link
    >>> cross = Landmark("x", "junction", 0.0, 0.0, links=tuple(Link("open", a) for a in (0, 1.57, 3.14, -1.57)))
    >>> len(turns(signature(cross), signature(cross)))
    4
    """
    found: list[Turn] = []
    for h1 in arms1.headings:
        for h2 in arms2.headings:
            turn = overlay(arms1, arms2, wrap(h1 - h2))
            known = any(abs(wrap(turn.rotation - other.rotation)) < ARM_TOLERANCE for other in found)
            if turn.contradict <= contradictions and turn.coincide and not known:
                found.append(turn)
    most = max((turn.coincide for turn in found), default=0)
    return tuple(sorted((t for t in found if t.coincide == most), key=lambda t: t.rotation))
