"""Two simulated robots in one hospital, merged while they map: when, how rightly, and whether covariances hold.

Part of ``benchmarks/online.py``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.special import chdtri

from mapfuse.datasets import se2
from mapfuse.datasets.logs import Log
from mapfuse.datasets.mapper import truth_of_map
from mapfuse.datasets.simulation import MILKA, VESPUCCI, build, hospital_like, simulate_logs
from mapfuse.datasets.simulation.simulated_log import SimulatedLog
from mapfuse.datasets.transform import Transform
from mapfuse.datasets.truth import Truth
from mapfuse.fusion import FusedMap, fuse
from mapfuse.fusion.online import Merged, Revised, Unmerged
from mapfuse.fusion.online.replay import Replay
from mapfuse.fusion.score import LEAST_RIGHT, MOST_OFF_M, PairScore, nees_of_transform, score_pair

TENTHS = 10
#: 99.9 % of a chi-square with 3 degrees of freedom.
BEYOND = float(chdtri(3, 0.001))
#: The loop around the block of lifts, corner by corner [m, world].
RING = np.array([(-9, -6), (9, -6), (9, -2), (9, 6), (-9, 6), (-9, 1.5), (-9, -6)], dtype=float)

Row = dict[str, Any]


def hospital(seed: int, _: argparse.Namespace) -> Row:
    """One pair: West and East wing, replayed together."""
    logs = simulate_logs(build(hospital_like()), (VESPUCCI, MILKA), seed, starts=("p9", "p13"), scans=False)
    row = replayed(logs, seed)
    row["closed"] = [_ring_closed(log) for log in logs]
    return row


def replayed(logs: Sequence[SimulatedLog], seed: int) -> Row:
    """A replay of two robots: when they merged, what was wrong, errors at each tenth, and the batch result.

    Of landmarks the mean over the fused ones is kept at each tenth: errors of those of one run go together, so that
    they count as one.
    """
    replay = Replay([Log(log.header, log.events) for log in logs])
    end = max(log.events[-1].t for log in logs)
    tenths: list[list[float] | None] = []
    merges: list[Row] = []
    parted: list[float] = []
    score: PairScore | None = None
    for moment in replay.run(every=end / TENTHS):
        if moment.weighed:
            score = _score(replay, logs)
        for event in replay.fuser.events():
            if isinstance(event, Merged | Revised) and score is not None:
                merges.append({"t": event.t, "kind": event.kind, **_judged(score)})
            elif isinstance(event, Unmerged):
                parted.append(event.t)
        if not moment.weighed:
            tenths.append(_nees(score))
    tenths = [*tenths[: TENTHS - 1], _nees(score)]
    fused = replay.fuser.fused()
    batch = fuse([feed.map() for feed in replay.feeds.values()])
    return {
        "end": end,
        "merges": merges,
        "parted": parted,
        "decision": fused.decision,
        "at_end": _judged(score) if score is not None and score.decision == "merged" else None,
        "tenths": tenths,
        "from_batch": _from_batch(fused, batch),
        "batch": batch.decision,
        "place_nees": _place_nees(replay, logs),
    }


def _nees(score: PairScore | None) -> list[float] | None:
    """NEES of T12, and the landmarks' mean; None where nothing is merged."""
    if score is None or score.decision != "merged" or not len(score.nees_landmarks):
        return None
    return [score.nees_T12, float(np.mean(score.nees_landmarks))]


def _truth(replay: Replay, logs: Sequence[SimulatedLog]) -> Truth:
    fused = replay.fuser.fused()
    truths = [
        truth_of_map(fused.sources[log.header.name], replay.feeds[log.header.name].mapper.sources, log.truth)
        for log in logs
    ]
    frames = {name: frame for truth in truths for name, frame in truth.frames.items()}
    landmarks = {name: ids for truth in truths for name, ids in truth.landmarks.items()}
    places = {place: xy for truth in truths for place, xy in truth.places.items()}
    return Truth(frames, landmarks, places)


def _score(replay: Replay, logs: Sequence[SimulatedLog]) -> PairScore | None:
    """The answer just given against the truth; None where a map is still empty."""
    fused = replay.fuser.fused()
    return score_pair(fused, _truth(replay, logs)) if len(fused.maps) == len(logs) else None


