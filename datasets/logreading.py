"""The events of a ``mapfuse.log/1`` file as a stream, with what is wrong in it left out or put right, and reported.

What is done with times and lines that aren't as they should be stands in `logfile`.
"""

from __future__ import annotations

import gzip
import logging
import zlib
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import suppress
from io import BufferedReader
from operator import attrgetter, le
from pathlib import Path
from typing import TypeAlias

import msgspec
import numpy as np

from .errors import FileFormatError, InputError, MapfuseError, Problem
from .files import open_stream, unreadable
from .jsondata import decode, said
from .logheader import header_from_dict
from .logreport import MAX_KEPT, LogReport, Remark
from .logs import Detection, Event, LogHeader, Odometry

_LOG = logging.getLogger(__name__)

#: An event that is late by this much [s] is put in its place.
REORDER = 5.0
#: Longer without any line [s] is reported.
PAUSE = 60.0
#: Lines in a row that make a jump in time out of what else is a stray line.
CONFIRM = 3
#: Poses of the odometry in a row that make a clock set back by little out of what else are late lines.
CONFIRM_STEP = 20
#: Longer lines are left out [bytes]; a scan of 100,000 ranges is half of that.
MAX_LINE_BYTES = 4 * 2**20
#: At a line longer than this [bytes] reading ends: no recorder writes it, a gzip bomb does.
MAX_SKIPPED_BYTES = 2**30
#: Events that wait for late ones at most, however many there are within `REORDER` seconds.
MAX_WAITING = 50_000

_CHUNK = 2**18
Stream: TypeAlias = BufferedReader | gzip.GzipFile
_TIME = attrgetter("t")
EVENTS: msgspec.json.Decoder[Event] = msgspec.json.Decoder(Event)
_KINDS = frozenset(str(kind.__struct_config__.tag) for kind in Event.__args__)


def open_log(path: Path) -> Stream:
    """The bytes of the log itself, unpacked where it is compressed. Raises `InputError` where it can't be read."""
    raw = open_stream(path)
    try:
        packed = raw.peek(2)[:2] == b"\x1f\x8b"
    except OSError as error:
        raw.close()
        raise unreadable(path, error) from error
    return _Unpacked(raw) if packed else raw


def _unreadable(path: Path, error: Exception) -> MapfuseError:
    if isinstance(error, (EOFError, zlib.error, gzip.BadGzipFile)):
        return FileFormatError(path, (Problem("", f"its compression is broken: {error}"),))
    return unreadable(path, error) if isinstance(error, OSError) else InputError(path, str(error))


class _Unpacked(gzip.GzipFile):
    """What a gzip stream holds; closing it closes the stream."""

    def __init__(self, raw: BufferedReader) -> None:
        super().__init__(fileobj=raw, mode="rb")
        self._raw = raw

    def close(self) -> None:
        super().close()
        self._raw.close()


