"""One map with sources: every landmark once, links joined, counters summed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mapfuse.datasets.arms import ARM_TOLERANCE, heading_of, is_passable
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Link, LinkType
from mapfuse.factors.axes import wrapped
from mapfuse.factors.correspondence import SAME_HEADING, SAME_PLACE
from mapfuse.factors.heading import arms_variance, headings_of, signatures_of

from .result import FusedLandmark

Array = NDArray[np.float64]
Member = tuple[int, int]  # (map, place in its landmarks)

MAX_LINKS = 4
#: What an arm is when two robots sensed it differently: what was seen to be passable comes first.
SURER: tuple[LinkType, ...] = ("door", "open", "blocked", "unknown")


@dataclass(frozen=True, eq=False)
class Place:
    """One landmark of the merged map before it gets its name: the recorded landmarks that are it."""

    members: tuple[Member, ...]
    existence: float


def _joined_link(a: Link, b: Link, weight_b: float) -> Link:
    """One link from two records of it: counters added, distances and readings averaged by travels."""
    assert a.heading is not None
    assert b.heading is not None
    travels = a.travel_counter + b.travel_counter
    same_way = a.connected_to_id == b.connected_to_id
    # two robots may have gone different lengths of one way: the merged link leads to the nearer landmark
    one, _ = sorted((a, b), key=_nearest_first)
    distance = one.distance
    if same_way and a.distance is not None and b.distance is not None:
        w = max(b.travel_counter, 1) / (max(a.travel_counter, 1) + max(b.travel_counter, 1))
        distance = (1 - w) * a.distance + w * b.distance
    readings = [link.compass for link in (a, b) if link.compass is not None]
    compass = float(np.angle(np.exp(1j * np.array(readings)).sum())) if readings else None
    return Link(
        type=min(a.type, b.type, key=SURER.index),
        heading=wrapped(a.heading + weight_b * wrapped(b.heading - a.heading)),
        compass=compass,
        connected_to_id=one.connected_to_id,
        distance=distance,
        travel_counter=travels if same_way else one.travel_counter,
        extra={**b.extra, **a.extra},
    )


def _nearest_first(link: Link) -> tuple[bool, float, str]:
    return link.connected_to_id is None, np.inf if link.distance is None else link.distance, link.connected_to_id or ""


def _joined_links(sources: Sequence[Sequence[Link]]) -> tuple[Link, ...]:
    """All arms of one place, those that meet joined; at most four, ways that lead somewhere first."""
    joined = list(sources[0])
    counts = [1] * len(joined)
    for links in sources[1:]:
        taken: set[int] = set()
        for link in links:
            near = [
                (abs(wrapped(link.heading - other.heading)), k)
                for k, other in enumerate(joined)
                if k not in taken and link.heading is not None and other.heading is not None
            ]
            off, k = min(near, default=(np.inf, -1))
            if off < ARM_TOLERANCE:
                counts[k] += 1
                joined[k] = _joined_link(joined[k], link, 1 / counts[k])
                taken.add(k)
            else:
                joined.append(link)
                counts.append(1)
                taken.add(len(joined) - 1)
    if len(joined) <= MAX_LINKS:
        return tuple(joined)
    rank = sorted(range(len(joined)), key=lambda k: (joined[k].connected_to_id is None, not is_passable(joined[k])))
    return tuple(joined[k] for k in sorted(rank[:MAX_LINKS]))


def meant_variance(recorded: LandmarkMap, landmark: Landmark) -> Array:
    """Variance (3,) over (x, y, heading) of what one robot means by a landmark from where that is: half of row 10 of
    the measurement model, and the errors of its arms."""
    arms = len(signatures_of(recorded)[landmark.id].headings)
    heading = arms_variance(recorded, landmark, arms) + SAME_HEADING**2 / 2
    return np.array([SAME_PLACE**2 / 2, SAME_PLACE**2 / 2, heading])


def merged_landmarks(
    maps: Sequence[LandmarkMap],
    places: Sequence[Place],
    poses: Sequence[Array],
    covariance: Mapping[Member, int],
    joint: Array,
    group: int,
    names: Sequence[str],
) -> tuple[tuple[FusedLandmark, ...], JointCovariance]:
    """The landmarks of one group, and their joint covariance.

    ``poses``: per map (n, 3) in the group's frame; ``joint`` (3N, 3N): covariance over all recorded landmarks, axes of
    the group's frame, ``covariance`` giving each one's block in it; ``names``: the fused ids, parallel to ``places``.
    A place recorded by several robots stands where the mean of their records does; what one robot means by it is half
    of row 10 of the measurement model away from where it is.
    """
    name_of = {member: names[k] for k, place in enumerate(places) for member in place.members}
    joint, meant = joint.copy(), np.zeros((len(joint) // 3, 3))
    members = [(k, member, 1 / len(place.members)) for k, place in enumerate(places) for member in place.members]
    for _, (r, n), _ in members:
        meant[covariance[r, n]] = meant_variance(maps[r], maps[r].landmarks[n])
    joint[np.diag_indices(len(joint))] += meant.ravel()
    of_place = np.array([k for k, _, _ in members], dtype=np.intp)
    block = np.array([covariance[member] for _, member, _ in members], dtype=np.intp)
    rows, columns = (3 * which[:, None] + np.arange(3) for which in (of_place, block))
    weights = np.repeat([weight for _, _, weight in members], 3)
    mean = csr_array((weights, (rows.ravel(), columns.ravel())), shape=(3 * len(places), len(joint)))
    fused_joint = np.asarray(mean @ (mean @ joint).T)
    fused_joint = (fused_joint + fused_joint.T) / 2
    merging = _Merging(maps, [headings_of(m) for m in maps], [own.tolist() for own in poses], name_of)
    landmarks = tuple(
        _landmark(merging, place, fused_joint[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], group)
        for k, place in enumerate(places)
    )
    order = tuple(landmark.id for landmark in landmarks)
    if all(landmark.heading is not None for landmark in landmarks):
        return landmarks, JointCovariance(order, 3, fused_joint)
    kept = np.flatnonzero(np.arange(len(fused_joint)) % 3 < 2)
    return landmarks, JointCovariance(order, 2, fused_joint[np.ix_(kept, kept)])


class _Merging(NamedTuple):
    """What all landmarks of a group are merged with: its maps, of each the headings by id and the poses (x, y, theta)
    in the group's frame, and the fused ids."""

    maps: Sequence[LandmarkMap]
    headings: Sequence[Mapping[str, float | None]]
    poses: Sequence[Sequence[Sequence[float]]]
    name_of: Mapping[Member, str]


