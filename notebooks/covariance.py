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
# # How sure, and is that true?
#
# A fused map comes with covariances: of `T12`, of every landmark, of all of them together. This notebook looks at what
# they mean, what they depend on, whether linearising makes them wrong, and whether they hold.
#
# **All maps here are simulated** (`mapfuse.datasets.simulation`) on seeds from `TEST_SEEDS`, which nothing was tuned
# on, so that the truth is known. The code is `mapfuse.fusion.analysis`.

# %%
import logging
from dataclasses import replace

import numpy as np
from IPython.display import Markdown, display
from scipy.stats import chi2

from mapfuse.datasets.maps import Landmark, LandmarkMap, Noise
from mapfuse.datasets.simulation import MILKA, TEST_SEEDS, VESPUCCI, simulated_pair
from mapfuse.factors import FrameKey, LandmarkKey, pair_problem
from mapfuse.fusion import FuseConfig, fuse
from mapfuse.fusion.analysis import Drives, linearised, monte_carlo, run_trials, sigma_points, squared_distances
from mapfuse.fusion.config import SolvingConfig
from mapfuse.fusion.show import charts, plot_ellipses
from mapfuse.fusion.show.style import GREY, INK, owner
from mapfuse.fusion.solve import solve

# %matplotlib inline
# %config InlineBackend.print_figure_kwargs = {"bbox_inches": None}

logging.getLogger("mapfuse").setLevel(logging.ERROR)
BLUE, ORANGE, GREEN, PINK = (owner(k).line for k in range(4))