def read_header(stream: Stream, path: Path) -> LogHeader:
    """The header in the first line of a log. Raises `FileFormatError` where it breaks a rule."""
    try:
        line = stream.readline(MAX_LINE_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise _unreadable(path, error) from error
    if len(line) > MAX_LINE_BYTES:
        raise FileFormatError(
            path, (Problem("line 1", f"is longer than {MAX_LINE_BYTES:,} bytes; no log has that header"),)
        )
    document, problems = decode(line.rstrip(b"\r\n"), path)
    if problems:
        raise FileFormatError(path, tuple(Problem(f"line 1: {p.place}", p.reason) for p in problems))
    return header_from_dict(document, path)


class Events:
    """The events of a file, read anew by each iteration; of a pipe, once."""

    def __init__(self, path: Path, strict: bool, report: LogReport | None, stream: Stream | None) -> None:
        self._path, self._strict, self._report, self._stream = path, strict, report, stream
        self._once = stream is not None

    def __iter__(self) -> Iterator[Event]:
        stream, self._stream = self._stream, None
        if stream is None:
            if self._once:
                raise InputError(self._path, "is a pipe, and its events have been read already")
            stream = open_log(self._path)
            read_header(stream, self._path)
        report = LogReport() if self._report is None else self._report
        report.remarks.clear()
        report.counts.clear()
        yield from _Reading(self._path, self._strict, report).events(stream)


class _Reading:
    """One pass over the events of a log."""

    def __init__(self, path: Path, strict: bool, report: LogReport) -> None:
        self.path, self.strict, self.report = path, strict, report
        # the latest time so far, that of the odometry, and that of the last event that left
        self.newest = self.newest_pose = self.given = -np.inf
        self.shift = 0.0
        # accepted events, lines that may be a jump in time, and lines that may be a small step back
        self.waiting: list[Event] = []
        self.doubtful: list[tuple[int, Event]] = []
        self.backward: list[tuple[int, Event]] = []

    def events(self, stream: Stream) -> Iterator[Event]:
        """All events, in order of time."""
        with stream:
            for number, block in self._blocks(stream):
                ordered = self._take(number, block)
                yield from self._ready(ordered)
        self._end()
        yield from self.waiting
        if self.report.counts:
            _LOG.warning("%s: %s", self.path, self.report)

    def remark(self, line: int, kind: str, reason: str) -> None:
        """Reports, or refuses where reading is strict."""
        if self.strict:
            raise FileFormatError(self.path, (Problem(f"line {line}", reason),))
        self.report.counts[kind] += 1
        if len(self.report.remarks) < MAX_KEPT or self.report.counts[kind] == 1:
            self.report.remarks.append(Remark(line, kind, reason))

    # Lines

    def _blocks(self, stream: Stream) -> Iterator[tuple[int, bytes]]:
        """Whole lines together, with the number of the first one."""
        number, rest = 2, b""
        while data := self._read(stream, number):
            end = data.rfind(b"\n") + 1
            if end:
                block = rest + data[:end]
                yield number, block
                number += block.count(b"\n")
                rest = data[end:]
            else:
                rest += data
            if len(rest) > MAX_LINE_BYTES:
                rest = self._skip(stream, number, len(rest))
                number += 1
        if rest.rstrip().endswith(b"}"):
            yield number, rest
        elif rest.strip():
            self.remark(number, "cut off", "is cut off; the log ends within it")

    def _read(self, stream: Stream, line: int) -> bytes:
        try:
            return stream.read1(_CHUNK)
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            self.remark(line, "cut off", f"is where the compressed file breaks off ({error})")
            return b""
        except OSError as error:
            raise unreadable(self.path, error) from error

    def _skip(self, stream: Stream, line: int, skipped: int) -> bytes:
        """What follows a line that is too long."""
        self.remark(line, "too long", f"is longer than {MAX_LINE_BYTES:,} bytes")
        while data := self._read(stream, line):
            at = data.find(b"\n")
            if at >= 0:
                return data[at + 1 :]
            skipped += len(data)
            if skipped > MAX_SKIPPED_BYTES:
                reason = f"is longer than {MAX_SKIPPED_BYTES:,} bytes; what follows is not read"
                raise FileFormatError(self.path, (Problem(f"line {line}", reason),))
        return b""

    def _take(self, number: int, block: bytes) -> bool:
        """Put the events of a block with those that wait; whether they all are in order of time."""
        with suppress(msgspec.MsgspecError, UnicodeError, RecursionError):
            found = EVENTS.decode_lines(block)
            if len(found) == block.count(b"\n") and self._plain_sailing(found):
                return True
        ordered = True
        for k, line in enumerate(block.split(b"\n"), start=number):
            if len(line) > MAX_LINE_BYTES:
                self.remark(k, "too long", f"is longer than {MAX_LINE_BYTES:,} bytes")
            elif line and not line.isspace():
                event = self._event(line, k)
                if event is not None:
                    ordered &= self._place(k, event)
        return ordered

    def _plain_sailing(self, found: list[Event]) -> bool:
        """Takes a block's events if nothing is to be said of any; the usual case, many times faster than one by one."""
        if self.shift or self.doubtful or self.backward or self.newest_pose == -np.inf or not found:
            return False
        times = list(map(_TIME, found))
        if not (times[0] >= self.newest and times[-1] <= self.newest + PAUSE and all(map(le, times, times[1:]))):
            return False
        self.waiting += found
        self.newest = times[-1]
        self.newest_pose = max(self.newest_pose, self.newest)
        return True

    def _event(self, line: bytes, number: int = 0) -> Event | None:
        """The event of a line, or None; with a ``number`` it is said why."""
        kind = "invalid"
        try:
            return EVENTS.decode(line)
        except (msgspec.MsgspecError, RecursionError) as error:
            reason = reason_of(error)
        except UnicodeError:
            reason = "is no UTF-8"
        if (named := _kind(line)) is not None and named not in _KINDS:
            kind, reason = "unknown", f"is an event of a kind that this version doesn't know: {said(named)}"
        if number:
            self.remark(number, kind, reason)
        return None

    # Time

    def _place(self, line: int, event: Event) -> bool:
        """Take one event by what its time says; False where those that wait may not be in order any more."""
        if self.shift:
            event = msgspec.structs.replace(event, t=event.t + self.shift)
        if self._late(event.t) or -np.inf < self.newest < event.t - PAUSE:
            return self._doubt(line, event)
        self._drop_doubtful()
        moving = isinstance(event, Odometry)
        if event.t < self.newest_pose if moving else self.backward and event.t < self.newest:
            return self._step_back(line, event)
        ordered = self._settle() if moving else True
        return self._accept(line, event) and ordered

    def _late(self, t: float) -> bool:
        return t < max(self.newest - REORDER, self.given)

    def _accept(self, line: int, event: Event) -> bool:
        if isinstance(event, Odometry):
            self.newest_pose = max(self.newest_pose, event.t)
        elif isinstance(event, Detection) and self.newest_pose == -np.inf:
            self.remark(line, "no odometry yet", "is a detection before any odometry")
        self.waiting.append(event)
        if event.t < self.newest:
            self.remark(line, "late", f"is {self.newest - event.t:.3g} s late; put in its place")
            return False
        self.newest = event.t
        return True

    def _step_back(self, line: int, event: Event) -> bool:
        """Odometry that is late, and what follows it: shuffled lines, or a clock that was set back by little."""
        ordered = True
        if isinstance(event, Odometry):
            poses = [e for _, e in self.backward if isinstance(e, Odometry)]
            if poses and event.t < poses[-1].t:
                ordered, poses = self._settle(), []
            if len(poses) + 1 == CONFIRM_STEP:
                lines, self.backward = [*self.backward, (line, event)], []
                return self._set_back(lines, self.newest_pose - poses[0].t) and ordered
        self.backward.append((line, event))
        return ordered

    def _settle(self) -> bool:
        """What went back a little was shuffled lines: into their places; False where there were any."""
        lines, self.backward = self.backward, []
        for line, event in lines:
            if self._late(event.t):
                self._stray(line, event)
            else:
                self._accept(line, event)
        return not lines

    def _set_back(self, lines: list[tuple[int, Event]], by: float) -> bool:
        """The clock was set back before these lines: on they move, and all that follow."""
        reason = f"begins {by:.6g} s too early: its time and all later ones are moved on by that"
        self.remark(lines[0][0], "clock", reason)
        self.shift += by
        moved = [(line, msgspec.structs.replace(event, t=event.t + by)) for line, event in lines]
        return not [line for line, event in moved if not self._accept(line, event)]

    def _drop_doubtful(self) -> None:
        lines, self.doubtful = self.doubtful, []
        for line, event in lines:
            self._stray(line, event)

    def _doubt(self, line: int, event: Event) -> bool:
        """A line out of all reason: the first of a jump in time, if more of the kind follow."""
        if self.doubtful and not -REORDER <= event.t - self.doubtful[-1][1].t <= PAUSE:
            self._drop_doubtful()
        self.doubtful.append((line, event))
        if len(self.doubtful) < CONFIRM:
            return True
        lines, self.doubtful = self.doubtful, []
        ordered = self._settle()
        earliest = min(event.t for _, event in lines)
        if earliest < self.newest:
            return self._set_back(lines, self.newest - earliest) and ordered
        self._pause(*lines[0])
        return not [line for line, event in lines if not self._accept(line, event)] and ordered

    def _pause(self, line: int, event: Event) -> None:
        self.remark(line, "pause", f"comes {event.t - self.newest:.6g} s after the line before it")

    def _stray(self, line: int, event: Event) -> None:
        by = event.t - self.newest
        said_so = f"{by:.6g} s ahead of" if by > 0 else f"{-by:.6g} s behind"
        self.remark(line, "stray", f"is {said_so} the lines around it")

    def _end(self) -> None:
        """No more lines: what came last after a pause is right as far as anybody knows."""
        self._settle()
        lines, self.doubtful = self.doubtful, []
        for line, event in lines:
            if event.t > self.newest:
                if event.t > self.newest + PAUSE:
                    self._pause(line, event)
                self._accept(line, event)
            else:
                self._stray(line, event)
        self.waiting.sort(key=_TIME)

    def _ready(self, ordered: bool) -> list[Event]:
        """The events that nothing can come before any more; they leave."""
        waiting = self.waiting
        if not ordered:
            waiting.sort(key=_TIME)
        count = bisect_right(waiting, self.newest - REORDER, key=_TIME)
        count = max(count, len(waiting) - MAX_WAITING)
        if not count:
            return []
        ready, self.waiting = waiting[:count], waiting[count:]
        self.given = ready[-1].t
        return ready


def _kind(line: bytes) -> str | None:
    """The kind of event that a line says it is, if it says anything."""
    try:
        return msgspec.json.decode(line, type=_Kind).event
    except (msgspec.MsgspecError, UnicodeError, RecursionError):
        return None


class _Kind(msgspec.Struct):
    event: str


def reason_of(error: Exception) -> str:
    """msgspec's words as a part of a sentence, the place first."""
    if isinstance(error, RecursionError):
        return "is nested too deeply"
    if isinstance(error, msgspec.ValidationError):
        what, _, place = str(error).partition(" - at `$")
        return f"{place.rstrip('`').lstrip('.')}: {what}" if place.strip("`") else what
    return "is not JSON: " + str(error).removeprefix("JSON is malformed: ")
