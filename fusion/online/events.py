"""What happens while maps grow: proposed, merged, revised, un-merged, refuted; and these as JSON lines."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

import numpy as np

from mapfuse.datasets import se2
from mapfuse.datasets.files import write_stream
from mapfuse.datasets.transform import Transform

from ..result import FusedMap, PairResult, RankedHypothesis

FORMAT = "mapfuse.events/1"
#: A placement is told once it is at least this probable.
WORTH_TELLING = 0.05
#: Two placements nearer to each other than this [m, rad] are one.
SAME_M, SAME_RAD = 2.0, 0.35
#: A landmark less likely to be there than this is refuted.
DOUBTFUL = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class _Event:
    """``t`` [s]: the time of the newest message that it rests on. ``reason``: a sentence that says why."""

    kind: ClassVar[str]
    t: float
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposed(_Event):
    """A placement of map 2 on map 1 that wasn't among the likely ones: ``T12``, its probability, how many match."""

    kind: ClassVar[str] = "proposed"
    maps: tuple[str, str]
    T12: Transform
    probability: float
    count: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Merged(_Event):
    """``maps`` came into one frame, and with them all of ``group``; ``T12``: map 2's frame in map 1's."""

    kind: ClassVar[str] = "merged"
    maps: tuple[str, str]
    T12: Transform
    probability: float
    count: int
    group: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Revised(_Event):
    """``maps`` stay in one frame, but elsewhere: ``T12`` instead of ``before``."""

    kind: ClassVar[str] = "revised"
    maps: tuple[str, str]
    T12: Transform
    before: Transform
    probability: float
    count: int
    group: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Unmerged(_Event):
    """``maps`` share a frame no more; ``probability`` is what is left of their first hypothesis."""

    kind: ClassVar[str] = "un-merged"
    maps: tuple[str, str]
    probability: float
    group: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Refuted(_Event):
    """Landmarks of ``map`` that are more likely false than not, since others passed them unseen."""

    kind: ClassVar[str] = "refuted"
    map: str
    landmark: str
    existence: float


Event: TypeAlias = Proposed | Merged | Revised | Unmerged | Refuted


def event_to_dict(event: Event) -> dict[str, Any]:
    """An event as plain Python values, ``event`` and ``t`` first.

    >>> event = Refuted(t=12.5, reason="D9 passed it", map="D7", landmark="c3", existence=0.2)
    >>> event_to_dict(event)
    {'event': 'refuted', 't': 12.5, 'reason': 'D9 passed it', 'map': 'D7', 'landmark': 'c3', 'existence': 0.2}
    """
    out: dict[str, Any] = {"event": event.kind, "t": event.t}
    for base in type(event).__mro__[::-1]:
        for name in base.__dict__.get("__slots__", ()):
            if name in out or name == "kind":
                continue
            value = getattr(event, name)
            out[name] = _plain(value)
    return out


def _plain(value: Any) -> Any:
    if isinstance(value, Transform):
        pose = {"x": value.x, "y": value.y, "theta": value.theta}
        return pose if value.covariance is None else {**pose, "covariance": value.covariance.tolist()}
    return list(value) if isinstance(value, tuple) else value


def header(maps: Iterable[str]) -> dict[str, Any]:
    """The first line of a file of events."""
    return {"format": FORMAT, "maps": list(maps)}


def json_line(value: Mapping[str, Any]) -> str:
    """One line of JSON; the same value gives the same bytes."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False) + "\n"


def write_events(events: Iterable[Event], maps: Iterable[str], path: str | Path) -> None:
    """Events as JSON lines, a header line first; whole or not at all.

    Raises `OutputError` where the file can't be written.
    """

    def lines() -> Iterator[bytes]:
        yield json_line(header(maps)).encode()
        for event in events:
            yield json_line(event_to_dict(event)).encode()

    write_stream(path, lines())


# From one answer to the next


def happened(before: FusedMap | None, after: FusedMap, t: float) -> list[Event]:
    """What is different in ``after``: placements first, then what was parted, joined, moved, and refuted."""
    pairs_before = {} if before is None else {pair.maps: pair for pair in before.pairs}
    events: list[Event] = []
    for pair in after.pairs:
        events += _proposed(pairs_before.get(pair.maps), pair, t)
    parted = _parted(before, after, t)
    return [*events, *parted, *_joined(before, after, t), *_moved(before, after, t), *_refuted(before, after, t)]


def same_placement(a: Transform, b: Transform, at: tuple[float, float] = (0.0, 0.0)) -> bool:
    """Whether two placements are one answer, where the point ``at`` [m] of map 2 is looked at."""
    apart = np.hypot(*(se2.transform(a.array, np.array(at)) - se2.transform(b.array, np.array(at))))
    return bool(apart < SAME_M and abs(se2.wrap(a.theta - b.theta)) < SAME_RAD)


def _likely(pair: PairResult | None) -> list[RankedHypothesis]:
    return [] if pair is None else [h for h in pair.hypotheses if h.probability >= WORTH_TELLING]


def _proposed(before: PairResult | None, pair: PairResult, t: float) -> list[Event]:
    known = _likely(before)
    return [
        Proposed(
            t=t,
            reason=f"{h.count} common landmarks, {h.log_evidence:+.1f} nats against no overlap",
            maps=pair.maps,
            T12=h.T12,
            probability=h.probability,
            count=h.count,
        )
        for h in _likely(pair)
        if not any(same_placement(h.T12, old.T12) for old in known)
    ]


def _group_of(fused: FusedMap | None) -> dict[str, tuple[str, ...]]:
    return {} if fused is None else {name: group for group in fused.groups for name in group}


def _ties(fused: FusedMap, names: set[frozenset[str]]) -> list[PairResult]:
    """Of the pairs of these groups, joined or parted, the one that is most telling for each two groups."""
    found = [pair for pair in fused.pairs if frozenset(pair.maps) in names]
    return sorted(found, key=lambda pair: (-pair.probability, pair.maps))


def _between(one: FusedMap | None, other: FusedMap) -> set[frozenset[str]]:
    """Pairs of maps that share a frame in ``other`` and don't in ``one``."""
    group1, group2 = _group_of(one), _group_of(other)
    return {
        frozenset((a, b))
        for group in other.groups
        for a in group
        for b in group
        if a != b and group1.get(a, (a,)) != group1.get(b, (b,)) and group2[a] == group2[b]
    }


