"""Files read and written, whole or as streams: one clear error instead of a traceback, and never half a result."""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Iterable
from io import BufferedReader
from pathlib import Path

from .errors import InputError, OutputError

#: Larger files are refused [bytes]: 1 GiB holds a joint covariance of 2,400 landmarks with headings.
MAX_FILE_BYTES = 2**30


def _reason(error: OSError | ValueError) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def read_whole(path: str | Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """The content of a file (or pipe) of at most ``limit`` bytes; no more than that is ever held.

    Raises `InputError` where there is no such file, where it is a folder or a device, where it may not be read, and
    where it is larger.
    """
    path = Path(path)
    with open_stream(path) as file:
        try:
            found = os.fstat(file.fileno())
            plain = stat.S_ISREG(found.st_mode)
            if plain and found.st_size > limit:
                raise InputError(path, f"is larger than {limit:,} bytes, the most that is read")
            # room is made for as much as is asked for
            size = found.st_size if plain else limit
            data = file.read(size + 1)
            if size < len(data) <= limit:  # it has grown meanwhile
                data += file.read(limit + 1 - len(data))
        except OSError as error:
            raise unreadable(path, error) from error
    if len(data) > limit:
        raise InputError(path, f"is larger than {limit:,} bytes, the most that is read")
    return data


def open_stream(path: str | Path) -> BufferedReader:
    """A file (or pipe) opened to be read, which the caller closes.

    Raises `InputError` where there is no such file, where it is a folder or a device, and where it may not be read.
    """
    path = Path(path)
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise InputError(path, "is a folder, not a file")
        if not (stat.S_ISREG(mode) or stat.S_ISFIFO(mode)):
            raise InputError(path, "is a device, not a file")
        return path.open("rb")
    except FileNotFoundError:
        raise InputError(path, "there is no such file") from None
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from error


def unreadable(path: str | Path, error: OSError | ValueError) -> InputError:
    """What to raise where the system refuses to read a file."""
    return InputError(path, f"can't be read: {_reason(error)}")


def write_whole(path: str | Path, data: str | bytes) -> None:
    """Put ``data`` (text as UTF-8) into a file, whole or not at all; an older file stays until the new one is done.

    Written to a new file beside the target, synchronised with the disk, then renamed over it, so that a reader, a
    crash or a full disk never shows a part. A link is followed, an existing file keeps its permissions, and a pipe or
    device (``/dev/stdout``) is written to directly.

    Raises `OutputError` where the folder is missing or not writable, the target is a folder or write-protected, or
    the disk is full; nothing is left behind then.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     target = Path(folder) / "result.txt"
    ...     write_whole(target, "done")
    ...     target.read_text(), len(list(Path(folder).iterdir()))
    ('done', 1)
    """
    write_stream(path, (data.encode() if isinstance(data, str) else data,))


def write_stream(path: str | Path, chunks: Iterable[bytes]) -> None:
    """As `write_whole`, from chunks that needn't be in memory together; an error that they raise leaves nothing behind.

    Raises what `write_whole` does.
    """
    path = Path(path)
    try:
        target = Path(os.path.realpath(path))
        mode = _mode(target)
        if not stat.S_ISREG(mode):
            with target.open("wb") as file:
                for chunk in chunks:
                    file.write(chunk)
            return
        if target.exists() and not os.access(target, os.W_OK):
            raise OutputError(path, "is write-protected")
        _replace(target, chunks, stat.S_IMODE(mode))
    except FileNotFoundError:
        raise OutputError(path, "its folder doesn't exist") from None
    except (OSError, ValueError) as error:
        raise OutputError(path, f"can't be written: {_reason(error)}") from error


def _mode(target: Path) -> int:
    """Kind and permissions of the target; those of a plain new file where there is none yet."""
    try:
        return target.stat().st_mode
    except FileNotFoundError:
        return stat.S_IFREG


def _replace(target: Path, chunks: Iterable[bytes], permissions: int) -> None:
    temporary = target.with_name(f".mapfuse-{secrets.token_hex(8)}.tmp")
    # os.open, unlike the tempfile module, lets the umask decide who may read the result
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0), 0o666)
    try:
        with os.fdopen(descriptor, "wb") as file:
            if permissions:
                os.fchmod(file.fileno(), permissions)
            for chunk in chunks:
                file.write(chunk)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _synchronise_folder(target.parent)


def _synchronise_folder(folder: Path) -> None:
    """Make the new name itself survive a power cut; some file systems can't, and the file is whole without it."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    except OSError:
        return
    finally:
        os.close(descriptor)
