"""What the commands share: words to the user, and files that are checked before the long work begins."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

PICTURE_SUFFIXES = (".png", ".svg", ".pdf")
PAGE_SUFFIXES = (".html", ".htm")

Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Say nothing but errors; files are written as ever.")]
Verbose = Annotated[bool, typer.Option("-v", "--verbose", help="Say what is being done, on standard error.")]


class UsageError(Exception):
    """Wrong usage: its text goes to the user as it is, exit code 2."""


def tolerate_any_text() -> None:
    """Let a terminal without our characters (±, any map's name) show an escape instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="backslashreplace")


def _without_controls(text: str) -> str:
    # names come out of files: none of them may steer the terminal
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


def say(text: str) -> None:
    """Print to standard output; a reader that has gone away (``| head``) is no error."""
    _write(_without_controls(text) + "\n")


def teller(*, quiet: bool) -> Callable[[str], None]:
    """`say`, or what says nothing."""
    return (lambda _: None) if quiet else say


def say_bytes(data: bytes) -> None:
    """Write bytes to standard output exactly as they are."""
    _write(data)


def _write(what: str | bytes) -> None:
    if sys.stdout is None:
        return
    try:
        if isinstance(what, bytes):
            sys.stdout.flush()
            sys.stdout.buffer.write(what)
        else:
            sys.stdout.write(what)
        sys.stdout.flush()
    except BrokenPipeError:
        # what is still buffered must not fail again at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:  # a full disk behind a redirection
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise UsageError(f"can't write to standard output: {error.strerror}") from None


def complain(text: str) -> None:
    """Print one message to standard error."""
    print(f"mapfuse: {_without_controls(text)}", file=sys.stderr)


def note(text: str) -> None:
    """Print a remark to standard error, where it does not mix with the result."""
    print(_without_controls(text), file=sys.stderr)


def warn_on_stderr(*, verbose: bool = False) -> None:
    """Show what the library warns of (a landmark whose type contradicts its arms) as remarks of ours.

    ``verbose``: also what it is doing.
    """
    import logging

    class Worded(logging.Formatter):
        def format(self, record: logging.LogRecord) -> str:
            warning = "warning: " if record.levelno >= logging.WARNING else ""
            return _without_controls(f"mapfuse: {warning}{record.getMessage()}")

    handler = logging.StreamHandler()
    handler.setFormatter(Worded())
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    if verbose:
        logging.getLogger("mapfuse").setLevel(logging.INFO)


@contextmanager
def log_levels(**level_from_name: int) -> Iterator[None]:
    """Show of these parts of mapfuse only what is as grave, for as long; ``mapfuse`` is the whole."""
    import logging

    loggers = [logging.getLogger("mapfuse" if name == "mapfuse" else f"mapfuse.{name}") for name in level_from_name]
    before = [logger.level for logger in loggers]
    for logger, level in zip(loggers, level_from_name.values(), strict=True):
        logger.setLevel(level)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


def check_outputs(path_from_option: Mapping[str, Path | None], inputs: Sequence[Path] = ()) -> None:
    """Raise `UsageError` where an output can't be written, is an input, or two outputs are one file."""
    option_from_target: dict[Path, str] = {}
    sources = {Path(os.path.realpath(path)) for path in inputs}
    for option, path in path_from_option.items():
        if path is None:
            continue
        target = Path(os.path.realpath(path))
        if target.is_dir():
            raise UsageError(f"{option} {path}: is a folder; give a file name")
        if not target.parent.is_dir():
            raise UsageError(f"{option} {path}: there is no folder {path.parent}")
        if target in sources:
            raise UsageError(f"{option} {path}: is an input, which would be overwritten")
        if target in option_from_target:
            raise UsageError(f"{option} {path}: is the same file as that of {option_from_target[target]}")
        if not os.access(target if target.exists() else target.parent, os.W_OK):
            raise UsageError(f"{option} {path}: may not be written")
        option_from_target[target] = option


def check_folder(option: str, folder: Path | None, path_from_option: Mapping[str, Path | None]) -> None:
    """Make the folder that files are to be written into, so that it is there and can be written to.

    Raises `UsageError` where it can't, or where another output is that folder or one above it.
    """
    if folder is None:
        return
    target = Path(os.path.realpath(folder))
    if target.exists() and not target.is_dir():
        raise UsageError(f"{option} {folder}: is a file; give a folder")
    for other, path in path_from_option.items():
        if path is not None and Path(os.path.realpath(path)) in (target, *target.parents):
            raise UsageError(f"{option} {folder}: can't be a folder, since {other} {path} is to be a file")
    try:
        target.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(prefix=".mapfuse-", dir=target).close()
    except OSError as error:
        raise UsageError(f"{option} {folder}: can't be written: {error.strerror or error}") from error


def check_picture(option: str, path: Path | None) -> None:
    """Raise `UsageError` where the file's ending is no picture format."""
    if path is not None and path.suffix.lower() not in PICTURE_SUFFIXES:
        raise UsageError(f"{option} {path}: a picture's name ends in one of {', '.join(PICTURE_SUFFIXES)}")


def check_page(option: str, path: Path | None) -> None:
    """Raise `UsageError` where the file's ending is not that of a page."""
    if path is not None and path.suffix.lower() not in PAGE_SUFFIXES:
        raise UsageError(f"{option} {path}: a page's name ends in {' or '.join(PAGE_SUFFIXES)}")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Raise `UsageError` where what the block writes to ``path`` can't be written."""
    try:
        yield
    except OSError as error:
        raise UsageError(f"{path}: can't be written: {error.strerror or error}") from error
