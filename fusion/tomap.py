"""A group of a fused map as one recorded map, which can be written as ``mapfuse.map/1`` and fused again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.formats.graphs import WAYS
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Link, Noise

from .result import FusedLandmark, FusedMap

Array = NDArray[np.float64]

#: Key under which the ways of all robots but the first are kept: ``path`` is one robot's, and begins where the
#: map's frame is tied to the landmarks.
OTHER_PATHS = "other_paths"


def to_map(fused: FusedMap, group: int = 0, name: str | None = None) -> LandmarkMap:
    """One group as a map in the frame of its first map; see `FusedMap.to_map`."""
    _check_group(fused, group)
    names = fused.groups[group]
    members = [landmark for landmark in fused.landmarks if landmark.group == group]
    joint = _joint_covariance(fused, group, members)
    noise = combined_noise([fused.sources[n].noise if n in fused.sources else Noise() for n in names])
    with_compass = len(names) == 1 or noise.compass_offset_sigma is not None
    paths = {n: path for n in names if (path := _path(fused, n)) is not None}
    others: dict[str, Any] = {n: path.tolist() for n, path in paths.items() if n != names[0]}
    return LandmarkMap(
        name="+".join(names) if name is None else name,
        landmarks=tuple(_landmark(l, {m.id for m in members}, with_compass, joint.rows) for l in members),
        noise=noise,
        joint_covariance=joint,
        walls=tuple(fused.frames[n].T.apply(w) for n in names if n in fused.sources for w in fused.sources[n].walls),
        path=paths.get(names[0]),
        same_as=_same_as(fused, names, members),
        extra={OTHER_PATHS: others} if others else {},
    )


def _joint_covariance(fused: FusedMap, group: int, members: Sequence[FusedLandmark]) -> JointCovariance:
    """That of the group in the order of its landmarks, with headings where all have one."""
    joint = fused.joint_covariances[group] if group < len(fused.joint_covariances) else None
    if joint is None:
        raise MapfuseError(
            f"the joint covariance of group {group} ({', '.join(fused.groups[group])}) was not kept, and without it "
            "this is no map that can be fused again: a file of a fused map doesn't hold it. Fuse the maps again "
            "(`fuse(list(read_fused(path).sources.values()))` where they are embedded) and call to_map on that result"
        )
    place = {identifier: k for k, identifier in enumerate(joint.order)}
    missing = [landmark.id for landmark in members if landmark.id not in place]
    if missing:
        raise MapfuseError(f"the joint covariance of group {group} lacks the landmarks {', '.join(missing[:10])}")
    rows = 3 if joint.rows == 3 and all(landmark.heading is not None for landmark in members) else 2
    kept = np.array(
        [joint.rows * place[landmark.id] + row for landmark in members for row in range(rows)], dtype=np.intp
    )
    return JointCovariance(tuple(l.id for l in members), rows, joint.matrix[np.ix_(kept, kept)])


def _landmark(fused: FusedLandmark, ids: set[str], with_compass: bool, rows: int) -> Landmark:
    landmark = Landmark(
        id=fused.id,
        type=fused.type,
        x=fused.x,
        y=fused.y,
        links=tuple(_link(link, ids, with_compass) for link in fused.links),
        visit_counter=fused.visit_counter,
        detection_counter=fused.detection_counter,
        # a joint covariance of three rows says it all; one of two rows lacks the heading's
        covariance=fused.covariance if rows == 2 and fused.heading is not None else None,
        existence=fused.existence,
        extra=fused.extra,
    )
    has_arms = any(link.heading is not None for link in landmark.links)
    return landmark if has_arms else replace(landmark, heading=fused.heading)


def _link(link: Link, ids: set[str], with_compass: bool) -> Link:
    compass = link.compass if with_compass else None
    if link.connected_to_id in ids:
        return replace(link, compass=compass)
    return replace(link, compass=compass, connected_to_id=None, distance=None)


def combined_noise(noises: Sequence[Noise]) -> Noise:
    """What can be promised of a map that several robots made: of each figure the worst of theirs.

    Part of the map may have been passed by one robot only, so that a landmark is in it with that robot's detection
    rate, the smallest in the worst case; likewise for false alarms, which each landmark's ``existence`` says better.
    Readings of several compasses stand side by side in the map, each with its own offset: where more than one robot
    contributed, `compass_sigma` takes the offsets in. One unknown offset makes the common one unknown.

    >>> both = combined_noise([Noise(detection_rate=0.8, heading_sigma=0.03), Noise(detection_rate=0.9)])
    >>> both.detection_rate, both.heading_sigma
    (0.8, 0.03)
    """
    if len(noises) == 1:
        return noises[0]
    offsets = [noise.compass_offset_sigma for noise in noises]
    known = [offset for offset in offsets if offset is not None]
    return Noise(
        distance_sigma_per_metre=max(noise.distance_sigma_per_metre for noise in noises),
        distance_sigma_floor=max(noise.distance_sigma_floor for noise in noises),
        heading_sigma=max(noise.heading_sigma for noise in noises),
        position_sigma=max(noise.position_sigma for noise in noises),
        compass_sigma=max(float(np.hypot(n.compass_sigma, n.compass_offset_sigma or 0.0)) for n in noises),
        compass_offset_sigma=max(known) if len(known) == len(offsets) else None,
        detection_rate=min(noise.detection_rate for noise in noises),
        false_alarm_rate=max(noise.false_alarm_rate for noise in noises),
        door_detection_rate=min(noise.door_detection_rate for noise in noises),
        door_false_alarm_rate=max(noise.door_false_alarm_rate for noise in noises),
    )


def _path(fused: FusedMap, name: str) -> Array | None:
    """A source's path (k, 4) in the group's frame."""
    path = fused.sources[name].path if name in fused.sources else None
    if path is None or not len(path):
        return None
    poses = se2.compose(fused.frames[name].T.array, path[:, 1:])
    return np.concatenate([path[:, :1], poses], axis=1)


def _same_as(fused: FusedMap, names: Sequence[str], members: Sequence[FusedLandmark]) -> dict[str, dict[str, str]]:
    """What the sources know of maps outside the group; of two answers for one landmark the first source's."""
    known: dict[str, dict[str, str]] = {}
    for landmark in members:
        for name in names:
            for identifier in landmark.sources.get(name, ()) if name in fused.sources else ():
                for other, theirs in fused.sources[name].same_as.get(identifier, {}).items():
                    if other not in names:
                        known.setdefault(landmark.id, {}).setdefault(other, theirs)
    return known