def _relative(fused: FusedMap, a: str, b: str) -> Transform:
    """Map b's frame in map a's: of two maps that were compared and are right with its covariance."""
    for pair in fused.pairs:
        if pair.maps == (a, b) and pair.T12 is not None and pair.decision == "merged" and len(fused.maps) == 2:
            return pair.T12
    Ta, Tb = fused.frames[a].T, fused.frames[b].T
    pose = np.asarray(se2.between(Ta.array, Tb.array))
    if fused.groups[fused.frames[a].group][0] == a:
        return Transform.from_array(pose, Tb.covariance)
    return Transform.from_array(pose)


def _joined(before: FusedMap | None, after: FusedMap, t: float) -> list[Event]:
    events: list[Event] = []
    met: list[set[str]] = [set(group) for group in (() if before is None else before.groups)]
    for pair in _ties(after, _between(before, after)):
        a, b = pair.maps
        of_a = next((m for m in met if a in m), {a})
        of_b = next((m for m in met if b in m), {b})
        if of_a is of_b or b in of_a:
            continue  # another pair has told of it
        met = [m for m in met if m is not of_a and m is not of_b] + [of_a | of_b]
        group = _group_of(after)[a]
        T12 = _relative(after, a, b)
        events.append(
            Merged(
                t=t,
                reason=pair.reason,
                maps=pair.maps,
                T12=T12,
                probability=pair.probability,
                count=len(pair.correspondences),
                group=group,
            )
        )
    return events


def _parted(before: FusedMap | None, after: FusedMap, t: float) -> list[Event]:
    if before is None:
        return []
    events: list[Event] = []
    told: set[frozenset[tuple[str, ...]]] = set()
    of = _group_of(after)
    for pair in _ties(after, _between(after, before)):
        parts = frozenset((of[pair.maps[0]], of[pair.maps[1]]))
        if parts in told:
            continue
        told.add(parts)
        group = _group_of(before)[pair.maps[0]]
        events.append(Unmerged(t=t, reason=pair.reason, maps=pair.maps, probability=pair.probability, group=group))
    return events


def _moved(before: FusedMap | None, after: FusedMap, t: float) -> list[Event]:
    """Maps that stay together and lie elsewhere on each other than the covariances allow for."""
    if before is None:
        return []
    events: list[Event] = []
    old, new = _group_of(before), _group_of(after)
    pairs = {pair.maps: pair for pair in after.pairs}
    for group in after.groups:
        first = group[0]
        for name in group[1:]:
            if old.get(first) is None or old.get(name) is None or old[first] != old[name] or new[first] != new[name]:
                continue
            was, now = _relative(before, first, name), _relative(after, first, name)
            if same_placement(was, now, _middle(after, first, name)):
                continue
            pair = pairs.get((first, name)) or pairs[name, first]
            events.append(
                Revised(
                    t=t,
                    reason=pair.reason,
                    maps=(first, name),
                    T12=now,
                    before=was,
                    probability=pair.probability,
                    count=len(pair.correspondences),
                    group=group,
                )
            )
    return events


def _middle(fused: FusedMap, first: str, name: str) -> tuple[float, float]:
    """The middle [m] of a map's landmarks that ``first`` has too, or of all, in its own frame: where a placement is
    looked at."""
    source = fused.sources.get(name)
    if source is None or not len(source):
        return 0.0, 0.0
    common = [i for l in fused.landmarks if l.sources.get(first) for i in l.sources.get(name, ())]
    places = [source.index_from_id[i] for i in common] or list(range(len(source)))
    x, y = source.positions[places].mean(axis=0).tolist()
    return x, y


def _false(fused: FusedMap | None) -> dict[tuple[str, str], float]:
    if fused is None:
        return {}
    return {
        (name, identifier): landmark.existence
        for landmark in fused.landmarks
        if landmark.existence < DOUBTFUL
        for name, ids in landmark.sources.items()
        for identifier in ids
    }


def _refuted(before: FusedMap | None, after: FusedMap, t: float) -> list[Event]:
    known = _false(before)
    group = _group_of(after)
    events: list[Event] = []
    for (name, identifier), existence in sorted(_false(after).items()):
        others = [other for other in group[name] if other != name]
        if (name, identifier) in known or not others:
            continue
        reason = f"recorded by {name} alone, and not where {', '.join(others)} passed"
        events.append(Refuted(t=t, reason=reason, map=name, landmark=identifier, existence=existence))
    return events
