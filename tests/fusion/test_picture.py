"""Pictures: what is drawn says what the result says, in artists, in titles and in pixels."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection, PathCollection
from matplotlib.figure import Figure
from matplotlib.text import Text

from mapfuse.datasets import se2
from mapfuse.datasets.errors import ConfigError, MapfuseError
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Link
from mapfuse.datasets.transform import Transform
from mapfuse.fusion.result import Frame, FusedLandmark, FusedMap, PairResult, RankedHypothesis
from mapfuse.fusion.show import draw_fused, draw_map

T12 = Transform(9.5, -4.0, 0.6, np.diag([0.04, 0.0225, 1e-4]))
CHI2_95 = 5.991464547107979


# A floor by hand: corridors along uneven grid lines, doors between the junctions, two robots that saw a part each.


def floor(columns: int, rows: int, rng: np.random.Generator) -> dict[str, tuple[float, float, str, list[Link]]]:
    """Places of a floor by name: x, y [m], type and links; a column of a door per stretch of the horizontal ways."""
    x = np.cumsum(rng.uniform(5.0, 11.0, columns))
    y = np.cumsum(rng.uniform(6.0, 12.0, rows))
    places: dict[str, tuple[float, float, str, list[Link]]] = {}
    for i in range(columns):
        for j in range(rows):
            arms = []
            for direction, (di, dj) in enumerate([(1, 0), (0, 1), (-1, 0), (0, -1)]):
                heading = float(se2.wrap(direction * np.pi / 2))
                if 0 <= i + di < columns and 0 <= j + dj < rows:
                    stretch = f"d{min(i, i + di)}-{j}" if dj == 0 else f"j{i}-{j + dj}"
                    arms.append(Link("open", heading, connected_to_id=stretch, distance=5.0, travel_counter=1))
                else:
                    arms.append(Link("blocked", heading))
            kind = "corner" if sum(arm.type == "open" for arm in arms) == 2 else "junction"
            places[f"j{i}-{j}"] = (float(x[i]), float(y[j]), kind, arms)
            if i + 1 < columns:
                ways = [
                    Link("open", 0.0, connected_to_id=f"j{i + 1}-{j}", distance=3.0, travel_counter=1),
                    Link("open", np.pi, connected_to_id=f"j{i}-{j}", distance=3.0, travel_counter=1),
                ]
                places[f"d{i}-{j}"] = (float(x[i] + 0.4 * (x[i + 1] - x[i])), float(y[j]), "door", ways)
    return places


def kept_links(links: list[Link], known: set[str], turn: float) -> tuple[Link, ...]:
    return tuple(
        replace(
            link,
            heading=None if link.heading is None else float(se2.wrap(link.heading + turn)),
            connected_to_id=link.connected_to_id if link.connected_to_id in known else None,
            distance=link.distance if link.connected_to_id in known else None,
        )
        for link in links
    )


def corridor_walls(places: dict[str, tuple[float, float, str, list[Link]]], seen: set[str]) -> list[np.ndarray]:
    """Both walls of every stretch between two seen places, 2 m apart."""
    walls = []
    for name in places:
        a = np.array(places[name][:2])
        for other in sorted({link.connected_to_id for link in places[name][3] if link.connected_to_id} & seen):
            b = np.array(places[other][:2])
            if name in seen and name < other:
                along = (b - a) / np.hypot(*(b - a))
                across = np.array([-along[1], along[0]])
                walls += [np.array([a + along + side * across, b - along + side * across]) for side in (1, -1)]
    return walls


def result(
    columns: int, rows: int, *, doubtful: int = 3, seed: int = 1, names: tuple[str, str] = ("D7", "D9")
) -> FusedMap:
    """A merged result on that floor: robot 1 saw its left part, robot 2 its right part, a quarter both."""
    rng = np.random.default_rng(seed)
    places = floor(columns, rows, rng)
    xs = sorted(place[0] for place in places.values())
    seen1 = {name for name, place in places.items() if place[0] < xs[int(0.7 * len(xs))]}
    seen2 = {name for name, place in places.items() if place[0] > xs[int(0.3 * len(xs))]}
    T21 = se2.inverse(T12.array)
    maps = []
    for name, seen, T in ((names[0], seen1, np.zeros(3)), (names[1], seen2, T21)):
        landmarks = [
            Landmark(p, kind, *(float(v) for v in se2.transform(T, [x, y]) + rng.normal(0, 0.15, 2)),
                     links=kept_links(links, seen, float(T[2])))
            for p, (x, y, kind, links) in places.items() if p in seen
        ]  # fmt: skip
        seen_walls = tuple(se2.transform(T, wall) for wall in corridor_walls(places, seen))
        maps.append(LandmarkMap(name, tuple(landmarks), robot="milka", walls=seen_walls))
    both = seen1 | seen2
    landmarks = []
    for p, (x, y, kind, links) in ((p, places[p]) for p in places if p in both):
        away = 0.02 + 0.0006 * np.hypot(x - xs[0], y)
        covariance = np.diag([away * 1.5, away * 0.6, 1e-3]) + 0.3 * away * np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]])
        sources = {name: (p,) for name, seen in zip(names, (seen1, seen2), strict=True) if p in seen}
        arms = kept_links(links, both, 0.0)
        landmarks.append(FusedLandmark(p, 0, kind, x, y, 0.0, covariance, sources, 0.97, arms))
    lonely = [k for k, l in enumerate(landmarks) if len(l.sources) == 1][:doubtful]
    landmarks = [replace(l, existence=0.2) if k in lonely else l for k, l in enumerate(landmarks)]
    common = tuple((p, p) for p in places if p in seen1 & seen2)
    hypotheses = (
        RankedHypothesis(T12, len(common), 41.2, 0.9978),
        RankedHypothesis(Transform(20.0, 1.0, -2.5, np.diag([0.1, 0.1, 1e-3])), 5, 3.0, 0.0012),
    )
    pair = PairResult(
        names, "merged", 0.9978, 0.001, hypotheses, common,
        f"{len(common)} landmarks agree along 61 m of corridor that both robots travelled; nothing that one of them "
        "passed is missing in the other's map except two doors. The runner-up is 38 nats behind.",
    )  # fmt: skip
    return FusedMap(
        "merged", 0.9978, names, (names,),
        {names[0]: Frame(0, Transform(0, 0, 0, np.zeros((3, 3)))), names[1]: Frame(0, T12)},
        (pair,), tuple(landmarks), {"mapfuse": "0.1.0", "inputs": {}, "config": {}},
        {map_.name: map_ for map_ in maps},
    )  # fmt: skip


def apart(fused: FusedMap, decision: str, probabilities: tuple[float, ...], none: float) -> FusedMap:
    """The same two maps with nothing merged, and these probabilities of placements that lie apart."""
    hypotheses = tuple(
        RankedHypothesis(replace(T12, x=T12.x + 11.0 * k, theta=T12.theta + k * np.pi), 9 - k, 12.0 - k, p)
        for k, p in enumerate(probabilities)
    )
    pair = replace(
        fused.pairs[0], decision=decision, hypotheses=hypotheses, correspondences=(), no_overlap_probability=none,
        probability=probabilities[0] if probabilities else 0.0, reason="The building repeats itself.",
    )  # fmt: skip
    frames = {name: Frame(k, Transform(0, 0, 0, np.zeros((3, 3)))) for k, name in enumerate(fused.maps)}
    groups = tuple((name,) for name in fused.maps)
    return replace(
        fused, decision=decision, probability=1.0, pairs=(pair,), landmarks=(), frames=frames, groups=groups
    )  # fmt: skip


# What is found on a page.


def artists(axes: Axes, gid: str) -> list[Artist]:
    return [artist for artist in axes.get_children() if artist.get_gid() == gid]


def count(axes: Axes, gid: str) -> int:
    found = artists(axes, gid)
    assert all(isinstance(artist, PathCollection) for artist in found)
    return sum(len(artist.get_offsets()) for artist in found if isinstance(artist, PathCollection))


def all_text(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(Text))


def overlapping(a: Artist, b: Artist) -> bool:
    return bool(a.get_window_extent().shrunk(0.98, 0.98).overlaps(b.get_window_extent().shrunk(0.98, 0.98)))


@pytest.mark.parametrize("size", [(4, 3), (7, 2), (16, 10)])
def test_the_merged_panel_shows_each_landmark_once_and_circles_the_common_ones(size: tuple[int, int]) -> None:
    fused = result(*size)
    page = draw_fused(fused)
    merged = page.axes[-1]
    common = [l for l in fused.landmarks if len(l.sources) == 2]
    (rings,) = artists(merged, "common")
    assert isinstance(rings, PathCollection)
    assert len(common) >= 3
    assert sorted(map(tuple, np.asarray(rings.get_offsets()))) == sorted((l.x, l.y) for l in common)
    assert count(merged, "doubtful") == 3
    assert count(merged, "doubtful") + count(merged, "landmarks") == len(fused.landmarks)


def test_doubtful_landmarks_are_hollow_and_the_others_are_not() -> None:
    merged = draw_fused(result(4, 3)).axes[-1]
    white = np.ones(4)
    for gid, hollow in (("doubtful", True), ("landmarks", False)):
        for artist in artists(merged, gid):
            assert isinstance(artist, PathCollection)
            assert np.allclose(artist.get_facecolor()[0], white) == hollow


def test_a_landmark_of_existence_one_half_is_not_called_doubtful() -> None:
    fused = result(4, 3, doubtful=0)
    landmarks = tuple(replace(l, existence=e) for l, e in zip(fused.landmarks, [0.5] + [0.9] * 99, strict=False))
    assert count(draw_fused(replace(fused, landmarks=landmarks)).axes[-1], "doubtful") == 0


@pytest.mark.parametrize("scale", [1.0, 5.0])
def test_ellipses_hold_ninety_five_per_cent(scale: float) -> None:
    """A point at angle phi of the drawn ellipse has p' C^-1 p = 5.991 scale^2, whatever the axes are called."""
    fused = result(4, 3)
    page = draw_fused(fused, ellipse_scale=scale)
    (ellipses,) = artists(page.axes[-1], "ellipses")
    assert isinstance(ellipses, EllipseCollection)
    phi = np.linspace(0, 2 * np.pi, 12)
    drawn = zip(
        ellipses.get_widths(), ellipses.get_heights(), ellipses.get_angles(), ellipses.get_offsets(), strict=True
    )
    for (width, height, degrees, offset), landmark in zip(drawn, fused.landmarks, strict=True):
        on_it = (
            np.stack([width / 2 * np.cos(phi), height / 2 * np.sin(phi)], axis=1) @ se2.rotation(np.deg2rad(degrees)).T
        )
        square = np.einsum("ni,ij,nj->n", on_it, np.linalg.inv(landmark.covariance[:2, :2]), on_it)
        assert np.allclose(square, CHI2_95 * scale**2)
        assert tuple(offset) == (landmark.x, landmark.y)
    assert ("5 × enlarged" in all_text(page)) == (scale == 5.0)


