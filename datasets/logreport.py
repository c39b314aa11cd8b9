"""What reading a log came upon."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

#: Reports that are kept word for word; all are counted.
MAX_KEPT = 1000


@dataclass(frozen=True, slots=True)
class Remark:
    """One thing that reading a log came upon: the ``line`` (from 1), which ``kind`` of thing, and a sentence."""

    line: int
    kind: str
    reason: str

    def __str__(self) -> str:
        return f"line {self.line}: {self.reason}"


@dataclass(slots=True)
class LogReport:
    """What reading a log came upon, filled while its events are read: the first `MAX_KEPT` remarks, the first one of
    each kind in any case, and all counted.

    Kinds: ``invalid`` (no event; left out), ``cut off`` (the last line or the compressed file; left out), ``unknown``
    (kind of event; left out), ``too long`` (left out), ``stray`` (its time fits nothing; left out), ``late`` (put in
    its place), ``pause``, ``clock`` (set back; later times moved on), ``no odometry yet`` (a detection that comes
    first; kept).
    """

    remarks: list[Remark] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)

    @property
    def left_out(self) -> int:
        """Number of lines that were left out."""
        return sum(self.counts[kind] for kind in ("invalid", "cut off", "unknown", "too long", "stray"))

    def __str__(self) -> str:
        if not self.counts:
            return "nothing to report"
        first = {remark.kind: remark.line for remark in reversed(self.remarks)}
        counted = [f"{number:,} {kind}" for kind, number in self.counts.items()]
        if len(counted) > 1:
            places = (f"{'line' if n == 1 else 'from line'} {first[kind]:,}" for kind, n in self.counts.items())
            counted = [f"{what} ({place})" for what, place in zip(counted, places, strict=True)]
        lines = "1 line" if self.left_out == 1 else f"{self.left_out:,} lines"
        return f"{', '.join(counted)}; {lines} left out; first, {self.remarks[0]}"
