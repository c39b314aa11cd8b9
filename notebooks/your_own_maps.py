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
# # Bring your own maps
#
# How a map gets in: from a file of another program, or built by hand. What to say of how good it is. What to do where
# the answer is `ambiguous`. The maps used as examples are simulated or made up here, and said to be.

# %%
import logging
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from IPython.display import Markdown

from mapfuse.datasets import read_map, recordings, se2
from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.formats import formats, read_any, write_any
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link, Noise
from mapfuse.datasets.transform import Transform
from mapfuse.datasets.truth import read_truth
from mapfuse.fusion import FuseConfig, KnownTransform, fuse
from mapfuse.fusion.config import DecisionConfig
from mapfuse.fusion.show import draw_fused, draw_map

# %matplotlib inline
# %config InlineBackend.print_figure_kwargs = {"bbox_inches": None}

logging.getLogger("mapfuse").setLevel(logging.ERROR)
folder = TemporaryDirectory()
here = Path(folder.name)


def table(heads, rows):
    lines = [heads, ["---"] * len(heads), *rows]
    return Markdown("\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines))


# %% [markdown]
# ## From a file
#
# `read_any` finds out what a file is by what it holds. These are the formats
# ([docs/formats.md](../docs/formats.md) says of each what its frame and units are):

# %%
table(
    ["format", "what it is", "read", "written"],
    [[f"`{f.name}`", f.title, "yes" if f.reads else "", "yes" if f.writes else ""] for f in formats()],
)

# %% [markdown]
# The least that a map can be is a list of objects. Here two robots have listed trees, with the variances of their
# positions, each in its own frame: text as it comes out of somebody's program, made up.

# %%
rng = np.random.default_rng(4)
trees = np.column_stack([rng.uniform(0, 40, 16), rng.uniform(0, 25, 16)])
kinds = rng.choice(["oak", "pine", "bench"], 16)
T_true = np.array([12.0, -4.0, 0.8])  # of the second list in the first
seen = {"north": np.arange(0, 12), "south": np.arange(5, 16)}
for name, which in seen.items():
    at = trees[which] if name == "north" else se2.transform(se2.inverse(T_true), trees[which])
    at = at + rng.normal(0, 0.15, at.shape)
    rows = [f"{name[0]}{k},{kinds[k]},{x:.2f},{y:.2f},0.0225,0,0.0225" for k, (x, y) in zip(which, at, strict=True)]
    (here / f"{name}.csv").write_text("\n".join(["name,label,x,y,cov_xx,cov_xy,cov_yy", *rows]))
Markdown("```\n" + "\n".join((here / "north.csv").read_text().splitlines()[:4]) + "\n```")

# %%
north, found = read_any(here / "north.csv", detection_rate=0.9, false_alarm_rate=0.05)
south, _ = read_any(here / "south.csv", detection_rate=0.9, false_alarm_rate=0.05)
trees_fused = fuse([north, south])
pair = trees_fused.pairs[0]
Markdown(
    f"Taken for `{found.name}`. **{trees_fused.decision}** with probability {trees_fused.probability:.4f}: "
    f"{len(pair.correspondences)} of {len(set(seen['north']) & set(seen['south']))} common objects matched, "
    f"T12 = ({pair.T12.x:.2f} m, {pair.T12.y:.2f} m, {pair.T12.theta:.3f} rad), "
    f"true ({T_true[0]:.2f} m, {T_true[1]:.2f} m, {T_true[2]:.3f} rad)."
)

# %% [markdown]
# `detection_rate` and `false_alarm_rate` are what no such file says: how much the robot misses and invents (on the
# command line `--set detection_rate=0.9`). They count: a landmark that the other robot passed
# and doesn't have speaks against a placement.
#
# What a format can't hold is missed later. Two simulated maps of one floor, as mapfuse's own format has them, with
# arms, travelled ways and their lengths; then both through other formats and back.

# %%
vespucci, milka = (read_map(recordings.path(name)) for name in recordings.SCENES["ground-floor"])
T12_true = read_truth(recordings.truth_path("ground-floor")).T12(vespucci.name, milka.name)
true_places = T12_true.apply(milka.positions)
rows = []
for ending in (".map.json", ".geojson", ".csv", ".g2o"):
    back = []
    for recorded in (vespucci, milka):
        kind, lost = write_any(recorded, here / f"{recorded.name}{ending}")
        back.append(read_any(here / f"{recorded.name}{ending}")[0].replace(name=recorded.name))
    through = fuse(back)
    best = through.pairs[0].hypotheses[0]
    off = np.linalg.norm(best.T12.apply(milka.positions) - true_places, axis=1).mean()
    kept = [what for what in ("heading", "arms", "ways", "distances") if what not in lost]
    rows.append(
        [f"`{kind.name}`", ", ".join(kept) or "none", through.decision, f"{best.probability:.3f}", f"{off:.1f}"]
    )
assert rows[0][2] == "merged"
table(["through", "kept of headings, arms, ways", "decision", "P(best placement)", "best is off by [m]"], rows)

# %%
lost_it = [f"{row[0]} (kept: {row[1]})" for row in rows if row[2] != "merged"]
Markdown(
    ("These maps do overlap, and it isn't found through " + ", ".join(lost_it) + ". " if lost_it else "")
    + "So if your program knows directions and ways, write them: as `mapfuse.map/1` "
    "([README](../README.md#a-map-file)), or in Python."
)

# %% [markdown]
# ## By hand
#
# A corridor with a corner, two doors and a T-junction, as its robot saw it: `x`, `y` in metres where the robot started;
# each arm a `Link` with its direction in that frame, and where the robot went along it also which landmark it came to
# and how far that was. Types with a meaning are `corner`, `junction` and `door`; any other word is a point's label.

# %%
EAST, NORTH, WEST, SOUTH = 0.0, np.pi / 2, np.pi, -np.pi / 2


def way(direction, to, distance):
    """An arm that the robot travelled."""
    return Link("open", direction, connected_to_id=to, distance=distance, travel_counter=1)


corridor = LandmarkMap(
    "corridor",
    (
        Landmark("corner", "corner", 0.0, 0.1, links=(way(EAST, "office", 4.1), Link("open", SOUTH))),
        Landmark(
            "office", "door", 4.0, 0.0, links=(way(WEST, "corner", 4.1), way(EAST, "tee", 5.0), Link("door", NORTH))
        ),
        Landmark(
            "tee", "junction", 9.1, 0.1, links=(way(WEST, "office", 5.0), way(EAST, "lab", 6.9), Link("open", SOUTH))
        ),
        Landmark("lab", "door", 16.0, -0.1, links=(way(WEST, "tee", 6.9), Link("open", EAST), Link("door", SOUTH))),
    ),
    robot="mine",
    noise=Noise(position_sigma=0.2, heading_sigma=0.05, detection_rate=0.9, false_alarm_rate=0.05),
)
draw_map(corridor, dpi=60)

# %% [markdown]
# Directions are those of the map's frame, not relative to the robot. `noise` says what the robot is known to be; the
# answer is as honest as these numbers ([docs/measurement-model.md](../docs/measurement-model.md)). What breaks a rule
# is refused with place and reason:

# %%
broken = corridor.replace(name="broken", landmarks=(*corridor.landmarks, replace(corridor["lab"], y=float("nan"))))
try:
    fuse([corridor, broken])
except MapfuseError as error:
    said = str(error)
Markdown(f"```\n{said}\n```")

# %% [markdown]
# A second robot came from the other side and turned back at the junction. Its frame is turned by a right angle.

# %%
T_second = np.array([16.5, -4.0, np.pi / 2])  # made up: what fuse shall find


def as_seen(identifier, type_, x, y, links):
    at = se2.transform(se2.inverse(T_second), [x, y])
    turned = tuple(replace(link, heading=float(se2.wrap(link.heading - T_second[2]))) for link in links)
    return Landmark(identifier, type_, *at.tolist(), links=turned)


other = LandmarkMap(
    "other",
    (
        as_seen("1", "door", 16.1, 0.1, (way(WEST, "2", 7.1), Link("open", EAST), Link("door", SOUTH))),
        as_seen("2", "junction", 9.0, 0.0, (way(EAST, "1", 7.1), Link("open", WEST), Link("open", SOUTH))),
    ),
    robot="mine",
    noise=corridor.noise,
)
by_hand = fuse([corridor, other])
pair = by_hand.pairs[0]


def best(result):
    found = result.pairs[0]
    T = found.hypotheses[0].T12
    return (
        f"**{result.decision}**; the best placement matches {found.hypotheses[0].count}, "
        f"({T.x:.1f} m, {T.y:.1f} m, {np.degrees(T.theta):.0f} deg), probability "
        f"{found.hypotheses[0].probability:.3f}; no overlap {found.no_overlap_probability:.3f}."
    )


Markdown(best(by_hand))

# %%
assert by_hand.decision != "merged"
assert np.linalg.norm(pair.T12.array[:2] - T_second[:2]) < 1.0
Markdown(pair.reason)

# %% [markdown]
# The placement is right, and `fuse` doesn't take it: a door at 7 m from a junction is found in many places. That is the
# point at which what you know comes in.
#
# ## When the answer is ambiguous
#
# **Look at the rivals**: `pair.hypotheses`, or the picture of the result. If one of them is nonsense, you know
# something that `fuse` doesn't. Say it:
#
# | you know | in Python | on the command line |
# |---|---|---|
# | about where one map lies in the other | `known=[KnownTransform(...)]` | `--near A B X Y DEG SIGMA_M SIGMA_DEG` |
# | that two landmarks are the same | `same_as` of the map | `same_as` in the map file |
# | that both maps are of one floor | `DecisionConfig(overlap_prior=0.99)` | `--overlap-prior 0.99` |
# | a floor plan | `as_reference(plan)` | `--reference MAP` |

# %%
near = Transform(15.0, -5.0, np.deg2rad(80.0), np.diag([3.0**2, 3.0**2, np.deg2rad(15.0) ** 2]))
sure = FuseConfig(decision=DecisionConfig(overlap_prior=0.99))
same = corridor.replace(same_as={"lab": {"other": "1"}})
told = {
    "nothing": by_hand,
    "both maps are of one floor (0.99)": fuse([corridor, other], sure),
    "about where, within 3 m and 15 degrees": fuse(
        [corridor, other], known=[KnownTransform(("corridor", "other"), near)]
    ),
    "`lab` is the other's `1`": fuse([same, other]),
    "one floor, and about where": fuse([corridor, other], sure, known=[KnownTransform(("corridor", "other"), near)]),
}
assert all(
    result.pairs[0].probability > by_hand.pairs[0].probability for what, result in told.items() if what != "nothing"
)
table(
    ["said", "decision", "probability", "no overlap"],
    [
        [what, result.decision, f"{result.pairs[0].probability:.4f}", f"{result.pairs[0].no_overlap_probability:.4f}"]
        for what, result in told.items()
    ],
)

# %%
draw_fused(told["about where, within 3 m and 15 degrees"], dpi=66)

# %% [markdown]
# Each statement is weighed as evidence, with the doubt that you state, and isn't obeyed: `same_as` that everything else
# contradicts is refused, and a wrong `known` within its covariance only misleads so far. What stays `ambiguous` is
# better left so: ask for another drive through the place where the rivals differ, or fuse with a third map
# ([ambiguity](ambiguity.ipynb)). Until then `pair.mixture_covariance` and `fused.landmark_mixture()` say what is known.
