"""Heuristic, Kalman and optimised merges on fresh simulated pairs: floors of every kind, and the hospital again.

    .venv/bin/python benchmarks/compare_simulated.py [--pairs N] [--whole N] [--hospitals N] [--first SEED]
        [--quick] [--write]

Of every kind of floor N pairs, by seeds that nothing was tuned or tested on before; each pair counts as with a loop
where the ways of both robots together close one. rms are of all recorded landmarks that are true places, in the frame
of map 1 and after the best rigid motion; ratios and means over the pairs that both methods merged. ``bound``: the rms
that is expected of the optimum of all measurements with the true matches, by its covariance: Cramer and Rao's bound,
no unbiased estimate from the same measurements has less. What loops are worth: the same of floors that both robots
explored whole, with recorded positions that close all loops, and as first reckoned, which close none. Hospitals: two
fresh drives each through the building of the hospital pair, as `mapfuse.datasets.recordings.make_paper_maps` makes
them, mapped and merged. ``--write`` keeps the tables in ``benchmarks/results/compare-simulated.md``.
"""

from __future__ import annotations

import argparse
import logging
import platform
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mapfuse.datasets.mapper import Mapper, truth_of_map
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.recordings.make_paper_maps import hospital_building, hospital_logs
from mapfuse.datasets.simulation.pairs import simulated_pair
from mapfuse.datasets.truth import Truth
from mapfuse.factors import LandmarkKey, pair_problem
from mapfuse.fusion.compare import Evaluation, Interval, compare_pair, methods
from mapfuse.fusion.compare.hospital import OnPlan, on_plan
from mapfuse.fusion.compare.statistics import interval
from mapfuse.fusion.config import SolvingConfig
from mapfuse.fusion.solve import solve

FIRST_SEED = 2_000_000
#: Share of the corridors that a robot knows which explored a floor whole.
WHOLE = (0.95, 1.0)
KINDS = ("irregular", "oblique", "alike", "symmetric", "wings")
METHODS = ("heuristic", "kalman", "optimised")
#: What no unbiased estimate goes below, beside them.
BOUND = "bound"
RESULT = Path(__file__).resolve().parent / "results" / "compare-simulated.md"
Pair = dict[str, Evaluation]


def loops(maps: Sequence[LandmarkMap], truth: Truth) -> int:
    """Independent cycles of the ways that the robots drove from place to place, both maps together."""
    ways = set()
    for m in maps:
        place = truth.landmarks[m.name]
        for landmark in m.landmarks:
            for link in landmark.links:
                a, b = place[landmark.id], place.get(link.connected_to_id or "")
                if a is not None and b is not None and a != b:
                    ways.add((min(a, b), max(a, b)))
    names = {name: k for k, name in enumerate(sorted({name for way in ways for name in way}))}
    if not names:
        return 0
    ends = np.array([[names[a], names[b]] for a, b in sorted(ways)])
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(names), len(names)))
    return len(ways) - len(names) + int(connected_components(graph, directed=False)[0])


def bound(map1: LandmarkMap, map2: LandmarkMap, truth: Truth) -> tuple[float, float]:
    """Expected rms [m] of all recorded true places in the frame of map 1, and after the best rigid motion, by the
    covariance of the optimum with the true matches."""
    maps = (map1, map2)
    matches = truth.true_pairs(map1.name, map2.name)
    T12 = truth.T12(map1.name, map2.name).array
    solution = solve(pair_problem(map1, map2, T12, matches, robust=False), SolvingConfig())
    keys = [LandmarkKey(r, i) for r, m in enumerate(maps) for i in m.ids if truth.landmarks[m.name][i] is not None]
    xy = np.array([solution.poses[key][:2] for key in keys])
    rows = (3 * np.arange(len(keys))[:, None] + np.arange(2)).ravel()
    C = solution.joint_covariance(keys)[np.ix_(rows, rows)]
    # what a rigid motion takes away, to first order: two shifts and a turn
    motion = np.zeros((2 * len(keys), 3))
    motion[0::2, 0] = motion[1::2, 1] = 1.0
    motion[0::2, 2], motion[1::2, 2] = -xy[:, 1], xy[:, 0]
    Q = np.linalg.qr(motion)[0]
    left = np.trace(C) - np.trace(Q.T @ C @ Q)
    return float(np.sqrt(np.trace(C) / len(keys))), float(np.sqrt(left / len(keys)))


