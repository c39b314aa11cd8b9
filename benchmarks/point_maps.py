"""Maps of points without headings to measure the matcher on: simulated ones with known truth, Halmstad's corners."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Landmark, LandmarkMap, Noise
from mapfuse.matching.config import MatchingConfig

Array = NDArray[np.float64]

#: A landmark per so many square metres of floor.
AREA_M2 = 36.0
MISSED, FALSE = 0.19, 0.20
HALMSTAD = Path(__file__).resolve().parents[1] / ".." / "shared" / "data" / "halmstad" / "annotations"
#: Pixels, not metres: corners are off by 9 px in all, and the maps' bend against each other has 18 px over 250 px.
HALMSTAD_NOISE = Noise(position_sigma=9 / 2**0.5, detection_rate=0.8, false_alarm_rate=0.2)
HALMSTAD_CONFIG = MatchingConfig(tolerance_m=20.0, bend_sigma_m=18.0, bend_length_m=250.0, max_hypotheses=24)


@dataclass(frozen=True, slots=True)
class PointPair:
    """Two maps, the true ``T12`` (3,), and the places (k, 2) of landmarks that both have."""

    map1: LandmarkMap
    map2: LandmarkMap
    T12: Array
    common: NDArray[np.intp]

    def off(self, T12: Array) -> float:
        """Mean distance [m] between where ``T12`` and the truth take the common landmarks of map 2."""
        at = self.map2.positions[self.common[:, 1]]
        return float(np.hypot(*(se2.transform(T12, at) - se2.transform(self.T12, at)).T).mean())


def simulated_points(seed: int, n: int, overlap: float, sigma: float, labels: int = 1, bend: float = 0.0) -> PointPair:
    """Two maps of about ``n`` points each from floors that share ``overlap`` of their area; simulated.

    Points lie anywhere, one per `AREA_M2`; each robot misses 19 % of them, 20 % of a map's are false, positions have
    ``sigma`` [m] per axis in each map. ``bend`` [m]: standard deviation of a smooth bend of map 2, as long as a third
    of the floor.
    """
    rng = np.random.default_rng(seed)
    n_places = n * (1 - FALSE) / (1 - MISSED)
    side = float(np.sqrt(n_places * AREA_M2))
    whole = np.array([(2 - overlap) * side, side])
    places = rng.uniform(0, whole, (rng.poisson(n_places * (2 - overlap)), 2))
    kinds = rng.integers(labels, size=len(places))
    T12 = np.array([*rng.uniform(-100, 100, 2), rng.uniform(-np.pi, np.pi)])
    maps, recorded = [], []
    for name, T, low in (("a", np.zeros(3), 0.0), ("b", T12, (1 - overlap) * side)):
        inside = np.flatnonzero((places[:, 0] >= low) & (places[:, 0] <= low + side))
        seen = inside[rng.random(len(inside)) > MISSED]
        n_false = rng.poisson(FALSE * n)
        xy = np.vstack([places[seen], rng.uniform((low, 0), (low + side, side), (n_false, 2))])
        xy = xy + rng.normal(0, sigma, xy.shape)
        if name == "b" and bend:
            xy = xy + _bend(rng, xy, bend, side / 3)
        xy = se2.transform(se2.inverse(T), xy)
        of = np.concatenate([kinds[seen], rng.integers(labels, size=n_false)])
        order = rng.permutation(len(xy))
        marks = tuple(Landmark(f"{name}{k}", f"kind {of[p]}", *xy[p].tolist()) for k, p in enumerate(order))
        maps.append(LandmarkMap(name, marks, noise=Noise(position_sigma=sigma, detection_rate=1 - MISSED)))
        where = np.full(len(places), -1)
        where[seen] = np.argsort(order)[: len(seen)]
        recorded.append(where)
    both = np.flatnonzero((recorded[0] >= 0) & (recorded[1] >= 0))
    return PointPair(*maps, T12, np.stack([recorded[0][both], recorded[1][both]], axis=1))


def _bend(rng: np.random.Generator, xy: Array, sigma: float, length: float) -> Array:
    """Smooth displacements (n, 2) [m]: a few waves with the spectrum of a Gaussian kernel."""
    k = rng.normal(0, 1 / length, (24, 2))
    phase = rng.uniform(0, 2 * np.pi, (24, 2))
    waves = np.cos((xy @ k.T)[:, :, None] + phase)
    return np.asarray(sigma * np.sqrt(2 / 24) * waves.sum(axis=1))


def halmstad_pairs() -> list[PointPair]:
    """The pairs of sensor maps of floor E5 with usable correspondences; lengths in pixels.

    The truth is their own best rigid fit.
    """
    names = [f"E5_{k:02d}" for k in range(1, 15)]
    maps = {name: _halmstad_map(name) for name in names}
    out = []
    for a, b in combinations(names, 2):
        try:
            common = np.load(HALMSTAD / f"association_{a}_{b}.npy", allow_pickle=False).astype(np.intp)
        except (OSError, ValueError):
            continue
        p1, p2 = maps[a].positions[common[:, 0]], maps[b].positions[common[:, 1]]
        out.append(PointPair(maps[a], maps[b], se2.align(p1, p2).T12, common))
    return out


def _halmstad_map(name: str) -> LandmarkMap:
    xy = np.load(HALMSTAD / f"keypoints_{name}.npy", allow_pickle=False)
    marks = tuple(Landmark(str(k), "corner", *p) for k, p in enumerate(xy.tolist()))
    return LandmarkMap(name, marks, noise=HALMSTAD_NOISE)


def diagonal(recorded: LandmarkMap) -> float:
    """Diagonal [m] of the box around the map's landmarks."""
    return float(np.hypot(*np.ptp(recorded.positions, axis=0)))
