"""Times of the command line, imports included."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from baseline import Metric

from mapfuse.datasets import recordings

# idle threads of a linear algebra library spin, and count as processor time
_ONE_THREAD = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
_MAPFUSE = str(Path(sys.executable).with_name("mapfuse"))


@dataclass(frozen=True, slots=True)
class Cost:
    """Best wall time [s] and best processor time [s] of several runs."""

    wall: float
    processor: float


def _children_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _cost(repeat: int, *command: str) -> Cost:
    walls, processors = [], []
    for _ in range(repeat):
        before, begin = _children_seconds(), time.perf_counter()
        subprocess.run(command, check=True, capture_output=True, env=_ONE_THREAD)
        walls.append(time.perf_counter() - begin)
        processors.append(_children_seconds() - before)
    return Cost(min(walls), min(processors))


def metrics(repeat: int) -> list[Metric]:
    """``mapfuse --help`` and ``mapfuse fuse`` on two maps of some 20 landmarks.

    The promise is about wall time; what is compared with the baseline is processor time against that of an
    interpreter that loads numpy, which other load on the machine disturbs less.
    """
    reference = _cost(repeat, sys.executable, "-c", "import numpy")
    help_ = _cost(2 * repeat, _MAPFUSE, "--help")
    maps = [str(recordings.path(name)) for name in recordings.SCENES["ground-floor"]]
    with tempfile.TemporaryDirectory() as folder:
        fuse = _cost(repeat, _MAPFUSE, "fuse", *maps, "-o", str(Path(folder) / "out.fused.json"))
    return [
        Metric("mapfuse --help: wall", help_.wall, "s", tolerance=None, limit=0.3),
        Metric("mapfuse --help: processor / import numpy", help_.processor / reference.processor, "x", tolerance=0.5),
        Metric("mapfuse fuse, two small maps: wall", fuse.wall, "s", tolerance=None, limit=3.0),
        Metric(
            "mapfuse fuse, two small maps: processor / import numpy",
            fuse.processor / reference.processor,
            "x",
            tolerance=0.5,
        ),
    ]