def with_bound(pair: Pair, map1: LandmarkMap, map2: LandmarkMap, truth: Truth) -> Pair:
    """The pair with `BOUND` as a method of its own, on what the optimised one merged."""
    optimised = pair["optimised"]
    if optimised.truth is None or optimised.truth.rms is None:
        return {**pair, BOUND: replace(optimised, method=BOUND)}
    rms, aligned = bound(map1, map2, truth)
    return {
        **pair,
        BOUND: replace(optimised, method=BOUND, truth=replace(optimised.truth, rms=rms, rms_aligned=aligned)),
    }


def floors(first: int, count: int) -> dict[tuple[str, bool], list[Pair]]:
    """Pairs by kind of floor and whether a loop was closed."""
    chosen = methods(METHODS)
    found: dict[tuple[str, bool], list[Pair]] = {}
    for kind in KINDS:
        for seed in range(first, first + count):
            map1, map2, truth = simulated_pair(seed, kind)
            pair = {e.method: e for e in compare_pair(map1, map2, chosen, truth)}
            pair = with_bound(pair, map1, map2, truth)
            found.setdefault((kind, loops((map1, map2), truth) > 0), []).append(pair)
        print(kind, "done", flush=True)
    return found


def whole_floors(first: int, count: int) -> dict[tuple[str, bool], list[Pair]]:
    """Pairs of floors with loops that both robots explored whole, by kind and whether their positions close them."""
    chosen = methods(METHODS)
    found: dict[tuple[str, bool], list[Pair]] = {}
    for kind in KINDS:
        if kind == "symmetric":
            continue
        for seed in range(first, first + count):
            for closed in (True, False):
                map1, map2, truth = simulated_pair(seed, kind, share=WHOLE, loops_closed=closed)
                if loops((map1, map2), truth):
                    pair = {e.method: e for e in compare_pair(map1, map2, chosen, truth)}
                    found.setdefault((kind, closed), []).append(with_bound(pair, map1, map2, truth))
        print(kind, "whole, done", flush=True)
    return found


def both(pairs: Sequence[Pair], other: str) -> list[tuple[float, float, float, float]]:
    """rms and aligned rms of the heuristic, then of another method, on pairs that both merged."""
    rows = []
    for pair in pairs:
        one, two = pair["heuristic"].truth, pair[other].truth
        if one is None or two is None or one.rms_aligned is None or two.rms_aligned is None:
            continue
        assert one.rms is not None
        assert two.rms is not None
        rows.append((one.rms, one.rms_aligned, two.rms, two.rms_aligned))
    return rows


def told(found: Interval | None, digits: int = 2) -> str:
    return "-" if found is None else f"{found.value:.{digits}f} ({found.low:.{digits}f} to {found.high:.{digits}f})"


