"""`Smoother`: iSAM2 over all landmarks of all maps, whatever came last; merges are factors that come and go.

It holds what `mapfuse.factors.graph` holds for maps that no longer grow. A message replaces what its landmarks
measured; a merge adds correspondences, after its maps were put where they lie on each other; an un-merge takes just
these out again. Of each group of maps the first one's frame is held, the others' are loose.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any, TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.arms import heading_of
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.transform import Transform
from mapfuse.factors import CompassKey, CompassReading, FrameKey, Gauge, LandmarkKey, TransformPrior
from mapfuse.factors.axes import joint_to_axes
from mapfuse.factors.compass import NorthOffset, NorthPrior
from mapfuse.factors.correspondence import correspondence
from mapfuse.factors.frame import anchor, nearest_to_start
from mapfuse.factors.joint import joint_measurement
from mapfuse.factors.measurement import Measurement
from mapfuse.factors.noise import LOOSE_ROTATION, PoseNoise

from ..result import FusedMap
from .segment import Segment
from .terms import neighbourhood, stripped, terms_of

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

#: A joint covariance of more landmarks than this is left to the weighing: here their links stand for it.
MOST_JOINT = 150
#: iSAM2 linearises anew what moved by more than this [m, rad].
RELINEARISE = 0.05
#: It looks for such every so many messages; after what moves much at once.
SKIP = 10
#: Updates after what moves much, at most, until nothing moves.
SETTLING = 8
_PINNED = 1.0

Tag: TypeAlias = tuple[Hashable, ...]
Match: TypeAlias = tuple[LandmarkKey, LandmarkKey]


@dataclass
class _Held:
    """One map in the graph: which landmarks link to which, which hang together, and which of those are anchored."""

    segment: Segment
    number: int
    out: dict[str, frozenset[str]] = field(default_factory=dict)
    into: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    ties: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    part: dict[str, str] = field(default_factory=dict)
    members: dict[str, set[str]] = field(default_factory=dict)
    anchored: dict[str, str] = field(default_factory=dict)
    joined: frozenset[str] = frozenset()
    turned: frozenset[str] = frozenset()
    corrected: int = -1


class Smoother:
    """Frames and landmarks of all maps by now. Poses are in the frame of the first map of each group."""

    def __init__(self) -> None:
        self._held: dict[str, _Held] = {}
        self._keys: dict[Hashable, int] = {}
        self._terms: dict[Tag, tuple[Measurement, ...]] = {}
        self._indices: dict[Tag, list[int]] = {}
        self._groups: list[tuple[str, ...]] = []
        self._matches: dict[Match, Tag] = {}
        self._new: dict[Tag, tuple[Measurement, ...]] = {}
        self._gone: list[int] = []
        self._isam = _isam()
        self._start: dict[Hashable, Array] = {}
        self._frames: dict[int, Array] = {}
        self._known: dict[Hashable, Array] = {}
        self._failed = False

    # GTSAM's keys, as `mapfuse.factors` asks for them

    def key(self, unknown: Hashable) -> int:
        """GTSAM key of an unknown, a new one where it has none."""
        found = self._keys.get(unknown)
        if found is None:
            found = self._keys[unknown] = gtsam.symbol("x", len(self._keys))
        return found

    def keys(self, unknowns: Iterable[Hashable]) -> list[int]:
        """GTSAM keys of several unknowns."""
        return [self.key(unknown) for unknown in unknowns]

    # What comes in

    def changed(self, segment: Segment, ids: Sequence[str]) -> None:
        """Landmarks of a map are new, gone, or otherwise there."""
        held = self._held.get(segment.name)
        if held is None:
            held = self._held[segment.name] = _Held(segment, len(self._held))
            self._groups.append((segment.name,))
            T = FrameKey(held.number)
            self._start[T] = self._frames[held.number] = np.zeros(3)
            self._put((segment.name, "frame"), (Gauge.held(held.number, np.zeros(3)),))
        anew = held.corrected != segment.corrected
        if anew:
            held.corrected = segment.corrected
            ids = tuple(dict.fromkeys((*ids, *self._rejoin(held))))
        apart = self._relink(held, ids)
        self._anchor(held, ids, afresh=anew or apart)
        self._update(settle=anew)

    def _rejoin(self, held: _Held) -> tuple[str, ...]:
        """The joint covariance of a correction; ids of the landmarks that it newly speaks of, or no longer does."""
        recorded = held.segment.map()
        joint = recorded.joint_covariance
        if joint is None or len(joint.order) > MOST_JOINT:
            joined: frozenset[str] = frozenset()
            self._put((held.segment.name, "joint"), ())
        else:
            joined = frozenset(joint.order)
            measured = joint_measurement(recorded, held.number)
            self._put((held.segment.name, "joint"), () if measured is None else (measured,))
            self._begin(held, joint.order)
        differ = tuple(sorted(joined ^ held.joined))
        turned = joined if joint is not None and joint.rows == 3 else frozenset()
        differ = tuple(sorted({*differ, *(turned ^ held.turned)}))
        held.joined, held.turned = joined, turned
        return differ

    def _begin(self, held: _Held, ids: Iterable[str]) -> None:
        """Starting values of landmarks that are new here."""
        T = self._frames[held.number]
        for name in ids:
            key = LandmarkKey(held.number, name)
            landmark = held.segment.landmark(name)
            if landmark is not None and not self._isam.valueExists(self.key(key)):
                pose = np.array([landmark.x, landmark.y, heading_of(landmark) or 0.0])
                self._start[key] = np.asarray(se2.compose(T, pose))

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
                    self._put((name, "link", *sorted((identifier, other))), ())
                for what in ("heading", "compass", "anchor"):
                    self._put((name, what, identifier), ())
                parted = held.ties.pop(identifier, set())
                apart = apart or len(parted) > 0 or identifier in held.part
                for others_of in held.ties.values():
                    others_of.discard(identifier)
                continue
            near = neighbourhood(segment, identifier, others)
            terms = terms_of(near, identifier, held.number, held.joined, held.turned)
            self._put((name, "heading", identifier), terms.heading)
            self._put((name, "compass", identifier), terms.compass)
            self._compass(held, terms.compass)
            for other in sorted(others):
                found = terms.links.get(other, ())
                self._put((name, "link", *sorted((identifier, other))), found)
                tied = bool(found) and terms.ties(other)
                apart = apart or (other in held.ties[identifier] and not tied)
                for one, two in ((identifier, other), (other, identifier)):
                    if tied:
                        held.ties[one].add(two)
                    else:
                        held.ties[one].discard(two)
        return apart

    def _compass(self, held: _Held, readings: tuple[CompassReading, ...]) -> None:
        """North as this robot's compass has it, where it reads for the first time."""
        c, tag = CompassKey(held.number), (held.segment.name, "north")
        if not readings or self._terms.get(tag) or tag in self._new:
            return
        first = readings[0]
        seen = self._pose(first.b)[2] - first.measured[2]
        self._start[c] = np.array([0.0, 0.0, float(se2.wrap(seen))])
        noise = PoseNoise.from_sigmas(_PINNED, _PINNED, LOOSE_ROTATION)
        self._put(tag, (NorthPrior(c, (0.0, 0.0, float(se2.wrap(seen))), noise),))

    def _anchor(self, held: _Held, ids: Sequence[str], *, afresh: bool) -> None:
        """One landmark of those that hang together by links tied to the frame; none where a joint covariance is."""
        if afresh:
            ids = tuple(held.out)
            for name in held.anchored.values():
                self._put((held.segment.name, "anchor", name), ())
            held.part, held.members, held.anchored = {}, {}, {}
        for name in ids:
            if name not in held.out:
                continue
            own = held.part.setdefault(name, name)
            if own == name:
                held.members.setdefault(name, {name})
            for other in held.ties[name]:
                if other in held.part and held.part[other] != held.part[name]:
                    self._unite(held, held.part[name], held.part[other])
            self._reanchor(held, held.part[name], {name})

    def _unite(self, held: _Held, one: str, two: str) -> None:
        if len(held.members[one]) < len(held.members[two]):
            one, two = two, one
        moved = held.members.pop(two)
        held.members[one] |= moved
        for name in moved:
            held.part[name] = one
        other = held.anchored.pop(two, None)
        if other is not None:
            self._put((held.segment.name, "anchor", other), ())
            self._reanchor(held, one, {other})

    def _reanchor(self, held: _Held, part: str, also: set[str]) -> None:
        name, segment = held.segment.name, held.segment
        was = held.anchored.get(part)
        near = {*also, *([was] if was is not None else [])}
        if not held.joined.isdisjoint(held.members[part]):
            if was is not None:
                self._put((name, "anchor", held.anchored.pop(part)), ())
            return
        found = [stripped(l) for n in sorted(near) if (l := segment.landmark(n)) is not None]
        base = segment.base
        path = None if base is None or base.path is None else base.path[:1]
        few = LandmarkMap(name, tuple(found), noise=segment.noise, path=path)
        nearest = nearest_to_start(few, few.ids)
        if was is not None and was != nearest.id:
            self._put((name, "anchor", was), ())
        held.anchored[part] = nearest.id
        alone = LandmarkMap(name, (nearest,), noise=segment.noise, path=path)
        self._put((name, "anchor", nearest.id), (anchor(alone, held.number, nearest),))

    # Merges

    def merged(self, fused: FusedMap) -> None:
        """Follow an answer: maps that came together are put there and tied, those that parted let go."""
        groups = [tuple(n for n in group if n in self._held) for group in fused.groups]
        groups = [group for group in groups if group]
        groups += [(n,) for n in self._held if not any(n in group for group in groups)]
        of = {name: set(group) for group in self._groups for name in group}
        met = any(a not in of[b] for group in groups for a, b in combinations(group, 2))
        wanted = self._wanted(fused)
        elsewhere = any(
            not _near(self._pose(FrameKey(self._held[name].number)), fused.frames[name].T.array)
            for group in groups
            for name in group[1:]
        )
        for match in [m for m in self._matches if m not in wanted]:
            self._put(self._matches.pop(match), ())
        self._groups = groups
        if met or elsewhere:
            self._seat(fused)
        self._hold(fused)
        for match in wanted:
            a, b = match
            one, two = self._segment(a.map), self._segment(b.map)
            rotation = float(self._turn(b.map) - self._turn(a.map))
            tag = self._matches.setdefault(match, ("match", a.map, a.id, b.map, b.id))
            self._put(tag, (correspondence(one.map(), a, two.map(), b, rotation, None, wanted[match]),))
        if met or elsewhere:
            self._rebuild()
        else:
            self._update(settle=True)

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

    def _hold(self, fused: FusedMap) -> None:
        """The frame of each group's first map held, the others' loose, their compasses tied to its."""
        for group in self._groups:
            for k, name in enumerate(group):
                held = self._held[name]
                r, tag = held.number, (name, "frame")
                T = self._pose(FrameKey(r))
                if k == 0:
                    if not any(isinstance(m, Gauge) for m in self._of(tag)):
                        self._put(tag, (Gauge.held(r, T),))
                    self._put((name, "offset"), ())
                    continue
                if not any(isinstance(m, TransformPrior) for m in self._of(tag)):
                    self._put(tag, (TransformPrior.weak(r, fused.frames[name].T.array, _centre(held.segment)),))
                self._put((name, "offset"), self._offset(group[0], name))

    def _offset(self, first: str, name: str) -> tuple[NorthOffset, ...]:
        """Both robots' compasses mean one north, each but for its offset."""
        one, two = self._held[first], self._held[name]
        of_one, of_two = one.segment.noise.compass_offset_sigma, two.segment.noise.compass_offset_sigma
        if not (self._of((first, "north")) and self._of((name, "north"))) or of_one is None or of_two is None:
            return ()
        sigma = float(np.hypot(of_one, of_two))
        noise = PoseNoise.from_sigmas(_PINNED, _PINNED, sigma)
        return (NorthOffset(CompassKey(one.number), CompassKey(two.number), (0.0, 0.0, 0.0), noise),)

    def _seat(self, fused: FusedMap) -> None:
        """Starting values for maps that lie elsewhere from now on: each as it is, in its new place."""
        values = self._poses()
        for group in self._groups:
            for name in group:
                held = self._held[name]
                frame = FrameKey(held.number)
                old, new = values[frame], np.asarray(fused.frames[name].T.array if name != group[0] else np.zeros(3))
                turn = float(new[2] - old[2])
                moved = np.asarray(se2.compose(new, se2.inverse(old)))
                for unknown in values:
                    if unknown == CompassKey(held.number):
                        self._start[unknown] = values[unknown] + np.array([0.0, 0.0, turn])
                    elif isinstance(unknown, LandmarkKey) and unknown.map == held.number:
                        self._start[unknown] = np.asarray(se2.compose(moved, values[unknown]))
                self._start[frame] = new
                self._terms.pop((name, "frame"), None)

    def _rebuild(self) -> None:
        """All measurements in a new tree, from the starting values."""
        poses = {**self._poses(), **self._start}
        self._terms.update(self._new)
        terms = {tag: t for tag, t in self._terms.items() if t}
        self._isam, self._indices, self._terms, self._gone = _isam(), {}, {}, []
        used = {unknown for t in terms.values() for m in t for unknown in m.unknowns}
        self._start = {unknown: pose for unknown, pose in poses.items() if unknown in used}
        self._new = terms
        self._update(settle=True)

    # The tree

    def _of(self, tag: Tag) -> tuple[Measurement, ...]:
        return self._new.get(tag, self._terms.get(tag, ()))

    def _put(self, tag: Tag, terms: tuple[Measurement, ...]) -> None:
        """These measurements under a name, instead of those that were there."""
        if self._of(tag) == terms:
            return
        self._gone += self._indices.pop(tag, [])
        self._terms.pop(tag, None)
        self._new[tag] = terms

    def _update(self, *, settle: bool) -> None:
        if not self._new and not self._gone:
            return
        graph, tags = gtsam.NonlinearFactorGraph(), []
        used: set[Hashable] = set()
        for tag, terms in self._new.items():
            for m in terms:
                graph.add(m.factor(self))  # type: ignore[arg-type]
                tags.append(tag)
                used.update(m.unknowns)
        values = gtsam.Values()
        for unknown in used:
            key = self.key(unknown)
            if not self._isam.valueExists(key):
                self._start.setdefault(unknown, self._known.get(unknown, np.zeros(3)))
                x, y, theta = self._start[unknown].tolist()
                values.insert(key, gtsam.Pose2(x, y, theta))
        try:
            result = self._isam.update(graph, values, self._gone)
        except RuntimeError as error:
            self._again(error)
            return
        for tag, index in zip(tags, result.getNewFactorsIndices(), strict=True):
            self._indices.setdefault(tag, []).append(int(index))
        self._terms.update({tag: terms for tag, terms in self._new.items() if terms})
        self._known.update(self._start)
        self._new, self._gone, self._start = {}, [], {}
        if settle:
            for _ in range(SETTLING):
                again = self._isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), [], None, None, None, True)
                if not again.getVariablesRelinearized():
                    break
            self._known = self._poses()
            # a pose asked for by itself costs as much as all of them
            self._frames |= {u.map: pose for u, pose in self._known.items() if isinstance(u, FrameKey)}

    def _again(self, error: RuntimeError) -> None:
        """The tree is of no use after an error: all in a new one; where that fails too, with the next message."""
        poses = {u: p for u, p in self._known.items() if u not in self._start}
        self._start = {**poses, **self._start}
        self._new = {**self._terms, **self._new}
        self._isam, self._indices, self._terms, self._gone = _isam(), {}, {}, []
        if self._failed:
            log.warning("the smoother waits for more measurements: %s", str(error).strip().splitlines()[0])
            return
        self._failed = True
        try:
            self._update(settle=True)
        finally:
            self._failed = False

    # What comes out

    def _segment(self, number: int) -> Segment:
        return next(held.segment for held in self._held.values() if held.number == number)

    def _pose(self, unknown: Hashable) -> Array:
        if unknown in self._start:
            return self._start[unknown]
        pose = self._isam.calculateEstimatePose2(self.key(unknown))
        return np.array([pose.x(), pose.y(), pose.theta()])

    def _turn(self, number: int) -> float:
        return float(self._pose(FrameKey(number))[2])

    def _poses(self) -> dict[Hashable, Array]:
        """All unknowns in the tree."""
        values = self._isam.calculateEstimate()
        unknown = {key: u for u, key in self._keys.items()}
        keys = list(values.keys())
        return dict(zip([unknown[k] for k in keys], gtsam.utilities.extractPose2(values), strict=True)) if keys else {}

    def knows(self, name: str) -> bool:
        """Whether there is anything of this map."""
        return name in self._held

    @property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """Maps that share a frame; alone ones too."""
        return tuple(self._groups)

    def frame(self, name: str) -> Transform:
        """Pose of a map's frame in that of its group, with covariance. KeyError for a map that it doesn't have."""
        number = self._held[name].number
        C = self.joint_covariance(name, ())[0]
        return Transform.from_array(self._pose(FrameKey(number)), C)

    def landmarks(self, name: str) -> dict[str, Array]:
        """Poses (3,) of a map's landmarks in the frame of its group, theta without meaning where there is none."""
        number = self._held[name].number
        return {u.id: pose for u, pose in self._poses().items() if isinstance(u, LandmarkKey) and u.map == number}

    def joint_covariance(self, name: str, ids: Sequence[str]) -> tuple[Array, Array]:
        """Covariance of a map's frame (3, 3), and of frame and these landmarks together (3 + 3k, 3 + 3k), in the
        axes of the group's frame; where that frame is this map's own, its part is zero."""
        number = self._held[name].number
        unknowns = [FrameKey(number), *(LandmarkKey(number, i) for i in ids)]
        keys = self.keys(unknowns)
        marginal = self._isam.jointMarginalCovariance(keys) if len(keys) > 1 else None
        k = 3 * len(keys)
        C = np.zeros((k, k))
        for m, a in enumerate(keys):
            for n, b in enumerate(keys):
                block = self._isam.marginalCovariance(a) if marginal is None else marginal.at(a, b)
                C[3 * m : 3 * m + 3, 3 * n : 3 * n + 3] = block
        thetas = np.array([self._pose(u)[2] for u in unknowns])
        C = joint_to_axes(thetas, C)
        if any(isinstance(m, Gauge) for m in self._of((name, "frame"))):
            C[:3, :] = C[:, :3] = 0.0
        return C[:3, :3], C

    @property
    def size(self) -> int:
        """Number of factors in the tree."""
        return sum(len(indices) for indices in self._indices.values())


def _isam() -> Any:
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(RELINEARISE)
    params.relinearizeSkip = SKIP
    params.findUnusedFactorSlots = True
    return gtsam.ISAM2(params)


def _targets(links: Iterable[Any]) -> frozenset[str]:
    return frozenset(l.connected_to_id for l in links if l.connected_to_id is not None and l.distance is not None)


def _near(a: Array, b: Array) -> bool:
    return bool(np.hypot(*(a[:2] - b[:2])) < 5.0 and abs(se2.wrap(a[2] - b[2])) < 0.5)


def _centre(segment: Segment) -> Array:
    recorded = segment.map()
    return recorded.positions.mean(axis=0) if len(recorded) else np.zeros(2)
