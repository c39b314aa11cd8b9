"""Groups of a whole folder from its comparisons: part by part, each part chosen, its groups solved by the engine."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapfuse.datasets.transform import Transform

from ..config import FuseConfig
from ..consistent import Choice, choose
from ..members import Emptiness
from ..pairwise import Comparison
from ..placing import Pair
from ..prepared import PreparedMap
from ..settle import MAX_CHOICES


@dataclass(frozen=True, slots=True)
class Solved:
    """A group's graph, solved: what its answer is kept under, what it takes apart, or why there is no answer."""

    names: tuple[str, ...]
    key: str
    broken: tuple[tuple[Pair, int], ...] = ()
    error: str | None = None


#: Solves all groups of several maps of one choice; ``final``: whatever their graphs take apart.
Solve = Callable[[Choice, bool], Sequence[Solved]]


def parts(names: Iterable[str], together: Iterable[Pair]) -> list[tuple[str, ...]]:
    """Names in alphabetical order that pairs hold together, directly or by way of others.

    >>> parts("abcd", [("a", "c")])
    [('a', 'c'), ('b',), ('d',)]
    """
    root = {name: name for name in names}

    def find(name: str) -> str:
        while root[name] != name:
            root[name] = root[root[name]]
            name = root[name]
        return name

    for a, b in together:
        one, other = sorted((find(a), find(b)))
        root[other] = one
    members: dict[str, list[str]] = {}
    for name in sorted(root):
        members.setdefault(find(name), []).append(name)
    return [tuple(found) for _, found in sorted(members.items())]


def settled_part(
    names: Sequence[str],
    comparisons: Mapping[Pair, Comparison],
    prepared: Mapping[str, PreparedMap],
    config: FuseConfig,
    solve: Solve,
) -> tuple[Choice, list[Solved]]:
    """As `mapfuse.fusion.settle.settled`, for one part of a folder: the choice, and its groups of several maps."""
    emptiness = Emptiness(prepared, config.evidence)
    forbidden: frozenset[tuple[Pair, int]] = frozenset()
    for again in range(MAX_CHOICES):
        choice = choose(names, comparisons, config, emptiness.against, forbidden)
        final = again == MAX_CHOICES - 1 or len(comparisons) == 1
        solved = solve(choice, final)
        broken = [item for group in solved for item in group.broken]
        if not broken or final:
            break
        forbidden |= frozenset(broken)
    return choice, list(solved)


def alone(names: Sequence[str]) -> Choice:
    """The choice that merges nothing, of maps that nothing was found between."""
    home = Transform(0.0, 0.0, 0.0, np.zeros((3, 3)))
    groups = tuple((name,) for name in names)
    return Choice(groups, dict.fromkeys(names, home), {}, {}, (1.0,) * len(groups))
