"""The paper's figures: 2 (what the heuristics leave), 3 to 5 (two merges), 7 and 8 (the hospital).

Each is a figure of matplotlib; `save_all` writes them as PNG and SVG. What is drawn is simulated; the titles say so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.paper import HOSPITAL_CORRIDOR, HOSPITAL_WALL_ERROR
from mapfuse.datasets.simulation.building import Building

from ..result import FusedMap
from ..show.fused_page import Page
from ..show.layout import Panel
from ..show.page import draw_page, save
from ..show.scene import COMMON_OWNER, Scene, laid_together, scene_of_group, scene_of_map
from ..show.style import GREY, INK, OWNERS
from .hospital import OnPlan
from .method import Merge
from .methods import HEURISTIC
from .paper import PaperRow

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".svg")
RECONSTRUCTION = "reconstruction, simulated"


def save_all(figures: Mapping[str, Figure], folder: Path) -> tuple[Path, ...]:
    """Every figure by name as PNG and SVG. Raises `OutputError` where one can't be written."""
    written = []
    for name, figure in figures.items():
        for suffix in SUFFIXES:
            written.append(folder / f"{name}{suffix}")
            save(figure, written[-1])
    return tuple(written)


def figure_2(rows: Sequence[PaperRow]) -> Figure:
    """Left, all pairs of landmarks and those that H1 and H2 leave; right, the latter in percent; paper's and ours."""
    figure = _figure(10.0, 4.4)
    left, right = figure.subplots(1, 2)
    at = np.arange(1, len(rows) + 1)
    total = np.array([row.paper.candidates for row in rows])
    paper = np.array([row.paper.selected for row in rows])
    ours = np.array([row.ours[HEURISTIC].selected for row in rows])
    left.plot(at, total, color=INK, linestyle="-", marker="s", markersize=3.5, linewidth=1, label="all candidates")
    left.plot(
        at, paper, color=OWNERS[0].line, marker="o", markersize=3.5, linewidth=1, label="selected, the paper's maps"
    )
    left.plot(at, ours, color=OWNERS[5].line, linestyle="--", marker="^", markersize=3.5, linewidth=1,
              label="selected, the reconstruction")  # fmt: skip
    left.set_ylabel("candidate transformations")
    right.plot(
        at, 100 * paper / total, color=OWNERS[0].line, marker="o", markersize=3.5, linewidth=1, label="the paper's maps"
    )
    right.plot(at, 100 * ours / total, color=OWNERS[5].line, linestyle="--", marker="^", markersize=3.5, linewidth=1,
               label="the reconstruction")  # fmt: skip
    right.set_ylabel("selected [% of all candidates]")
    right.set_ylim(bottom=0)
    for axes in (left, right):
        _plain(axes, "map combination, in the order of Table 1")
        axes.legend(fontsize=8, frameon=False)
    figure.suptitle(f"Fig. 2: what H1 and H2 leave of the candidates (ours: {RECONSTRUCTION})", x=0.01, ha="left",
                    fontsize=12, weight="bold")  # fmt: skip
    figure.tight_layout()
    return figure


def maps_figure(number: int, maps: Sequence[LandmarkMap]) -> Figure:
    """Maps side by side in their own frames, as in Fig. 3."""
    names = tuple(m.name for m in maps)
    panels = tuple(Panel(f"{m.name}: {len(m)} landmarks", scene_of_map(m, k)) for k, m in enumerate(maps))
    title = f"Fig. {number}: maps {' and '.join(names)} ({_origin(maps)})"
    return draw_page(Page(title, names, mains=panels), None, ids=False, ellipse_scale=1.0, dpi=150.0)


def merge_figure(
    number: int, maps: Sequence[LandmarkMap], heuristic: Merge, fused: FusedMap, *, alone: Sequence[int] = ()
) -> Figure:
    """Both merges of two maps side by side, common landmarks ringed, as in Fig. 4; maps ``alone`` first."""
    names = tuple(m.name for m in maps)
    first = tuple(Panel(f"{names[k]} alone", scene_of_map(maps[k], k)) for k in alone)
    by_heuristic = Panel(f"heuristic: {len(heuristic.correspondences)} in common", scene_of_merge(maps, heuristic))
    pair = fused.pairs[0]
    if fused.decision == "merged":
        optimised = Panel(f"optimised: {len(pair.correspondences)} in common", scene_of_group(fused, 0))
    else:
        assert pair.T12 is not None
        one, two = (scene_of_map(m, k) for k, m in enumerate(maps))
        said = f"optimised: {pair.decision.replace('_', ' ')}, best placement, nothing merged"
        optimised = Panel(said, laid_together(one, two.moved(pair.T12.array)))
    title = f"Fig. {number}: {' and '.join(names)} merged ({_origin(maps)})"
    page = Page(title, names, mains=(*first, by_heuristic, optimised))
    return draw_page(page, None, ids=False, ellipse_scale=1.0, dpi=150.0)


def _origin(maps: Sequence[LandmarkMap]) -> str:
    return RECONSTRUCTION if any(m.extra.get("reconstruction") for m in maps) else "simulated"


