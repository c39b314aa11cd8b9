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

import numpy as np
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


def _costs(repeat: int, *commands: tuple[str, ...]) -> list[Cost]:
    """Of each command; they take turns, so that a slow moment of the machine meets them all."""
    walls, processors = np.empty((2, repeat, len(commands)))
    for turn in range(repeat):
        for i, command in enumerate(commands):
            before, begin = _children_seconds(), time.perf_counter()
            subprocess.run(command, check=True, capture_output=True, env=_ONE_THREAD)
            walls[turn, i] = time.perf_counter() - begin
            processors[turn, i] = _children_seconds() - before
    return [Cost(*best) for best in zip(walls.min(axis=0), processors.min(axis=0), strict=True)]


def metrics(repeat: int) -> list[Metric]:
    """``mapfuse --help`` and ``mapfuse fuse`` on two maps of some 20 landmarks.

    The promises are wall times, 0.3 s and 3 s. Those are printed, for slow and busy machines break them whatever the
    code does; what is judged is processor time against that of an interpreter that loads a library: for the help numpy,
    in 0.15 s on the machine that was promised for, and for a fusion all that it computes with. Even these ratios vary
    by half on a busy machine, hence limits and no tolerances.
    """
    load = (sys.executable, "-c")
    maps = [str(recordings.path(name)) for name in recordings.SCENES["ground-floor"]]
    numpy, help_ = _costs(2 * repeat, (*load, "import numpy"), (_MAPFUSE, "--help"))
    with tempfile.TemporaryDirectory() as folder:
        fusion = (_MAPFUSE, "fuse", *maps, "-o", str(Path(folder) / "out.fused.json"))
        libraries, fuse = _costs(repeat, (*load, "import numpy, scipy.optimize, numba, gtsam"), fusion)
    return [
        Metric("mapfuse --help: wall", help_.wall, "s", tolerance=None),
        Metric(
            "mapfuse --help: processor / import numpy",
            help_.processor / numpy.processor,
            "x",
            tolerance=None,
            limit=2.0,
        ),
        Metric("mapfuse fuse, two small maps: wall", fuse.wall, "s", tolerance=None),
        Metric(
            "mapfuse fuse, two small maps: processor / import of its libraries",
            fuse.processor / libraries.processor,
            "x",
            tolerance=None,
            limit=4.0,
        ),
    ]
