"""The names that detections of a log carry: taken as they are, left out, or found by looking at the whole log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import typer

from .console import UsageError
from .progress import stages

if TYPE_CHECKING:
    from mapfuse.datasets.logs import Log, LogTruth

NoIds = Annotated[bool, typer.Option("--no-ids", help="Don't use the names that detections carry.")]
NamePoints = Annotated[
    bool,
    typer.Option(
        "--name-points",
        help="For points in open space, as trees: first find out from the whole log which detections without names "
        "and arms are of one landmark. Seconds to minutes of work.",
    ),
]


@dataclass(frozen=True, eq=False, slots=True)
class Named:
    """A log with the names to use. Where points were given some: ``numbers`` of its detections in the log as it was
    read, and how many (``count``) that one has."""

    log: Log
    numbers: Sequence[int] | None = None
    count: int = 0

    def truth(self, known: LogTruth) -> LogTruth:
        """The truth of the log as it was read, for the detections that are left.

        Raises `UsageError` where it is of another number of detections.
        """
        if self.numbers is None:
            return known
        check_count(known, self.count)
        return replace(known, detections=tuple(known.detections[number] for number in self.numbers))


def check_count(known: LogTruth, count: int) -> None:
    """Raises `UsageError` where the truth is not of ``count`` detections."""
    if len(known.detections) != count:
        raise UsageError(f"--truth: is of {len(known.detections)} detections, and the log has {count}")


def named(log: Log, *, no_ids: bool, name_points: bool, quiet: bool) -> Named:
    """The log with the names of its detections that the command is to use."""
    if no_ids:
        log = log.without_ids()
    if not name_points:
        return Named(log)
    from mapfuse.datasets.logs import Detection, Log
    from mapfuse.datasets.mapper.naming import name_detections

    events = list(log.events)
    with stages(f"naming what {log.header.name} saw", quiet=quiet):
        found = name_detections(Log(log.header, events))
    return Named(
        replace(found.log, path=log.path), found.numbers, sum(isinstance(event, Detection) for event in events)
    )
