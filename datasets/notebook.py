"""What a notebook shows of a map: its numbers in a table and its landmarks as dots, in plain HTML."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .maps import LandmarkMap

#: Side [pixels] of the picture, and the most dots in it.
SIDE, MOST_DOTS = 240, 2000


def table(rows: Iterable[Sequence[str]], heads: Sequence[str] = ()) -> str:
    """Rows of texts as an HTML table; nothing in them is markup, and very long ones are cut.

    >>> table([("a", "<b>")])
    '<table><tr><td><bdi>a</bdi></td><td><bdi>&lt;b&gt;</bdi></td></tr></table>'
    """
    head = "<tr>" + "".join(f"<th>{escape(text)}</th>" for text in heads) + "</tr>" if heads else ""
    body = "".join(
        "<tr>" + "".join(f"<td><bdi>{escape(_shown(text))}</bdi></td>" for text in row) + "</tr>" for row in rows
    )
    return f"<table>{head}{body}</table>"


def _shown(text: str) -> str:
    text = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
    return text if len(text) <= 500 else f"{text[:499]}…"


def map_html(map_: LandmarkMap) -> str:
    """A map in a notebook.

    >>> from mapfuse.datasets.maps import Landmark, LandmarkMap
    >>> "1 corner" in map_html(LandmarkMap("D1", (Landmark("c1", "corner", 0.0, 0.0),)))
    True
    """
    kinds = ", ".join(f"{n} {name}" for name, n in sorted(Counter(map_.types).items(), key=lambda kn: (-kn[1], kn[0])))
    rows = [("map", map_.name), ("landmarks", kinds or "none")]
    if map_.robot:
        rows.insert(1, ("robot", map_.robot))
    if len(map_):
        across, up = np.ptp(map_.positions, axis=0)
        rows.append(("extent", f"{across:.1f} m x {up:.1f} m"))
    if map_.extra.get("simulated"):
        rows.append(("data", "simulated"))
    return table(rows) + _dots(map_)


def _dots(map_: LandmarkMap) -> str:
    """The landmarks where they lie, y upwards."""
    at = map_.positions[:MOST_DOTS]
    if not len(at):
        return ""
    low = at.min(axis=0)
    scale = (SIDE - 16) / max(float(np.ptp(at, axis=0).max()), 1e-9)
    x, y = (8 + (at - low) * scale).T
    circles = "".join(f'<circle cx="{a:.1f}" cy="{SIDE - b:.1f}" r="3"/>' for a, b in zip(x, y, strict=True))
    return f'<svg width="{SIDE}" height="{SIDE}" fill="#0072B2" role="img" aria-label="landmarks">{circles}</svg>'
