"""How far long work has come: a line on standard error, on a terminal only, gone when the work is done."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.progress import Progress

Item = TypeVar("Item")
#: The line is told of its progress every so many items.
_STEP = 2000


@contextmanager
def progress(label: str, total: float | None = None, *, quiet: bool = False) -> Iterator[Callable[[float], None]]:
    """Gives a function to call with the work done since the last call; ``total`` None: it is counted only."""
    if quiet or not _on_terminal():
        yield lambda _: None
        return
    with _bar(timed=total is not None) as bar:
        task = bar.add_task(label, total=total, rate="")

        def advance(done: float) -> None:
            bar.advance(task, done)
            speed = bar.tasks[task].finished_speed or bar.tasks[task].speed
            bar.update(task, rate=f"{speed:.3g}/s" if speed else "")

        yield advance


@contextmanager
def stages(label: str, *, quiet: bool = False) -> Iterator[None]:
    """Shows on a terminal how far the block's work has come, as the library tells its log (`mapfuse.fusion.told`)."""
    if quiet or not _on_terminal():
        yield
        return
    with _bar() as bar, _listening(bar, label):
        yield


@contextmanager
def _listening(bar: Progress, label: str) -> Iterator[None]:
    task = bar.add_task(label, total=None)
    logger = logging.getLogger("mapfuse.fusion.told")
    level = logger.level

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            done, total = getattr(record, "done", 0), getattr(record, "total", 1)
            # the last step is followed by work that nobody counts
            shown = {"completed": done, "total": total} if done < total else {"completed": 0, "total": None}
            bar.update(task, description=f"{label}: {record.getMessage()}", **shown)

    listener = Listener()
    logger.addHandler(listener)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(listener)
        logger.setLevel(level)


def _on_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()


def _bar(*, timed: bool = False) -> Progress:
    """``timed``: with how fast the work goes, the task's ``rate``, and how long it will still take."""
    from rich import progress as rp
    from rich.console import Console

    columns: list[rp.ProgressColumn] = [rp.TextColumn("{task.description}", markup=False), rp.BarColumn()]
    columns += [rp.MofNCompleteColumn(), rp.TimeElapsedColumn()]
    if timed:
        columns += [rp.TextColumn("{task.fields[rate]}", markup=False), rp.TimeRemainingColumn()]
    return rp.Progress(*columns, console=Console(stderr=True), transient=True)


def watched(items: Iterable[Item], label: str, total: float | None = None, *, quiet: bool = False) -> Iterator[Item]:
    """The same items, their number shown while they pass.

    >>> list(watched(range(3), "three"))
    [0, 1, 2]
    """
    with progress(label, total, quiet=quiet) as advance:
        count = 0
        for count, item in enumerate(items, start=1):
            yield item
            if count % _STEP == 0:
                advance(_STEP)
        advance(count % _STEP)
