"""What a notebook shows of a result and of a pair: the answer in words, the picture, and the rivals."""

from __future__ import annotations

import base64
import io
from html import escape

from mapfuse.datasets.notebook import table

from ..result import FusedMap, PairResult
from ..show.words import percent, transform_text
from .verdict import answer, facts

#: Rivals beyond these are counted, not listed.
LISTED = 6


def fused_html(fused: FusedMap) -> str:
    """A result in a notebook: the answer, its numbers, and the page as a picture."""
    said = answer(fused)
    head = f"<p><strong>{escape(said['word'])}</strong>: {escape(said['sentence'])} {escape(said['detail'])}</p>"
    return head + table(facts(fused)) + _picture(fused)


def _picture(fused: FusedMap) -> str:
    from ..show import draw_fused

    buffer = io.BytesIO()
    draw_fused(fused, dpi=90).savefig(buffer, format="png")
    encoded = base64.b64encode(buffer.getvalue()).decode("ascii")
    return (
        f'<img style="max-width: 100%" alt="the maps and what was made of them" src="data:image/png;base64,{encoded}">'
    )


def pair_html(pair: PairResult) -> str:
    """A pair in a notebook: every placement with its probability, and the reason.

    >>> "share nothing" in pair_html(PairResult(("A", "B"), "no_overlap", 0.0, 1.0, (), (), "they share nothing"))
    True
    """
    rows = [
        (str(k), percent(h.probability), str(h.count), f"{h.log_evidence:+.1f}", transform_text(h.T12))
        for k, h in enumerate(pair.hypotheses[:LISTED], start=1)
    ]
    rows.append(("", percent(pair.no_overlap_probability), "", "", "no overlap"))
    more = len(pair.hypotheses) - LISTED
    title = f"{pair.maps[0]} and {pair.maps[1]}: {pair.decision.replace('_', ' ')}"
    rest = f"<p>and {more} less probable placements</p>" if more > 0 else ""
    listed = table(rows, ("", "probability", "matches", "nats", "T12"))
    return table([(title,)]) + listed + rest + table([(pair.reason,)])
