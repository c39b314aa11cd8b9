"""Names for the detections of a whole log that have neither names nor arms, before the mapper reads it.

Particles say which landmark each one is (`particles`). A landmark that they began twice, since the robot's heading was
off when it came back, stands twice close together once the mapper has smoothed all of it: such doubles become one, and
it is smoothed again. The mapper then estimates the map, with its covariance, as if the names had been given.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import msgspec
import numpy as np

from ..logs import Detection, Event, Log
from .mapper import Mapper
from .particles import ParticleConfig, associate, is_nameless

#: Rounds of joining doubles and smoothing anew, at most.
_ROUNDS = 8
#: Two that were seen at one moment in a larger share of the rarer one's sightings are two.
_AT_ONCE = 0.05


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
    >>> named = name_detections(Log(LogHeader("D7"), events), ParticleConfig(particles=20, runs=2))
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
    return NamedLog(_without_doubles(Log(log.header, out), set(names.values()), config.near), tuple(numbers))


def _free_name(type_: str, taken: set[str | None]) -> str:
    k = 1
    while f"{type_}.{k}" in taken:
        k += 1
    taken.add(f"{type_}.{k}")
    return f"{type_}.{k}"


def _without_doubles(log: Log, ours: Collection[str], near: float) -> Log:
    """The log with one name for landmarks of one type, among ``ours``, that the map has nearer than ``near`` [m]."""
    for _ in range(_ROUNDS):
        name_from_double = _doubles(log, ours, near)
        if not name_from_double:
            break
        events = [
            msgspec.structs.replace(event, id=name_from_double.get(event.id, event.id))
            if isinstance(event, Detection) and event.id is not None
            else event
            for event in log.events
        ]
        log = Log(log.header, events)
    return log


def _doubles(log: Log, ours: Collection[str], near: float) -> Mapping[str, str]:
    """Of each landmark that is another one the name of that; the nearest pairs first, each landmark once."""
    mapper = Mapper(log.header)
    for event in log.events:
        mapper.update(event)
    known = [landmark for landmark in mapper.map().landmarks if landmark.id in ours]
    if len(known) < 2:
        return {}
    seen, together = _sightings(log, ours)
    at = np.array([(landmark.x, landmark.y) for landmark in known])
    apart = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    rows, columns = np.nonzero(np.triu(apart < near, k=1))
    found: dict[str, str] = {}
    taken: set[str] = set()
    for k in np.argsort(apart[rows, columns], kind="stable").tolist():
        one, other = known[int(rows[k])], known[int(columns[k])]
        pair = (min(one.id, other.id), max(one.id, other.id))
        if one.type != other.type or taken & set(pair):
            continue
        if together[pair] <= _AT_ONCE * min(seen[one.id], seen[other.id]):
            found[pair[1]] = pair[0]
            taken |= set(pair)
    return found


def _sightings(log: Log, ours: Collection[str]) -> tuple[Counter[str], Counter[tuple[str, str]]]:
    """How often each landmark was seen, and each two at one moment (by name, the first in alphabetical order first)."""
    at: dict[float, set[str]] = {}
    seen: Counter[str] = Counter()
    for event in log.events:
        if isinstance(event, Detection) and event.id is not None and event.id in ours:
            at.setdefault(event.t, set()).add(event.id)
            seen[event.id] += 1
    return seen, Counter((a, b) for names in at.values() for a in names for b in names if a < b)
