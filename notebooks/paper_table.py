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
# # Heuristic against optimised
#
# Dedeoglu and Sukhatme (2000) merged maps with a heuristic: of all transformations that lay a landmark of one map on
# one of the other, take the one under which most landmarks match within a metre, and lay the maps on each other
# rigidly. mapfuse optimises: one factor graph of all measurements, and evidence for and against. What is that worth?
#
# The paper's Table 1 has 26 pairs of 19 maps. The maps are lost. **What stands here is a reconstruction**: simulated
# robots explored a floor like the paper's, and their maps have the paper's sizes; their seeds were chosen by size,
# never by a result. So our columns and the paper's aren't measured on the same data, and only ours can be compared with
# each other. The code is `mapfuse.fusion.compare`; `mapfuse compare --paper` writes all of it.

# %%
import logging

import numpy as np
from IPython.display import Markdown, display

from mapfuse.datasets.simulation import TEST_SEEDS, simulated_pair
from mapfuse.datasets.truth import Truth
from mapfuse.fusion import fuse
from mapfuse.fusion.compare import compare_pair, methods, paired, paper_rows, summaries
from mapfuse.fusion.compare.figures import figure_2, merge_figure
from mapfuse.fusion.compare.paper import paper_config, paper_maps
from mapfuse.fusion.show import charts
from mapfuse.fusion.show.style import GREY, owner

# %matplotlib inline
# %config InlineBackend.print_figure_kwargs = {"bbox_inches": None}

logging.getLogger("mapfuse").setLevel(logging.ERROR)
BLUE, ORANGE, GREEN = (owner(k).line for k in range(3))


