"""`Hypothesis`: one proposed T12 with what speaks for it; the value that flows on to factors and fusion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.transform import Transform

IdPair = tuple[str, str]


class Correspondences(Sequence[IdPair]):
    """Pairs (id in map 1, id in map 2), in the order of map 2's landmarks, made when they are looked at.

    A hypothesis of large maps has tens of thousands; most are never asked for. Equals a tuple of the same pairs.

    Parameters
    ----------
    ids1, ids2
        Ids of all landmarks of both maps.
    partner
        Of each landmark of map 2 the place of its partner in map 1, or -1; (n2,).
    count
        How many have one.

    >>> pairs = Correspondences(("a", "b"), ("x", "y", "z"), np.array([1, -1, 0]), 2)
    >>> len(pairs), pairs[0], pairs == (("b", "x"), ("a", "z"))
    (2, ('b', 'x'), True)
    """

    __slots__ = ("_count", "_ids1", "_ids2", "_partner")

    def __init__(self, ids1: Sequence[str], ids2: Sequence[str], partner: NDArray[np.integer[Any]], count: int) -> None:
        self._ids1, self._ids2, self._partner, self._count = ids1, ids2, partner, count

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, k: int) -> IdPair: ...
    @overload
    def __getitem__(self, k: slice) -> tuple[IdPair, ...]: ...
    def __getitem__(self, k: int | slice) -> IdPair | tuple[IdPair, ...]:
        return tuple(self)[k]

    def __iter__(self) -> Iterator[IdPair]:
        ids1, ids2 = self._ids1, self._ids2
        return ((ids1[i], ids2[j]) for j, i in enumerate(self._partner.tolist()) if i >= 0)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Correspondences | tuple):
            return NotImplemented
        return len(self) == len(other) and tuple(self) == tuple(other)

    def __hash__(self) -> int:
        return hash(tuple(self))

    def __repr__(self) -> str:
        return repr(tuple(self))

    def __reduce__(self) -> tuple[Any, ...]:
        return tuple, (tuple(self),)


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A proposed transformation of map 2 into map 1 (``p1 = T12 p2``).

    ``count``: one-to-one matching landmarks under ``T12``. ``correspondences``: their (id in map 1, id in map 2).
    ``seed``: the landmark pairs that proposed it, or the surest of its matches. ``score``: what hypotheses are ranked
    by: the count in paper mode, else log odds [nats]. ``explanation``: why it was proposed, where that was asked for.
    """

    T12: Transform
    count: int
    correspondences: Sequence[IdPair] = ()
    seed: tuple[IdPair, ...] = ()
    score: float = field(default=0.0)
    explanation: str = field(default="", compare=False)
