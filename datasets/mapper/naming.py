"""Names for the detections of a whole log that have neither names nor arms, before the mapper reads it.

Particles say which landmark each one is (`particles`). A landmark that they began twice, since the robot's heading was
off when it came back, stands twice close together once the mapper has smoothed all of it: such doubles become one, and
it is smoothed again. One that was hardly ever seen where others were goes. The mapper then estimates the map, with its
covariance, as if the names had been given.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import msgspec
import numpy as np

from ..logs import Detection, Event, Log
from .finish import Finished, finish
from .mapper import Mapper
from .particle_filter import ParticleConfig
from .particles import associate, in_plain_sight, is_nameless

#: Rounds of joining doubles and smoothing anew, at most.
_ROUNDS = 8
#: Two that were seen at one moment in a larger share of the rarer one's sightings are two.
_AT_ONCE = 0.05
#: A landmark that was seen in a smaller share of the moments when it stood in plain sight isn't there, where there are
#: enough of those.
_SHARE, _ENOUGH = 0.2, 4


@dataclass(frozen=True, eq=False, slots=True)
class NamedLog:
    """A log whose detections have names, and ``numbers``: of each of its detections the number in the log before."""

    log: Log
    numbers: tuple[int, ...]


def name_detections(log: Log, config: ParticleConfig | None = None, *, seed: int = 0) -> NamedLog:
    """Name the detections that have neither a name nor arms; such as fit no landmark, or weren't looked at, go.

    Detections with names or arms, and all other events, stay as they are. The same log and seed give the same names.

    >>> from mapfuse.datasets.logs import LogHeader, Odometry
    >>> moves = [Odometry(0.1 * k, 0.1 * k, 0.0, 0.0) for k in range(20)]
    >>> looks = [Detection(0.1 * k, "tree", 4 - 0.1 * k, 0.0) for k in range(20)]
    >>> events = sorted([*moves, *looks], key=lambda event: event.t)
    >>> named = name_detections(Log(LogHeader("D7"), events), ParticleConfig(particles=20, filters=2))
    >>> {event.id for event in named.log.events if isinstance(event, Detection)}
    {'tree.1'}
    """
    config = config or ParticleConfig()
    events = list(log.events)
    found = associate(events, log.header.sensors, config, seed)
    counts = Counter(found.landmark_from_number.values())
    out: list[Event] = []
    numbers: list[int] = []
    names: dict[int, str] = {}
    taken = {event.id for event in events if isinstance(event, Detection)}
    number = -1
    for event in events:
        if isinstance(event, Detection):
            number += 1
            if is_nameless(event):
                landmark = found.landmark_from_number.get(number, -1)
                if landmark < 0 or counts[landmark] < config.least:
                    continue
                if landmark not in names:
                    names[landmark] = _free_name(found.type_from_landmark[landmark], taken)
                out.append(msgspec.structs.replace(event, id=names[landmark]))
            else:
                out.append(event)
            numbers.append(number)
        else:
            out.append(event)
    return _settled(NamedLog(Log(log.header, out), tuple(numbers)), set(names.values()), config.near)


def _free_name(type_: str, taken: set[str | None]) -> str:
    k = 1
    while f"{type_}.{k}" in taken:
        k += 1
    taken.add(f"{type_}.{k}")
    return f"{type_}.{k}"


def _settled(named: NamedLog, ours: Collection[str], near: float) -> NamedLog:
    """With one name for landmarks, among ``ours``, that are one, and without those that aren't there."""
    for _ in range(_ROUNDS if ours else 0):
        mapper = Mapper(named.log.header)
        for event in named.log.events:
            mapper.update(event)
        found = finish(mapper)
        refuted, renamed = _refuted(found, ours), _doubles(found, named.log, ours, near)
        if not refuted and not renamed:
            break
        named = _changed(named, refuted, renamed)
    return named


def _changed(named: NamedLog, refuted: Collection[str], name_from_double: Mapping[str, str]) -> NamedLog:
    events: list[Event] = []
    numbers: list[int] = []
    coming = iter(named.numbers)
    for event in named.log.events:
        if not isinstance(event, Detection):
            events.append(event)
            continue
        number = next(coming)
        if event.id in refuted:
            continue
        name = name_from_double.get(event.id or "")
        events.append(event if name is None else msgspec.structs.replace(event, id=name))
        numbers.append(number)
    return NamedLog(Log(named.log.header, events), tuple(numbers))


def _refuted(found: Finished, ours: Collection[str]) -> set[str]:
    """Landmarks that the robot hardly ever saw where it saw others and had them in plain sight."""
    sightings = found.memory.sightings
    seen = {(sighting.keyframe, sighting.landmark) for sighting in sightings}
    frames = np.unique([sighting.keyframe for sighting in sightings]).astype(np.intp)
    plain = in_plain_sight(found.smoothed.estimate.poses[frames], found.smoothed.estimate.landmarks)
    gone: set[str] = set()
    for k, (key, landmark) in enumerate(found.landmarks.items()):
        chances = frames[plain[:, k]].tolist()
        hits = sum((frame, key) in seen for frame in chances)
        name = landmark.name
        if name is not None and name in ours and len(chances) >= _ENOUGH and hits < _SHARE * len(chances):
            gone.add(name)
    return gone


def _doubles(found: Finished, log: Log, ours: Collection[str], near: float) -> Mapping[str, str]:
    """Of each landmark that is another one, nearer than ``near`` [m], the name of that; the nearest pairs first."""
    known = [(place, landmark) for place, landmark in enumerate(found.landmarks.values()) if landmark.name in ours]
    if len(known) < 2:
        return {}
    seen, together = _sightings(log, ours)
    at = found.smoothed.estimate.landmarks[[place for place, _ in known]]
    apart = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    rows, columns = np.nonzero(np.triu(apart < near, k=1))
    renamed: dict[str, str] = {}
    taken: set[str] = set()
    for k in np.argsort(apart[rows, columns], kind="stable").tolist():
        one, other = known[int(rows[k])][1], known[int(columns[k])][1]
        first, second = sorted((str(one.name), str(other.name)))
        if one.type != other.type or taken & {first, second}:
            continue
        if together[first, second] <= _AT_ONCE * min(seen[first], seen[second]):
            renamed[second] = first
            taken |= {first, second}
    return renamed


def _sightings(log: Log, ours: Collection[str]) -> tuple[Counter[str], Counter[tuple[str, str]]]:
    """How often each landmark was seen, and each two at one moment (by name, the first in alphabetical order first)."""
    at: dict[float, set[str]] = {}
    seen: Counter[str] = Counter()
    for event in log.events:
        if isinstance(event, Detection) and event.id is not None and event.id in ours:
            at.setdefault(event.t, set()).add(event.id)
            seen[event.id] += 1
    return seen, Counter((a, b) for names in at.values() for a in names for b in names if a < b)
