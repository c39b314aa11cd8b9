"""``mapfuse.log/1``: a robot's log as a file of lines, ``NAME.log.jsonl``, read and written as a stream.

The first line is the header, each other line one event (docs/logs.md has the format). A log that broke off, or whose
clock was set, is still worth something, so that reading is lenient unless asked otherwise: what is valid is kept, what
isn't is left out, and both are reported with the line's number. What `read_log` gives away event by event:

- times never decrease. An event up to `REORDER` seconds late is put in its place;
- a single line whose time is out of all reason (more late than that, or more than `PAUSE` seconds ahead of the lines
  around it) is left out;
- where `CONFIRM` lines in a row agree that time has jumped, it has. A jump ahead is a pause and kept; a jump back is a
  clock that was set, and all later times are moved on, so that the drive goes on where it was. A clock that was set
  back by less than `REORDER` seconds shows in the odometry, which then repeats times: `CONFIRM_STEP` poses of it in a
  row, each later than the one before, are no shuffled lines; fewer are taken for such;
- a line that isn't an event of this format is left out: cut off, no JSON, NaN, a negative range, an unknown type of arm
  or kind of event;
- a detection before any odometry is kept.

With ``strict`` the first of these is an error. A broken header always is. Memory is bounded whatever the file holds: a
line of more than `MAX_LINE_BYTES` is left out without ever being held.
"""

from __future__ import annotations

import gzip
import logging
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, fields
from io import BufferedReader
from operator import attrgetter, le
from pathlib import Path
from typing import Any, TypeAlias

import msgspec
import numpy as np

from .errors import FileFormatError, InputError, MapfuseError, Problem
from .files import open_stream, unreadable, write_stream
from .jsondata import Place, decode, format_fault, json_faults, render, said
from .logs import Detection, Event, Log, LogHeader, Odometry, Sensors
from .rules import NOT_NEGATIVE, PROBABILITY, WORD, Rule, RuleError

_LOG = logging.getLogger(__name__)

FORMAT = "mapfuse.log/1"
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
#: Reports that are kept word for word; all are counted.
MAX_KEPT = 1000

_CHUNK = 2**18
_Stream: TypeAlias = BufferedReader | gzip.GzipFile
_TIME = attrgetter("t")
_EVENTS: msgspec.json.Decoder[Event] = msgspec.json.Decoder(Event)
_KINDS = frozenset(str(kind.__struct_config__.tag) for kind in Event.__args__)


@dataclass(frozen=True, slots=True)
class Remark:
    """One thing that reading a log came upon: the ``line`` (from 1), which ``kind`` of thing, and a sentence."""

    line: int
    kind: str
    reason: str

    def __str__(self) -> str:
        return f"line {self.line}: {self.reason}"


@dataclass(slots=True)
class LogReport:
    """What reading a log came upon, filled while its events are read: the first `MAX_KEPT` remarks, the first one of
    each kind in any case, and all counted.

    Kinds: ``invalid`` (no event; left out), ``cut off`` (the last line or the compressed file; left out), ``unknown``
    (kind of event; left out), ``too long`` (left out), ``stray`` (its time fits nothing; left out), ``late`` (put in
    its place), ``pause``, ``clock`` (set back; later times moved on), ``no odometry yet`` (a detection that comes
    first; kept).
    """

    remarks: list[Remark] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)

    @property
    def left_out(self) -> int:
        """Number of lines that were left out."""
        return sum(self.counts[kind] for kind in ("invalid", "cut off", "unknown", "too long", "stray"))

    def __str__(self) -> str:
        if not self.counts:
            return "nothing to report"
        first = {remark.kind: remark.line for remark in reversed(self.remarks)}
        counted = [f"{number:,} {kind}" for kind, number in self.counts.items()]
        if len(counted) > 1:
            places = (f"{'line' if n == 1 else 'from line'} {first[kind]:,}" for kind, n in self.counts.items())
            counted = [f"{what} ({place})" for what, place in zip(counted, places, strict=True)]
        lines = "1 line" if self.left_out == 1 else f"{self.left_out:,} lines"
        return f"{', '.join(counted)}; {lines} left out; first, {self.remarks[0]}"