def test_an_ellipse_of_known_eigenvalues() -> None:
    """Variances 4 and 1 m^2 along axes turned by 30 degrees: half axes 2 and 1 times the root of 5.991."""
    R = se2.rotation(np.deg2rad(30.0))
    fused = result(2, 1, doubtful=0)
    one = replace(fused.landmarks[0], covariance=R @ np.diag([4.0, 1.0]) @ R.T, heading=None)
    (ellipses,) = artists(draw_fused(replace(fused, landmarks=(one,))).axes[-1], "ellipses")
    assert isinstance(ellipses, EllipseCollection)
    assert ellipses.get_widths()[0] == pytest.approx(2 * np.sqrt(4.0 * CHI2_95))
    assert ellipses.get_heights()[0] == pytest.approx(2 * np.sqrt(1.0 * CHI2_95))
    assert ellipses.get_angles()[0] % 180.0 == pytest.approx(30.0)


def test_title_and_facts_carry_the_answer() -> None:
    page = draw_fused(result(4, 3))
    assert page.get_suptitle() == "D7 + D9: merged, probability 0.998"
    text = all_text(page)
    assert "x = 9.50 ± 0.20 m,  y = −4.00 ± 0.15 m,  θ = 34.38 ± 0.57°" in text
    assert "The runner-up is 38 nats" in text.replace("\n", " ")
    assert "3 common" in page.axes[-1].get_title(loc="left")