def floor_table(found: dict[tuple[str, bool], list[Pair]], of: str) -> list[str]:
    """One row per class and method; ``of``: what the classes' flag says."""
    lines = [
        f"| floor | {of} | method | pairs | merged | wrong | both merged | mean rms, heuristic | mean rms"
        " | median ratio of rms | mean aligned, heuristic | mean aligned | median ratio, aligned |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    every = {True: [p for (_, loop), ps in found.items() if loop for p in ps]}
    every[False] = [p for (_, loop), ps in found.items() if not loop for p in ps]
    groups = [*sorted(found.items()), *((("all", loop), ps) for loop, ps in every.items() if ps)]
    for (kind, loop), pairs in groups:
        for method in (*METHODS, BOUND):
            own = [p[method] for p in pairs]
            merged, wrong = sum(e.decision == "merged" for e in own), sum(bool(e.merged_wrongly) for e in own)
            decided = "- | -" if method == BOUND else f"{merged} | {wrong}"
            line = f"| {kind} | {'yes' if loop else 'no'} | {method} | {len(own)} | {decided} |"
            if method == "heuristic":
                lines.append(line + " - |" * 7)
                continue
            v = np.array(both(pairs, method)).reshape(-1, 4)
            m = v.mean(axis=0) if len(v) else np.full(4, np.nan)
            ratio, aligned = (told(interval((v[:, k + 2] / v[:, k]).tolist(), np.median)) for k in (0, 1))
            lines.append(f"{line} {len(v)} | {m[0]:.2f} | {m[2]:.2f} | {ratio} | {m[1]:.2f} | {m[3]:.2f} | {aligned} |")
    return lines


def hospital(seed: int) -> dict[str, OnPlan]:
    """Both merges of a fresh pair of drives over the plan, by method; those that merged nothing are left out."""
    maps, frames, landmarks = [], {}, {}
    places = {}
    for drive in hospital_logs(seed).values():
        mapper = Mapper(drive.header)
        for event in drive.events:
            mapper.update(event)
        maps.append(mapper.map(joint=True))
        own = truth_of_map(maps[-1], mapper.sources, drive.truth)
        frames |= own.frames
        landmarks |= own.landmarks
        places |= own.places
    truth, building = Truth(frames, landmarks, places), hospital_building()
    found = {}
    for e in compare_pair(maps[0], maps[1], methods(METHODS), truth):
        if e.merge is not None and e.merge.landmarks and not e.merged_wrongly:
            found[e.method] = on_plan(maps, e.merge, truth, building, bent=e.method == "optimised")
    return found


def hospital_table(found: Sequence[dict[str, OnPlan]]) -> list[str]:
    """One row per method: medians over pairs with their intervals."""
    lines = [
        "| method | merged rightly | landmark rms [m] | 95 % of the walls within [m] | worst wall [m]"
        " | in % of the reach | lengths above 50 m off [%] | worst length [%] |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for method in METHODS:
        own = [laid[method] for laid in found if method in laid]
        walls = [float(o.wall_off.max(initial=0.0)) for o in own]
        long = [o.length_percents for o in own if len(o.length_percents)]
        cells = (
            [o.rms for o in own],
            [float(np.quantile(o.wall_off, 0.95)) for o in own],
            walls,
            [o.wall_percent for o in own],
            [float(np.median(lengths)) for lengths in long],
            [float(lengths.max()) for lengths in long],
        )
        shown = " | ".join(told(interval(values, np.median)) for values in cells)
        lines.append(f"| {method} | {len(own)} of {len(found)} | {shown} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=60, help="of each kind of floor")
    parser.add_argument("--whole", type=int, default=40, help="of each kind explored whole")
    parser.add_argument("--hospitals", type=int, default=40)
    parser.add_argument("--first", type=int, default=FIRST_SEED, metavar="SEED", help="first of the seeds")
    parser.add_argument(
        "--quick", action="store_true", help="three pairs of each kind, two explored whole, two hospitals"
    )
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    pairs, whole, hospitals = (3, 2, 2) if given.quick else (given.pairs, given.whole, given.hospitals)
    of_floors = floor_table(floors(given.first, pairs), "loop")
    print("\n".join(of_floors), flush=True)
    of_whole = floor_table(whole_floors(given.first, whole), "positions close loops")
    print("\n".join(of_whole), flush=True)
    laid = [hospital(seed) for seed in range(given.first, given.first + hospitals)]
    lines = [
        "# Heuristic against optimised on fresh simulated pairs",
        "",
        f"{pairs} pairs of each kind of floor and {hospitals} hospitals, seeds from {given.first}; nothing was "
        f"tuned on them. All simulated. {platform.machine()}, 2 cores, Python {platform.python_version()}, "
        f"{datetime.now(UTC):%Y-%m-%d}.",
        "",
        "## Floors",
        "",
        *of_floors,
        "",
        "Means and ratios over the pairs that the heuristic and the method both merged, rms in metres; in brackets",
        "95 % by bootstrap over pairs.",
        "",
        "## Floors explored whole",
        "",
        f"{whole} pairs of each kind but symmetric ones, the same seeds; those with a loop.",
        "",
        *of_whole,
        "",
        "## Hospitals",
        "",
        *hospital_table(laid),
        "",
        "Medians over pairs of drives that were merged rightly, 95 % in brackets. Laid over the plan as a whole.",
    ]
    text = "\n".join(lines) + "\n"
    print(text)
    if given.write:
        RESULT.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