def table(heads, rows):
    lines = [heads, ["---"] * len(heads), *rows]
    return Markdown("\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines))


def percent(share):
    return "-" if share is None else f"{100 * share:.0f}"


def metres(value):
    return "-" if value is None else f"{value:.2f}"


# %% [markdown]
# ## The table
#
# *Right*: share of the reported matches that are true, in percent. *Alarms gone*: share of the false alarms which the
# other robot passed that the merge doesn't keep, in percent. *rms* [m]: of all landmarks against the truth, after the
# best rigid motion. p: the paper, h: our heuristic (its method on our maps), o: optimised, told that both maps are of
# one floor (overlap prior 0.99). Rows with * have a map of less than six landmarks. A dash: nothing to count.

# %%
rows = paper_rows()
lines = []
for row in rows:
    h, o = row.ours["heuristic"], row.ours["optimised"]
    rms = [None if e.truth is None else e.truth.rms_aligned for e in (h, o)]
    lines.append(
        [
            row.paper.label + ("" if row.large else " *"),
            row.paper.candidates,
            f"{row.paper.selected} / {h.selected}",
            f"{row.paper.correctness} / {percent(h.correctness)} / {percent(o.correctness)}",
            " / ".join(
                ["-" if row.paper.eliminated is None else str(row.paper.eliminated)]
                + [percent(e.eliminated_share) for e in (h, o)]
            ),
            " / ".join(map(metres, rms)),
            o.decision.replace("_", " ") + (" **wrongly**" if o.merged_wrongly else ""),
            f"{o.merge.probability:.4f}",
            {True: "right", False: "wrong", None: "-"}[o.best_is_right],
        ]
    )
heads = ["maps", "pairs of landmarks", "left by H1, H2 (p / h)", "right (p / h / o)", "alarms gone (p / h / o)",
         "rms (h / o)", "optimised says", "probability", "its best placement"]  # fmt: skip
table(heads, lines)

# %%
ours = {name: [row.ours[name] for row in rows] for name in ("heuristic", "optimised")}
mean = {name: np.mean([e.correctness for e in found if e.correctness is not None]) for name, found in ours.items()}
gone = {
    name: np.mean([e.eliminated_share for e in found if e.eliminated_share is not None]) for name, found in ours.items()
}
large = [row.ours["optimised"] for row in rows if row.large]
both = [
    (row, *values)
    for row in rows
    if None not in (values := [row.ours[n].truth.rms_aligned for n in ("heuristic", "optimised")])
]
worse = [row.paper.label for row, h, o in both if o > h]
assert all(row.ours["heuristic"].candidates == row.paper.candidates for row in rows)
Markdown(
    f"All {len(rows)} rows have the paper's number of candidates. Of the {len(large)} rows whose maps both have six "
    f"landmarks or more the optimised merge merges {sum(e.decision == 'merged' for e in large)}, of all rows "
    f"{sum(e.decision == 'merged' for e in ours['optimised'])}, and "
    f"{sum(bool(e.merged_wrongly) for e in ours['optimised'])} wrongly. Right matches: {mean['heuristic']:.1%} of the "
    f"heuristic's, {mean['optimised']:.1%} of the optimised (93.3 % in the paper). False alarms eliminated: "
    f"{gone['heuristic']:.1%} and {gone['optimised']:.1%} (77.2 % in the paper). In {len(both)} rows both have a "
    f"merged map; the optimised rms is larger in: {', '.join(worse) or 'none'}."
)

# %% [markdown]
# The heuristic keeps no landmark that the other robot passed without seeing it, however good the reason to believe in
# it; the optimised merge weighs that (`existence`), and so keeps some false alarms. What the heuristic lays aside may
# be there after all:

# %%
lost = {name: [e.truth.lost_places for e in found if e.truth.lost_places is not None] for name, found in ours.items()}
table(
    ["method", "rows with a merged map", "true landmarks that the merge doesn't keep"],
    [[name, len(values), sum(values)] for name, values in lost.items()],
)

# %% [markdown]
# ## Figure 2: what the heuristics leave
#
# H1 (landmarks of one kind only) and H2 (corners and junctions only) leave few of all pairs of landmarks to propose.

# %%
figure = figure_2(rows)
figure.set_dpi(75)
display(figure)

# %% [markdown]
# ## Row by row

# %%
figure, (ax,) = charts(1, height=4.6)
places = np.arange(len(both))
before, after = (np.array([values[k] for values in both]) for k in (1, 2))
ax.hlines(places, before, after, color=GREY, linewidth=1)
ax.plot(before, places, "s", color=ORANGE, markersize=5, label="heuristic")
ax.plot(after, places, "o", color=BLUE, markersize=5, label="optimised")
ax.set_yticks(
    places, [row.paper.label.split(" (")[-1].removeprefix("likely ").rstrip(")") for row, *_ in both], fontsize=7
)
ax.invert_yaxis()
ax.set_xlim(0)
ax.set_xlabel("rms of all landmarks after the best rigid motion [m], reconstruction")
ax.legend(fontsize=8)
display(figure)

# %% [markdown]
# ## One pair: D7 and D9
#
# As in the paper's Fig. 4, common landmarks ringed, doubtful ones hollow.

# %%
maps, truth = paper_maps()
pair = maps["D7"], maps["D9"]
heuristic = next(row.ours["heuristic"].merge for row in rows if row.paper.pair == ("D7", "D9"))
figure = merge_figure(4, pair, heuristic, fuse(pair, paper_config()))
figure.set_dpi(75)
display(figure)

# %% [markdown]
# ## More floors
#
# One floor is one floor. So the same on ten pairs of simulated maps, each of an irregular floor of its own, on seeds
# that nothing was tuned on (`TEST_SEEDS`), without a word about overlap. *Kalman*: the heuristic's matches, fused by a
# Kalman filter (filterpy) instead of a rigid motion. Medians over pairs with 95 % bootstrap intervals.

# %%
compared = methods(("heuristic", "kalman", "optimised"))
evaluations = []
for seed in TEST_SEEDS[200:210]:
    map1, map2, its_truth = simulated_pair(seed)
    named = {"A": f"A{seed}", "B": f"B{seed}"}
    renamed = Truth(
        {named[k]: v for k, v in its_truth.frames.items()},
        {named[k]: v for k, v in its_truth.landmarks.items()},
        its_truth.places,
    )
    one, two = map1.replace(name=named["A"]), map2.replace(name=named["B"])
    evaluations += compare_pair(one, two, compared, renamed)


def bounds(found):
    return "-" if found is None else f"{found.value:.2f} ({found.low:.2f} to {found.high:.2f})"


table(
    ["method", "merged", "wrongly", "right matches", "rms in map 1's frame [m]", "rms aligned [m]"],
    [
        [s.method, f"{s.merged} of {s.pairs}", s.wrong, bounds(s.correctness), bounds(s.rms), bounds(s.rms_aligned)]
        for s in summaries(evaluations)
    ],
)

# %%
tests = [
    t for first in ("heuristic", "kalman") for t in paired(evaluations, first, "optimised") if t.metric == "rms_aligned"
]
table(
    ["optimised against", "pairs with both", "its rms aligned, as a factor (median)", "p (Wilcoxon)"],
    [[t.first, t.n, bounds(t.ratio), "-" if t.p is None else f"{t.p:.3f}"] for t in tests],
)

# %% [markdown]
# A factor below 1 is in favour of optimising; p is the probability of such differences if neither were better. A
# wrong merge, if there is one, enters with its large rms. Recorded data, and more of all this, is
# in [benchmarks/results](../benchmarks/results).