def test_an_ambiguous_pair_is_never_drawn_as_merged() -> None:
    fused = apart(result(4, 3), "ambiguous", (0.5, 0.3, 0.1, 0.05), 0.05)
    page = draw_fused(fused)
    assert page.get_suptitle() == "D7 + D9: ambiguous, probability of the best hypothesis 0.500"
    rivals = page.axes[2:]
    titles = [axes.get_title(loc="left").replace("\n", " ") for axes in rivals]
    assert [title.split(" matching")[0] for title in titles] == [
        "possible placement 1: probability 0.500, 9", "possible placement 2: probability 0.300, 8",
        "possible placement 3: probability 0.100, 7",
    ]  # fmt: skip
    both = sum(len(map_) for map_ in fused.sources.values())
    for axes in rivals:
        assert count(axes, "landmarks") == both
        assert not artists(axes, "common")
    text = all_text(page).replace("\n", " ")
    assert "nothing is merged" in text
    assert "4 placements possible, probability of no overlap 0.050" in text
    assert "4:  probability 0.050, 6 matching" in text  # what isn't drawn is told
    assert "The building repeats itself." in text


def test_a_rival_is_map_2_laid_onto_map_1_by_its_T12() -> None:
    fused = apart(result(4, 3), "ambiguous", (0.5, 0.45), 0.05)
    axes = draw_fused(fused).axes[3]
    drawn = np.concatenate(
        [np.asarray(a.get_offsets()) for a in artists(axes, "landmarks") if isinstance(a, PathCollection)]
    )
    expected = fused.pairs[0].hypotheses[1].T12.apply(fused.sources["D9"].positions)
    nearest = np.hypot(*(drawn[:, None] - expected[None]).transpose(2, 0, 1)).min(axis=0)
    assert nearest.max() < 1e-9


