"""`Hypothesis`: one proposed T12 with what speaks for it; the value that flows on to factors and fusion."""

from __future__ import annotations

from dataclasses import dataclass, field

from mapfuse.datasets.transform import Transform


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A proposed transformation of map 2 into map 1 (``p1 = T12 p2``).

    ``count``: one-to-one matching landmarks under ``T12``. ``correspondences``: their (id in map 1, id in map 2).
    ``seed``: the landmark pairs that proposed it. ``score``: what hypotheses are ranked by (the count in paper mode).
    """

    T12: Transform
    count: int
    correspondences: tuple[tuple[str, str], ...] = ()
    seed: tuple[tuple[str, str], ...] = ()
    score: float = field(default=0.0)
