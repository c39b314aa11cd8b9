"""`Segment`: what is known of one robot's map in one of its frames, from messages in any order."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.arms import wrap
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Link, Noise
from mapfuse.datasets.values import frozen_array

from ..far import FAR_M, shifted
from .messages import Correction, LandmarkLink, LandmarkSeen, Message, Placed, Removed

Array = NDArray[np.float64]

#: Arms of a landmark nearer to each other than this [rad] are one.
ONE_ARM = 0.35
MOST_LINKS = 4
#: Links without a landmark at the other end are told apart by their direction, in this many bins of a whole turn, each
#: narrower than `ONE_ARM`: of one bin the newest holds. By nearness to another the last of them would hang on the order
#: in which they come.
BINS = math.ceil(2 * math.pi / ONE_ARM)


class Record(NamedTuple):
    """A landmark as the message ``sequence`` has it; None: it was removed."""

    sequence: int
    landmark: Landmark | None


@dataclass
class Counters:
    """Messages that came: all, those that were known already, and those that a later one had overtaken."""

    messages: int = 0
    doubled: int = 0
    overtaken: int = 0


@dataclass
class Segment:
    """One robot's map in one frame.

    ``corrected``: the message that `base` is of (-1: none). ``records``, ``ways``: landmarks and links that were sent
    since, by id, the links then by `way_of`. ``changed``: ids of landmarks that are new, gone or otherwise there since
    `settle` was called last.
    """

    robot: str
    frame: int
    noise: Noise = field(default_factory=Noise)
    base: LandmarkMap | None = None
    corrected: int = -1
    records: dict[str, Record] = field(default_factory=dict)
    ways: dict[str, dict[str | int | None, tuple[int, Link]]] = field(default_factory=dict)
    placed: Placed | None = None
    counters: Counters = field(default_factory=Counters)
    changed: set[str] = field(default_factory=set)
    heard: float = -np.inf
    _map: LandmarkMap | None = None
    _origin: Array | None = None

    @property
    def name(self) -> str:
        """The robot's name, and from its second frame on which one it is."""
        return self.robot if self.frame == 0 else f"{self.robot}~{self.frame + 1}"

    @property
    def anywhere(self) -> tuple[float, float] | None:
        """Where one of its landmarks is [m]; None without any."""
        landmarks = self.base.landmarks if self.base is not None else ()
        sent = (r.landmark for r in self.records.values() if r.landmark is not None)
        some = next(iter(landmarks), None) or next(sent, None)
        return None if some is None else (some.x, some.y)

    def known_as(self, noise: Noise) -> None:
        """What the robot is known to be; a correction says so itself."""
        if self.base is None:
            self.noise, self._map = noise, None

    def take(self, message: Message) -> tuple[str, ...]:
        """Take a message in; ids of the landmarks that it changes."""
        self.counters.messages += 1
        self.heard = max(self.heard, message.t)
        if isinstance(message, Placed):
            if self.placed is None or message.sequence > self.placed.sequence:
                self.placed = message
            else:
                self._old(message.sequence, self.placed.sequence)
            return ()
        if isinstance(message, Correction):
            return self._correct(message)
        if message.sequence <= self.corrected:
            self._old(message.sequence, self.corrected)
            return ()
        if isinstance(message, LandmarkLink):
            return self._link(message)
        return self._record(message)

    def _old(self, sequence: int, newest: int) -> None:
        if sequence == newest:
            self.counters.doubled += 1
        else:
            self.counters.overtaken += 1

    def _record(self, message: LandmarkSeen | Removed) -> tuple[str, ...]:
        name = message.id if isinstance(message, Removed) else message.landmark.id
        known = self.records.get(name)
        if known is not None and message.sequence <= known.sequence:
            self._old(message.sequence, known.sequence)
            return ()
        landmark = None if isinstance(message, Removed) else message.landmark
        before = self.landmark(name)
        self.records[name] = Record(message.sequence, landmark)
        return self._touched(name, before)

    def _link(self, message: LandmarkLink) -> tuple[str, ...]:
        ways, to = self.ways.get(message.id, {}), way_of(message.link)
        known = ways.get(to)
        if known is not None and message.sequence <= known[0]:
            self._old(message.sequence, known[0])
            return ()
        before = self.landmark(message.id)
        ways[to] = (message.sequence, message.link)
        self.ways[message.id] = ways
        return self._touched(message.id, before)

    def _touched(self, name: str, before: Landmark | None) -> tuple[str, ...]:
        self._map = None
        if self.landmark(name) == before:
            return ()
        self.changed.add(name)
        return (name,)

    def _correct(self, message: Correction) -> tuple[str, ...]:
        if message.sequence <= self.corrected:
            self._old(message.sequence, self.corrected)
            return ()
        before = {l.id: l for l in self.landmarks()}
        self.base, self.corrected, self.noise = message.map, message.sequence, message.map.noise
        self.records = {name: r for name, r in self.records.items() if r.sequence > message.sequence}
        left = {
            at: {to: way for to, way in ways.items() if way[0] > message.sequence} for at, ways in self.ways.items()
        }
        self.ways = {at: ways for at, ways in left.items() if ways}
        self._map = None
        after = {l.id: l for l in self.landmarks()}
        touched = tuple(name for name in {**before, **after} if before.get(name) != after.get(name))
        self.changed |= {name for name in touched if not _alike(before.get(name), after.get(name))}
        return touched

    # What is known

    def landmark(self, name: str) -> Landmark | None:
        """A landmark as it is known by now; None where there is none."""
        record = self.records.get(name)
        sequence = self.corrected
        if record is not None:
            found, sequence = record.landmark, record.sequence
        else:
            place = None if self.base is None else self.base.index_from_id.get(name)
            found = None if place is None or self.base is None else self.base.landmarks[place]
        if found is None or name not in self.ways:
            return found
        own = sorted((way for way in self.ways[name].values() if way[0] > sequence), key=lambda w: w[0])
        return with_links(found, [link for _, link in own]) if own else found

    def landmarks(self) -> list[Landmark]:
        """All landmarks, those of the last correction in its order, then the others by id."""
        first = () if self.base is None else self.base.ids
        later = sorted(set(self.records) - set(first))
        return [l for name in (*first, *later) if (l := self.landmark(name)) is not None]

    @property
    def size(self) -> int:
        """About how many landmarks there are: what was removed since the last correction counts, too."""
        first = 0 if self.base is None else len(self.base)
        if self.base is None:
            return len(self.records)
        return first + sum(name not in self.base.index_from_id for name in self.records)

    def map(self) -> LandmarkMap:
        """The map as it is known by now; links to landmarks that it doesn't have are arms only."""
        if self._map is None:
            landmarks = self.landmarks()
            known = {l.id for l in landmarks}
            kept = tuple(without_strangers(l, known) for l in landmarks)
            if self.base is None:
                self._map = LandmarkMap(self.name, kept, self.robot, noise=self.noise)
            else:
                joint = self._joint({l.id: l for l in kept})
                self._map = self.base.replace(name=self.name, landmarks=kept, joint_covariance=joint)
        return self._map

    # In coordinates that can be computed with

    @property
    def origin(self) -> Array:
        """Origin (2,) of its local coordinates [m, whole metres]: where it was first heard to be, if far out.

        What links, headings and joint covariances say doesn't hang on where the origin is, but over a lever of 10 km
        and more a rotation's last digits count (`mapfuse.fusion.far`). It stays where it is for good.
        """
        if self._origin is not None:
            return self._origin
        somewhere = self.anywhere
        at = np.array(somewhere or (0.0, 0.0))
        origin = frozen_array(np.round(at) if np.hypot(*at) > FAR_M else np.zeros(2))
        self._origin = None if somewhere is None else origin
        return origin

    def local(self, name: str) -> Landmark | None:
        """A landmark as `landmark` has it, in local coordinates."""
        landmark, (x, y) = self.landmark(name), self.origin.tolist()
        return landmark if landmark is None or not (x or y) else replace(landmark, x=landmark.x - x, y=landmark.y - y)

    def local_map(self) -> LandmarkMap:
        """The map as `map` has it, in local coordinates."""
        return shifted(self.map(), self.origin)

    @property
    def local_path(self) -> Array | None:
        """Where its robot began (1, 4) [s, m, m, rad], in local coordinates; None where no correction said so."""
        if self.base is None or self.base.path is None:
            return None
        return np.asarray(self.base.path[:1] - np.array([0.0, *self.origin, 0.0]))

    def _joint(self, known: dict[str, Landmark]) -> JointCovariance | None:
        """The correction's joint covariance of those landmarks that still stand where it has them."""
        assert self.base is not None
        joint = self.base.joint_covariance
        if joint is None:
            return None
        kept = [k for k, name in enumerate(joint.order) if name in known and _same_place(known[name], self.base[name])]
        if len(kept) == len(joint.order):
            return joint
        rows = np.array([joint.rows * k + row for k in kept for row in range(joint.rows)], dtype=np.intp)
        order = tuple(joint.order[k] for k in kept)
        return JointCovariance(order, joint.rows, frozen_array(joint.matrix[np.ix_(rows, rows)])) if kept else None


