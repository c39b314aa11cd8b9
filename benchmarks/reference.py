"""A fixed workload that times are divided by, so that a baseline of one machine holds on another."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

#: What `work` takes [ms] on the machine that times were promised for; slower and busier ones take longer for both.
NOMINAL_MS = 18.0


def work() -> float:
    """Some 20 ms of what the matchers do: interpreted Python, and arithmetic over all pairs and their arms.

    Arrays of this size live in the caches, whose speed differs between machines more than that of plain algebra does.
    """
    rng = np.random.default_rng(0)
    total = float(sum(k * k % 7 for k in range(30_000)))
    angles = rng.normal(size=(100, 100, 16))
    for _ in range(4):
        off = np.abs(angles - 0.1 * angles[:, :1])
        total += float((off < 1.0).sum()) + float(np.cos(off).sum())
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


def processor_seconds(repeat: int) -> float:
    """Best processor time [s] of ``repeat`` runs of `work`: on a busy machine wall times hold the others' work."""
    work()
    times = []
    for _ in range(repeat):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return min(times)
