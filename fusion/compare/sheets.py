"""`Sheet`: a table in words, for the terminal and the page; the numbers themselves are in `table`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ..show.words import percent
from .evaluation import Evaluation
from .methods import HEURISTIC, OPTIMISED
from .paper import PaperRow
from .statistics import Interval, MethodSummary, PairedTest

NONE = "-"
DECISION_WORDS = {"merged": "merged", "ambiguous": "ambiguous", "no_overlap": "no overlap"}


@dataclass(frozen=True, slots=True)
class Sheet:
    """Rows of text below heads, with a title and what has to be known to read them.

    What stands before a head's comma is said of several columns.
    """

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def text(self) -> str:
        """The table as aligned text.

        >>> print(Sheet("Tubes", ("set", "rms"), (("2", "0.07"), ("all", "-"))).text())
        Tubes
        set   rms
        ---  ----
          2  0.07
        all     -
        """
        split = [head.rpartition(", ")[::2] for head in self.heads]
        heads = [line for line in zip(*split, strict=True) if any(line)]
        lines = [*heads, *self.rows]
        widths = [max(len(line[k]) for line in lines) for k in range(len(self.heads))]
        lines.insert(len(heads), tuple("-" * width for width in widths))
        shown = ["  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines]
        return "\n".join([self.title, *shown, *([self.note] if self.note else [])])


PAIR_HEADS = (
    "map 1", "map 2", "method", "candidates", "selected", "matches", "right", "alarms gone", "T12 off", "rms [m]",
    "aligned [m]", "decision", "probability", "chi2 / dof", "gained", "lost", "s",
)  # fmt: skip


def pair_sheet(evaluations: Iterable[Evaluation], title: str = "Pairs") -> Sheet:
    """One row per pair and method."""
    note = (
        "right: share of the matches that are true. alarms gone: false alarms that the other robot passed and that the"
        " merge doesn't keep, of how many. T12 off, rms: against the truth, in the frame of map 1; aligned: rms after"
        " the best rigid motion. gained, lost: matches against the first method's."
    )
    return Sheet(title, PAIR_HEADS, tuple(_pair_row(e) for e in evaluations), note)


def _pair_row(e: Evaluation) -> tuple[str, ...]:
    head = (*e.maps, e.method, str(e.candidates), str(e.selected))
    if e.merge is None:
        return (*head, *([NONE] * 6), f"failed: {e.error}", *([NONE] * 5))
    t, m = e.truth, e.merge
    alarms = NONE if t is None or t.eliminated is None else f"{t.eliminated} of {t.passed_alarms}"
    off = NONE
    if t is not None and t.error_m is not None and t.error_rad is not None:
        off = f"{t.error_m:.2f} m, {np.degrees(t.error_rad):.1f}°"
    chi2 = NONE if m.chi2 is None or m.dof is None else f"{m.chi2:.1f} / {m.dof:.1f}"
    return (
        *head,
        str(e.count),
        share(e.correctness),
        alarms,
        off,
        metres(None if t is None else t.rms),
        metres(None if t is None else t.rms_aligned),
        DECISION_WORDS[m.decision] + (" (wrong)" if e.merged_wrongly else ""),
        NONE if m.probability is None else percent(m.probability),
        chi2,
        number(e.gained),
        number(e.lost),
        NONE if e.seconds is None else f"{e.seconds:.2f}",
    )


SUMMARY_HEADS = (
    "method", "pairs", "failed", "merged", "wrong", "right matches", "alarms gone", "T12 off [m]", "T12 off [deg]",
    "rms [m]", "aligned [m]", "s",
)  # fmt: skip


def summary_sheet(found: Sequence[MethodSummary], title: str = "Summary") -> Sheet:
    """One row per method, with 95 % intervals."""
    rows = tuple(
        (
            s.method,
            str(s.pairs),
            str(s.failed),
            str(s.merged),
            number(s.wrong),
            bounds(s.correctness, 100, 1, " %"),
            bounds(s.eliminated, 100, 1, " %"),
            bounds(s.error_m),
            bounds(s.error_rad, float(np.degrees(1.0))),
            bounds(s.rms),
            bounds(s.rms_aligned),
            bounds(s.seconds),
        )
        for s in found
    )
    note = "Means of shares, medians of all else, over pairs; in brackets 95 % by bootstrap over pairs."
    return Sheet(title, SUMMARY_HEADS, rows, note)


def paired_sheet(tests: Sequence[PairedTest], title: str = "Paired tests") -> Sheet:
    """One row per comparison of two methods on the same pairs."""
    rows = tuple(
        (t.metric, f"{t.second} by {t.first}", str(t.n), bounds(t.ratio), NONE if t.p is None else f"{t.p:.2g}")
        for t in tests
    )
    note = (
        "Ratio: median over the pairs that both merged, below 1 where the first-named is better. p: Wilcoxon's"
        " signed-rank test; of right merges the exact sign test."
    )
    return Sheet(title, ("metric", "methods", "pairs", "ratio", "p"), rows, note)


PAPER_TITLE = "Table 1 of Dedeoglu and Sukhatme (2000), the paper's maps and our reconstruction of them"
PAPER_HEADS = (
    "maps", "direction", "candidates, paper", "candidates, ours", "selected, paper", "selected, ours", "right %, paper",
    "right %, heuristic", "right %, optimised", "alarms gone %, paper", "alarms gone %, heuristic",
    "alarms gone %, optimised", "places lost, heuristic", "places lost, optimised", "rms [m], heuristic",
    "rms [m], optimised", "optimised, says", "optimised, probability", "optimised, placement",
)  # fmt: skip


def paper_sheet(rows: Sequence[PaperRow]) -> Sheet:
    """The paper's table with its figures beside ours; the last line holds means over the rows that have a value."""
    note = (
        "The maps of the paper are lost: ours are simulated, a reconstruction with the same sizes and directions."
        " alarms gone: of the false alarms that the other robot passed; places lost: landmarks that are there and that"
        " the merge doesn't keep. rms: after the best rigid motion. Rows with * have a map of fewer than"
        " 6 landmarks. Both maps are told to be of one floor (overlap prior 0.99)."
    )
    return Sheet(PAPER_TITLE, PAPER_HEADS, (*(_paper_row(row) for row in rows), _paper_means(rows)), note)


