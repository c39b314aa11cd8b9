"""Logs replayed together on their own clocks: events of all robots in one row, the fuser after each."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import chain
from math import isfinite
from pathlib import Path
from typing import TypeVar

import msgspec

from mapfuse.datasets.errors import InputError, MapfuseError
from mapfuse.datasets.logs import Event as LogEvent
from mapfuse.datasets.logs import Log, LogHeader

from .feed import Feed
from .fuser import OnlineFuser
from .savedfeeds import Earlier, load_replay, save_replay

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Moment:
    """The replay at time ``t`` [s]; ``weighed``: whether the fuser has answered anew just now."""

    t: float
    weighed: bool


class Replay:
    """Robots' logs, each through its mapper, into one fuser.

    Clocks: where all logs say when they were recorded, the earliest one's is the common clock; else they begin
    together. A replay can be `save`d at its end and `resume`d with what the robots recorded later: on the clock of
    the earlier log, or on one of its own where both say when they were recorded.
    """

    def __init__(
        self,
        logs: Sequence[Log],
        fuser: OnlineFuser | None = None,
        earlier: Mapping[str, Earlier] | None = None,
    ) -> None:
        """``earlier``: robots of an earlier part; a log of the same name goes on from there."""
        earlier = earlier or {}
        names = [log.header.name for log in logs]
        if (twice := next((name for name in names if names.count(name) > 1), None)) is not None:
            files = [str(log.path) for log in logs if log.header.name == twice and log.path is not None]
            where = f" ({', '.join(files)})" if files else ""
            raise MapfuseError(
                f"two logs have one name, {twice!r}{where}; names must differ, since results refer to them"
            )
        self.logs = tuple(logs)
        self.fuser = fuser or OnlineFuser()
        # an event's time on the clock by which its mapper began: what to add, and up to when that one knows already
        self.shifts = [
            _shift(earlier[n].feed.mapper.header, log.header) if n in earlier else 0.0
            for n, log in zip(names, logs, strict=True)
        ]
        self._until = {name: robot.feed.t for name, robot in earlier.items()}
        self.feeds = {name: robot.feed for name, robot in earlier.items()}
        for log in logs:
            if log.header.name not in self.feeds:
                feed = self.feeds[log.header.name] = Feed(log.header)
                self.fuser.add_robot(log.header.name, feed.noise())
        headers = [self.feeds[name].mapper.header for name in (*earlier, *names)]
        common = offsets(headers, [robot.offset for robot in earlier.values()])
        self._offsets = dict(zip((*earlier, *names), common, strict=True)) | {n: e.offset for n, e in earlier.items()}
        self.offsets = [self._offsets[name] for name in names]
        known = [t for robot in earlier.values() if isfinite(t := robot.feed.t + robot.offset)]
        self.t = max(known, default=0.0)

    def save(self, path: str | Path) -> None:
        """Fuser and mappers as one file, for `resume`; `OnlineFuser.load` reads it, too. Raises `OutputError`."""
        save_replay(path, self.fuser, {name: Earlier(feed, self._offsets[name]) for name, feed in self.feeds.items()})

    @classmethod
    def resume(cls, path: str | Path, logs: Sequence[Log]) -> Replay:
        """A replay that goes on from where `save` left it; ``logs`` are what came after, of robots that were there or
        of others.

        Raises `FileFormatError` for a file that holds none, or one of another minor version, which it names;
        `InputError` where it can't be read.
        """
        fuser, earlier = load_replay(path)
        return cls(logs, fuser, earlier)

    def run(self, *, every: float | None = None) -> Iterator[Moment]:
        """All events in the order of their times; a moment each time when the fuser has answered, and ``every`` so
        many seconds of the log; at the end one more, when everything is weighed. At each the fuser knows where the
        robots are by then (`OnlineFuser.places`)."""
        due = every
        for t, name, event in self.events():
            if due is not None and every is not None and t >= due:
                self.place()
                yield Moment(self.t, False)
                due = _after(t, every)
            self.t = t
            if self.step(name, event, t):
                self.place()
                yield Moment(t, True)
        self.finish()
        yield Moment(self.t, True)

    def events(self) -> Iterator[tuple[float, str, LogEvent]]:
        """Events of all logs with their times on the common clock; their own are on the clock of their robot's mapper.

        Raises `MapfuseError`, before the first of them, where a log begins earlier than what its robot's mapper knows
        already: such events would be left out or count twice.
        """

        def of(log: Log, shift: float, offset: float) -> Iterator[tuple[float, str, LogEvent]]:
            name = log.header.name
            events = (_moved(event, shift) for event in log.events) if shift else iter(log.events)
            first = next(events, None)
            if first is None:
                return
            if first.t < self._until.get(name, first.t):
                last = max((event.t for event in events), default=first.t)
                raise _overlap(log, first.t - shift, last - shift, self._until[name] - shift)
            for event in chain((first,), events):
                yield event.t + offset, name, event

        streams = [of(*each) for each in zip(self.logs, self.shifts, self.offsets, strict=True)]
        return merged_by_time(streams)

    def step(self, name: str, event: LogEvent, t: float) -> bool:
        """One event; whether the fuser has answered anew."""
        feed = self.feeds[name]
        said = False
        for message in feed.update(event):
            self.fuser.take(_at(message, t))
            said = True
        if not said and not self.fuser.waiting:
            return False
        if self.fuser.due:
            self.correct()
        return self.fuser.advance()

    def correct(self) -> None:
        """Every robot whose map has changed sends the whole of it, and where it is."""
        for feed in self.feeds.values():
            if feed.stale:
                self.fuser.take(_at(feed.correction(), self.t))
            if feed.mapper.landmarks:
                self.fuser.take(_at(feed.placed(), self.t))

    def place(self) -> None:
        """Every robot says where it is by now."""
        for feed in self.feeds.values():
            if feed.mapper.landmarks:
                # past the fuser, whose clock has its worker's answers taken up: looking must change nothing
                self.fuser.segments[feed.name].take(_at(feed.placed(), self.t))

    def finish(self) -> None:
        """Everything said and weighed."""
        self.correct()
        self.fuser.advance(force=True)


def _after(t: float, every: float) -> float:
    """The first multiple of ``every`` that is later than ``t``, though t may be one but for rounding."""
    due = (t // every + 1) * every
    return due if due > t else due + every


def _at(message: Item, t: float) -> Item:
    """The message with its time on the common clock."""
    return replace(message, t=t)  # type: ignore[type-var]


def merged_by_time(streams: Iterable[Iterator[tuple[float, str, LogEvent]]]) -> Iterator[tuple[float, str, LogEvent]]:
    """Streams in one, by time; at equal times the first stream's first."""
    return heapq.merge(*streams, key=lambda item: item[0])


