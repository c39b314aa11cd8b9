"""The names that detections of a log carry: taken as they are, left out, or found by looking at the whole log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from .progress import stages

if TYPE_CHECKING:
    from mapfuse.datasets.logs import Log
    from mapfuse.datasets.mapper import Mapper

NoIds = Annotated[bool, typer.Option("--no-ids", help="Don't use the names that detections carry.")]
FindIds = Annotated[
    bool,
    typer.Option(
        "--find-ids",
        help="Read the whole log first, and find which detections without name and arms are of one landmark.",
    ),
]


@dataclass(frozen=True, eq=False, slots=True)
class Named:
    """A log with the names to use. Where they were found: ``numbers`` of its detections in the log as it was read, and
    how many (``count``) that one has."""

    log: Log
    numbers: Sequence[int] | None = None
    count: int | None = None

    def sources(self, mapper: Mapper) -> Mapping[str, Sequence[int]]:
        """Of each landmark its detections, by their numbers in the log as it was read."""
        if self.numbers is None:
            return mapper.sources
        return {name: [self.numbers[k] for k in found] for name, found in mapper.sources.items()}


def named(log: Log, *, no_ids: bool, find_ids: bool, quiet: bool) -> Named:
    """The log with the names of its detections that the command is to use."""
    if no_ids:
        log = log.without_ids()
    if not find_ids:
        return Named(log)
    from mapfuse.datasets.logs import Detection, Log
    from mapfuse.datasets.mapper.naming import name_detections

    events = list(log.events)
    with stages(f"finding names in {log.header.name}", quiet=quiet):
        found = name_detections(Log(log.header, events))
    return Named(found.log, found.numbers, sum(isinstance(event, Detection) for event in events))
