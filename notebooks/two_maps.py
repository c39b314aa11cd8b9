# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Two maps to one
#
# Two robots, Vespucci and Milka, have explored parts of one corridor floor. Where they started relative to each other
# is unknown. **The floor and both recordings are simulated** (`mapfuse.datasets.simulation`), so there is a truth to
# compare with at the end; `fuse` never sees it.

# %%
import logging

import numpy as np
from IPython.display import Markdown
from scipy.stats import chi2

from mapfuse.datasets import read_map, recordings, se2
from mapfuse.datasets.truth import read_truth
from mapfuse.fusion import fuse
from mapfuse.fusion.show import draw_fused, draw_map
from mapfuse.matching import MatchingConfig, propose

# %matplotlib inline
# %config InlineBackend.print_figure_kwargs = {"bbox_inches": None}

logging.getLogger("mapfuse").setLevel(logging.ERROR)  # one corner has an arm too many: meant so, as a sonar's mistake

# %% [markdown]
# ## Read and look
#
# Each map is in the frame in which its robot started. Arms of a landmark are open, blocked or a door; straight lines
# are the links that the robot travelled.

# %%
map1, map2 = (read_map(recordings.path(name)) for name in recordings.SCENES["ground-floor"])
assert all(recorded.extra["simulated"] for recorded in (map1, map2))
draw_map(map1, dpi=52)

# %%
draw_map(map2, dpi=52)

# %% [markdown]
# ## Propose
#
# A hypothesis is one possible `T12`, which takes coordinates of map 2 into map 1. The matcher of Dedeoglu and Sukhatme
# (2000) counts the landmarks that match within a metre and takes the highest count. The default mode uses no compass,
# lets doors propose too, and keeps those answers that lie more than a metre apart. The last column is how far each
# hypothesis puts map 2's landmarks from where they belong, on average; only the simulation knows that.

# %%
truth = read_truth(recordings.truth_path("ground-floor"))
T12_true = truth.T12(map1.name, map2.name)


def displacement(T12):
    apart = se2.transform(T12.array, map2.positions) - se2.transform(T12_true.array, map2.positions)
    return np.linalg.norm(apart, axis=1).mean()


rows = ["| mode | hypotheses | rank | matches | x [m] | y [m] | theta [deg] | off by [m] |", "|" + "---|" * 8]
for mode in ("paper", "default"):
    hypotheses = propose(map1, map2, MatchingConfig(mode=mode))
    for rank, h in enumerate(hypotheses[:3], start=1):
        pose = f"{h.T12.x:.2f} | {h.T12.y:.2f} | {np.degrees(h.T12.theta):.1f}"
        rows.append(f"| {mode} | {len(hypotheses)} | {rank} | {h.count} | {pose} | {displacement(h.T12):.1f} |")
Markdown("\n".join(rows))

# %% [markdown]
# A count is no probability: nothing in this table says whether these maps overlap at all.
#
# ## Fuse
#
# `fuse` lets hypotheses grow, weighs what speaks for and against each (docs/evidence.md), solves a factor graph for the
# best, and decides: `merged`, `ambiguous` or `no_overlap`.

# %%
fused = fuse([map1, map2])
pair = fused.pairs[0]
Markdown(
    f"**{fused.decision}**, probability {fused.probability:.6f}; that they share nothing: "
    f"{pair.no_overlap_probability:.0e}\n\n{pair.reason}"
)

# %%
draw_fused(fused, dpi=76)

# %% [markdown]
# ## How sure
#
# `T12` with its standard deviations, beside the truth. The last column should be between -2 and 2 nineteen times in
# twenty. The joint measure of the three errors is the squared Mahalanobis distance (NEES): 3 on average, and chi-square
# distributed, where the covariance is right. One pair says little; the tests average over hundreds.

# %%
T12 = pair.T12
sigma = np.sqrt(np.diag(T12.covariance))
error = T12.array - T12_true.array
error[2] = se2.wrap(error[2])
rows = ["| | estimate | sigma | truth | error / sigma |", "|---|---|---|---|---|"]
for k, name in enumerate(("x [m]", "y [m]", "theta [rad]")):
    rows.append(
        f"| {name} | {T12.array[k]:.3f} | {sigma[k]:.3f} | {T12_true.array[k]:.3f} | {error[k] / sigma[k]:+.1f} |"
    )
nees = error @ np.linalg.solve(T12.covariance, error)
Markdown("\n".join(rows) + f"\n\nNEES {nees:.1f}; a right covariance gives more in {chi2.sf(nees, 3):.0%} of pairs")

# %% [markdown]
# Half a metre seems much for `T12`. But it lies between the two robots' *starts*, and where its start is relative to
# the landmarks each robot knows to 0.3 m per axis only (`position_sigma`): 0.42 m for both, before anything is matched.
# The covariance over x, y [m] and theta [rad] as correlations:

# %%
np.round(T12.covariance / np.outer(sigma, sigma), 2)

# %% [markdown]
# Given that the maps overlap, `mixture_covariance` adds the spread between the hypotheses. Where one has nearly all of
# the probability, as here, it is the same:

# %%
np.sqrt(np.diag(pair.mixture_covariance)) / sigma

# %% [markdown]
# ## What is really there
#
# Every landmark carries the probability that it exists. Below 0.9 here: what one robot saw and the other one should
# have seen, and what was seen once by a sensor that often errs. The truth knows which are false.

# %%
rows = ["| landmark | type | in | x [m] | y [m] | existence | really there |", "|" + "---|" * 7]
for landmark in sorted(fused.landmarks, key=lambda landmark: landmark.existence):
    if landmark.existence < 0.9:
        sources = [(name, i) for name, ids in landmark.sources.items() for i in ids]
        there = any(truth.landmarks[name][i] is not None for name, i in sources)
        seen = ", ".join(f"{name}:{i}" for name, i in sources)
        place = f"{landmark.x:.1f} | {landmark.y:.1f} | {landmark.existence:.2f}"
        rows.append(f"| {landmark.id} | {landmark.type} | {seen} | {place} | {'yes' if there else 'no'} |")
Markdown("\n".join(rows))

# %% [markdown]
# ## Right or wrong
#
# The reported matches against the true ones, and every true landmark of the merged map against where it is.

# %%
true_pairs = set(truth.true_pairs(map1.name, map2.name))
found = set(pair.correspondences)
squared = []
for landmark in fused.landmarks:
    name, (first, *_) = next(iter(landmark.sources.items()))
    place = truth.landmarks[name][first]
    if place is not None:
        at = se2.transform(se2.inverse(truth.frames[map1.name]), truth.places[place])
        off = np.array([landmark.x, landmark.y]) - at
        squared.append(off @ np.linalg.solve(landmark.covariance[:2, :2], off))
assert fused.decision == "merged"
assert displacement(T12) < 2.0
Markdown(
    f"{len(found & true_pairs)} of {len(found)} reported matches are true, of {len(true_pairs)} there are. "
    f"Map 2 lies {displacement(T12):.2f} m off on average. "
    f"{np.mean(np.array(squared) < 5.99):.0%} of the {len(squared)} true landmarks lie inside their 95 % ellipses "
    "(they share their errors, so one floor says little; the tests count hundreds)."
)