def read_log(path: str | Path, *, strict: bool = False, report: LogReport | None = None) -> Log:
    """The log in a file of format ``mapfuse.log/1``, as text or compressed by gzip, which its content says.

    Only the header is read at once. The events are read anew whenever they are iterated over (those of a pipe once), in
    bounded memory; ``report`` is filled meanwhile, and if there is something in it, this module's logger warns at the
    end. With ``strict`` the first remark raises instead.

    Raises `InputError` where the file can't be read, and `FileFormatError` where its header breaks a rule. Iterating
    raises `FileFormatError` with the line where ``strict`` refuses it, or where a line is longer than
    `MAX_SKIPPED_BYTES`.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "a.log.jsonl"
    ...     write_log(Log(LogHeader("a"), [Odometry(0.0, 0.0, 0.0, 0.0), Odometry(0.1, 0.05, 0.0, 0.0)]), file)
    ...     log = read_log(file)
    ...     log.header.name, [event.t for event in log.events]
    ('a', [0.0, 0.1])
    """
    path = Path(path)
    stream = _open(path)
    try:
        header = _read_header(stream, path)
    except BaseException:
        stream.close()
        raise
    if path.is_fifo():
        return Log(header, _Events(path, strict, report, stream))
    stream.close()
    return Log(header, _Events(path, strict, report, None))


def write_log(log: Log, path: str | Path) -> None:
    """Writes a log as a stream, whole or not at all, compressed where the name ends in ``.gz``.

    The same log gives the same bytes, and reading it gives equal events. They are written in the order they come in;
    that times increase is not asked for.

    Raises `MapfuseError`, which says which event it is, where the header or an event breaks a rule of the format, and
    `OutputError` where the file can't be written; what the log's own events raise while they are read passes through.
    """
    chunks = _chunks(log)
    write_stream(path, _compressed(chunks) if Path(path).suffix == ".gz" else chunks)


# Header


def _sensor_rules() -> dict[str, Rule]:
    return {
        f.name: PROBABILITY if f.name.endswith("_rate") else NOT_NEGATIVE for f in fields(Sensors) if f.name != "extra"
    }


_SENSORS = _sensor_rules()
#: Sensors that a robot may lack, or whose error may be unknown: null says so.
_MAY_BE_NULL = ("gyro_sigma", "compass_sigma", "compass_offset_sigma")
_WORDS = ("name", "robot", "recorded_at")


def header_to_dict(header: LogHeader) -> dict[str, Any]:
    """The first line of a log, as plain Python values; all of the sensors are in it.

    Raises `MapfuseError` where the header breaks a rule of the format.
    """
    document: dict[str, Any] = {"format": FORMAT, "name": header.name}
    document |= {key: value for key in ("robot", "recorded_at") if (value := getattr(header, key)) is not None}
    document["sensors"] = {name: _plain(getattr(header.sensors, name)) for name in _SENSORS} | dict(
        header.sensors.extra
    )
    document |= header.extra
    problems = [Problem(render(place), reason) for place, reason in json_faults(document, ())]
    problems = problems or _header(document)[1]
    if problems:
        raise MapfuseError(f"the header of log {said(header.name)} can't be written: {'; '.join(map(str, problems))}")
    return document


def header_from_dict(document: Any, path: str | Path = "log") -> LogHeader:
    """The header in a decoded first line; ``path`` is named in errors.

    Raises `FileFormatError`, which lists every broken rule.

    >>> header_from_dict({"format": "mapfuse.log/1", "name": "a", "sensors": {"gyro_sigma": 0.01}}).sensors.gyro_sigma
    0.01
    """
    header, problems = _header(document)
    if header is None or problems:
        raise FileFormatError(
            path, tuple(Problem(f"line 1: {p.place}" if p.place else "line 1", p.reason) for p in problems)
        )
    return header


def _header(document: Any) -> tuple[LogHeader | None, list[Problem]]:
    if not isinstance(document, dict):
        return None, [Problem("", f"must be an object, the log's header, not {said(document)}")]
    if fault := format_fault(document.get("format"), FORMAT):
        return None, [Problem("format", fault)]
    problems: list[Problem] = [] if "name" in document else [Problem("name", "is missing")]
    given = {
        key: value for key in _WORDS if (value := document.get(key)) is not None or (key == "name" and key in document)
    }
    words = _checked(given, dict.fromkeys(_WORDS, WORD), (), problems)
    sensors: Any = document.get("sensors")
    if sensors is not None and not isinstance(sensors, dict):
        problems.append(Problem("sensors", f"must be an object, not {said(sensors)}"))
    found = sensors if isinstance(sensors, dict) else {}
    nulls = {key: None for key in _MAY_BE_NULL if key in found and found[key] is None}
    stated = {key: value for key, value in found.items() if key in _SENSORS and value is not None}
    values = _checked(stated, _SENSORS, ("sensors",), problems) | nulls
    problems += [
        Problem(render(("sensors", key)), "must be above 0") for key in ("compass_bend_length",) if values.get(key) == 0
    ]
    if problems:
        return None, problems
    more = {key: value for key, value in found.items() if key not in _SENSORS}
    extra = {key: value for key, value in document.items() if key not in (*_WORDS, "format", "sensors")}
    return LogHeader(**words, sensors=Sensors(**values, extra=more), extra=extra), []