def test_no_overlap_says_so_and_why() -> None:
    fused = apart(result(4, 3), "no_overlap", (0.012, 0.003), 0.985)
    page = draw_fused(fused)
    assert page.get_suptitle() == "D7 + D9: no overlap, probability of no overlap 0.985"
    assert [axes.get_title(loc="left") for axes in page.axes] == [
        "D7, in its own frame: 12 landmarks", "D9, in its own frame: 12 landmarks",
    ]  # fmt: skip
    assert "No overlap was found: nothing is merged." in all_text(page)
    assert "The building repeats itself." in all_text(page)


@pytest.mark.parametrize("decision", ["ambiguous", "no_overlap"])
def test_without_embedded_maps_the_statement_stands_alone(decision: str) -> None:
    page = draw_fused(replace(apart(result(4, 3), decision, (0.5, 0.3), 0.2), sources={}))
    assert page.axes == []
    assert "nothing is merged" in all_text(page)


def test_without_embedded_maps_only_the_merged_map_is_drawn() -> None:
    fused = result(4, 3)
    page = draw_fused(replace(fused, sources={}))
    assert len(page.axes) == 1
    assert count(page.axes[0], "common") == sum(len(l.sources) == 2 for l in fused.landmarks)


def test_three_maps_of_which_two_are_merged() -> None:
    fused = result(4, 3)
    alone = LandmarkMap("D1", (Landmark("c1", "corner", 0.0, 0.0),))
    other = replace(apart(fused, "no_overlap", (), 1.0).pairs[0], maps=("D7", "D1"), reason="Nothing alike.")
    three = replace(
        fused, decision="partial", maps=("D7", "D9", "D1"), groups=(("D7", "D9"), ("D1",)),
        pairs=(fused.pairs[0], other), sources={**fused.sources, "D1": alone},
        frames={**fused.frames, "D1": Frame(1, Transform(0, 0, 0, np.zeros((3, 3))))},
    )  # fmt: skip
    page = draw_fused(three)
    assert page.get_suptitle() == "D7 + D9 + D1: partial, probability 0.998"
    assert len(page.axes) == 4
    assert "D7 + D1, no overlap: Nothing alike." in all_text(page)
    assert "D9 in D7:  x = 9.50" in all_text(page)
    assert count(page.axes[-1], "common") == sum(len(l.sources) == 2 for l in fused.landmarks)


def test_maps_differ_by_more_than_colour() -> None:
    page = draw_fused(result(4, 3, doubtful=0))
    edge, dashes, grey = [], [], []
    for axes in page.axes[:2]:
        links = artists(axes, "links")[0]
        marker = artists(axes, "landmarks")[0]
        assert isinstance(links, LineCollection)
        assert isinstance(marker, PathCollection)
        dashes.append(links.get_linestyle()[0][1] is None)
        edge.append(np.allclose(marker.get_edgecolor()[0], marker.get_facecolor()[0]))
        grey.append(float(marker.get_facecolor()[0, :3] @ [0.2126, 0.7152, 0.0722]))
    assert dashes == [True, False]
    assert edge == [True, False]
    assert abs(grey[0] - grey[1]) > 0.2


