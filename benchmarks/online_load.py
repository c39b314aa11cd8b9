"""What a landmark event and a correction cost. Part of ``benchmarks/online.py``."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matching_floors import pair_of_maps
from numpy.typing import NDArray

from mapfuse.datasets.datum import JointCovariance
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.values import frozen_array
from mapfuse.fusion.online import Correction, LandmarkSeen, OnlineConfig, OnlineFuser

Array = NDArray[np.float64]
Row = dict[str, Any]


def latency(seed: int, arguments: argparse.Namespace) -> Row:
    """Two maps that grow to 500 landmarks each, landmark by landmark, then are told again as they are with a little
    noise; weighing in a worker process."""
    rng = np.random.default_rng(seed)
    size = 120 if arguments.quick else 500
    pair = pair_of_maps(size, "irregular", rng)
    maps = (pair.map1, pair.map2)
    order = [walked(m) for m in maps]
    fuser = OnlineFuser(OnlineConfig(delay=None), worker=True)
    for m in maps:
        fuser.add_robot(m.name, m.noise)
    events: list[list[float]] = []
    answers = 0
    for k in range((1 + AGAIN) * size):
        for m, row in zip(maps, order, strict=True):
            landmark = m.landmarks[row[k % size]] if k % size < len(row) else None
            if landmark is None:
                continue
            if k >= size:
                landmark = replace(landmark, x=landmark.x + rng.normal(0, 0.02), y=landmark.y + rng.normal(0, 0.02))
            message = LandmarkSeen(robot=m.name, sequence=k, t=0.1 * k, landmark=landmark)
            begin, cpu = time.perf_counter(), time.thread_time()
            fuser.take(message)
            middle, cpu_middle = time.perf_counter(), time.thread_time()
            answers += fuser.advance()
            end, cpu_end = time.perf_counter(), time.thread_time()
            spent = (middle - begin, end - begin, cpu_middle - cpu, cpu_end - cpu)
            events.append([k + 1, *(1000 * s for s in spent)])
            time.sleep(PAUSE_S)
    decision = fuser.fused().decision if answers else "none yet"
    fuser.close()
    return {"size": size, "events": events, "load": os.getloadavg()[0], "answers": answers, "decision": decision}


#: How often the grown maps are told again.
AGAIN = 2
#: Pause [s] between landmarks of the latency benchmark, in which the worker works.
PAUSE_S = 0.005


def walked(m: LandmarkMap) -> list[int]:
    """Landmarks as a robot comes to them along links, what hangs on none at the end."""
    seen, row, todo = set(), [], list(range(len(m)))
    for first in todo:
        stack = [first]
        while stack:
            k = stack.pop()
            if k in seen:
                continue
            seen.add(k)
            row.append(k)
            far = [m.index_from_id[l.connected_to_id] for l in m.landmarks[k].links if l.connected_to_id is not None]
            stack += [f for f in far if f not in seen]
    return row


def latency_table(rows: Sequence[Row]) -> Iterator[str]:
    """Median and 99th percentile, as the maps grow, and as time passes over maps that don't."""
    yield "# Latency per landmark event, two simulated maps that grow and then stay as they are"
    for row in rows:
        size, events = row["size"], np.array(row["events"])
        yield ""
        yield f"{size} landmarks each, told in turn and weighed in another process:"
        yield ""
        yield "| | median [ms] | 99 % [ms] | largest [ms] |"
        yield "|---|---|---|---|"
        yield "| asked | 5 | 50 | |"
        said = ("taken in alone, by the clock", "taken in and advanced, by the clock")
        said += ("taken in alone, processor time", "taken in and advanced, processor time")
        for column, name in enumerate(said, start=1):
            yield _quantiles(name, events[:, column])
        yield ""
        yield "Taken in and advanced, processor time, by how many landmarks each map has, or how often it was told:"
        yield ""
        yield "| | median [ms] | 99 % [ms] | largest [ms] |"
        yield "|---|---|---|---|"
        fifth = size // 5
        for low in range(0, size, fifth):
            which = (events[:, 0] > low) & (events[:, 0] <= low + fifth)
            yield _quantiles(f"{low + 1} to {low + fifth} landmarks", events[which, 4])
        for again in range(1, 1 + AGAIN):
            which = (events[:, 0] > again * size) & (events[:, 0] <= (again + 1) * size)
            yield _quantiles(f"all {size}, told again ({again})", events[which, 4])
        yield ""
        yield (
            f"{row['answers']} answers meanwhile; the last one: {row['decision'].replace('_', ' ')}. The machine's two "
            f"processors had a load of {row['load']:.1f} at the end."
        )
    yield ""
    yield "![Processor time per landmark event against how many were told](../../docs/images/online-latency.png)"


