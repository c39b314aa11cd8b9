"""``mapfuse formats``: what maps may come in and go out as."""

from __future__ import annotations

import textwrap

from .console import say

_WIDTH = 100


def formats() -> None:
    """List the formats that maps are read from and written to, and what each one can't hold."""
    from mapfuse.datasets.formats import formats as all_formats

    for one in all_formats():
        does = " and ".join(word for word, can in (("read", one.reads), ("written", one.writes)) if can)
        needs = f"; needs mapfuse[{one.extra}]" if one.extra else ""
        say(f"{one.name}: {one.title} ({', '.join(one.suffixes)}), {does}{needs}")
        if one.writes and one.lost:
            _indented(f"lost in writing: {', '.join(one.lost)}")
        for key, meaning in one.options.items():
            _indented(f"--set {key}=...: {meaning}")
    say("")
    say("--set also takes the fields of a map's noise (detection_rate, position_sigma, ...) for all formats but map.")
    say("FILE#PART names one of several maps in a file.")


def _indented(text: str) -> None:
    say(textwrap.fill(text, _WIDTH, initial_indent="    ", subsequent_indent="    "))
