"""What walls add to T12 on simulated floors with scans: `.venv/bin/python benchmarks/walls.py [--pairs N] [--quick]`.

Two simulated robots drive through each building, the mapper makes maps with walls of their scans, `fuse` merges them
without walls; then walls are laid on walls (`mapfuse.fusion.walls`), beginning at the T12 that came out. Errors are
those against the truth; walls alone say where map 2 lies, and both together weigh them by their information. The seeds
are test seeds: nothing was tuned on them.
"""

from __future__ import annotations

import argparse
import logging
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from mapfuse.datasets import LandmarkMap, read_map, se2
from mapfuse.datasets.truth import read_truth
from mapfuse.fusion import FusedMap, fuse
from mapfuse.fusion.walls import align
from mapfuse.fusion.wallspace import wall_evidence

FIRST_SEED = 2_000_000
KINDS = ("irregular", "oblique")


def pair_of(kind: str, seed: int, folder: Path) -> list[tuple[np.ndarray, np.ndarray]] | None:
    """Errors (3,) and information (3, 3) of T12 by landmarks, by walls, and by both; None where nothing was merged."""
    command = [
        Path(sys.executable).with_name("mapfuse"),
        "simulate",
        kind,
        "-o",
        folder,
        "--seed",
        str(seed),
        "--joint",
    ]
    subprocess.run([str(part) for part in command], check=True, capture_output=True)
    maps = [read_map(path) for path in sorted(folder.glob("*.map.json"))]
    truth = read_truth(next(folder.glob("*.truth.json")))
    expected = se2.between(*(truth.frames[m.name] for m in maps))
    fused = fuse(maps)
    T12 = fused.pairs[0].T12
    if fused.decision != "merged" or T12 is None or T12.covariance is None:
        return None
    laid = align(maps[0].walls, maps[1].walls, T12.array)
    if laid is None:
        return None
    by_landmarks = np.linalg.inv(T12.covariance)
    by_both = by_landmarks + laid.information
    apart = laid.T12 - T12.array
    apart[2] = se2.wrap(apart[2])
    both = T12.array + np.linalg.solve(by_both, laid.information @ apart)
    rigid = wall_evidence(maps[0], maps[1], T12.array)
    elastic = wall_evidence(maps[0], maps[1], T12.array, placed=placed_by(fused, maps))
    print(kind, seed, "against the merge, maps rigid:", rigid, "and bent:", elastic, flush=True)
    found = []
    for pose, information in ((T12.array, by_landmarks), (laid.T12, laid.information), (both, by_both)):
        error = pose - expected
        error[2] = se2.wrap(error[2])
        found.append((error, information))
    return found


def placed_by(fused: FusedMap, maps: list[LandmarkMap]) -> tuple[np.ndarray, np.ndarray]:
    """Where the merged map has the landmarks of both maps, in the frame of the first."""
    at = [{i: (l.x, l.y) for l in fused.landmarks for i in l.sources.get(m.name, ())} for m in maps]
    first, second = (np.array([places[i] for i in m.ids]) for places, m in zip(at, maps, strict=True))
    return first, second


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=8)
    parser.add_argument("--quick", action="store_true", help="two pairs")
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    found = []
    count = 2 if given.quick else given.pairs
    for k in range(count):
        with tempfile.TemporaryDirectory() as name:
            one = pair_of(KINDS[k % len(KINDS)], FIRST_SEED + k, Path(name))
        if one is not None:
            found.append(one)
    print(f"\n{len(found)} of {count} pairs merged, seeds from {FIRST_SEED}\n")
    print("| T12 by | rms x, y [m] | rms theta [deg] | mean NEES (3) |\n|---|---|---|---|")
    for title, cases in zip(("landmarks", "walls", "both"), zip(*found, strict=True), strict=True):
        errors = np.array([error for error, _ in cases])
        nees = np.mean([error @ information @ error for error, information in cases])
        rms = np.sqrt((errors**2).mean(axis=0))
        print(f"| {title} | {np.hypot(*rms[:2]):.3f} | {np.degrees(rms[2]):.2f} | {nees:.2f} |")


if __name__ == "__main__":
    main()
