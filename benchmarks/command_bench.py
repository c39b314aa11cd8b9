"""Wall times of the command line, imports included."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from baseline import Metric
from reference import best_seconds

from mapfuse.datasets import recordings

_MAPFUSE = str(Path(sys.executable).with_name("mapfuse"))


def _run(*arguments: str) -> None:
    subprocess.run([_MAPFUSE, *arguments], check=True, stdout=subprocess.DEVNULL)


def metrics(repeat: int) -> list[Metric]:
    """``mapfuse --help`` and ``mapfuse fuse`` on two maps of some 20 landmarks, each against an idle interpreter."""
    idle = best_seconds(lambda: subprocess.run([sys.executable, "-c", "pass"], check=True), repeat)
    help_ = best_seconds(lambda: _run("--help"), repeat)
    maps = [str(recordings.path(name)) for name in recordings.SCENES["ground-floor"]]
    with tempfile.TemporaryDirectory() as folder:
        out = str(Path(folder) / "out.fused.json")
        fuse = best_seconds(lambda: _run("fuse", *maps, "-o", out), max(1, repeat // 2))
    return [
        Metric("mapfuse --help", help_, "s", tolerance=None, limit=0.3),
        Metric("mapfuse --help / python", help_ / idle, "x", tolerance=0.5),
        Metric("mapfuse fuse, two maps of 20", fuse, "s", tolerance=None, limit=3.0),
        Metric("mapfuse fuse, two maps of 20 / python", fuse / idle, "x", tolerance=0.5),
    ]
