"""Times of the matchers on alike corridor buildings and on unlabelled points; prints a table.

Run: ``python benchmarks/matching_bench.py [--repeat N] [--json]``. Times are the best of N runs on one core, warm.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.matching.config import MatchingConfig
from mapfuse.matching.exhaustive import match_exhaustively
from mapfuse.matching.point_pairs import match_point_pairs

TRUE_T12 = np.array([12.0, -7.0, 0.8])


@dataclass(frozen=True, slots=True)
class Row:
    """One measured job: best time [ms], how many hypotheses, and how far the best one is from the truth [m]."""

    job: str
    milliseconds: float
    hypotheses: int
    displacement_m: float


def corridor_building(n: int, rng: np.random.Generator) -> list[Landmark]:
    """About n places of alike corridors in a lattice: half of them junctions and corners, half doors."""
    side = max(2, round(np.sqrt(n / 2)))
    pitch = 9.0
    places: list[Landmark] = []
    for row in range(side):
        for column in range(side):
            opened = [column + 1 < side, row + 1 < side, column > 0, row > 0]
            opened = [o and (rng.random() < 0.8) for o in opened]
            headings = (0.0, np.pi / 2, np.pi, -np.pi / 2)
            links = tuple(Link("open" if o else "blocked", h) for o, h in zip(opened, headings, strict=True))
            kind = "junction" if sum(opened) > 2 else "corner"
            places.append(Landmark(f"s{row}.{column}", kind, column * pitch, row * pitch, links=links))
            places.append(Landmark(f"d{row}.{column}", "door", (column + rng.uniform(0.2, 0.8)) * pitch, row * pitch))
    return places[:n]


def recorded(places: list[Landmark], T: np.ndarray, rng: np.random.Generator) -> LandmarkMap:
    """The places seen in the frame ``T`` with noise, four fifths of them, shuffled."""
    back = se2.inverse(T)
    seen = []
    for place in places:
        x, y = se2.transform(back, [place.x, place.y]) + rng.normal(0, 0.3, 2)
        links = tuple(
            Link(l.type, float(se2.wrap(l.heading + back[2] + rng.normal(0, 0.03))))
            for l in place.links
            if l.heading is not None
        )
        seen.append(Landmark(place.id, place.type, x, y, links=links))
    return LandmarkMap("m", tuple(seen[k] for k in rng.permutation(len(seen))))


def unlabelled(n: int, rng: np.random.Generator) -> tuple[LandmarkMap, LandmarkMap]:
    """Two maps of n points each, two thirds in common, 0.2 m of noise."""
    shared = rng.uniform(0, 6 * np.sqrt(n), (2 * n // 3, 2))
    maps = []
    for T in (np.zeros(3), TRUE_T12):
        own = rng.uniform(0, 6 * np.sqrt(n), (n - len(shared), 2))
        points = se2.transform(se2.inverse(T), np.vstack([shared, own])) + rng.normal(0, 0.2, (n, 2))
        maps.append(LandmarkMap("m", tuple(Landmark(str(k), "tree", *p) for k, p in enumerate(points))))
    return maps[0], maps[1]


def measured(job: str, map2: LandmarkMap, run: Callable[[], Any], repeat: int) -> Row:
    """Best time of ``repeat`` runs after a warm one."""
    found, times = run(), []
    for _ in range(repeat):
        begin = time.perf_counter()
        found = run()
        times.append(time.perf_counter() - begin)
    off = se2.transform(found[0].T12.array, map2.positions) - se2.transform(TRUE_T12, map2.positions)
    return Row(job, round(1e3 * min(times), 2), len(found), round(float(np.hypot(*off.T).mean()), 3))


def rows(repeat: int) -> list[Row]:
    """All jobs."""
    out = []
    for n in (20, 100, 300):
        rng = np.random.default_rng(n)
        places = corridor_building(n, rng)
        one, two = recorded(places, np.zeros(3), rng), recorded(places, TRUE_T12, rng)
        for name, config in (("H1 H2", MatchingConfig()), ("H1 only", MatchingConfig(use_h2=False))):
            job = f"exhaustive {name} {n} x {n}"
            out.append(measured(job, two, lambda: match_exhaustively(one, two, config).best(64), repeat))  # noqa: B023
            job += " all values"
            out.append(measured(job, two, lambda: match_exhaustively(one, two, config).hypotheses, repeat))  # noqa: B023
    for n in (20, 40, 100, 300):
        one, two = unlabelled(n, np.random.default_rng(n))
        out.append(measured(f"point pairs {n} x {n}", two, lambda: match_point_pairs(one, two), repeat))  # noqa: B023
    return out


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    table = rows(arguments.repeat)
    if arguments.json:
        print(json.dumps([asdict(row) for row in table], indent=1))
        return
    print(f"{'job':44} {'ms':>9} {'found':>7} {'off by m':>9}")
    for row in table:
        print(f"{row.job:44} {row.milliseconds:9.2f} {row.hypotheses:7} {row.displacement_m:9.3f}")


if __name__ == "__main__":
    main()