def _paper_row(row: PaperRow) -> tuple[str, ...]:
    p, h, o = row.paper, row.ours[HEURISTIC], row.ours[OPTIMISED]
    probability = None if o.merge is None else o.merge.probability
    return (
        p.label + ("" if row.large else " *"),
        p.relation,
        str(p.candidates),
        str(h.candidates),
        str(p.selected),
        str(h.selected),
        str(p.correctness),
        _percent(h.correctness),
        _percent(o.correctness),
        number(p.eliminated),
        _percent(h.eliminated_share),
        _percent(o.eliminated_share),
        number(None if h.truth is None else h.truth.lost_places),
        number(None if o.truth is None else o.truth.lost_places),
        metres(None if h.truth is None else h.truth.rms_aligned),
        metres(None if o.truth is None else o.truth.rms_aligned),
        NONE if o.decision is None else DECISION_WORDS[o.decision] + (" (wrong)" if o.merged_wrongly else ""),
        NONE if probability is None else percent(probability),
        {True: "right", False: "wrong", None: NONE}[o.best_is_right],
    )


def _paper_means(rows: Sequence[PaperRow]) -> tuple[str, ...]:
    ours = {name: [row.ours[name] for row in rows] for name in (HEURISTIC, OPTIMISED)}
    merged = sum(e.decision == "merged" for e in ours[OPTIMISED])
    return (
        "mean",
        "",
        *(["", ""]),
        f"{_mean(100 * r.paper.selected_share for r in rows)} %",
        f"{_mean(100 * r.ours[HEURISTIC].selected / r.ours[HEURISTIC].candidates for r in rows)} %",
        _mean(r.paper.correctness for r in rows),
        *(_mean(None if (c := e.correctness) is None else 100 * c for e in found) for found in ours.values()),
        _mean(r.paper.eliminated for r in rows),
        *(_mean(None if (c := e.eliminated_share) is None else 100 * c for e in found) for found in ours.values()),
        *(_mean((None if e.truth is None else e.truth.lost_places for e in found), 2) for found in ours.values()),
        *(_mean((None if e.truth is None else e.truth.rms_aligned for e in found), 2) for found in ours.values()),
        f"{merged} of {len(rows)} merged",
        "",
        "",
    )


def _mean(values: Iterable[float | None], digits: int = 1) -> str:
    known = [value for value in values if value is not None]
    return f"{np.mean(known):.{digits}f}" if known else NONE


def _percent(value: float | None) -> str:
    return NONE if value is None else f"{100 * value:.0f}"


def share(value: float | None) -> str:
    """A share in percent."""
    return NONE if value is None else f"{100 * value:.0f} %"


def metres(value: float | None) -> str:
    """A length to the centimetre."""
    return NONE if value is None else f"{value:.2f}"


def number(value: int | None) -> str:
    """A count, or a dash where there is none."""
    return NONE if value is None else str(value)


def bounds(found: Interval | None, scale: float = 1.0, digits: int = 2, unit: str = "") -> str:
    """A value with its interval.

    >>> bounds(Interval(0.5, 0.25, 0.75, 9), 100, 0, " %")
    '50 % (25 to 75)'
    """
    if found is None:
        return NONE
    low, value, high = (f"{scale * x:.{digits}f}" for x in (found.low, found.value, found.high))
    return f"{value}{unit} ({low} to {high})"
