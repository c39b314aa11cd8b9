"""A replay in parts: what its robots' mappers know, in the file of the fuser that they feed."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import msgspec

from mapfuse.datasets.files import read_whole
from mapfuse.datasets.mapper import Mapper
from mapfuse.datasets.rules import MAX_COUNT

from .feed import Feed
from .fuser import OnlineFuser
from .saved import document_of, fuser_of, no_fuser, write


@dataclass(frozen=True, slots=True)
class Earlier:
    """A robot of an earlier part: its feed, and what to add to its log's times [s]."""

    feed: Feed
    offset: float


class _Feed(msgspec.Struct):
    mapper: msgspec.Raw
    sequence: int
    t: float | None
    stale: bool
    offset: float


def save_replay(path: str | Path, fuser: OnlineFuser, robots: dict[str, Earlier]) -> None:
    """Fuser and feeds as one file, which `OnlineFuser.load` reads, too. Raises `OutputError`."""
    feeds = {
        name: msgspec.Raw(
            msgspec.json.encode(
                _Feed(
                    msgspec.Raw(robot.feed.mapper.to_json()),
                    robot.feed.sequence,
                    robot.feed.t if isfinite(robot.feed.t) else None,
                    robot.feed.stale,
                    robot.offset,
                )
            )
        )
        for name, robot in robots.items()
    }
    write(fuser, path, feeds)


def load_replay(path: str | Path) -> tuple[OnlineFuser, dict[str, Earlier]]:
    """Fuser and feeds as `save_replay` left them.

    Raises `FileFormatError` for a file that holds none, also where it is that of a fuser alone, and for one of another
    minor version, which it names; `InputError` where it can't be read.
    """
    document = document_of(read_whole(path), path)
    lacking = sorted({segment.robot for segment in document.segments} - set(document.feeds))
    if lacking:
        reason = f"holds no mapper of {lacking[0]!r}: it is the state of a fuser, not of a replay"
        raise no_fuser(path, "feeds", reason)
    robots = {}
    for name, raw in document.feeds.items():
        try:
            saved = msgspec.json.decode(raw, type=_Feed)
        except msgspec.DecodeError as error:
            raise no_fuser(path, f"feeds.{name}", str(error)) from error
        if not name or not 0 <= saved.sequence <= MAX_COUNT:
            raise no_fuser(path, f"feeds.{name}", "needs a name, and a sequence of 0 or more")
        mapper = Mapper.from_json(saved.mapper, path, f"feeds.{name}.mapper")
        feed = Feed(mapper.header, name=name)
        feed.mapper, feed.sequence, feed.stale = mapper, saved.sequence, saved.stale
        feed.t = float("-inf") if saved.t is None else saved.t
        robots[name] = Earlier(feed, saved.offset)
    return fuser_of(OnlineFuser, document, path), robots