def table(heads, rows):
    lines = [heads, ["---"] * len(heads), *rows]
    return Markdown("\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines))


# %% [markdown]
# ## Two drives, and the merged map's ellipses
#
# Two robots each drive through about two fifths of one floor.

# %%
SEED = TEST_SEEDS[0]
drives = Drives.drawn(SEED, share=(0.35, 0.45), min_common=8)
map1, map2, truth = drives.pair(np.random.default_rng(SEED))
fused = fuse([map1, map2])
pair = fused.pairs[0]
assert fused.decision == "merged"
Markdown(
    f"**{fused.decision}**: {len(map1)} and {len(map2)} landmarks, {len(pair.correspondences)} of them matched, "
    f"probability {fused.probability:.4f}."
)

# %% [markdown]
# A covariance always is one *in a frame*. In the frame of robot 1's start, left, every ellipse holds the same error
# which all landmarks share: where the start is relative to the map, `position_sigma` 0.3 m per axis. Relative to one
# common landmark, right, that is gone, and what is left grows with the way from there. The joint covariance of all
# landmarks, `fused.joint_covariances`, says both.

# %%
joint = fused.joint_covariances[0]
positions = np.array([[l.x, l.y] for l in fused.landmarks])
common = [k for k, l in enumerate(fused.landmarks) if len(l.sources) > 1]
middle = positions[common].mean(axis=0)
base = min(common, key=lambda k: np.hypot(*(positions[k] - middle)))
n = joint.rows
xy = np.arange(2)


def block(a, b):
    return joint.matrix[np.ix_(n * a + xy, n * b + xy)]


relative = np.array([block(k, k) + block(base, base) - block(k, base) - block(base, k) for k in range(len(positions))])
own = np.array([block(k, k) for k in range(len(positions))])
figure, axes = charts(2, height=4.4)
for ax, covariances, title in zip(
    axes, (own, relative), ("in the frame of robot 1's start", "relative to the landmark at the cross"), strict=True
):
    ax.set_aspect("equal", adjustable="datalim")
    ax.plot(*positions.T, ".", color=GREY, markersize=3)
    ax.plot(*positions[common].T, ".", color=INK, markersize=5, label="in both maps")
    plot_ellipses(ax, positions, covariances, colour=BLUE, scale=3, fill=0.1, label="95 % ellipse, 3 × enlarged")
    ax.set_title(title, fontsize=9)
    ax.set_xlabel("x [m]")
axes[1].plot(*positions[base], "x", color=PINK, markersize=9, markeredgewidth=2)
axes[0].set_ylabel("y [m]")
axes[0].legend(fontsize=7.5, loc="best")
display(figure)

# %%
sigma = np.sqrt(np.trace(relative, axis1=1, axis2=2))
away = np.hypot(*(positions - positions[base]).T)
others = np.arange(len(positions)) != base
ranks = [np.argsort(np.argsort(values[others])) for values in (away, sigma)]
rank_correlation = np.corrcoef(*ranks)[0, 1]
assert rank_correlation > 0.5
in_frame = np.sqrt(np.trace(own, axis1=1, axis2=2))
Markdown(
    f"In the start's frame the standard deviations are {in_frame.min():.2f} to {in_frame.max():.2f} m, relative to the "
    f"landmark {sigma[others].min():.2f} to "
    f"{sigma.max():.2f} m; the rank correlation of the latter with the distance is {rank_correlation:.2f}."
)

# %% [markdown]
# ## Linearised, sigma points, Monte Carlo
#
# Reported covariances are *linearised*: the inverse of the information at the optimum. Two other ways go from the noise
# of the readings through the whole nonlinear solve. *Sigma points* (filterpy's, after van der Merwe) are chosen noise,
# weighed: two solves for each of the readings. *Monte Carlo* draws the noise. Which landmarks match is given in all
# three.

# %%
solution = fused.landmark_mixture().placements[0].solution
T12 = [FrameKey(1)]
rng = np.random.default_rng(SEED + 1)
ways = {
    "linearised": linearised(solution, T12),
    "sigma points": sigma_points(solution, T12),
    "Monte Carlo": monte_carlo(solution, T12, 200, rng),
}


def sigmas(spread):
    x, y, theta = spread.sigmas
    return f"{x:.3f}", f"{y:.3f}", f"{np.degrees(theta):.3f}"


assert np.allclose(ways["sigma points"].sigmas, ways["linearised"].sigmas, rtol=0.05)
assert np.allclose(ways["Monte Carlo"].sigmas, ways["linearised"].sigmas, rtol=4 / np.sqrt(2 * 200))
table(
    ["T12", "graphs solved", "sigma x [m]", "sigma y [m]", "sigma theta [deg]"],
    [[name, spread.solves, *sigmas(spread)] for name, spread in ways.items()],
)

# %% [markdown]
# The three agree: 200 draws know a standard deviation to within 5 %, one sigma. Errors of half a degree bend nothing.
#
# Linearising fails where an uncertain direction meets a long lever. The smallest such case, built by hand: two robots
# share two trees that stand 3 m apart, and one of them knows a third tree 30 m away. Each position is known to 0.2 m.

# %%
noise = Noise(position_sigma=0.2)
near = (Landmark("a", "tree", 0.0, 0.0), Landmark("b", "tree", 0.0, 3.0))
one, other = (
    LandmarkMap("one", near, noise=noise),
    LandmarkMap("other", (*near, Landmark("far", "tree", 30.0, 1.5)), noise=noise),
)
lever = solve(pair_problem(one, other, np.zeros(3), [("a", "a"), ("b", "b")], robust=False), SolvingConfig())
far = [LandmarkKey(1, "far")]
spreads = {
    "linearised": linearised(lever, far),
    "sigma points": sigma_points(lever, far),
    "Monte Carlo": monte_carlo(lever, far, 1000, rng),
}
figure, axes = charts(2, height=3.4)
looks = {"linearised": (INK, "-"), "sigma points": (ORANGE, (0, (5, 2))), "Monte Carlo": (BLUE, (0, (1, 1)))}
for ax, of, at, title in (
    (axes[0], ways, np.zeros(2), "T12 of the two drives: errors of x and y"),
    (axes[1], spreads, np.array([30.0, 1.5]), "the far tree"),
):
    drawn = of["Monte Carlo"].errors
    ax.plot(*(at + drawn[:, :2]).T, ".", color=BLUE, markersize=2, alpha=0.35)
    for name, spread in of.items():
        colour, line = looks[name]
        plot_ellipses(ax, at + spread.mean[:2], spread.covariance[:2, :2], colour=colour, linestyle=line, label=name)
    ax.set_title(title, fontsize=9)
    ax.set_xlabel("x [m]")
axes[0].set_aspect("equal", adjustable="datalim")
axes[0].set_ylabel("y [m]")
axes[0].legend(fontsize=7.5, loc="upper right")
display(figure)

# %%
held = {}
for name, spread in spreads.items():
    off = spreads["Monte Carlo"].errors[:, :2] - spread.mean[:2]
    held[name] = np.mean(squared_distances(off, spread.covariance[:2, :2]) < chi2(2).ppf(0.95))
assert held["linearised"] < 0.9 < held["sigma points"]
table(
    ["the far tree", "mean x [m]", "sigma x [m]", "sigma y [m]", "draws inside its 95 % ellipse"],
    [
        [name, f"{30 + spread.mean[0]:.2f}", f"{spread.sigmas[0]:.2f}", f"{spread.sigmas[1]:.2f}", f"{held[name]:.0%}"]
        for name, spread in spreads.items()
    ],
)

# %% [markdown]
# Along the lever the linearised ellipse is too thin, and it stands at the cloud's outer edge: too many draws are
# outside. Sigma points and Monte Carlo know both the shift and the width (the cloud stays bent, which no ellipse is).
# So where `T12`'s rotation is known to several degrees only, don't trust a linearised ellipse far from the overlap.

# %% [markdown]
# ## What it depends on
#
# Two longer drives on another floor, whose maps carry compass readings. The graph is solved again with fewer of their
# matches (random ones, one in the middle always among them), without compass, and with drift as if the robots' odometry
# and gyroscopes were better or worse than they are. Shown are the rotation of `T12`, and the position of map 2's
# landmarks relative to the one in the middle (root mean square); lines are medians over six draws of matches, bands
# their range.

# %%
wide = Drives.drawn(TEST_SEEDS[1], share=(0.6, 0.7), min_common=16)
wide1, wide2, _ = wide.pair(np.random.default_rng(TEST_SEEDS[1]))
wide_pair = fuse([wide1, wide2]).pairs[0]
assert wide_pair.decision == "merged"
matches = list(wide_pair.correspondences)
centre = np.mean([[wide1[a].x, wide1[a].y] for a, _ in matches], axis=0)
matches.sort(key=lambda match: np.hypot(*(np.array([wide1[match[0]].x, wide1[match[0]].y]) - centre)))
middle_match, rest = matches[0], matches[1:]


def without_compass(recorded):
    landmarks = [replace(l, links=tuple(replace(link, compass=None) for link in l.links)) for l in recorded.landmarks]
    return recorded.replace(landmarks=tuple(landmarks))


def with_drift(recorded, factor):
    names = ("distance_sigma_per_metre", "distance_sigma_floor", "heading_sigma")
    return recorded.replace(
        noise=replace(recorded.noise, **{name: factor * getattr(recorded.noise, name) for name in names})
    )


def uncertainty(recorded1, recorded2, kept):
    """Standard deviations of T12's rotation [deg], and of map 2's landmarks relative to the middle one [m]."""
    problem = pair_problem(recorded1, recorded2, wide_pair.T12, kept, robust=False)
    solution = solve(problem, SolvingConfig(gate_probability=0.999999))
    keys = [LandmarkKey(0, middle_match[0]), *solution.landmark_keys(1)]
    joint = solution.joint_covariance(keys).reshape(len(keys), 3, len(keys), 3)
    squares = [
        sum(joint[k, c, k, c] + joint[0, c, 0, c] - 2 * joint[k, c, 0, c] for c in (0, 1)) for k in range(1, len(keys))
    ]
    return np.degrees(np.sqrt(solution.covariance(FrameKey(1))[2, 2])), np.sqrt(np.mean(squares))


counts = [2, 3, 4, 6, 9, 13, len(matches)]
rng = np.random.default_rng(TEST_SEEDS[1] + 1)
subsets = [[[middle_match, *(rest[k] for k in rng.permutation(len(rest))[: n - 1])] for _ in range(6)] for n in counts]
by_count = {}
for name, change in (("with compass", lambda m: m), ("without", without_compass)):
    pair_of_maps = change(wide1), change(wide2)
    by_count[name] = np.array([[uncertainty(*pair_of_maps, kept) for kept in of_count] for of_count in subsets])
factors = np.array([0.5, 1.0, 2.0, 4.0])
by_drift = np.array([uncertainty(with_drift(wide1, f), with_drift(wide2, f), matches) for f in factors])

figure, axes = charts(3, height=3.0)
for k, (ax, what) in enumerate(
    zip(axes, ("T12's rotation: sigma [deg]", "landmarks of map 2: sigma [m]"), strict=False)
):
    for (name, found), colour, marker, size in zip(by_count.items(), (ORANGE, BLUE), "so", (7, 3), strict=True):
        values = found[:, :, k]
        ax.fill_between(counts, values.min(axis=1), values.max(axis=1), color=colour, alpha=0.12, linewidth=0)
        ax.plot(
            counts, np.median(values, axis=1), color=colour, marker=marker, markersize=size, linewidth=1, label=name
        )
    ax.set_title(what, fontsize=9)
    ax.set_xlabel("matched landmarks")
    ax.set_ylim(0)
axes[0].legend(fontsize=7.5)
axes[2].loglog(factors, by_drift[:, 0] / by_drift[1, 0], color=GREEN, marker="o", markersize=4, label="rotation")
axes[2].loglog(factors, by_drift[:, 1] / by_drift[1, 1], color=PINK, marker="s", markersize=4, label="landmarks")
axes[2].loglog(factors, factors, color=GREY, linewidth=0.8, linestyle=(0, (4, 3)), label="in proportion")
axes[2].set_xticks(factors, [f"{f:g}" for f in factors])
axes[2].set_yticks(factors, [f"{f:g}" for f in factors])
axes[2].minorticks_off()
axes[2].set_title("both, by drift (1: as recorded)", fontsize=9)
axes[2].set_xlabel("drift, all matches")
axes[2].legend(fontsize=7.5)
display(figure)

# %%
medians = {name: np.median(found, axis=1) for name, found in by_count.items()}
gain = {n: medians["without"][k] / medians["with compass"][k] for k, n in enumerate(counts)}
assert (medians["without"][0] > medians["without"][-1]).all()
assert all((ratio > 0.95).all() for ratio in gain.values())
table(
    ["matched", "rotation, with compass [deg]", "without [deg]", "landmarks, with compass [m]", "without [m]"],
    [
        [n, *(f"{medians[name][k][column]:.2f}" for column in (0, 1) for name in ("with compass", "without"))]
        for k, n in enumerate(counts)
    ],
)

# %%
Markdown(
    f"From {counts[0]} matches to {counts[-1]} the rotation becomes "
    f"{medians['without'][0, 0] / medians['without'][-1, 0]:.1f} times surer and the landmarks "
    f"{medians['without'][0, 1] / medians['without'][-1, 1]:.1f} times (without compass). A compass makes the rotation "
    f"{(gain[counts[0]][0] - 1):.0%} surer with {counts[0]} matches and {(gain[counts[-1]][0] - 1):.0%} with "
    f"{counts[-1]}: each landmark's arms say which way the corridors run, so well that the compass adds little. "
    "What a compass is worth is the choice between rivals, as the notebook on ambiguity shows. "
    f"With four times the drift the landmarks are {by_drift[3, 1] / by_drift[1, 1]:.1f} times less sure and the "
    f"rotation {by_drift[3, 0] / by_drift[1, 0]:.1f} times."
)

# %% [markdown]
# ## Does it hold?
#
# The two drives of the beginning, recorded 24 times: floor and routes stay; errors, misses and false alarms are new
# each time, and so is what `fuse` makes of it, associations included.
#
# Then 10 other pairs, each of a floor of its own. The squared Mahalanobis distance (NEES) of an error of `T12` from its
# own stated covariance is chi-square distributed with 3 degrees of freedom if that is right, and the mean of 10 lies in
# a band around 3 with 95 %. The same 10 pairs again with files that state half of the true noise, half of it
# with the noise estimated from each map's own residuals (`--estimate-noise`), and twice the true noise.

# %%
again = run_trials(drives.pair(np.random.default_rng([SEED, k])) for k in range(24))

default = FuseConfig()
estimating = replace(default, solving=replace(default.solving, estimate_noise=True))


pairs = [simulated_pair(seed, compass=True, share=(0.35, 0.45)) for seed in TEST_SEEDS[100:110]]


def stating(factor):
    """The pairs with maps that state ``factor`` times the true noise."""
    for *recorded, its_truth in pairs:
        one, other = (
            m.replace(noise=replace(robot, noise=m.noise, stated_noise_factor=factor).stated_noise)
            for m, robot in zip(recorded, (VESPUCCI, MILKA), strict=True)
        )
        yield one, other, its_truth


studies = {
    "true": run_trials(pairs, default),
    "half": run_trials(stating(0.5), default),
    "half, estimated": run_trials(stating(0.5), estimating),
    "twice": run_trials(stating(2.0), default),
}

figure, axes = charts(2, height=3.6)
axes[0].plot(*again.errors[:, :2].T, "o", color=BLUE, markersize=3.5, label="error of T12, by recording")
stated = again.covariances.mean(axis=0)[:2, :2]
plot_ellipses(axes[0], [0.0, 0.0], stated, colour=INK, label="95 % ellipse, mean of the stated")
axes[0].set_aspect("equal", adjustable="datalim")
axes[0].set_xlabel("error of x [m]")
axes[0].set_ylabel("error of y [m]")
axes[0].set_title("the same drives again and again", fontsize=9)
axes[0].legend(fontsize=7, loc="upper right")
quantiles = np.linspace(0, 20, 200)
axes[1].plot(quantiles, chi2(3).cdf(quantiles), color=GREY, linewidth=4, alpha=0.4, label="chi-square, 3 degrees")
looks = zip((INK, ORANGE, ORANGE, GREEN), ("-", ":", "-", ":"), strict=True)
for (name, trials), (colour, line) in zip(studies.items(), looks, strict=True):
    nees = np.sort(trials.consistency.nees)
    shares = np.arange(len(nees) + 1) / len(nees)
    steps = [0.0, *nees, max(20.0, nees[-1])]
    axes[1].stairs(shares, steps, baseline=None, color=colour, linestyle=line, linewidth=1.3, label=name)
axes[1].set_xlim(0, 20)
axes[1].set_xlabel("NEES of T12")
axes[1].set_title("share of pairs below, by stated noise", fontsize=9)
axes[1].legend(fontsize=7, loc="lower right")
display(figure)

# %%
rows = []
for name, trials in {"true, the same drives": again, **studies}.items():
    found = trials.consistency
    low, high = found.held_band
    rows.append(
        [
            name,
            f"{len(trials.merged)} of {len(trials)}",
            trials.merged_wrongly,
            f"{found.mean:.2f}",
            f"{found.band[0]:.2f} to {found.band[1]:.2f}",
            f"{found.held:.0%} ({low:.0%} to {high:.0%})",
            f"{found.scale:.2f}",
        ]
    )
heads = ["stated noise", "merged", "wrongly", "mean NEES", "95 % band", "inside 95 % (bounds)", "true errors / stated"]
table(heads, rows)

# %%
found = {name: trials.consistency for name, trials in {"true, the same drives": again, **studies}.items()}
assert found["half"].mean > found["half"].band[1]
assert found["half, estimated"].mean < found["half"].mean / 2
assert found["twice"].mean < found["twice"].band[0]
inside = [name for name, c in found.items() if c.band[0] <= c.mean <= c.band[1]]
outside = [name for name in found if name not in inside]
Markdown(
    f"The mean NEES is inside its band where the stated noise is: {'; '.join(inside)}. It is outside where it is: "
    f"{'; '.join(outside)}. A covariance is as good as the noise that the maps state: stated half, the errors are "
    f"{found['half'].scale:.1f} times what the covariance says. The maps' own residuals know it, since loops then "
    f"close worse than they should: with the noise estimated it is {found['half, estimated'].scale:.1f} times. "
    "Statistics are of the merged pairs, and one mean in twenty is outside its band by chance. A few pairs are a "
    "picture, not a measurement: [a hundred recordings of each of six drives](../benchmarks/results/rerecorded.md), "
    "[thousands of pairs](../benchmarks/results/calibration.md)."
)