def _judged(score: PairScore) -> Row:
    """A merge in numbers: matches, how far off its common landmarks are, in the first robot's map alone, too."""
    return {
        "right": score.right,
        "reported": score.reported,
        "off": score.displacement,
        "own_off": score.own_displacement,
        "nees": score.nees_T12,
    }


def _wrong(merge: Row) -> bool:
    """As `PairScore.merged_wrongly`."""
    off = merge["off"] - (merge["own_off"] or 0.0)
    return bool(merge["right"] < LEAST_RIGHT * merge["reported"] or not off <= MOST_OFF_M)


def _from_batch(fused: FusedMap, batch: FusedMap) -> float | None:
    """Largest difference of T12 from the batch's in its standard deviations."""
    if fused.decision != batch.decision or fused.decision != "merged":
        return None
    T, B = fused.frames[fused.maps[1]].T, batch.frames[fused.maps[1]].T
    off = T.array - B.array
    off[2] = se2.wrap(off[2])
    return float(np.max(np.abs(off) / np.sqrt(np.diag(B.covariance))))


def _place_nees(replay: Replay, logs: Sequence[SimulatedLog]) -> list[float | None]:
    """NEES (3) of each robot's pose at the end, in the first one's frame."""
    found: list[float | None] = []
    places = replay.fuser.places()
    for log in logs:
        place = places.get(log.header.name)
        if place is None or place.frame_of != logs[0].header.name:
            found.append(None)
            continue
        true = Transform.from_array(se2.between(logs[0].truth.path[0, 1:], log.truth.path[-1, 1:]))
        found.append(nees_of_transform(place.pose, true))
    return found


def _ring_closed(log: SimulatedLog) -> float | None:
    """When a robot has been everywhere around the block of lifts; None: never."""
    steps = [np.linspace(a, b, max(2, int(np.hypot(*(b - a))))) for a, b in pairwise(RING)]
    path = log.truth.path
    last = 0.0
    for point in np.concatenate(steps):
        near = np.flatnonzero(np.hypot(*(path[:, 1:3] - point).T) < 2.0)
        if not len(near):
            return None
        last = max(last, float(path[near[0], 0]))
    return last