def scene_of_merge(maps: Sequence[LandmarkMap], merge: Merge) -> Scene:
    """A merged map as a scene in the frame of map 1: what both have once, what isn't kept hollow."""
    one, two = (scene_of_map(m, k) for k, m in enumerate(maps))
    assert merge.T12 is not None
    laid = laid_together(one, two.moved(merge.T12.array))
    positions, owners, doubtful = laid.positions.copy(), laid.owners.copy(), np.zeros(len(laid), dtype=bool)
    stands_for = np.arange(len(laid))
    for landmark in merge.landmarks:
        places = [maps[0].index_from_id[i] for i in landmark.ids1]
        places += [len(one) + maps[1].index_from_id[i] for i in landmark.ids2]
        positions[places] = landmark.x, landmark.y
        doubtful[places] = not landmark.kept
        stands_for[places] = places[0]
        if landmark.ids1 and landmark.ids2:
            owners[places] = COMMON_OWNER
    kept = np.flatnonzero(stands_for == np.arange(len(laid)))
    place = np.searchsorted(kept, stands_for)
    return replace(
        laid,
        positions=positions[kept],
        kinds=tuple(laid.kinds[k] for k in kept),
        owners=owners[kept],
        doubtful=doubtful[kept],
        ids=tuple(laid.ids[k] for k in kept),
        arms=tuple(arm._replace(landmark=int(place[arm.landmark])) for arm in laid.arms),
        links=place[laid.links].astype(np.intp),
        covariances=np.zeros((0, 2, 2)),
        covariance_of=np.zeros(0, dtype=np.intp),
    )


def figure_8(building: Building, laid: Mapping[str, OnPlan]) -> Figure:
    """Merged walls over the plan, one panel a method; below, how far walls and landmarks are off along the building."""
    figure = _figure(10.0, 2.0 + 3.0 * len(laid))
    panels = figure.subplots(len(laid) + 1, 1)
    looks = dict(zip(laid, (OWNERS[5], OWNERS[0], *OWNERS), strict=False))
    for axes, (name, found) in zip(panels, laid.items(), strict=False):
        for wall in building.walls:
            axes.plot(*wall.T, color="#b0b0b0", linewidth=3.0, solid_capstyle="round", zorder=1)
        for wall in found.walls:
            axes.plot(*wall.T, color=looks[name].line, linewidth=1.1, zorder=2)
        axes.scatter(*found.places.T, marker="+", s=22, c=INK, linewidths=0.7, zorder=3)
        axes.scatter(*found.landmarks.T, marker="o", s=9, c=looks[name].line, zorder=4)
        axes.set_aspect("equal")
        lengths = found.length_percents
        axes.set_title(
            f"{name}: worst wall {found.wall_off.max(initial=0.0):.2f} m, {found.wall_percent:.2f} % of"
            f" {found.reach:.0f} m; lengths above {HOSPITAL_CORRIDOR:.0f} m off by {np.median(lengths):.2f} % (median)",
            fontsize=9, loc="left",
        )  # fmt: skip
        _plain(axes, "", "y [m]")
    along = panels[-1]
    for name, found in laid.items():
        along.plot(
            found.wall_at[:, 0],
            found.wall_off,
            ".",
            markersize=2.5,
            color=looks[name].line,
            alpha=0.6,
            label=f"walls, {name}",
        )
        along.plot(found.places[:, 0], found.landmark_off, "o", markersize=4, markerfacecolor="none",
                   color=looks[name].line, label=f"landmarks, {name}")  # fmt: skip
    reach = max(found.reach for found in laid.values())
    for height, said in (
        (HOSPITAL_WALL_ERROR, "the paper's bound for every wall, 1 m over more than 50 m: 2 %"),
        (0.005 * reach, f"0.5 % of {reach:.0f} m"),
    ):
        along.axhline(height, color=GREY, linewidth=0.8, linestyle="--")
        along.text(
            0.995,
            height,
            said,
            transform=along.get_yaxis_transform(),
            ha="right",
            va="bottom",
            fontsize=7.5,
            color=GREY,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.8},
        )
    along.set_ylim(0, max(1.3, *(float(f.wall_off.max(initial=0.0)) * 1.05 for f in laid.values())))
    along.set_xlim(panels[0].get_xlim())
    along.legend(fontsize=7.5, frameon=False, ncols=2, loc="upper left")
    _plain(along, "x along the building [m]", "off [m]")
    figure.suptitle("Fig. 8: merged walls over the plan of a hospital (simulated)", x=0.01, ha="left", fontsize=12,
                    weight="bold")  # fmt: skip
    figure.tight_layout()
    return figure


def _figure(width: float, height: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=150.0)
    FigureCanvasAgg(figure)
    return figure


def _plain(axes: Axes, across: str, up: str | None = None) -> None:
    axes.set_xlabel(across, fontsize=8.5)
    axes.set_ylabel(axes.get_ylabel() if up is None else up, fontsize=8.5)
    axes.tick_params(labelsize=7.5)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