def _same_place(a: Landmark, b: Landmark) -> bool:
    return (a.x, a.y, a.heading) == (b.x, b.y, b.heading) and [l.heading for l in a.links] == [
        l.heading for l in b.links
    ]


def _alike(a: Landmark | None, b: Landmark | None) -> bool:
    """Whether only numbers differ: not what it is, nor where its arms lead."""
    if a is None or b is None or a.type != b.type:
        return False
    return [(l.type, l.connected_to_id) for l in a.links] == [(l.type, l.connected_to_id) for l in b.links]


def way_of(link: Link) -> str | int | None:
    """What tells the links of a landmark apart: where they lead, or else the bin of their direction, if they have one.

    >>> way_of(Link("open", 0.0, None, "b")), way_of(Link("open", 0.01)) == way_of(Link("open", 0.03))
    ('b', True)
    """
    if link.connected_to_id is not None or link.heading is None:
        return link.connected_to_id
    return math.floor(link.heading / (2 * math.pi) * BINS) % BINS


def with_links(landmark: Landmark, links: list[Link]) -> Landmark:
    """The landmark with links that were sent by themselves, each in the place of the arm that it is, at most four."""
    arms = list(landmark.links)
    for link in links:
        same = next((k for k, arm in enumerate(arms) if _one_arm(arm, link)), None)
        if same is not None:
            arms[same] = link
        elif len(arms) < MOST_LINKS:
            arms.append(link)
    return replace(landmark, links=tuple(arms))


def _one_arm(arm: Link, link: Link) -> bool:
    if arm.connected_to_id is not None and link.connected_to_id is not None:
        return arm.connected_to_id == link.connected_to_id
    if arm.heading is None or link.heading is None:
        return False
    return abs(wrap(arm.heading - link.heading)) < ONE_ARM


def without_strangers(landmark: Landmark, known: set[str]) -> Landmark:
    """The landmark with links to others than the ``known`` ones as arms only."""
    if all(link.connected_to_id is None or link.connected_to_id in known for link in landmark.links):
        return landmark
    links = tuple(
        link
        if link.connected_to_id is None or link.connected_to_id in known
        else replace(link, connected_to_id=None, distance=None, travel_counter=0)
        for link in landmark.links
    )
    return replace(landmark, links=links)