def _landmark(merging: _Merging, place: Place, covariance: Array, group: int) -> FusedLandmark:
    maps, name = merging.maps, merging.name_of[place.members[0]]
    # by name, so that what is joined does not depend on the order of the maps
    members = sorted(place.members, key=lambda member: (maps[member[0]].name, maps[member[0]].ids[member[1]]))
    recorded = [maps[r].landmarks[k] for r, k in members]
    facing = [merging.headings[r][maps[r].ids[k]] for r, k in members]
    at = [merging.poses[r][k] for r, k in members]
    links = _joined_links(
        [
            _links(landmark, pose[2] - (own or 0.0), maps[r], r, merging.name_of, name)
            for landmark, own, pose, (r, _) in zip(recorded, facing, at, members, strict=True)
        ]
    )
    x, y = (sum(pose[axis] for pose in at) / len(at) for axis in (0, 1))
    with_arms = heading_of(Landmark("", recorded[0].type, 0.0, 0.0, links=links))
    headings = [pose[2] for own, pose in zip(facing, at, strict=True) if own is not None]
    heading = with_arms
    if heading is None and headings:
        heading = float(np.angle(np.exp(1j * np.array(headings)).sum()))
    sources: dict[str, tuple[str, ...]] = {}
    for r, k in members:
        sources[maps[r].name] = (*sources.get(maps[r].name, ()), maps[r].ids[k])
    return FusedLandmark(
        id=name,
        group=group,
        type=recorded[0].type,
        x=x,
        y=y,
        heading=heading,
        covariance=covariance if heading is not None else covariance[:2, :2],
        sources=sources,
        existence=place.existence,
        links=links,
        visit_counter=sum(l.visit_counter for l in recorded),
        detection_counter=sum(l.detection_counter for l in recorded),
    )


def _links(
    landmark: Landmark, turn: float, map_: LandmarkMap, r: int, name_of: Mapping[Member, str], own: str
) -> list[Link]:
    """A landmark's links in the group's frame, where its directions turn by ``turn`` [rad], to the merged landmarks."""
    return [
        Link(
            link.type,
            None if link.heading is None else wrapped(link.heading + turn),
            link.compass,
            _target(map_, r, link, name_of, own),
            link.distance,
            link.travel_counter,
            link.extra,
        )
        for link in landmark.links
    ]


def _target(map_: LandmarkMap, r: int, link: Link, name_of: Mapping[Member, str], own: str) -> str | None:
    other = map_.index_from_id.get(link.connected_to_id or "")
    if other is None:
        return None
    name = name_of[(r, other)]
    return None if name == own else name
