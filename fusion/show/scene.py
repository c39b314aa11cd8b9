"""`Scene`: what stands in one frame, as arrays ready to be drawn; of a map, a group, or two maps laid together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.arms import Kind, signature
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link

from ..result import FusedLandmark, FusedMap
from .style import DOUBTFUL

Array = NDArray[np.float64]

#: Owner of what several maps recorded.
COMMON_OWNER = -1


class Arm(NamedTuple):
    """One sensed arm: the landmark's place in the scene, direction [rad], and whether a corridor goes on there."""

    landmark: int
    heading: float
    passable: bool


@dataclass(frozen=True, slots=True)
class Scene:
    """Landmarks in one frame, positions (n, 2) [m], parallel to ``kinds``, ``owners``, ``doubtful`` and ``ids``.

    ``owners``: which map recorded it, `COMMON_OWNER` where several did. ``covariances``: (m, 2, 2) [m^2] of the
    landmarks ``covariance_of`` (m,). ``links``: (l, 2) landmarks at their ends, with ``link_owners`` (l,).
    """

    positions: Array
    kinds: tuple[Kind, ...]
    owners: NDArray[np.intp]
    doubtful: NDArray[np.bool_]
    ids: tuple[str, ...]
    arms: tuple[Arm, ...]
    links: NDArray[np.intp]
    link_owners: NDArray[np.intp]
    covariances: Array
    covariance_of: NDArray[np.intp]
    walls: tuple[Array, ...]

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def common(self) -> NDArray[np.bool_]:
        """Which landmarks several maps recorded (n,)."""
        return np.asarray(self.owners == COMMON_OWNER)

    @property
    def extent(self) -> tuple[Array, Array]:
        """Lower and upper corner (2,) [m] of everything, at least four metres wide."""
        points = np.concatenate([self.positions, *self.walls]) if len(self) or self.walls else np.zeros((1, 2))
        return widened(points.min(axis=0), points.max(axis=0))

    def moved(self, T: Array) -> Scene:
        """The same in another frame: ``T`` (3,) takes this frame's coordinates there."""
        R = se2.rotation(T[2])
        return replace(
            self,
            positions=se2.transform(T, self.positions),
            arms=tuple(arm._replace(heading=arm.heading + float(T[2])) for arm in self.arms),
            covariances=R @ self.covariances @ R.T,
            walls=tuple(se2.transform(T, wall) for wall in self.walls),
        )


def widened(low: Array, high: Array) -> tuple[Array, Array]:
    """Corners (2,) [m] of a box, drawn apart where it is less than four metres wide."""
    missing = np.maximum(0.0, 4.0 - (high - low)) / 2
    return low - missing, high + missing


def _arms(landmarks: Iterable[Landmark]) -> tuple[Arm, ...]:
    found = []
    for k, landmark in enumerate(landmarks):
        arms = signature(landmark)
        found += [Arm(k, h, p) for h, p in zip(arms.headings, arms.passable, strict=True)]
        if not arms.headings and landmark.heading is not None:
            found.append(Arm(k, landmark.heading, True))
    return tuple(found)


def _links(links_of: Sequence[tuple[str, tuple[Link, ...]]]) -> NDArray[np.intp]:
    """Pairs of landmarks that a link connects, each once (l, 2)."""
    place = {identifier: k for k, (identifier, _) in enumerate(links_of)}
    pairs = {
        (min(k, place[link.connected_to_id]), max(k, place[link.connected_to_id]))
        for k, (_, links) in enumerate(links_of)
        for link in links
        if link.connected_to_id in place
    }
    return np.array(sorted(pairs), dtype=np.intp).reshape(-1, 2)


def _covariances(of: Iterable[Array | None]) -> tuple[Array, NDArray[np.intp]]:
    known = [(k, c[:2, :2]) for k, c in enumerate(of) if c is not None]
    matrices = np.array([c for _, c in known], dtype=float).reshape(-1, 2, 2)
    return matrices, np.array([k for k, _ in known], dtype=np.intp)