def _quantiles(name: str, values: Array) -> str:
    found = (np.quantile(values, q) for q in (0.5, 0.99, 1.0)) if len(values) else [float("nan")] * 3
    return f"| {name} | " + " | ".join(f"{value:.2f}" for value in found) + " |"


def latency_picture(rows: Sequence[Row], path: Path) -> None:
    """Median and 99th percentile of every fiftieth of the run, and where the maps stop growing."""
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 3.6), layout="constrained")
    row = rows[-1]
    events, size = np.array(row["events"]), row["size"]
    parts = np.array_split(np.arange(len(events)), 50)
    at = [events[part, 0].mean() for part in parts]
    for q, colour, name in ((0.5, "#1f5a99", "median"), (0.99, "#b9502b", "99th percentile")):
        axes.plot(at, [np.quantile(events[part, 4], q) for part in parts], color=colour, label=name)
    axes.axvline(size, color="0.6", linewidth=1)
    axes.annotate(
        f"{size} landmarks each;\nfrom here told again",
        (size, axes.get_ylim()[1]),
        (4, -4),
        textcoords="offset points",
        va="top",
        fontsize=8,
    )
    for bound in (5, 50):
        axes.axhline(bound, color="0.6", linestyle=":", linewidth=1)
    axes.set(xlabel="landmark events of each robot", ylabel="processor time per event [ms]", yscale="log")
    axes.set_yticks([1, 2, 5, 10, 20, 50], ["1", "2", "5", "10", "20", "50"])
    axes.minorticks_off()
    axes.legend(loc="upper right", bbox_to_anchor=(1, 0.9), fontsize=8)
    axes.set_title("Two simulated maps, as they grow and as they are told again", fontsize=10)
    figure.savefig(path, dpi=110)
    plt.close(figure)


# Corrections


def correction(seed: int, arguments: argparse.Namespace) -> Row:
    """What it costs to take in a map whole, by its size: the first time, again a little elsewhere, and while merged."""
    sizes = (50, 150) if arguments.quick else (50, 100, 150, 200, 500, 1000)
    rng = np.random.default_rng(seed)
    rows = []
    for size in sizes:
        pair = pair_of_maps(size, "irregular", rng)
        fuser = OnlineFuser()
        spent = []
        for k, m in enumerate((with_joint(pair.map1, rng), with_joint(pair.map2, rng))):
            for again in range(2):
                told = m if not again else shifted(m, rng)
                message = Correction(robot=m.name, sequence=again, t=float(2 * k + again), map=told)
                begin = time.thread_time()
                fuser.take(message)
                spent.append(time.thread_time() - begin)
        rows.append([size, *(1000 * s for s in spent)])
    return {"rows": rows}


def with_joint(m: LandmarkMap, rng: np.random.Generator) -> LandmarkMap:
    """The map with a joint covariance of positions and headings, as the mapper gives one."""
    n = 3 * len(m)
    common = rng.normal(0, 0.1, (n, 6))
    matrix = common @ common.T + np.diag(np.tile([0.01, 0.01, 0.001], len(m)))
    return m.replace(joint_covariance=JointCovariance(m.ids, 3, frozen_array(matrix)))


def shifted(m: LandmarkMap, rng: np.random.Generator) -> LandmarkMap:
    """Every landmark a little elsewhere."""
    moved = (replace(l, x=l.x + rng.normal(0, 0.05), y=l.y + rng.normal(0, 0.05)) for l in m.landmarks)
    return m.replace(landmarks=tuple(moved))


def correction_table(rows: Sequence[Row]) -> Iterator[str]:
    """Milliseconds by size."""
    yield "# What it costs to take in a map whole (`Correction`), simulated maps with joint covariances"
    yield ""
    yield "| landmarks | first [ms] | again, all elsewhere [ms] | second map, first [ms] | again [ms] |"
    yield "|---|---|---|---|---|"
    for row in rows:
        for size, *spent in row["rows"]:
            yield f"| {size} | " + " | ".join(f"{s:.0f}" for s in spent) + " |"
    yield ""
    yield "Processor time; nothing is weighed in it."
