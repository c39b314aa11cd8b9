"""Topological maps of one care home in three years (STRANDS), turned and shifted at random, names dropped.

Nothing was tuned on them. Nodes that kept their name are what the truth is; some were moved between the years.
"""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.formats import read_any
from mapfuse.fusion import fuse

YEARS = (2, 3, 4)


def moved(map_, T, rng):
    """A map in another frame, its nodes in random order with made-up ids, and the name of each."""
    order = rng.permutation(len(map_)).tolist()
    id_of = {map_.ids[k]: f"n{place}" for place, k in enumerate(order)}
    xy = se2.transform(T, map_.positions)
    landmarks = [
        replace(
            map_.landmarks[k],
            id=id_of[map_.ids[k]],
            x=float(xy[k, 0]),
            y=float(xy[k, 1]),
            links=tuple(
                replace(link, connected_to_id=id_of[link.connected_to_id], extra={}) for link in map_.landmarks[k].links
            ),
            extra={},
        )
        for k in order
    ]
    return map_.replace(landmarks=tuple(landmarks), extra={}), {i: name for name, i in id_of.items()}


@pytest.mark.parametrize("years", [*combinations(YEARS, 2)], ids=lambda years: "y{}-y{}".format(*years))
def test_years_of_one_care_home_fuse_and_names_agree(shared_data, years):
    rng = np.random.default_rng(20 + sum(years))
    frames = [np.array([*rng.uniform(-50, 50, 2), rng.uniform(-np.pi, np.pi)]) for _ in years]
    recorded = [read_any(shared_data / "strands" / f"aaf_y{year}.tplg")[0] for year in years]
    (map1, name1), (map2, name2) = (moved(m, T, rng) for m, T in zip(recorded, frames, strict=True))
    (pair,) = fuse([map1, map2]).pairs
    assert pair.decision == "merged"
    named = [(name1[a], name2[b]) for a, b in pair.correspondences]
    assert np.mean([a == b for a, b in named]) >= 0.95
    common = set(recorded[0].ids) & set(recorded[1].ids)
    assert len(named) >= 0.8 * len(common)
    # The years share a frame but for a few decimetres, so that the motion is known to about as much.
    T12 = se2.compose(frames[0], se2.inverse(frames[1]))
    off = se2.transform(pair.T12.array, map2.positions) - se2.transform(T12, map2.positions)
    assert np.median(np.hypot(*off.T)) < 0.3
