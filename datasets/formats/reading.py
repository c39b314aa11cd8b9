"""What every reader of a foreign format returns, and what it may say about the file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ..maps import LandmarkMap

#: Things of one sort that a remark names, at most.
NAMED = 5


@dataclass(frozen=True, slots=True)
class Reading:
    """The maps in a file, one or more, and what was found in it that couldn't be taken as it stands.

    ``parts``: what each map is called within the file (a level of a building), empty where there is one map only.
    ``remarks``: sentences without the file's name, one per sort of oddity.
    """

    maps: tuple[LandmarkMap, ...]
    remarks: tuple[str, ...] = ()
    parts: tuple[str, ...] = ()


def remark(found: Sequence[object], what: str, done: str) -> tuple[str, ...]:
    """One sentence on things that are wrong in the same way, the first `NAMED` of them by name; none: no sentence.

    >>> remark(["7", "9"], "edges to nodes that aren't there", "left out")
    ("edges to nodes that aren't there (7, 9): left out",)
    """
    if not found:
        return ()
    names = ", ".join(str(item)[:60] for item in found[:NAMED])
    more = f", and {len(found) - NAMED} more" if len(found) > NAMED else ""
    return (f"{what} ({names}{more}): {done}",)


def counted(count_from_what: Mapping[str, int], done: str) -> tuple[str, ...]:
    """One sentence on how much of each sort was dealt with in the same way.

    >>> counted({"floors": 2, "lifts": 0, "models": 30}, "left out")
    ('2 floors, 30 models: left out',)
    """
    present = [f"{count} {what}" for what, count in count_from_what.items() if count]
    return (f"{', '.join(present)}: {done}",) if present else ()
