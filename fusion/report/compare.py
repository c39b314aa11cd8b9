"""The page of a comparison: what came out in a sentence, the tables, and pictures where there are some."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mapfuse.datasets.files import write_whole

from ..compare.sheets import Sheet
from .document import document
from .plain import text


def compare_report(
    title: str,
    sentence: str,
    sheets: Sequence[Sheet],
    path: str | Path | None = None,
    *,
    facts: Sequence[Sequence[str]] = (),
    pictures: Mapping[str, bytes] | None = None,
) -> str:
    """The page as HTML, written whole to ``path`` where one is given.

    Tables are sorted by a click on a head and filtered by a word. ``pictures``: title -> PNG, which goes into the file.
    Names are shown as text. Raises `OutputError` where the file can't be written, which then isn't there in part.

    >>> page = compare_report("D1 to D19", "26 pairs.", [Sheet("Pairs", ("map",), (("<b>",),))])
    >>> "26 pairs." in page, "<b>" in page
    (True, False)
    """
    data: dict[str, Any] = {
        "kind": "compare",
        "sheets": [
            {
                "title": sheet.title,
                "note": sheet.note,
                "heads": list(sheet.heads),
                "rows": [[text(cell) for cell in row] for row in sheet.rows],
            }
            for sheet in sheets
        ],
        "pictures": [
            {"title": name, "src": f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"}
            for name, png in (pictures or {}).items()
        ],
    }
    answer = {"word": "compare", "sentence": sentence, "detail": ""}
    page = document(text(title), answer, facts, data)
    if path is not None:
        write_whole(path, page.encode("utf-8"))
    return page
