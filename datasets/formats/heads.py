"""The beginning of a file, and text files whole, plain or compressed, in bounded memory."""

from __future__ import annotations

import zlib
from pathlib import Path

from ..errors import FileFormatError, InputError, Problem
from ..files import open_stream, read_whole, unreadable

#: What `detect` is shown of a file [bytes].
HEAD_BYTES = 2**16
#: Text of foreign formats is refused beyond this, unpacked [bytes]: their parsers need up to 50 times as much memory.
MAX_TEXT_BYTES = 2**27
_GZIP = b"\x1f\x8b"


def head_of(path: Path) -> bytes:
    """The first bytes of a file, unpacked; of a folder or a pipe, which can be read once only, none.

    Raises `InputError` where the file can't be read.
    """
    if path.is_dir() or path.is_fifo():
        return b""
    with open_stream(path) as file:
        try:
            head = file.read(HEAD_BYTES)
        except OSError as error:
            raise unreadable(path, error) from error
    if not head.startswith(_GZIP):
        return head
    try:
        return zlib.decompressobj(wbits=31).decompress(head, HEAD_BYTES)
    except zlib.error:
        return head


def plain_name(path: Path) -> str:
    """A file's name in lower case, without the ending of compression."""
    return path.name.lower().removesuffix(".gz")


def stem(path: Path, *endings: str) -> str:
    """A file's name without its ending: the first of ``endings`` that it has, else what follows the last dot.

    >>> stem(Path("a/farm.tmap2.yaml.gz"), ".tmap2.yaml"), stem(Path("park.v2.g2o"))
    ('farm', 'park.v2')
    """
    name = path.name[:-3] if path.name.lower().endswith(".gz") else path.name
    for ending in endings:
        if name.lower().endswith(ending) and len(name) > len(ending):
            return name[: -len(ending)]
    return Path(name).stem or path.resolve().name or "map"


def read_bytes(path: Path, limit: int = MAX_TEXT_BYTES) -> bytes:
    """The content of a file, unpacked if it is compressed (gzip), of at most ``limit`` bytes.

    Raises `InputError` where it can't be read or is larger, `FileFormatError` where it is packed wrongly.
    """
    data = read_whole(path, limit)
    if not data.startswith(_GZIP):
        return data
    unpacker = zlib.decompressobj(wbits=31)
    try:
        text = unpacker.decompress(data, limit + 1)
    except zlib.error as error:
        raise FileFormatError(path, (Problem("", f"is broken compressed data: {error}"),)) from error
    if len(text) > limit:
        raise InputError(path, f"unpacks to more than {limit:,} bytes, the most that is read")
    if not unpacker.eof:
        raise FileFormatError(path, (Problem("", "is compressed data that ends too early"),))
    return text


def read_text(path: Path, limit: int = MAX_TEXT_BYTES) -> str:
    """A text file in UTF-8 (a byte order mark is skipped), unpacked; errors as `read_bytes` raises them."""
    data = read_bytes(path, limit)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        reason = f"is not UTF-8 text: byte 0x{data[error.start]:02x} at position {error.start} (line {line})"
        raise FileFormatError(path, (Problem("", reason),)) from None
