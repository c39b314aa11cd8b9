"""`Smoother`: iSAM2 over all landmarks of all maps, whatever came last; merges are factors that come and go.

It holds what `mapfuse.factors.graph` holds for maps that no longer grow. A message replaces what its landmarks
measured; a merge adds correspondences, after its maps were put where they lie on each other; an un-merge takes just
these out again. Of each group of maps the first one's frame is held, the others' are loose. `fusion.online.tree` keeps
account of the factors. All in it is in the maps' local coordinates, so that maps far from their origins are as good as
any.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.arms import heading_of
from mapfuse.datasets.transform import Transform
from mapfuse.factors import CompassKey, CompassReading, FrameKey, Gauge, LandmarkKey, TransformPrior
from mapfuse.factors.compass import NorthOffset, NorthPrior, compass_readings
from mapfuse.factors.correspondence import correspondence
from mapfuse.factors.joint import joint_measurement
from mapfuse.factors.noise import LOOSE_ROTATION, PoseNoise

from ..far import carried
from ..result import FusedMap
from .anchors import Anchors
from .segment import Segment
from .terms import neighbourhood, terms_of
from .tree import Tag, Tree

Array = NDArray[np.float64]

#: A joint covariance of more landmarks than this is left to the weighing: here their links stand for it.
MOST_JOINT = 150
_PINNED = 1.0
#: A frame that is held at its own origin lies this close to it [m, rad].
_AT_HOME = 1e-6

Match: TypeAlias = tuple[LandmarkKey, LandmarkKey]


@dataclass
class _Held:
    """One map in the tree: which landmarks link to which, and of which a joint covariance speaks."""

    segment: Segment
    number: int
    anchors: Anchors
    out: dict[str, frozenset[str]] = field(default_factory=dict)
    into: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    turned: frozenset[str] = frozenset()
    corrected: int = -1


class Smoother:
    """Frames and landmarks of all maps by now. Poses are in the frame of the first map of each group."""

    def __init__(self) -> None:
        self._held: dict[str, _Held] = {}
        self._groups: list[tuple[str, ...]] = []
        self._matches: dict[Match, Tag] = {}
        self.tree = Tree()

    # What comes in

    def changed(self, segment: Segment, ids: Sequence[str]) -> None:
        """Landmarks of a map are new, gone, or otherwise there."""
        held = self._held.get(segment.name)
        if held is None:
            held = self._held[segment.name] = self._new(segment)
            self._groups.append((segment.name,))
            self.tree.start(FrameKey(held.number), np.zeros(3))
            self.tree.put((segment.name, "frame"), (Gauge.held(held.number, np.zeros(3)),))
        anew = held.corrected != segment.corrected
        if anew:
            held.corrected = segment.corrected
            ids = tuple(dict.fromkeys((*ids, *self._rejoin(held))))
        apart = self._relink(held, ids)
        held.anchors.update(ids, held.out, afresh=anew or apart)
        self.tree.update(settle=anew)

    def _new(self, segment: Segment) -> _Held:
        number = len(self._held)
        return _Held(segment, number, Anchors(segment, number, self.tree))

    def _rejoin(self, held: _Held) -> tuple[str, ...]:
        """The joint covariance of a correction; ids of the landmarks that it newly speaks of, or no longer does."""
        recorded = held.segment.local_map()
        joint = recorded.joint_covariance
        if joint is None or len(joint.order) > MOST_JOINT:
            joined: frozenset[str] = frozenset()
            self.tree.put((held.segment.name, "joint"), ())
        else:
            joined = frozenset(joint.order)
            measured = joint_measurement(recorded, held.number)
            self.tree.put((held.segment.name, "joint"), () if measured is None else (measured,))
            self._begin(held, joint.order)
        differ = tuple(sorted(joined ^ held.anchors.joined))
        turned = joined if joint is not None and joint.rows == 3 else frozenset()
        known = {LandmarkKey(held.number, name) for name in turned}
        seen = tuple(m for m in compass_readings(recorded, held.number) if m.b in known) if known else ()
        self.tree.put((held.segment.name, "compass"), seen)
        self._compass(held, seen)
        differ = tuple(sorted({*differ, *(turned ^ held.turned)}))
        held.anchors.joined, held.turned = joined, turned
        return differ

    def _begin(self, held: _Held, ids: Iterable[str]) -> None:
        """Starting values of landmarks that are new here."""
        T = self.tree.about(FrameKey(held.number))
        for name in ids:
            key = LandmarkKey(held.number, name)
            landmark = held.segment.local(name)
            if landmark is not None and not self.tree.has(key):
                pose = np.array([landmark.x, landmark.y, heading_of(landmark) or 0.0])
                self.tree.start(key, np.asarray(se2.compose(T, pose)))

    def _relink(self, held: _Held, ids: Sequence[str]) -> bool:
        """What these landmarks measure instead of what they did; whether some no longer hang together."""
        segment, name, apart = held.segment, held.segment.name, False
        self._begin(held, ids)
        for identifier in ids:
            landmark = segment.landmark(identifier)
            before = held.out.get(identifier, frozenset())
            targets = frozenset() if landmark is None else _targets(landmark.links) - {identifier}
            for old in before - targets:
                held.into[old].discard(identifier)
            for target in targets - before:
                held.into[target].add(identifier)
            held.out[identifier] = targets
            others = targets | before | held.into[identifier]
            if landmark is None:
                held.out.pop(identifier)
                for other in others:
                    self.tree.put((name, "link", *sorted((identifier, other))), ())
                for what in ("heading", "compass"):
                    self.tree.put((name, what, identifier), ())
                apart = held.anchors.drop(identifier) or apart
                continue
            near = neighbourhood(segment, identifier, others)
            terms = terms_of(near, identifier, held.number, held.anchors.joined, held.turned)
            self.tree.put((name, "heading", identifier), terms.heading)
            self.tree.put((name, "compass", identifier), terms.compass)
            self._compass(held, terms.compass)
            for other in sorted(others):
                found = terms.links.get(other, ())
                self.tree.put((name, "link", *sorted((identifier, other))), found)
                tied = bool(found) and terms.ties(other)
                apart = held.anchors.tie(identifier, other, tied) or apart
        return apart

    def _compass(self, held: _Held, readings: tuple[CompassReading, ...]) -> None:
        """North as this robot's compass has it, where it reads for the first time."""
        c, tag = CompassKey(held.number), (held.segment.name, "north")
        if not readings or self.tree.of(tag):
            return
        first = readings[0]
        seen = self.tree.pose(first.b)[2] - first.measured[2]
        self.tree.start(c, np.array([0.0, 0.0, float(se2.wrap(seen))]))
        noise = PoseNoise.from_sigmas(_PINNED, _PINNED, LOOSE_ROTATION)
        self.tree.put(tag, (NorthPrior(c, (0.0, 0.0, float(se2.wrap(seen))), noise),))

    # Merges

    def merged(self, fused: FusedMap) -> None:
        """Follow an answer: maps that came together are put there and tied, those that parted let go."""
        groups = [tuple(n for n in group if n in self._held) for group in fused.groups]
        groups = [group for group in groups if group]
        groups += [(n,) for n in self._held if not any(n in group for group in groups)]
        of = {name: set(group) for group in self._groups for name in group}
        met = any(a not in of[b] for group in groups for a, b in combinations(group, 2))
        wanted = self._wanted(fused)
        frames = {
            name: carried(fused.frames[name].T, -self._origin(group[0]), -self._origin(name)).array
            for group in groups
            for name in group[1:]
        }
        elsewhere = any(not _near(self.tree.pose(FrameKey(self._held[name].number)), T) for name, T in frames.items())
        # who stood in another's frame and is alone again, or the first of its group, has its own from now on
        firsts = [self.tree.pose(FrameKey(self._held[group[0]].number)) for group in groups]
        elsewhere |= any(np.abs(pose).max() > _AT_HOME for pose in firsts)
        for match in [m for m in self._matches if m not in wanted]:
            self.tree.put(self._matches.pop(match), ())
        self._groups = groups
        if met or elsewhere:
            self._seat(frames)
        self._hold(frames)
        for match in wanted:
            a, b = match
            one, two = self._segment(a.map), self._segment(b.map)
            rotation = float(self._turn(b.map) - self._turn(a.map))
            tag = self._matches.setdefault(match, ("match", a.map, a.id, b.map, b.id))
            self.tree.put(tag, (correspondence(one.local_map(), a, two.local_map(), b, rotation, None, wanted[match]),))
        if met or elsewhere:
            self.tree.rebuild()
        else:
            self.tree.update(settle=True)

    def _wanted(self, fused: FusedMap) -> dict[Match, int]:
        """Pairs of landmarks that are one, and how many landmarks are that one."""
        number = {name: held.number for name, held in self._held.items()}
        wanted: dict[Match, int] = {}
        for landmark in fused.landmarks:
            members = [
                LandmarkKey(number[name], i)
                for name, ids in landmark.sources.items()
                if name in number
                for i in ids
                if self._held[name].segment.landmark(i) is not None
            ]
            for a, b in combinations(sorted(members), 2):
                if a.map != b.map:
                    wanted[a, b] = len(members)
        return wanted

    def _hold(self, frames: Mapping[str, Array]) -> None:
        """The frame of each group's first map held, the others' loose, their compasses tied to its."""
        for group in self._groups:
            for k, name in enumerate(group):
                held = self._held[name]
                r, tag = held.number, (name, "frame")
                T = self.tree.pose(FrameKey(r))
                if k == 0:
                    if not any(isinstance(m, Gauge) for m in self.tree.of(tag)):
                        self.tree.put(tag, (Gauge.held(r, T),))
                    self.tree.put((name, "offset"), ())
                    continue
                if not any(isinstance(m, TransformPrior) for m in self.tree.of(tag)):
                    self.tree.put(tag, (TransformPrior.weak(r, frames[name], _centre(held.segment)),))
                self.tree.put((name, "offset"), self._offset(group[0], name))

    def _offset(self, first: str, name: str) -> tuple[NorthOffset, ...]:
        """Both robots' compasses mean one north, each but for its offset."""
        one, two = self._held[first], self._held[name]
        of_one, of_two = one.segment.noise.compass_offset_sigma, two.segment.noise.compass_offset_sigma
        if not (self.tree.of((first, "north")) and self.tree.of((name, "north"))) or of_one is None or of_two is None:
            return ()
        sigma = float(np.hypot(of_one, of_two))
        noise = PoseNoise.from_sigmas(_PINNED, _PINNED, sigma)
        return (NorthOffset(CompassKey(one.number), CompassKey(two.number), (0.0, 0.0, 0.0), noise),)

    def _seat(self, frames: Mapping[str, Array]) -> None:
        """Starting values for maps that lie elsewhere from now on: each as it is, in its new place."""
        values = self.tree.poses()
        for group in self._groups:
            for name in group:
                held = self._held[name]
                frame = FrameKey(held.number)
                old, new = values[frame], frames.get(name, np.zeros(3))
                turn = float(new[2] - old[2])
                moved = np.asarray(se2.compose(new, se2.inverse(old)))
                for unknown in values:
                    if unknown == CompassKey(held.number):
                        self.tree.start(unknown, values[unknown] + np.array([0.0, 0.0, turn]))
                    elif isinstance(unknown, LandmarkKey) and unknown.map == held.number:
                        self.tree.start(unknown, np.asarray(se2.compose(moved, values[unknown])))
                self.tree.start(frame, new)
                self.tree.put((name, "frame"), ())

    # What comes out

    def _segment(self, number: int) -> Segment:
        return next(held.segment for held in self._held.values() if held.number == number)

    def _turn(self, number: int) -> float:
        return float(self.tree.pose(FrameKey(number))[2])

    def knows(self, name: str) -> bool:
        """Whether there is anything of this map."""
        return name in self._held

    @property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """Maps that share a frame; alone ones too."""
        return tuple(self._groups)

    def local_frame(self, name: str) -> Transform:
        """Pose of a map's frame in that of its group, with covariance, between the local coordinates of both (those of
        `Segment.origin`). KeyError for a map that it doesn't have."""
        number = self._held[name].number
        C = self.local_covariance(name, ())[:3, :3]
        return Transform.from_array(self.tree.pose(FrameKey(number)), C)

    def local_landmarks(self, name: str) -> dict[str, Array]:
        """Poses (3,) of a map's landmarks in the local coordinates of its group's first map."""
        number = self._held[name].number
        return {u.id: pose for u, pose in self.tree.poses().items() if isinstance(u, LandmarkKey) and u.map == number}

    def local_covariance(self, name: str, ids: Sequence[str]) -> Array:
        """Covariance (3 + 3k, 3 + 3k) of `local_frame` and these landmarks together, in the axes of the group's frame,
        given the frame that the gauge holds: what keeps the solver from floating is no uncertainty."""
        number = self._held[name].number
        first = self._held[self.first_of_group(name)].number
        own = [FrameKey(number), *(LandmarkKey(number, i) for i in ids)]
        C = self.tree.covariance(own if number == first else [FrameKey(first), *own])
        gauge, rest = C[:3, :3], C[3:, 3:]
        given = rest - C[3:, :3] @ np.linalg.solve(gauge, C[:3, 3:])
        if number != first:
            return np.asarray(given)
        whole = np.zeros_like(C)  # the frame is this map's own
        whole[3:, 3:] = given
        return whole

    def frame(self, name: str) -> Transform:
        """Pose of a map's frame in that of its group, with covariance. KeyError for a map that it doesn't have."""
        return carried(self.local_frame(name), self.origin_of_group(name), self._origin(name))

    def landmarks(self, name: str) -> dict[str, Array]:
        """Poses (3,) of a map's landmarks in the frame of its group, theta without meaning where there is none."""
        origin = np.array([*self.origin_of_group(name), 0.0])
        return {i: pose + origin for i, pose in self.local_landmarks(name).items()}

    def joint_covariance(self, name: str, ids: Sequence[str]) -> tuple[Array, Array]:
        """Covariance of a map's frame (3, 3), and of frame and these landmarks together (3 + 3k, 3 + 3k), in the
        axes of the group's frame; where that frame is this map's own, its part is zero."""
        C = self.local_covariance(name, ids)
        J = np.eye(len(C))
        T = self.tree.pose(FrameKey(self._held[name].number))
        J[:3, :3] = se2.compose_jacobians(T, np.array([*-self._origin(name), 0.0]))[0]
        C = J @ C @ J.T
        return C[:3, :3], C

    def origin_of_group(self, name: str) -> Array:
        """Origin (2,) [m] of the local coordinates of the first map of this one's group."""
        return self._origin(self.first_of_group(name))

    def first_of_group(self, name: str) -> str:
        """The map whose frame is that of this one's group."""
        return next(group[0] for group in self._groups if name in group)

    def _origin(self, name: str) -> Array:
        return self._held[name].segment.origin

    @property
    def size(self) -> int:
        """Number of factors in the tree."""
        return self.tree.size


def _targets(links: Iterable[Any]) -> frozenset[str]:
    return frozenset(l.connected_to_id for l in links if l.connected_to_id is not None and l.distance is not None)


def _near(a: Array, b: Array) -> bool:
    return bool(np.hypot(*(a[:2] - b[:2])) < 5.0 and abs(se2.wrap(a[2] - b[2])) < 0.5)


def _centre(segment: Segment) -> Array:
    recorded = segment.local_map()
    return recorded.positions.mean(axis=0) if len(recorded) else np.zeros(2)
