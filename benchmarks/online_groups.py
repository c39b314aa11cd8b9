"""Four simulated robots on one floor, and the five recorded ones of MRCLAM 6. Part of ``benchmarks/online.py``."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from mapfuse.datasets import se2
from mapfuse.datasets.logs import Log
from mapfuse.datasets.mapper.naming import name_detections
from mapfuse.datasets.mrclam import ROBOTS, read_mrclam_log, read_mrclam_truth
from mapfuse.datasets.simulation import MILKA, VESPUCCI, make_building, simulate_logs
from mapfuse.datasets.simulation.simulated_log import SimulatedLog
from mapfuse.fusion import FusedMap
from mapfuse.fusion.online import Merged
from mapfuse.fusion.online.replay import Replay

Row = dict[str, Any]

#: Where names of landmarks come from.
BARCODES, FOUND = "within each robot's log only", "none; names found in each whole log before"
NAMES = (BARCODES, FOUND, "none")


def four(seed: int, _: argparse.Namespace) -> Row:
    """Four robots, each of a half or more of an irregular floor, started anywhere."""
    site = make_building("irregular", seed)
    logs = simulate_logs(site, (VESPUCCI, MILKA, VESPUCCI, MILKA), seed, scans=False, share=0.7)
    replay = Replay([Log(log.header, log.events) for log in logs])
    merges = [event.t for _ in replay.run() for event in replay.fuser.events() if isinstance(event, Merged)]
    fused = replay.fuser.fused()
    off = [_off(fused, group, logs) for group in fused.groups if len(group) > 1]
    return {
        "groups": len(fused.groups),
        "largest": max(len(group) for group in fused.groups),
        "off": max(off, default=0.0),
        "merges": merges,
        "end": replay.t,
    }


def _off(fused: FusedMap, group: Sequence[str], logs: Sequence[SimulatedLog]) -> float:
    """How far [m, mean] the worst placed map of a group lies from where it is, its first map being right."""
    start = {log.header.name: log.truth.path[0, 1:] for log in logs}
    worst = 0.0
    for name in group[1:]:
        points = fused.sources[name].positions
        true = se2.between(start[group[0]], start[name])
        apart = se2.transform(fused.frames[name].T.array, points) - se2.transform(true, points)
        worst = max(worst, float(np.hypot(*apart.T).mean()))
    return worst


def four_table(rows: Sequence[Row]) -> Iterator[str]:
    """How many ended as one group."""
    n = len(rows)
    one = sum(row["groups"] == 1 for row in rows)
    yield "# Four simulated robots on one floor, started anywhere"
    yield ""
    yield "| | asked | measured |"
    yield "|---|---|---|"
    yield f"| one group at the end | 95 % | {100 * one / n:.0f} % ({one} of {n}) |"
    yield f"| a map of a group more than 5 m (mean) off | none | {sum(row['off'] > 5 for row in rows)} |"
    yield f"| three of the four together | | {sum(row['largest'] == 3 for row in rows)} |"


def mrclam(seed: int, arguments: argparse.Namespace) -> Row:
    """All five robots of MRCLAM 6 replayed: barcodes name a robot's own landmarks, and are no names between robots
    (first seed); dropped, and names found in each whole log before (second); dropped (third)."""
    home = arguments.folder / "MRCLAM_Dataset6"
    names = NAMES[(seed - arguments.first) % len(NAMES)]
    logs = [read_mrclam_log(home, robot, barcodes=names == BARCODES) for robot in ROBOTS]
    numbers_from_name: dict[str, Sequence[int]] = {}
    if names == FOUND:
        known = [name_detections(log) for log in logs]
        numbers_from_name = {log.header.name: k.numbers for log, k in zip(logs, known, strict=True)}
        logs = [k.log for k in known]
    replay = Replay(logs)
    merges = [event.t for _ in replay.run() for event in replay.fuser.events() if isinstance(event, Merged)]
    fused = replay.fuser.fused()
    named = {}
    places: dict[str, np.ndarray] = {}
    for log, robot in zip(logs, ROBOTS, strict=True):
        truth = read_mrclam_truth(home, robot)
        places = {**places, **truth.places}
        sources = replay.feeds[log.header.name].mapper.sources
        numbers = numbers_from_name.get(log.header.name, range(len(truth.detections)))
        for landmark, detections in sources.items():
            seen = Counter(truth.detections[numbers[k]] for k in detections).most_common(1)[0][0]
            named[log.header.name, landmark] = seen
    largest = max(range(len(fused.groups)), key=lambda k: len(fused.groups[k]))
    found, true = [], []
    for landmark in fused.landmarks:
        if landmark.group == largest:
            tubes = Counter(named.get((name, i)) for name, ids in landmark.sources.items() for i in ids)
            tube = tubes.most_common(1)[0][0]
            if tube is not None:
                found.append((landmark.x, landmark.y))
                true.append(places[tube])
    apart = np.hypot(*se2.align(np.array(true), np.array(found)).residuals.T)
    return {
        "barcodes": names,
        "groups": len(fused.groups),
        "largest": len(fused.groups[largest]),
        "landmarks": len(found),
        "rms": float(np.sqrt(np.mean(apart**2))),
        "worst": float(apart.max()),
        "merges": merges,
    }


def mrclam_table(rows: Sequence[Row]) -> Iterator[str]:
    """One group, and how near to the survey."""
    yield "# MRCLAM 6, recorded: five robots' raw logs replayed together"
    yield ""
    yield "Asked: one group, fused landmarks at most 0.15 m rms from the survey (laid on by the best rigid motion)."
    yield ""
    yield "| barcodes | groups | robots in the largest | landmarks there | rms [m] | worst [m] |"
    yield "|---|---|---|---|---|---|"
    for row in rows:
        numbers = f"{row['groups']} | {row['largest']} | {row['landmarks']} | {row['rms']:.3f} | {row['worst']:.2f}"
        yield f"| {row['barcodes']} | {numbers} |"
