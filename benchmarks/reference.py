"""A fixed workload that times are divided by, so that a baseline of one machine holds on another."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np


def work() -> float:
    """Some 20 ms of what the library does: interpreted Python, small dense algebra, sorting."""
    rng = np.random.default_rng(0)
    total = sum(k * k % 7 for k in range(60_000))
    for _ in range(4):
        matrix = rng.normal(size=(120, 120))
        total += float(np.linalg.slogdet(matrix @ matrix.T + np.eye(120))[1])
        total += float(np.sort(rng.normal(size=60_000))[::7].sum())
    return total


def best_seconds(run: Callable[[], object], repeat: int, *, warm: bool = True) -> float:
    """Best wall time [s] of ``repeat`` runs, after one that isn't counted."""
    if warm:
        run()
    times = []
    for _ in range(repeat):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return min(times)
