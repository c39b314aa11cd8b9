"""How far long work has come: a line on standard error, on a terminal only, gone when the work is done."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")
#: The line is told of its progress every so many items.
_STEP = 2000


@contextmanager
def progress(label: str, total: float | None = None) -> Iterator[Callable[[float], None]]:
    """Gives a function to call with the work done since the last call; ``total`` None: it is counted only."""
    if sys.stderr is None or not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich import progress as rp
    from rich.console import Console

    columns: list[rp.ProgressColumn] = [rp.TextColumn("{task.description}", markup=False), rp.BarColumn()]
    columns += [rp.MofNCompleteColumn(), rp.TimeElapsedColumn()]
    if total is not None:
        columns += [rp.TextColumn("{task.fields[rate]}", markup=False), rp.TimeRemainingColumn()]
    with rp.Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=total, rate="")

        def advance(done: float) -> None:
            bar.advance(task, done)
            speed = bar.tasks[task].finished_speed or bar.tasks[task].speed
            bar.update(task, rate=f"{speed:.3g}/s" if speed else "")

        yield advance


def watched(items: Iterable[Item], label: str, total: float | None = None) -> Iterator[Item]:
    """The same items, their number shown while they pass.

    >>> list(watched(range(3), "three"))
    [0, 1, 2]
    """
    with progress(label, total) as advance:
        count = 0
        for count, item in enumerate(items, start=1):
            yield item
            if count % _STEP == 0:
                advance(_STEP)
        advance(count % _STEP)