def test_ids_stand_beside_few_landmarks_and_not_beside_many() -> None:
    few, many = result(4, 3), result(16, 10)
    shown = {text.get_text() for text in draw_fused(few).axes[-1].texts}
    assert shown == {l.id for l in few.landmarks}
    assert not draw_fused(many).axes[-1].texts
    assert not draw_fused(few, ids=False).axes[-1].texts
    assert len(draw_fused(result(9, 6), ids=True).axes[-1].texts) == len(result(9, 6).landmarks)


def test_ids_cover_neither_each_other_nor_landmarks() -> None:
    fused = result(4, 3)
    page = draw_fused(fused)
    axes = page.axes[-1]
    boxes = list(axes.texts)
    pairs = [(a, b) for k, a in enumerate(boxes) for b in boxes[k + 1 :]]
    assert not [(a.get_text(), b.get_text()) for a, b in pairs if overlapping(a, b)]
    at = axes.transData.transform([(l.x, l.y) for l in fused.landmarks])
    assert not [text.get_text() for text in boxes for p in at if text.get_window_extent().contains(*p)]


LONG = "map of the northern wing of building 36, second floor, recorded by robot vespucci on the morning of July 1st"


@pytest.mark.parametrize(
    "names", [("D7", "D9"), (LONG, LONG.replace("northern", "southern")), ("x" * 200, "$a_b$ & <c> %")]
)
@pytest.mark.parametrize("decision", ["merged", "ambiguous", "no_overlap"])
def test_no_text_is_cut_and_none_lies_on_another(names: tuple[str, str], decision: str) -> None:
    fused = result(4, 3, names=names)
    if decision != "merged":
        fused = apart(fused, decision, (0.6, 0.3), 0.1)
    pair = replace(fused.pairs[0], reason="Because of this and that, " * 60)
    page = draw_fused(replace(fused, pairs=(pair,)))
    page.canvas.draw()
    within = page.bbox.expanded(0.98, 1.001)  # text keeps a margin at its sides
    for part in [*page.texts, *page.legends]:
        box = part.get_window_extent()
        assert within.contains(box.x0, box.y0), str(part)
        assert within.contains(box.x1, box.y1), str(part)
    for axes in page.axes:
        box = axes.get_tightbbox()
        assert box is not None
        assert within.contains(box.x0, box.y0)
        assert within.contains(box.x1, box.y1)
    blocks: list[Artist] = [*page.texts, *page.legends, *page.axes]
    titles = [axes._left_title for axes in page.axes]
    pairs = [(a, b) for k, a in enumerate(blocks + titles) for b in (blocks + titles)[k + 1 :]]
    assert not [(str(a), str(b)) for a, b in pairs if overlapping(a, b)]


@pytest.mark.parametrize("n", [0, 1, 2])
def test_a_map_with_next_to_nothing_in_it(n: int) -> None:
    landmarks = tuple(Landmark(f"t{k}", "tree", 3.0, 4.0) for k in range(n))  # at one spot, without heading
    page = draw_map(LandmarkMap("garden", landmarks))
    assert count(page.axes[0], "landmarks") == n
    assert ("no landmarks" in all_text(page)) == (n == 0)
    assert np.ptp(page.axes[0].get_xlim()) >= 4.0


def test_a_merged_result_without_any_landmark_is_drawn() -> None:
    fused = result(2, 1)
    empty = {name: replace(map_, landmarks=(), walls=()) for name, map_ in fused.sources.items()}
    page = draw_fused(replace(fused, landmarks=(), sources=empty))
    assert len(page.axes) == 3


def test_a_map_shows_what_it_says_of_its_landmarks() -> None:
    landmarks = (
        Landmark("a", "tree", 0.0, 0.0, covariance=np.diag([1.0, 2.0])),
        Landmark("b", "tree", 9.0, 0.0, existence=0.3),
        Landmark("c", "tree", 9.0, 9.0),
    )
    axes = draw_map(LandmarkMap("garden", landmarks)).axes[0]
    (ellipses,) = artists(axes, "ellipses")
    assert isinstance(ellipses, EllipseCollection)
    assert np.asarray(ellipses.get_offsets()).tolist() == [[0.0, 0.0]]
    assert count(axes, "doubtful") == 1