def without_joint_covariance(fused: FusedMap, group: int = 0, name: str | None = None) -> LandmarkMap:
    """One group as a map to be looked at or driven on, for formats that hold no joint covariance anyway.

    As `to_map`, but each landmark carries its own covariance and existence, and no result file lacks what that needs.
    Fused again it would claim too much: that its landmarks err independently. Ways beyond a landmark's four links, of
    embedded sources that have such (`WAYS`), lead to the merged landmarks, each once.
    """
    _check_group(fused, group)
    names = fused.groups[group]
    members = [landmark for landmark in fused.landmarks if landmark.group == group]
    ids = {landmark.id for landmark in members}
    fused_id = {(n, i): landmark.id for landmark in members for n, own in landmark.sources.items() for i in own}
    landmarks = []
    for member in members:
        rows = 2 if member.heading is None else 3
        landmark = _landmark(member, ids, with_compass=True, rows=2)
        landmark = replace(landmark, covariance=member.covariance[:rows, :rows], links=_each_way_once(landmark.links))
        led = {link.connected_to_id for link in landmark.links} | {member.id}
        further = [end for end in _ends(fused, member, fused_id) if end not in led]
        extra = {**landmark.extra, WAYS: [{"to": end} for end in further]} if further else landmark.extra
        landmarks.append(replace(landmark, extra=extra))
    return LandmarkMap(
        name="+".join(names) if name is None else name,
        landmarks=tuple(landmarks),
        noise=combined_noise([fused.sources[n].noise if n in fused.sources else Noise() for n in names]),
        walls=tuple(fused.frames[n].T.apply(w) for n in names if n in fused.sources for w in fused.sources[n].walls),
        path=_path(fused, names[0]),
    )


def _check_group(fused: FusedMap, group: int) -> None:
    if not 0 <= group < len(fused.groups):
        raise MapfuseError(f"there is no group {group}: this result has {len(fused.groups)}, counted from 0")


def _each_way_once(links: Sequence[Link]) -> tuple[Link, ...]:
    """Links, of those without direction that lead to one landmark the first only."""
    told: set[str] = set()
    kept = []
    for link in links:
        if link.heading is None and link.connected_to_id is not None:
            if link.connected_to_id in told:
                continue
            told.add(link.connected_to_id)
        kept.append(link)
    return tuple(kept)


def _ends(fused: FusedMap, member: FusedLandmark, fused_id: Mapping[tuple[str, str], str]) -> list[str]:
    """Where the ways without direction of a landmark lead in its sources, as merged landmarks, each once."""
    ends: dict[str, None] = {}
    for source, own in member.sources.items():
        recorded = fused.sources.get(source)
        for identifier in own if recorded is not None else ():
            assert recorded is not None
            landmark = recorded[identifier]
            # of ways along arms the merged links hold all that is to be driven: the nearer of two ends
            told = [link.connected_to_id for link in landmark.links if link.heading is None]
            further = landmark.extra.get(WAYS, ())
            told += [way.get("to") for way in further if isinstance(way, Mapping)] if isinstance(further, list) else []
            for end in told:
                if isinstance(end, str) and (merged := fused_id.get((source, end))) is not None:
                    ends[merged] = None
    return list(ends)
