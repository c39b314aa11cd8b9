"""The picture of the vote in docs/matching.md, from a simulated pair of maps.

.venv/bin/python benchmarks/matching_picture.py [OUT.png]
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matching_floors import FloorPair, pair_of_maps

from mapfuse.datasets import se2
from mapfuse.matching import MatchingConfig, propose
from mapfuse.matching.landmark_arrays import landmark_arrays
from mapfuse.matching.settings import SETTINGS, Settings
from mapfuse.matching.voting import Pair

OUT = Path(__file__).resolve().parents[1] / "docs" / "images" / "matching-vote.png"
SEED = 12


def draw(pair: FloorPair, path: Path) -> None:
    """Rotations that all pairs of landmarks propose; the votes of one rotation mode; map 2 laid on map 1."""
    arrays = landmark_arrays(pair.map1), landmark_arrays(pair.map2)
    everything = Pair(*arrays, MatchingConfig(), Settings(direct=10**9)).proposals().T12s
    best = propose(pair.map1, pair.map2)[0].T12.array
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")

    left.hist(np.rad2deg(everything[:, 2]), bins=180, color="0.5")
    left.axvline(np.rad2deg(best[2]), color="C3", lw=1)
    left.set(xlabel="rotation [degrees]", ylabel="proposals", title="Turns that lay arms on arms")

    in_mode = everything[np.abs(se2.wrap(everything[:, 2] - best[2])) < SETTINGS.rotation_width]
    c, s = np.cos(best[2]), np.sin(best[2])
    # the translation at the mode's own rotation, about the middle of map 2
    centre = arrays[1].xy.mean(axis=0)
    at = se2.transform(in_mode, centre) - np.array([c * centre[0] - s * centre[1], s * centre[0] + c * centre[1]])
    size = SETTINGS.cell_m
    edges = [np.arange(a.min(), a.max() + size, size) for a in at.T]
    votes = np.histogram2d(*at.T, bins=edges)[0]
    shown = middle.pcolormesh(*edges, votes.T, cmap="viridis", rasterized=True)
    middle.plot(best[0], best[1], "o", mfc="none", mec="C3", ms=14)
    middle.set(xlabel="x of T12 [m]", ylabel="y of T12 [m]", title="Votes of the marked rotation", aspect="equal")
    figure.colorbar(shown, ax=middle, label="pairs")

    right.plot(*arrays[0].xy.T, "s", mfc="none", color="C0", label="map 1")
    right.plot(*se2.transform(best, arrays[1].xy).T, "+", color="C1", label="map 2 under the first hypothesis")
    right.set(xlabel="x [m]", ylabel="y [m]", title="First in the list (simulated)", aspect="equal")
    right.legend(fontsize="small", loc="upper left", bbox_to_anchor=(0.0, -0.15))
    figure.savefig(path, dpi=80, metadata={"Software": None})
    plt.close(figure)


def main() -> None:
    """Draw to the path given, or to docs/images."""
    draw(
        pair_of_maps(120, "irregular", np.random.default_rng(SEED), overlap=0.4),
        Path(sys.argv[1]) if len(sys.argv) > 1 else OUT,
    )


if __name__ == "__main__":
    main()
