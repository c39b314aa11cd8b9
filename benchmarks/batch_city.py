"""A simulated city of floors from end to end: `mapfuse batch` on a folder, its groups against the true buildings.

    .venv/bin/python benchmarks/batch_city.py RUNS [--buildings 100] [--maps 10] [--jobs 2] [--seed 1000001]

Quick form: ``--buildings 5``. RUNS keeps folder and ledger, so that a measurement that was stopped goes on. A map's
group is right where it is the largest one of its building and holds no map of another, and where each of the map's
landmarks lies where the group's other maps have the same true place. The default seed is a test seed: nothing was set
on it. What is printed goes into ``benchmarks/results/batch-city.md`` by hand, with what it ran on.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections import Counter
from contextlib import closing
from pathlib import Path

import numpy as np
from city import CityMap, city

from mapfuse.datasets import se2, write_map
from mapfuse.fusion.batch.engine import LocalEngine
from mapfuse.fusion.batch.run import run_batch
from mapfuse.fusion.config import FuseConfig

#: Maps of one group disagree where they put the places that both have farther apart, in the mean [m].
WRONG_M = 3.0


def judged(maps: list[CityMap], run: Path) -> str:
    """Maps in their building's largest group, groups of several buildings, maps laid elsewhere than the others."""
    by_name = {m.map.name: m for m in maps}
    with (run / "maps.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["group"]]
    group = {row["map"]: row["group"] for row in rows}
    pose = {row["map"]: np.array([float(row[k]) for k in ("x", "y", "theta")]) for row in rows if row["x"]}
    buildings: dict[str, Counter[int]] = {}
    for name, number in group.items():
        buildings.setdefault(number, Counter())[by_name[name].building] += 1
    mixed = [number for number, of in buildings.items() if len(of) > 1]
    largest = {
        b: max((n for n in buildings if n not in mixed), key=lambda n: buildings[n][b], default="")
        for b in {m.building for m in maps}
    }
    right = [name for name, number in group.items() if largest[by_name[name].building] == number]
    off = [name for name in right if _off(by_name[name], [by_name[o] for o in right if group[o] == group[name]], pose)]
    return (
        f"{len(right) - len(off)} of {len(maps)} maps right; groups of several buildings: {len(mixed)}; "
        f"laid elsewhere than the others of their group: {off}; in no group: {len(maps) - len(group)}"
    )


def _off(of: CityMap, others: list[CityMap], pose: dict[str, np.ndarray]) -> bool:
    """Whether a map's landmarks lie elsewhere than most others of its group have the same true places."""
    at, disagrees = _places(of, pose), []
    for other in others:
        theirs = _places(other, pose)
        common = at.keys() & theirs.keys()
        if other is not of and len(common) >= 3:
            disagrees.append(np.mean([np.hypot(*(at[p] - theirs[p])) for p in common]) > WRONG_M)
    return bool(disagrees) and bool(np.mean(disagrees) > 0.5)


def _places(of: CityMap, pose: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """True places of a map, where its group has them."""
    at = se2.transform(pose[of.map.name], of.map.positions)
    return {p: xy for id_, xy in zip(of.map.ids, at, strict=True) if (p := of.place_from_id.get(id_)) is not None}


def main() -> None:
    """Fuse the city and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--buildings", type=int, default=100)
    parser.add_argument("--maps", type=int, default=10)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1_000_001)
    args = parser.parse_args()
    maps = list(city(args.seed, args.buildings, args.maps))
    folder = args.runs / f"city-{args.seed}-{len(maps)}"
    folder.mkdir(parents=True, exist_ok=True)
    for of in maps:
        write_map(of.map, folder / f"{of.map.name}.map.json")
    run = args.runs / f"city-{args.seed}-{len(maps)}-run"
    begin = time.perf_counter()
    with closing(LocalEngine(args.jobs)) as engine:
        summary = run_batch(folder, run, FuseConfig(), engine)
    print(f"{summary}\n{time.perf_counter() - begin:.0f} s with {args.jobs} workers")
    print(judged(maps, run))


if __name__ == "__main__":
    main()
