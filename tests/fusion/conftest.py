"""What the tests of the command line share."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from mapfuse.fusion.cli import main

Command = Callable[..., int]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Command:
    """The command in this process; gives its exit code, lets a bug's exception through."""

    def call(*arguments: str | Path) -> int:
        monkeypatch.setattr(sys, "argv", ["mapfuse", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            main()
        return int(left.value.code or 0)

    return call
