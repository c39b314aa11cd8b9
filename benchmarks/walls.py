"""What walls add: `.venv/bin/python benchmarks/walls.py [--pairs N] [--symmetric N] [--quick]`.

T12 on simulated floors: two robots drive through each building; the mapper makes maps without walls, which `fuse`
merges, and with them, which `fuse` merges with walls. T12 is from start to start, as is the covariance that it is held
against. The symmetric floor: maps drawn from the joint covariance that they state, of a ring of corridors that is its
own image under half a turn, with and without an alcove in one wall.

Seeds from 2,000,000 on are test seeds: nothing was tuned on them. The settings were chosen on seeds from 1,900,000 on.
"""

from __future__ import annotations

import argparse
import logging

import numpy as np

from mapfuse.datasets import se2
from mapfuse.datasets.mapper import WITH_KEYFRAMES, Mapper
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.simulation import MILKA, VESPUCCI, make_building, simulate_log
from mapfuse.datasets.simulation.drifted import drifted, driven
from mapfuse.fusion import FusedMap, fuse
from mapfuse.fusion.config import FuseConfig, WallsConfig

FIRST_SEED = 2_000_000
KINDS = ("irregular", "oblique")
SETTINGS = (FuseConfig(), FuseConfig(walls=WallsConfig(use=True)))


def floor(kind: str, seed: int) -> list[tuple[FusedMap, np.ndarray]]:
    """A simulated pair mapped and fused without walls and with them, and its true T12 (3,).

    Robots, logs and seeds are those of ``mapfuse simulate KIND --seed SEED``; maps as of ``mapfuse map --joint`` and of
    ``mapfuse map --walls``.
    """
    building = make_building(kind, seed)
    maps: list[list[LandmarkMap]] = [[], []]
    starts = []
    for r, robot in enumerate((VESPUCCI, MILKA)):
        rng = np.random.default_rng([seed, r])
        header, events, truth = simulate_log(building, robot, rng, name=robot.name)
        mappers = Mapper(header), Mapper(header, WITH_KEYFRAMES)
        for event in events:
            for mapper in mappers:
                mapper.update(event)
        maps[0].append(mappers[0].map(joint=True))
        maps[1].append(mappers[1].map(keyframes=True))
        starts.append(truth.path[0, 1:4])
    expected = np.asarray(se2.between(*starts))
    return [(fuse(recorded, settings), expected) for recorded, settings in zip(maps, SETTINGS, strict=True)]


def off(fused: FusedMap, expected: np.ndarray) -> tuple[np.ndarray, float]:
    """Error (3,) of the first hypothesis' T12 and its NEES."""
    T12 = fused.pairs[0].T12
    assert T12 is not None
    assert T12.covariance is not None
    error = T12.array - expected
    error[2] = se2.wrap(error[2])
    return error, float(error @ np.linalg.solve(T12.covariance, error))


def floors(count: int) -> None:
    print(f"T12 on {count} simulated pairs, seeds from {FIRST_SEED}\n")
    print("| pair | decision without, with walls | error without [m, deg] | with walls | NEES without | with walls |")
    print("|---|---|---|---|---|---|", flush=True)
    errors, nees = [], []
    for k in range(count):
        kind, seed = KINDS[k % len(KINDS)], FIRST_SEED + k
        without, with_them = floor(kind, seed)
        decisions = f"{without[0].decision}, {with_them[0].decision}"
        if without[0].decision != "merged" or with_them[0].decision != "merged":
            print(f"| {kind} {seed} | {decisions} | | | | |", flush=True)
            continue
        found = [off(*one) for one in (without, with_them)]
        errors.append([error for error, _ in found])
        nees.append([n for _, n in found])
        said = [f"{np.hypot(*error[:2]):.3f}, {np.degrees(abs(error[2])):.2f}" for error, _ in found]
        print(
            f"| {kind} {seed} | {decisions} | {said[0]} | {said[1]} | {found[0][1]:.1f} | {found[1][1]:.1f} |",
            flush=True,
        )
    if errors:
        rms, mean = np.sqrt(np.mean(np.square(errors), axis=0)), np.mean(nees, axis=0)
        said = [f"{np.hypot(*rms[k, :2]):.3f}, {np.degrees(rms[k, 2]):.2f}" for k in (0, 1)]
        print(f"| rms of {len(errors)}, mean NEES | | {said[0]} | {said[1]} | {mean[0]:.2f} | {mean[1]:.2f} |")


def ring(alcove: bool) -> list[np.ndarray]:
    """Both walls of a ring of corridors, 38 m by 20 m outside and 2 m wide; the alcove is 4 m by 1.5 m."""
    found = [np.array([[-a, -b], [a, -b], [a, b], [-a, b], [-a, -b]]) for a, b in ((19.0, 10.0), (17.0, 8.0))]
    if alcove:
        recess = [[9.0, 10.0], [9.0, 11.5], [5.0, 11.5], [5.0, 10.0]]
        found[0] = np.concatenate([found[0][:3], recess, found[0][3:]])
    return found


def symmetric(count: int) -> None:
    corners = np.array([[-18.0, -9.0], [18.0, -9.0], [18.0, 9.0], [-18.0, 9.0]])
    print(f"\nThe symmetric floor, {count} pairs each, seeds from {FIRST_SEED}\n")
    print(
        "| walls | alcove | merged rightly | merged wrongly | ambiguous | no overlap |\n|---|---|---|---|---|---|",
        flush=True,
    )
    for alcove in (True, False):
        for used, settings in zip(("not used", "used"), SETTINGS, strict=True):
            tally = dict.fromkeys(("right", "wrong", "ambiguous", "no_overlap"), 0)
            for seed in range(FIRST_SEED, FIRST_SEED + count):
                rng = np.random.default_rng(seed)
                half = np.column_stack([np.linspace(-18, 18, 8), -9 + rng.uniform(-0.7, 0.7, 8)])
                half = np.concatenate([half, [[18.0, rng.uniform(-5, 5)]]])
                marks = np.concatenate([half, -half])
                ways = driven(corners, 0), driven(corners, 1, back=True)
                maps = [drifted(n, ring(alcove), way, marks, rng) for n, way in zip("AB", ways, strict=True)]
                fused = fuse(maps, settings)
                outcome: str = fused.decision
                if fused.decision == "merged":
                    turned = off(fused, np.asarray(se2.between(ways[0][0], ways[1][0])))[0][2]
                    outcome = "right" if abs(turned) < 0.3 else "wrong"
                tally[outcome] += 1
            print(
                f"| {used} | {'yes' if alcove else 'no'} | " + " | ".join(map(str, tally.values())) + " |", flush=True
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=12, help="simulated floors")
    parser.add_argument("--symmetric", type=int, default=100, help="symmetric floors with and without an alcove")
    parser.add_argument("--quick", action="store_true", help="two floors, five symmetric ones")
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    floors(2 if given.quick else given.pairs)
    symmetric(5 if given.quick else given.symmetric)


if __name__ == "__main__":
    main()
