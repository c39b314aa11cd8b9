"""The tables as numbers: one row per pair and method, per row of the paper, per method; for CSV and Parquet."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import fields
from typing import Any

from ..batch.table import COVARIANCE
from .evaluation import AgainstTruth, Evaluation
from .methods import HEURISTIC, OPTIMISED
from .paper import PaperRow
from .statistics import Interval, MethodSummary

_TRUTH = tuple(field.name for field in fields(AgainstTruth))
#: Of one merge; of a pair they follow the maps and the method.
MERGE_COLUMNS = (
    "decision", "probability", "count", "correctness", *_TRUTH, "eliminated_share", "best_is_right", "merged_wrongly",
    "x", "y", "theta", *COVARIANCE, "chi2", "dof", "gained", "lost",
)  # fmt: skip
PAIR_COLUMNS = ("map1", "map2", "method", "candidates", "selected", *MERGE_COLUMNS, "seconds", "error")

_PAPER = (
    "printed", "map1", "map2", "relation", "size1", "size2", "candidates_paper", "candidates", "selected_paper",
    "selected", "correctness_paper", "eliminated_share_paper",
)  # fmt: skip
_PAPER_METHODS = (HEURISTIC, OPTIMISED)
#: Without times, so that the same maps give the same table to the last digit.
PAPER_COLUMNS = (*_PAPER, *(f"{method}_{name}" for method in _PAPER_METHODS for name in MERGE_COLUMNS))

_BOUNDED = ("correctness", "eliminated", "error_m", "error_rad", "rms", "rms_aligned", "seconds")
SUMMARY_COLUMNS = (
    "method", "pairs", "failed", "merged", "wrong",
    *(f"{name}{end}" for name in _BOUNDED for end in ("", "_low", "_high", "_n")),
)  # fmt: skip

_TEXTS = ("map1", "map2", "method", "decision", "error", "printed", "relation")
_COUNTS = (
    "candidates", "selected", "count", "right", "common", "false_alarms", "passed_alarms", "eliminated", "lost_places",
    "gained", "lost", "size1", "size2", "candidates_paper", "selected_paper",
)  # fmt: skip
_FLAGS = ("best_is_right", "merged_wrongly")


def kind_of(column: str) -> str:
    """What a column of the tables of pairs and of the paper holds: ``text``, ``count``, ``flag`` or ``number``.

    >>> kind_of("map1"), kind_of("optimised_count"), kind_of("rms")
    ('text', 'count', 'number')
    """
    for method in _PAPER_METHODS:
        column = column.removeprefix(f"{method}_")
    kinds = {"text": _TEXTS, "count": _COUNTS, "flag": _FLAGS}
    return next((kind for kind, names in kinds.items() if column in names), "number")


def _merge_values(e: Evaluation) -> dict[str, Any]:
    row: dict[str, Any] = dict.fromkeys(MERGE_COLUMNS)
    if e.truth is not None:
        row |= {name: getattr(e.truth, name) for name in _TRUTH}
    row |= {"count": e.count, "correctness": e.correctness, "eliminated_share": e.eliminated_share}
    row |= {"best_is_right": e.best_is_right, "merged_wrongly": e.merged_wrongly, "gained": e.gained, "lost": e.lost}
    if e.merge is not None:
        m = e.merge
        row |= {"decision": m.decision, "probability": m.probability, "chi2": m.chi2, "dof": m.dof}
        if m.T12 is not None:
            row |= {"x": m.T12.x, "y": m.T12.y, "theta": m.T12.theta}
            if m.T12.covariance is not None:
                row |= {name: float(m.T12.covariance[at]) for name, at in COVARIANCE.items()}
    return row


def pair_rows(evaluations: Iterable[Evaluation]) -> list[dict[str, Any]]:
    """Rows of `PAIR_COLUMNS`; lengths in metres, angles in radians, shares from 0 to 1, None where not known."""
    return [
        {
            "map1": e.maps[0],
            "map2": e.maps[1],
            "method": e.method,
            "candidates": e.candidates,
            "selected": e.selected,
            **_merge_values(e),
            "seconds": None if e.seconds is None else round(e.seconds, 4),
            "error": e.error or None,
        }
        for e in evaluations
    ]


def paper_table(rows: Sequence[PaperRow]) -> list[dict[str, Any]]:
    """Rows of `PAPER_COLUMNS`."""
    found = []
    for row in rows:
        first = row.ours[HEURISTIC]
        eliminated = row.paper.eliminated
        values = (
            row.paper.label, *row.paper.pair, row.paper.relation, *row.sizes, row.paper.candidates, first.candidates,
            row.paper.selected, first.selected, row.paper.correctness / 100,
            None if eliminated is None else eliminated / 100,
        )  # fmt: skip
        table = dict(zip(_PAPER, values, strict=True))
        for method in _PAPER_METHODS:
            table |= {f"{method}_{name}": value for name, value in _merge_values(row.ours[method]).items()}
        found.append(table)
    return found


def summary_rows(found: Iterable[MethodSummary]) -> list[dict[str, Any]]:
    """Rows of `SUMMARY_COLUMNS`."""
    rows = []
    for s in found:
        row: dict[str, Any] = {name: getattr(s, name) for name in ("method", "pairs", "failed", "merged", "wrong")}
        for name in _BOUNDED:
            value: Interval | None = getattr(s, name)
            ends = (None,) * 4 if value is None else (value.value, value.low, value.high, value.n)
            row |= {f"{name}{end}": x for end, x in zip(("", "_low", "_high", "_n"), ends, strict=True)}
        rows.append(row)
    return rows
