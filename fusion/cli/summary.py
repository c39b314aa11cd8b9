"""A result in words: what was decided, how sure it is, where the maps lie, and why."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

import numpy as np

from mapfuse.datasets.transform import Transform
from mapfuse.fusion.result import FusedMap, PairResult
from mapfuse.fusion.show.words import percent

#: Rivals beyond these, or less probable than this, are counted, not listed.
_LISTED, _WORTH_LISTING = 8, 1e-4
_WIDTH = 100


def summarise(fused: FusedMap) -> str:
    """The whole answer as text of some ten lines."""
    several = len(fused.pairs) != 1
    head = f"{fused.decision.replace('_', ' ')}, {percent(fused.probability)}" if several else _headline(fused.pairs[0])
    pairs = (_pair(pair, named=several) for pair in fused.pairs)
    return "\n".join([head, *pairs, *_noise(fused), _counts(fused)])


def _headline(pair: PairResult) -> str:
    if pair.decision == "merged":
        return f"merged: {percent(pair.probability)} that this is right"
    if pair.decision == "no_overlap":
        return f"no overlap: {percent(pair.no_overlap_probability)}, nothing was merged"
    best = f"the likeliest of {len(pair.hypotheses)} placements has {percent(pair.probability)}"
    return f"ambiguous: {best}, nothing was merged"


def _pair(pair: PairResult, *, named: bool) -> str:
    first, second = pair.maps
    lines = [f"{first} and {second}, {_headline(pair)}"] if named else []
    T12 = pair.T12
    if T12 is not None and pair.decision == "merged":
        lines += [f"  T12, which takes coordinates of {second} into {first}:", *_transform(T12)]
        if pair.mixture_covariance is not None:
            sigmas = np.sqrt(np.diag(pair.mixture_covariance))
            spread = f"{sigmas[0]:.3f} m, {sigmas[1]:.3f} m, {math.degrees(sigmas[2]):.2f} deg"
            lines.append(f"  ± with the spread over all hypotheses added: {spread}")
        count = len(pair.correspondences)
        lines.append(f"  {count} common landmark{'s' if count != 1 else ''}")
    elif pair.hypotheses:
        lines += _rivals(pair)
    lines.append(f"  no overlap: {percent(pair.no_overlap_probability)}")
    lines += textwrap.wrap(f"reason: {pair.reason}", _WIDTH, initial_indent="  ", subsequent_indent="    ")
    if pair.overruled_by is not None:
        lines.append(f"  overruled by the cycle {', '.join(pair.overruled_by)}")
    return "\n".join(lines)


def _transform(T: Transform) -> list[str]:
    if T.covariance is None:
        return [f"    x {T.x:.3f} m, y {T.y:.3f} m, theta {math.degrees(T.theta):.2f} deg, uncertainty unknown"]
    x, y, theta = np.sqrt(np.diag(T.covariance))
    return [
        f"    x     {T.x:9.3f} ± {x:.3f} m",
        f"    y     {T.y:9.3f} ± {y:.3f} m",
        f"    theta {math.degrees(T.theta):9.2f} ± {math.degrees(theta):.2f} deg",
    ]


def _rivals(pair: PairResult) -> list[str]:
    listed = [k for k, h in enumerate(pair.hypotheses[:_LISTED]) if k == 0 or h.probability >= _WORTH_LISTING]
    rows = [
        (
            f"{k + 1}",
            percent(h.probability),
            f"{h.T12.x:.2f}",
            f"{h.T12.y:.2f}",
            f"{math.degrees(h.T12.theta):.1f}",
            f"{h.count}",
            f"{h.log_evidence:.1f}",
        )
        for k, h in ((k, pair.hypotheses[k]) for k in listed)
    ]
    head = ("", "probability", "x [m]", "y [m]", "theta [deg]", "matches", "log evidence")
    lines = [f"  possible T12 ({pair.maps[1]} into {pair.maps[0]}):", *table((head, *rows), indent="    ")]
    rest = [h for k, h in enumerate(pair.hypotheses) if k not in listed]
    if rest:
        lines.append(f"    and {len(rest)} more, together {percent(sum(h.probability for h in rest))}")
    return lines


def table(rows: Sequence[Sequence[str]], indent: str = "") -> list[str]:
    """Rows of texts as lines with right-aligned columns.

    >>> table([("", "n"), ("a", "10")])
    ['    n', 'a  10']
    """
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return [indent + "  ".join(cell.rjust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]


def _noise(fused: FusedMap) -> list[str]:
    """Maps whose stated noise can't be true, and by how much it is off."""
    lines = []
    for name, fit in fused.noise.items():
        if not fit.can_be_true:
            low, high = fit.interval
            by = f"{fit.scale:.2f} times ({low:.2f} to {high:.2f}) what it states"
            used = "; that was used" if fit.used != 1 else "; see solving.estimate_noise"
            lines.append(f"  the noise of {name} is not as stated: its residuals are {by}{used}")
    return lines


def _counts(fused: FusedMap) -> str:
    doubtful = sum(landmark.existence < 0.5 for landmark in fused.landmarks)
    where = "the merged map" if len(fused.groups) == 1 else f"{len(fused.groups)} separate frames"
    return f"  {len(fused.landmarks)} landmarks in {where}, {doubtful} of them doubtful (existence below 50 %)"