def test_a_joint_covariance_gives_ellipses() -> None:
    landmarks = (Landmark("a", "tree", 0.0, 0.0), Landmark("b", "tree", 9.0, 0.0, heading=0.0))
    joint = JointCovariance(("b", "a"), 3, np.diag([4.0, 1.0, 0.1, 9.0, 9.0, 0.1]))
    (ellipses,) = artists(draw_map(LandmarkMap("garden", landmarks, joint_covariance=joint)).axes[0], "ellipses")
    assert isinstance(ellipses, EllipseCollection)
    assert np.asarray(ellipses.get_offsets()).tolist() == [[0.0, 0.0], [9.0, 0.0]]
    assert ellipses.get_widths() == pytest.approx([2 * np.sqrt(9.0 * CHI2_95), 2 * np.sqrt(4.0 * CHI2_95)])


def test_one_metre_is_as_long_in_x_as_in_y_and_everything_is_inside() -> None:
    fused = result(16, 10)
    page = draw_fused(fused)
    page.canvas.draw()
    for axes in page.axes:
        box = axes.get_window_extent()
        across, up = np.ptp(axes.get_xlim()) / box.width, np.ptp(axes.get_ylim()) / box.height
        assert across == pytest.approx(up, rel=1e-6)
    left, right = page.axes[-1].get_xlim()
    assert all(left < l.x < right for l in fused.landmarks)


@pytest.mark.parametrize("size", [(4, 3), (16, 10)])
def test_the_png_is_there_and_shows_something(tmp_path: Path, size: tuple[int, int]) -> None:
    target = tmp_path / "out.png"
    page = draw_fused(result(*size), target, dpi=80)
    pixels = matplotlib.image.imread(target)[..., :3]
    width, height = page.get_size_inches() * 80
    assert abs(pixels.shape[1] - width) <= 1
    assert abs(pixels.shape[0] - height) <= 1
    dark = (pixels < 0.8).any(axis=2).mean()
    assert 0.005 < dark < 0.5
    blue = (abs(pixels - np.array([0x00, 0x72, 0xB2]) / 255) < 0.02).all(axis=2)
    orange = (abs(pixels - np.array([0xE6, 0x9F, 0x00]) / 255) < 0.02).all(axis=2)
    assert blue.sum() > 100
    assert orange.sum() > 100


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_the_same_result_gives_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    fused = result(4, 3)
    first, second = tmp_path / f"1.{suffix}", tmp_path / f"2.{suffix}"
    draw_fused(fused, first)
    draw_fused(fused, second)
    assert first.read_bytes() == second.read_bytes()


def test_the_svg_is_xml(tmp_path: Path) -> None:
    draw_map(result(4, 3).sources["D7"], tmp_path / "map.SVG")
    assert ET.parse(tmp_path / "map.SVG").getroot().tag.endswith("svg")


def test_an_unknown_suffix_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"must end in one of \.png, \.svg, \.pdf"):
        draw_fused(result(4, 3), tmp_path / "out.bmp")
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder_is_an_error_of_ours(tmp_path: Path) -> None:
    with pytest.raises(MapfuseError, match="folder"):
        draw_fused(result(4, 3), tmp_path / "nowhere" / "out.png")


def test_matplotlib_is_loaded_when_a_picture_is_drawn_and_pyplot_never() -> None:
    code = (
        "import sys; from mapfuse.fusion.show import draw_map; from mapfuse.datasets.maps import LandmarkMap; "
        "assert 'matplotlib' not in sys.modules; draw_map(LandmarkMap('D1')); "
        "assert 'matplotlib.figure' in sys.modules; assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_names_cannot_steer_the_drawing(tmp_path: Path) -> None:
    strange = Landmark("\u202enoitcerid\x1b[2J", "corner", 0.0, 0.0)
    figure = draw_map(LandmarkMap("階 \u202eright to left", (strange,)), tmp_path / "strange.png")
    drawn = "".join(text.get_text() for text in figure.findobj(Text))
    assert "\u202e" not in drawn
    assert "\x1b" not in drawn
