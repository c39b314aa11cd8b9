"""Drawing into axes that exist already: what is added is returned, and what was there stays in view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.path import Path
from matplotlib.transforms import Affine2D

from mapfuse.datasets import se2
from mapfuse.datasets.errors import ConfigError
from mapfuse.datasets.logs import Detection, Odometry
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.datasets.simulation import build, floor_from_graph
from mapfuse.datasets.transform import Transform
from mapfuse.fusion.result import Frame, FusedLandmark, FusedMap, PairResult, RankedHypothesis
from mapfuse.fusion.show import (
    charts,
    draw_pair,
    plot_building,
    plot_ellipses,
    plot_fused,
    plot_log,
    plot_map,
    plot_pair,
)
from mapfuse.fusion.show.journey import journey
from mapfuse.fusion.show.log_page import Drive

T12 = Transform(10.0, 2.0, 0.7, np.diag([0.01, 0.01, 1e-4]))


def axes(width: float = 6.0, height: float = 4.0) -> Axes:
    return Figure(figsize=(width, height)).add_subplot()


def recorded(name: str, places: dict[str, tuple[float, float]], T: np.ndarray) -> LandmarkMap:
    back = se2.inverse(T)
    return LandmarkMap(
        name,
        tuple(
            Landmark(i, "junction", *se2.transform(back, xy).tolist(), links=(Link("open", 0.3),))
            for i, xy in places.items()
        ),
        walls=(se2.transform(back, [[0.0, 5.0], [9.0, 5.0]]),),
    )


@pytest.fixture(scope="module")
def fused() -> FusedMap:
    places = {"a": (0.0, 0.0), "b": (8.0, 1.0), "c": (4.0, 9.0)}
    maps = {"D1": recorded("D1", places, np.zeros(3)), "D2": recorded("D2", places, T12.array)}
    matches = (("a", "a"), ("b", "b"))
    best = RankedHypothesis(T12, 2, 9.0, 0.9, correspondences=matches)
    other = RankedHypothesis(Transform(50.0, 0.0, 0.0), 1, 2.0, 0.05, correspondences=(("a", "b"),))
    pair = PairResult(("D1", "D2"), "merged", 0.9, 0.05, (best, other), matches, "why")
    landmarks = tuple(
        FusedLandmark(i, 0, "junction", x, y, None, np.eye(2) * 0.01, {"D1": (i,), "D2": (i,)}, 0.9)
        for i, (x, y) in places.items()
    )
    frames = {"D1": Frame(0, Transform(0, 0, 0, np.zeros((3, 3)))), "D2": Frame(0, T12)}
    return FusedMap("merged", 0.9, ("D1", "D2"), (("D1", "D2"),), frames, (pair,), landmarks, {}, maps)


def shown_in(ax: Axes, points: np.ndarray) -> bool:
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    return bool(((points[:, 0] > x0) & (points[:, 0] < x1) & (points[:, 1] > y0) & (points[:, 1] < y1)).all())


def test_what_is_added_is_returned_and_nothing_else(fused: FusedMap) -> None:
    ax = axes()
    (line,) = ax.plot([0, 1], [0, 1])
    before = set(ax.get_children())
    artists = plot_map(ax, fused.sources["D1"])
    assert set(artists) == set(ax.get_children()) - before
    assert line not in artists
    for artist in artists:
        artist.remove()
    assert set(ax.get_children()) == before


def test_scales_are_equal_and_everything_is_in_view(fused: FusedMap) -> None:
    for width, height in ((6.0, 4.0), (3.0, 8.0)):
        ax = axes(width, height)
        plot_fused(ax, fused)
        box = ax.get_window_extent()
        assert np.ptp(ax.get_xlim()) / box.width == pytest.approx(np.ptp(ax.get_ylim()) / box.height)
        assert shown_in(ax, np.array([(l.x, l.y) for l in fused.landmarks]))


def test_a_second_map_widens_the_view_and_keeps_the_first(fused: FusedMap) -> None:
    ax = axes()
    plot_map(ax, fused.sources["D1"], label="D1")
    plot_map(ax, fused.sources["D2"], Transform(100.0, 0.0, 0.0), look=1, label="D2")
    assert shown_in(ax, fused.sources["D1"].positions)
    assert shown_in(ax, fused.sources["D2"].positions + np.array([100.0, 0.0]))
    assert [text.get_text() for text in ax.legend().get_texts()] == ["D1", "D2"]


def test_a_pair_is_drawn_as_its_hypothesis_lays_it(fused: FusedMap) -> None:
    for k, matches in ((0, 2), (1, 1)):
        ax = axes()
        artists = plot_pair(ax, fused, ("D2", "D1"), hypothesis=k)
        (lines,) = [artist for artist in artists if artist.get_gid() == "matches"]
        assert isinstance(lines, LineCollection)
        ends = np.array(lines.get_segments())
        assert ends.shape == (matches, 2, 2)
        # the maps agree exactly under the first hypothesis
        assert np.allclose(ends[:, 0], ends[:, 1], atol=1e-9) == (k == 0)


def test_what_is_not_there_is_refused(fused: FusedMap) -> None:
    with pytest.raises(ConfigError, match="no group 1: the result has 1"):
        plot_fused(axes(), fused, 1)
    with pytest.raises(ConfigError, match="no hypothesis 2: D1 and D2 have 2"):
        plot_pair(axes(), fused, hypothesis=2)
    with pytest.raises(ConfigError, match="the pair D1 and D9 in this result; its maps are D1, D2"):
        plot_pair(axes(), fused, ("D1", "D9"))
    with pytest.raises(ConfigError, match="D1 isn't embedded"):
        plot_pair(axes(), replace(fused, sources={}))


def test_a_page_of_a_pair_shows_its_placements(fused: FusedMap) -> None:
    page = draw_pair(fused, ("D1", "D2"))
    titles = [ax.get_title(loc="left") for ax in page.axes]
    assert page.get_suptitle() == "D1 + D2: merged"
    assert sum(title.startswith("possible placement") for title in titles) == 2
    assert len(draw_pair(replace(fused, sources={})).axes) == 0
    simulated = {name: map_.replace(extra={"simulated": True}) for name, map_ in fused.sources.items()}
    assert draw_pair(replace(fused, sources=simulated)).get_suptitle() == "D1 + D2, simulated: merged"


def test_a_drive_and_a_building_are_drawn() -> None:
    events = [Odometry(0.0, 0.0, 0.0, 0.0), Odometry(1.0, 6.0, 0.0, 0.0), Detection(1.0, "door", 1.0, 0.0)]
    ax = axes()
    assert {artist.get_gid() for artist in plot_log(ax, Drive("d", journey(events)))} >= {"odometry", "detections"}
    assert shown_in(ax, np.array([[0.0, 0.0], [7.0, 0.0]]))
    building = build(floor_from_graph("L", [(0, 0), (8, 0), (8, 6)], [(0, 1), (1, 2)]), steel_sigma=0)
    ax = axes()
    assert {artist.get_gid() for artist in plot_building(ax, building)} >= {"building", "places"}
    assert shown_in(ax, building.walls.reshape(-1, 2))


@pytest.mark.parametrize("scale", [1.0, 10.0])
def test_ellipses_hold_95_percent_of_what_is_drawn_from_them(scale: float) -> None:
    _, (ax, _) = charts(2, height=3.0)
    C = np.array([[4.0, 1.5], [1.5, 1.0]]) / scale**2
    drawn = plot_ellipses(ax, [[1.0, 2.0], [50.0, 0.0]], [C, C], label="T12", scale=scale)
    ax.set_aspect("equal")
    FigureCanvasAgg(ax.figure).draw()
    (path, *_), (transform, *_) = drawn.get_paths(), drawn.get_transforms()
    outline = path.transformed(Affine2D(transform)).vertices
    points = np.random.default_rng(1).multivariate_normal([0.0, 0.0], C * scale**2, 20_000)
    assert Path(outline).contains_points(points).mean() == pytest.approx(0.95, abs=0.01)
    assert ax.get_legend_handles_labels()[1] == ["T12"]
    assert ax.get_xlim()[0] < 1.0 - 2 * 2.0
    assert ax.get_xlim()[1] > 50.0 + 2 * 2.0