def _checked(values: dict[str, Any], rules: dict[str, Rule], place: Place, problems: list[Problem]) -> dict[str, Any]:
    checked = {}
    for key, value in values.items():
        try:
            checked[key] = rules[key].check(value)
        except RuleError as error:
            problems += [Problem(render((*place, key, *where)), reason) for where, reason in error.faults]
    return checked


def _read_header(stream: _Stream, path: Path) -> LogHeader:
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


# Reading


def _open(path: Path) -> _Stream:
    """The bytes of the log itself."""
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


class _Events:
    """The events of a file, read anew by each iteration; of a pipe, once."""

    def __init__(self, path: Path, strict: bool, report: LogReport | None, stream: _Stream | None) -> None:
        self._path, self._strict, self._report, self._stream = path, strict, report, stream
        self._once = stream is not None

    def __iter__(self) -> Iterator[Event]:
        stream, self._stream = self._stream, None
        if stream is None:
            if self._once:
                raise InputError(self._path, "is a pipe, and its events have been read already")
            stream = _open(self._path)
            _read_header(stream, self._path)
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

    def events(self, stream: _Stream) -> Iterator[Event]:
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

    def _blocks(self, stream: _Stream) -> Iterator[tuple[int, bytes]]:
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

    def _read(self, stream: _Stream, line: int) -> bytes:
        try:
            return stream.read1(_CHUNK)
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            self.remark(line, "cut off", f"is where the compressed file breaks off ({error})")
            return b""
        except OSError as error:
            raise unreadable(self.path, error) from error

    def _skip(self, stream: _Stream, line: int, skipped: int) -> bytes:
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
            found = _EVENTS.decode_lines(block)
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
            return _EVENTS.decode(line)
        except (msgspec.MsgspecError, RecursionError) as error:
            reason = _reason(error)
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


def _reason(error: Exception) -> str:
    """msgspec's words as a part of a sentence, the place first."""
    if isinstance(error, RecursionError):
        return "is nested too deeply"
    if isinstance(error, msgspec.ValidationError):
        what, _, place = str(error).partition(" - at `$")
        return f"{place.rstrip('`').lstrip('.')}: {what}" if place.strip("`") else what
    return "is not JSON: " + str(error).removeprefix("JSON is malformed: ")


# Writing


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _number_of_numpy(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError  # what a hook of msgspec says of types that it doesn't know


def _chunks(log: Log) -> Iterator[bytes]:
    """The lines of a log, some hundred kilobytes at a time."""
    yield msgspec.json.encode(header_to_dict(log.header)) + b"\n"
    encode = msgspec.json.Encoder(enc_hook=_number_of_numpy).encode
    lines: list[bytes] = []
    for k, event in enumerate(log.events):
        try:
            # what can't be read must not be written (NaN would become null), and a whole number is written as a float
            read = _EVENTS.decode(encode(event))
            if read != event:
                raise TypeError("holds values of another type than the format's")
            line = encode(read)
        except (msgspec.MsgspecError, TypeError, NotImplementedError, UnicodeError) as error:
            reason = _reason(error) if isinstance(error, msgspec.MsgspecError) else str(error)
            raise MapfuseError(f"event {k} of log {said(log.header.name)} can't be written: {reason}") from error
        lines.append(line)
        if len(lines) == 4096:
            yield b"\n".join(lines) + b"\n"
            lines.clear()
    if lines:
        yield b"\n".join(lines) + b"\n"


def _compressed(chunks: Iterable[bytes]) -> Iterator[bytes]:
    """The chunks as a gzip stream without name and time in it, so that the same log gives the same bytes."""
    packer = zlib.compressobj(wbits=31)
    for chunk in chunks:
        yield packer.compress(chunk)
    yield packer.flush()
