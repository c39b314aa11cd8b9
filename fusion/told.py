"""Long work told step by step to the log, from which the command line makes its progress bar."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from typing import TypeVar

Item = TypeVar("Item")
log = logging.getLogger(__name__)


def told(items: Sequence[Item], what: str) -> Iterator[Item]:
    """The same items; after each one the log is told (level INFO) how many of them are done.

    The record's ``done``, ``total`` and ``what`` say the same to programs.

    >>> list(told(("a", "b"), "letters"))
    ['a', 'b']
    """
    for done, item in enumerate(items, start=1):
        yield item
        about = {"done": done, "total": len(items), "what": what}
        log.info("%d of %d %s", done, len(items), what, extra=about)