def hospital_table(rows: Sequence[Row]) -> Iterator[str]:
    """What was asked, and what came out."""
    n = len(rows)
    before = sum(_before_loops(row) for row in rows)
    wrong = [(row, merge) for row in rows for merge in row["merges"] if _wrong(merge)]
    adrift = [(row, merge) for row in rows for merge in row["merges"] if not merge["off"] <= MOST_OFF_M]
    runs, drifted = (len({row["seed"] for row, _ in found}) for found in (wrong, adrift))
    left = sum(row["at_end"] is not None and _wrong(row["at_end"]) for row in rows)
    merged = [row for row in rows if row["decision"] == "merged"]
    apart = [row["from_batch"] for row in rows if row["from_batch"] is not None]
    same = sum(row["decision"] == row["batch"] for row in rows)
    beyond = len({row["seed"] for row in rows for merge in row["merges"] if merge["nees"] > BEYOND})
    yield "# Two simulated robots in one hospital, merged while they map"
    yield ""
    yield "| | asked | measured |"
    yield "|---|---|---|"
    yield f"| merged before both have closed the central loop | 90 % | {100 * before / n:.1f} % ({before} of {n}) |"
    yield f"| ever merged wrongly | at most 0.5 % | {100 * runs / n:.1f} % ({runs}) |"
    yield f"| of these still wrong at the end | none | {left} |"
    yield f"| ever merged with landmarks 3 m off, the first robot's own drift included (below) | | {drifted} |"
    yield f"| ever merged with T12 outside its own 99.9 % ellipsoid | 0.1 % | {100 * beyond / n:.1f} % ({beyond}) |"
    yield f"| merged at the end | | {100 * len(merged) / n:.1f} % ({len(merged)}) |"
    yield f"| decision at the end is the batch's | all | {same} of {n} |"
    yield f"| T12 from the batch's [sigma], largest | 0.1 | {max(apart, default=float('nan')):.2g} |"
    place = [value for row in rows for value in row["place_nees"] if value is not None]
    yield f"| mean NEES of robots' poses at the end, / 3 | {_told(3 * len(place))} | {np.mean(place) / 3:.2f} |"
    found = [(k, values, *_of_tenth(values)) for k in range(TENTHS) if len(values := _at_tenth(rows, k))]
    means = [(mean, dof) for _, _, *both in found for mean, dof in both]
    alone, together = (_outside(means, confidence) for confidence in (0.95, 0.95 ** (1 / max(len(means), 1))))
    yield f"| NEES at the tenths (below) outside its 95 % band | 1 in 20 | {alone} of {len(means)} |"
    yield f"| outside the band that all of them keep with 95 % | none | {together} |"
    yield ""
    yield "NEES over degrees of freedom at each tenth of the run, of those merged by then: of T12 (3; in exponential"
    yield "coordinates, `mapfuse.fusion.score.nees_of_transform`, since early ones are known to 0.1 rad), and the mean"
    yield "of the landmarks (2) in the frame of the first robot. Landmarks of one run err together: for the band each"
    yield "run counts as one landmark."
    yield ""
    yield "| tenth | merged | T12 | 95 % band | landmarks | 95 % band |"
    yield "|---|---|---|---|---|---|"
    for k, values, (T12, dof), (landmark, dof_landmark) in found:
        bands = _told(dof), _told(dof_landmark)
        yield f"| {k + 1} | {len(values)} | {T12:.2f} | {bands[0]} | {landmark:.2f} | {bands[1]} |"
    times = sorted(row["merges"][0]["t"] / row["end"] for row in rows if row["merges"])
    if times:
        yield ""
        half, most = (100 * np.quantile(times, q) for q in (0.5, 0.9))
        yield f"First merge at {half:.0f} % of the run (median); 90 % of them by {most:.0f} %."
    for row, merge in (*wrong, *(found for found in adrift if not _wrong(found[1]))):
        own = float("nan") if merge["own_off"] is None else merge["own_off"]
        yield ""
        yield (
            f"Seed {row['seed']}, {merge['kind']} at {merge['t']:.0f} s: {merge['right']} of {merge['reported']} "
            f"matches true, common landmarks {merge['off']:.1f} m off, {own:.1f} m in the first robot's own map; "
            f"NEES of T12 over 3: {merge['nees'] / 3:.1f}."
        )


def _before_loops(row: Row) -> bool:
    closed = [row["end"] if t is None else t for t in row["closed"]]
    return bool(row["merges"]) and row["merges"][0]["t"] < max(closed)


def _at_tenth(rows: Sequence[Row], k: int) -> np.ndarray:
    """NEES (n, 2) of T12 and of the landmarks at a tenth of the run, of those merged by then."""
    tenths = [row["tenths"][k] for row in rows if len(row["tenths"]) > k]
    return np.array([values for values in tenths if values is not None]).reshape(-1, 2)


def _of_tenth(values: np.ndarray) -> tuple[tuple[float, int], tuple[float, int]]:
    """Mean over degrees of freedom, and how many these are, of T12 and of the landmarks."""
    n = len(values)
    T12, landmark = values.mean(axis=0) / (3, 2)
    return (float(T12), 3 * n), (float(landmark), 2 * n)


def _outside(means: Sequence[tuple[float, int]], confidence: float) -> int:
    """How many means lie outside the band of their degrees of freedom."""
    bands = [_band(dof, confidence) for _, dof in means]
    return sum(not low <= mean <= high for (mean, _), (low, high) in zip(means, bands, strict=True))


def _band(dof: int, confidence: float = 0.95) -> tuple[float, float]:
    """Band of the mean of chi-square values over their degrees of freedom, ``dof`` in all."""
    tail = (1 - confidence) / 2
    return float(chdtri(dof, 1 - tail)) / dof, float(chdtri(dof, tail)) / dof


def _told(dof: int) -> str:
    """The 95 % band in words."""
    return "{:.2f} to {:.2f}".format(*_band(dof)) if dof else "-"