def offsets(headers: Sequence[LogHeader], earlier: Sequence[float] = ()) -> list[float]:
    """What to add to each log's times [s]: by ``recorded_at`` where all have it, else nothing.

    ``earlier``: what the first ones have, by which the common clock is already set.
    """
    times = [_recorded(header.recorded_at) for header in headers]
    known = [t for t in times if t is not None]
    if len(known) < len(times) or not known:
        return [0.0] * len(headers)
    zero, at_zero = (known[0], earlier[0]) if earlier else (min(known), 0.0)
    return [(t - zero).total_seconds() + at_zero for t in known]


def _shift(before: LogHeader, after: LogHeader) -> float:
    """What to add to the times of a later log [s], so that they are on an earlier one's clock: by ``recorded_at``
    where both have it, else nothing, as for a clock that went on."""
    begun, again = _recorded(before.recorded_at), _recorded(after.recorded_at)
    return 0.0 if begun is None or again is None else (again - begun).total_seconds()


def _moved(event: LogEvent, shift: float) -> LogEvent:
    # rounded, so that moments which both clocks know are one
    return msgspec.structs.replace(event, t=round(event.t + shift, 9))


def _overlap(log: Log, first: float, last: float, until: float) -> MapfuseError:
    name = log.header.name
    reason = (
        f"holds events of {first:.3f} to {last:.3f} s, and the state knows {name!r} up to {until:.3f} s on that clock; "
        "give only what was recorded after, on a clock that went on or with the recorded_at of its own"
    )
    return MapfuseError(f"log {name!r}: {reason}") if log.path is None else InputError(log.path, reason)


def _recorded(text: str | None) -> datetime | None:
    if text is None:
        return None
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        return None
    return found if found.tzinfo is not None else found.replace(tzinfo=UTC)
