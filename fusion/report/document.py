"""A page as one file: head, data, styles and scripts, which the file's own policy allows and nothing else."""

from __future__ import annotations

import base64
import hashlib
import html
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

from mapfuse.datasets.jsondata import encode

#: In the order in which they are run; each uses only what stands before it.
SCRIPTS = ("base.js", "view.js", "uncertainty.js", "fused.js", "single.js", "batch.js", "compare.js", "start.js")


def document(
    title: str,
    answer: Mapping[str, str],
    facts: Iterable[Sequence[str]],
    data: Mapping[str, Any],
    *,
    made_by: str = "",
    parts: Mapping[str, Any] | None = None,
) -> str:
    """The page's HTML. ``title``, ``answer`` and ``facts`` stand in it as text, so that they are read without scripts.

    ``data`` goes to the script; ``parts``: id -> what the script reads only when it is wanted.
    """
    style, script = _asset("page.css"), _script()
    policy = (
        f"default-src 'none'; style-src {_hashed(style)}; script-src {_hashed(script)}; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )
    rows = "".join(f"<dt><bdi>{html.escape(a)}</bdi></dt><dd><bdi>{html.escape(b)}</bdi></dd>" for a, b in facts)
    blocks = [_block(name, value) for name, value in (("data", data), *(parts or {}).items())]
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<link rel="icon" href="data:,">',
            f"<title>{html.escape(title)}</title>",
            f"<style>{style}</style>",
            "</head>",
            "<body>",
            f"<header><h1><bdi>{html.escape(title)}</bdi></h1>",
            _verdict(answer),
            f'<dl class="facts">{rows}</dl></header>',
            "<main></main>",
            "<noscript><p>The pictures of this page need JavaScript; it loads nothing from anywhere.</p></noscript>",
            f"<footer>Metres and degrees; ± and σ are one standard deviation. {html.escape(made_by)}</footer>",
            *blocks,
            f"<script>{script}</script>",
            "</body>",
            "</html>",
            "",
        ]
    )


def _verdict(answer: Mapping[str, str]) -> str:
    word, sentence, detail = (html.escape(answer[key]) for key in ("word", "sentence", "detail"))
    kind = html.escape(answer["word"].replace(" ", "_"))
    sure = f'<span class="sure">{detail[:1].upper() + detail[1:]}.</span>' if detail else ""
    return f'<p class="verdict {kind}" id="verdict"><strong>{word}</strong> <span>{sentence}</span> {sure}</p>'


def _block(name: str, value: Any) -> str:
    """Data for the script, which no text in it can end: all that could begin a tag is escaped within the JSON."""
    plain = encode(value).decode("utf-8")
    for character in "<>&\u2028\u2029":
        plain = plain.replace(character, f"\\u{ord(character):04x}")
    return f'<script type="application/json" id="{html.escape(name)}">{plain}</script>'


@cache
def _asset(name: str) -> str:
    return (files("mapfuse.fusion.report") / "assets" / name).read_text(encoding="utf-8")


@cache
def _script() -> str:
    """All scripts as one, in a scope of its own."""
    return '"use strict";\n(() => {\n' + "\n".join(_asset(name) for name in SCRIPTS) + "})();\n"


def _hashed(content: str) -> str:
    digest = hashlib.sha256(content.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"