def _own_covariances(map_: LandmarkMap) -> list[Array | None]:
    """Each landmark's covariance, from the joint one where that knows it."""
    found = [landmark.covariance for landmark in map_.landmarks]
    if (joint := map_.joint_covariance) is None:
        return found
    for k, identifier in enumerate(joint.order):
        block = slice(joint.rows * k, joint.rows * k + 2)
        found[map_.index_from_id[identifier]] = joint.matrix[block, block]
    return found


def scene_of_map(map_: LandmarkMap, owner: int = 0) -> Scene:
    """One map in its own frame."""
    n = len(map_)
    links = _links([(l.id, l.links) for l in map_.landmarks])
    covariances, covariance_of = _covariances(_own_covariances(map_))
    return Scene(
        positions=map_.positions,
        kinds=tuple(signature(l).kind for l in map_.landmarks),
        owners=np.full(n, owner, dtype=np.intp),
        doubtful=np.array([l.existence is not None and l.existence < DOUBTFUL for l in map_.landmarks], dtype=bool),
        ids=map_.ids,
        arms=_arms(map_.landmarks),
        links=links,
        link_owners=np.full(len(links), owner, dtype=np.intp),
        covariances=covariances,
        covariance_of=covariance_of,
        walls=map_.walls,
    )


def _owner(sources: Iterable[str], place: Mapping[str, int]) -> int:
    names = set(sources)
    return place[names.pop()] if len(names) == 1 else COMMON_OWNER


def _recorders(landmark: FusedLandmark) -> set[str]:
    return {name for name, ids in landmark.sources.items() if ids}


def scene_of_group(fused: FusedMap, group: int) -> Scene:
    """One group's merged map in the frame of its first map; walls of its embedded sources included."""
    members = [l for l in fused.landmarks if l.group == group]
    place = {name: k for k, name in enumerate(fused.maps)}
    as_landmarks = [Landmark(l.id, l.type, l.x, l.y, l.heading, l.links) for l in members]
    links = _links([(l.id, l.links) for l in members])
    covariances, covariance_of = _covariances(l.covariance for l in members)
    return Scene(
        positions=np.array([(l.x, l.y) for l in members], dtype=float).reshape(-1, 2),
        kinds=tuple(signature(l).kind for l in as_landmarks),
        owners=np.array([_owner(_recorders(l), place) for l in members], dtype=np.intp),
        doubtful=np.array([l.existence < DOUBTFUL for l in members], dtype=bool),
        ids=tuple(l.id for l in members),
        arms=_arms(as_landmarks),
        links=links,
        link_owners=np.array(
            [_owner(_recorders(members[a]) & _recorders(members[b]), place) for a, b in links], dtype=np.intp
        ),
        covariances=covariances,
        covariance_of=covariance_of,
        walls=tuple(
            fused.frames[name].T.apply(wall)
            for name in fused.groups[group]
            if name in fused.sources
            for wall in fused.sources[name].walls
        ),
    )


def laid_together(first: Scene, second: Scene) -> Scene:
    """Two scenes of one frame in one picture, nothing merged."""
    n = len(first)
    return Scene(
        positions=np.concatenate([first.positions, second.positions]),
        kinds=first.kinds + second.kinds,
        owners=np.concatenate([first.owners, second.owners]),
        doubtful=np.concatenate([first.doubtful, second.doubtful]),
        ids=first.ids + second.ids,
        arms=first.arms + tuple(arm._replace(landmark=arm.landmark + n) for arm in second.arms),
        links=np.concatenate([first.links, second.links + n]),
        link_owners=np.concatenate([first.link_owners, second.link_owners]),
        covariances=np.concatenate([first.covariances, second.covariances]),
        covariance_of=np.concatenate([first.covariance_of, second.covariance_of + n]),
        walls=first.walls + second.walls,
    )
