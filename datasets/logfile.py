"""``mapfuse.log/1``: a robot's log as a file of lines, ``NAME.log.jsonl``, read and written as a stream.

The first line is the header, each other line one event (docs/logs.md has the format). A log that broke off, or whose
clock was set, is still worth something, so that reading is lenient unless asked otherwise: what is valid is kept, what
isn't is left out, and both are reported with the line's number. What `read_log` gives away event by event, by the
numbers in `logreading`:

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

import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from .errors import MapfuseError
from .files import write_stream
from .jsondata import said
from .logheader import header_to_dict
from .logreading import EVENTS, Events, open_log, read_header, reason_of
from .logreport import LogReport
from .logs import Log


def read_log(path: str | Path, *, strict: bool = False, report: LogReport | None = None) -> Log:
    """The log in a file of format ``mapfuse.log/1``, as text or compressed by gzip, which its content says.

    Only the header is read at once. The events are read anew whenever they are iterated over (those of a pipe once), in
    bounded memory; ``report`` is filled meanwhile, and if there is something in it, a warning is logged at the end.
    With ``strict`` the first remark raises instead.

    Raises `InputError` where the file can't be read, and `FileFormatError` where its header breaks a rule. Iterating
    raises `FileFormatError` with the line where ``strict`` refuses it, or where a line is longer than
    `MAX_SKIPPED_BYTES`.

    >>> import tempfile
    >>> from mapfuse.datasets.logs import LogHeader, Odometry
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "a.log.jsonl"
    ...     write_log(Log(LogHeader("a"), [Odometry(0.0, 0.0, 0.0, 0.0), Odometry(0.1, 0.05, 0.0, 0.0)]), file)
    ...     log = read_log(file)
    ...     log.header.name, [event.t for event in log.events]
    ('a', [0.0, 0.1])
    """
    path = Path(path)
    stream = open_log(path)
    try:
        header = read_header(stream, path)
    except BaseException:
        stream.close()
        raise
    if path.is_fifo():
        return Log(header, Events(path, strict, report, stream), path)
    stream.close()
    return Log(header, Events(path, strict, report, None), path)


def write_log(log: Log, path: str | Path) -> None:
    """Writes a log as a stream, whole or not at all, compressed where the name ends in ``.gz``.

    The same log gives the same bytes, and reading it gives equal events. They are written in the order they come in;
    that times increase is not asked for.

    Raises `MapfuseError`, which says which event it is, where the header or an event breaks a rule of the format, and
    `OutputError` where the file can't be written; what the log's own events raise while they are read passes through.
    """
    chunks = _chunks(log)
    write_stream(path, _compressed(chunks) if Path(path).suffix == ".gz" else chunks)


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
            read = EVENTS.decode(encode(event))
            if read != event:
                raise TypeError("holds values of another type than the format's")
            line = encode(read)
        except (msgspec.MsgspecError, TypeError, NotImplementedError, UnicodeError) as error:
            reason = reason_of(error) if isinstance(error, msgspec.MsgspecError) else str(error)
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
