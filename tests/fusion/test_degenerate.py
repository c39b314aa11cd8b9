"""Inputs at the edge of what a map can be: each has a typed answer; warnings are errors here as everywhere."""

from __future__ import annotations

import tracemalloc
from dataclasses import fields, replace

import numpy as np
import pytest

from mapfuse.datasets import read_map, se2, write_map
from mapfuse.datasets.errors import MapError, MapfuseError, TooLargeError
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Link, Noise
from mapfuse.datasets.simulation import MILKA, VESPUCCI, explore, make_floor, record, simulated_pair
from mapfuse.factors import FrameKey, LandmarkKey, build_problem, components
from mapfuse.fusion import FuseConfig, fuse, read_fused, write_fused
from mapfuse.fusion.config import SolvingConfig
from mapfuse.fusion.solve import solve
from mapfuse.matching.config import MatchingConfig

#: As many hypotheses as these small maps need.
FEW = FuseConfig(matching=MatchingConfig(max_hypotheses=8))
T12 = np.array([3.0, 4.0, 0.8])


def arms(heading=0.0, kinds=("open", "blocked", "blocked", "open")):
    return tuple(Link(kind, float(se2.wrap(heading + k * np.pi / 2))) for k, kind in enumerate(kinds))


def corner(id_, x=0.0, y=0.0, heading=0.0, **more):
    return Landmark(id_, "corner", x, y, links=arms(heading), **more)


def trees(name, positions, type_="tree", **more):
    landmarks = tuple(Landmark(f"{name}{k}", type_, float(x), float(y)) for k, (x, y) in enumerate(positions))
    return LandmarkMap(name, landmarks, **more)


def field(n=14, seed=0):
    """Positions of trees in map 1 and in map 2, without noise."""
    p2 = np.random.default_rng(seed).uniform(0, 40, (n, 2))
    return se2.transform(T12, p2), p2


def checked_fuse(maps, tmp_path, config=FEW):
    """The answer, after all that must hold of any answer: probabilities add up, it can be written and read back."""
    fused = fuse(maps, config)
    pair = fused.pairs[0]
    assert fused.decision == pair.decision
    assert sum(h.probability for h in pair.hypotheses) + pair.no_overlap_probability == pytest.approx(1)
    assert pair.reason
    for hypothesis in pair.hypotheses:
        assert np.isfinite(hypothesis.T12.array).all()
        assert np.isfinite(hypothesis.log_evidence)
        assert np.linalg.eigvalsh(hypothesis.T12.covariance).min() >= -1e-9 * np.abs(hypothesis.T12.covariance).max()
    n = len(maps[0]) + len(maps[1]) - (len(pair.correspondences) if fused.decision == "merged" else 0)
    assert len(fused.landmarks) == n
    assert all(np.isfinite((l.x, l.y, l.existence)).all() and np.isfinite(l.covariance).all() for l in fused.landmarks)
    write_fused(fused, tmp_path / "x.fused.json")
    assert read_fused(tmp_path / "x.fused.json").pairs == fused.pairs
    return fused


def is_T12(fused, expected=T12, sigmas=4.0):
    found = fused.pairs[0].T12
    off = found.array - expected
    off[2] = se2.wrap(off[2])
    return bool((np.abs(off) < sigmas * np.sqrt(np.diag(found.covariance))).all())


@pytest.mark.parametrize(
    ("one", "two"),
    [
        ((), ()),
        ((), (Landmark("t", "tree", 1.0, 2.0),)),
        ((corner("c"),), ()),
        ((Landmark("t", "tree", 1.0, 2.0),), (Landmark("u", "tree", 5.0, 2.0),)),
        ((corner("c"),), (Landmark("u", "tree", 5.0, 2.0),)),
    ],
    ids=["both empty", "first empty", "second empty", "one tree each", "nothing in common"],
)
def test_too_little_for_any_hypothesis_is_no_overlap(one, two, tmp_path):
    fused = checked_fuse([LandmarkMap("A", one), LandmarkMap("B", two)], tmp_path)
    assert (fused.decision, fused.pairs[0].no_overlap_probability) == ("no_overlap", 1.0)
    assert fused.pairs[0].T12 is None
    assert fused.pairs[0].mixture_covariance is None
    assert fused.groups == (("A",), ("B",))


def test_one_corner_each_is_a_hypothesis_and_no_merge(tmp_path):
    fused = checked_fuse([LandmarkMap("A", (corner("c"),)), LandmarkMap("B", (corner("d", 3.0, 0, 1.0),))], tmp_path)
    assert fused.decision != "merged"
    assert fused.pairs[0].correspondences == (("c", "d"),)
    assert fused.pairs[0].T12.theta == pytest.approx(-1.0)


def test_no_common_kinds_is_no_overlap_however_alike_the_places(tmp_path):
    p1, p2 = field()
    fused = checked_fuse([trees("A", p1), trees("B", p2, "pole")], tmp_path)
    assert (fused.decision, fused.pairs[0].hypotheses) == ("no_overlap", ())


def test_one_map_alone_is_itself_straightened(tmp_path):
    fused = fuse([trees("A", field()[0])])
    assert (fused.decision, fused.probability, fused.pairs) == ("merged", 1.0, ())
    write_fused(fused, tmp_path / "x.fused.json")
    assert len(fuse([LandmarkMap("E")]).landmarks) == 0


def test_landmarks_on_a_line_merge_where_their_gaps_tell(tmp_path):
    x = np.array([0.0, 1.0, 4.0, 9.0, 16.0, 25.0, 36.0, 49.0])
    line = np.column_stack([x, np.zeros(8)])
    fused = checked_fuse([trees("A", se2.transform(T12, line)), trees("B", line)], tmp_path)
    assert fused.decision == "merged"
    assert is_T12(fused)


def test_a_regular_line_repeats_itself_and_does_not_merge(tmp_path):
    line = np.column_stack([np.arange(8.0) * 3, np.zeros(8)])
    assert checked_fuse([trees("A", line), trees("B", line)], tmp_path).decision != "merged"


def test_everything_at_one_spot(tmp_path):
    spot = np.zeros((8, 2))
    assert checked_fuse([trees("A", spot), trees("B", spot)], tmp_path).decision == "no_overlap"
    corners = [LandmarkMap(name, tuple(corner(f"{name}{k}") for k in range(8))) for name in "AB"]
    assert checked_fuse(corners, tmp_path).decision != "merged"


def test_duplicates_among_others_leave_the_rest_as_it_is(tmp_path):
    p1, p2 = field()
    twice = [trees("A", np.concatenate([p1, p1[:3]])), trees("B", np.concatenate([p2, p2[:2], p2[:2]]))]
    fused = checked_fuse(twice, tmp_path)
    assert fused.decision == "merged"
    assert is_T12(fused)


def test_a_map_and_itself_under_another_name(tmp_path):
    recorded = simulated_pair(3)[0]
    fused = checked_fuse([recorded, recorded.replace(name="again")], tmp_path)
    assert fused.decision == "merged"
    assert set(fused.pairs[0].correspondences) >= {(id_, id_) for id_ in recorded.ids[:5]}
    np.testing.assert_allclose(fused.pairs[0].T12.array, 0, atol=1e-6)


EXTREME = {
    "positions exact": Noise(position_sigma=0.0),
    "headings exact": Noise(heading_sigma=0.0),
    "distances exact": Noise(distance_sigma_floor=0.0, distance_sigma_per_metre=0.0),
    "compass exact": Noise(compass_sigma=0.0, compass_offset_sigma=0.0),
    "offset unknown": Noise(compass_offset_sigma=None),
    "nothing detected": Noise(detection_rate=0.0, door_detection_rate=0.0),
    "everything detected": Noise(detection_rate=1.0, door_detection_rate=1.0),
    "nothing false": Noise(false_alarm_rate=0.0, door_false_alarm_rate=0.0),
    "everything false": Noise(false_alarm_rate=1.0, door_false_alarm_rate=1.0),
    "all exact": Noise(
        distance_sigma_per_metre=0.0,
        distance_sigma_floor=0.0,
        heading_sigma=0.0,
        position_sigma=0.0,
        compass_sigma=0.0,
        compass_offset_sigma=0.0,
        detection_rate=1.0,
        false_alarm_rate=0.0,
        door_detection_rate=1.0,
        door_false_alarm_rate=0.0,
    ),
    "all vague": Noise(
        distance_sigma_floor=1e3, heading_sigma=3.0, position_sigma=1e4, detection_rate=0.0, false_alarm_rate=1.0
    ),
}


def stated(recorded, noise):
    """The map with those figures of ``noise`` that aren't the defaults."""
    own = {f.name: getattr(noise, f.name) for f in fields(Noise) if getattr(noise, f.name) != getattr(Noise(), f.name)}
    return recorded.replace(noise=replace(recorded.noise, **own))


@pytest.mark.parametrize("noise", EXTREME.values(), ids=EXTREME.keys())
def test_extreme_noise_has_an_answer(noise, tmp_path):
    p1, p2 = field()
    checked_fuse([trees("A", p1, noise=noise), trees("B", p2, noise=noise)], tmp_path)
    fused = checked_fuse([stated(m, noise) for m in simulated_pair(3, compass=True)[:2]], tmp_path)
    if noise in (EXTREME["nothing detected"], EXTREME["everything false"], EXTREME["all vague"]):
        assert fused.decision != "merged"
    if noise in (EXTREME["offset unknown"], EXTREME["nothing false"], EXTREME["everything detected"]):
        assert fused.decision == "merged"


def test_existence_of_zero_and_one_has_an_answer(tmp_path):
    maps = [
        m.replace(landmarks=tuple(replace(l, existence=float(k % 2)) for k, l in enumerate(m.landmarks)))
        for m in simulated_pair(3)[:2]
    ]
    fused = checked_fuse(maps, tmp_path)
    assert fused.decision != "merged" or all(0 <= l.existence <= 1 for l in fused.landmarks)


def test_counters_of_zero_count_as_one(tmp_path):
    map1, map2, _ = simulated_pair(3)
    never = map1.replace(landmarks=tuple(replace(l, visit_counter=0, detection_counter=0) for l in map1.landmarks))
    assert checked_fuse([never, map2], tmp_path).decision == "merged"


def with_links(recorded, **changes):
    return recorded.replace(
        landmarks=tuple(
            replace(l, links=tuple(replace(link, **changes) for link in l.links)) for l in recorded.landmarks
        )
    )


@pytest.mark.parametrize(
    ("changes", "merges"),
    [
        ({"heading": None}, True),
        ({"distance": None}, True),
        ({"type": "unknown"}, True),
        ({"compass": None, "travel_counter": 0}, True),
        ({"connected_to_id": None, "distance": None}, None),
        ({"type": "unknown", "connected_to_id": None, "distance": None}, True),
        ({"heading": None, "connected_to_id": None, "distance": None}, True),
        ({"distance": 0.0}, False),
    ],
    ids=lambda value: ", ".join(value) if isinstance(value, dict) else "",
)
def test_links_with_only_some_of_their_fields(changes, merges, tmp_path):
    map1, map2, truth = simulated_pair(3, compass=True)
    fused = checked_fuse([with_links(map1, **changes), with_links(map2, **changes)], tmp_path)
    if merges is not None:
        assert (fused.decision == "merged") == merges
    if fused.decision == "merged":
        assert set(fused.pairs[0].correspondences) & set(truth.true_pairs("A", "B"))


def test_links_of_no_length_and_no_noise(tmp_path):
    maps = [with_links(m, distance=0.0) for m in simulated_pair(3)[:2]]
    exact = Noise(distance_sigma_floor=0.0, distance_sigma_per_metre=0.0, heading_sigma=0.0)
    assert checked_fuse([stated(m, exact) for m in maps], tmp_path).decision != "merged"


def test_disconnected_components_hang_together_by_their_positions(tmp_path):
    map1, map2, _ = simulated_pair(3)
    third = set(map1.ids[::3])

    def cut_off(landmark):
        cut = {link for link in landmark.links if landmark.id in third or link.connected_to_id in third}
        return tuple(replace(k, connected_to_id=None, distance=None) if k in cut else k for k in landmark.links)

    cut = map1.replace(landmarks=tuple(replace(l, links=cut_off(l)) for l in map1.landmarks))
    assert len(components(cut)) > len(third)
    fused = checked_fuse([cut, map2], tmp_path)
    assert fused.decision != "no_overlap"


def test_landmarks_with_a_heading_and_without_mixed(tmp_path):
    p1, p2 = field(16)
    h = np.linspace(-3, 3, 16)

    def mixed(name, p, turn):
        headed = (
            Landmark(f"c{k}", "chair", *p[k].tolist(), heading=float(se2.wrap(h[k] + turn))) for k in range(0, 16, 2)
        )
        bare = (Landmark(f"t{k}", "tree", *p[k].tolist()) for k in range(1, 16, 2))
        return LandmarkMap(name, (*headed, *bare))

    fused = checked_fuse([mixed("A", p1, T12[2]), mixed("B", p2, 0.0)], tmp_path)
    assert fused.decision == "merged"
    assert len(fused.pairs[0].correspondences) == 16
    assert is_T12(fused)
    assert {l.covariance.shape for l in fused.landmarks} == {(2, 2), (3, 3)}


@pytest.mark.parametrize("rows", [2, 3])
@pytest.mark.parametrize("kind", ["regular", "zero", "common shift", "one exact"])
def test_joint_covariances_singular_ones_too(rows, kind, tmp_path):
    p1, p2 = field()
    n = len(p1)
    C = {
        "regular": 0.01 * np.eye(rows * n),
        "zero": np.zeros((rows * n, rows * n)),
        "common shift": 0.01 * np.ones((rows * n, rows * n)),
        "one exact": np.diag(np.r_[np.zeros(rows), np.full(rows * (n - 1), 0.01)]),
    }[kind]

    def joint(name, p, turn):
        heading = {} if rows == 2 else {"heading": 0.5 + turn}
        landmarks = tuple(Landmark(f"{name}{k}", "chair", x, y, **heading) for k, (x, y) in enumerate(p.tolist()))
        return LandmarkMap(name, landmarks, joint_covariance=JointCovariance(tuple(l.id for l in landmarks), rows, C))

    fused = checked_fuse([joint("A", p1, T12[2]), joint("B", p2, 0.0)], tmp_path)
    assert fused.decision == "merged"
    assert len(fused.pairs[0].correspondences) == n
    np.testing.assert_allclose(fused.pairs[0].T12.array, T12, atol=1e-3)


@pytest.mark.parametrize("origin", [1e4, 3e7])
def test_survey_coordinates_are_as_good_as_any(origin, tmp_path):
    p1, p2 = field()
    near = fuse([trees("A", p1), trees("B", p2, path=np.zeros((1, 4)))], FEW)
    shift1, shift2 = np.array([origin, -origin]), np.array([-2 * origin, origin / 2])
    path = np.array([[0.0, *shift2, 0.0]])
    fused = checked_fuse([trees("A", p1 + shift1), trees("B", p2 + shift2, path=path)], tmp_path)
    assert fused.decision == near.decision == "merged"
    assert fused.probability == pytest.approx(near.probability, abs=1e-6)
    assert len(fused.pairs[0].correspondences) == len(p1)
    # T12 takes coordinates of file 2 into those of file 1
    at = fused.pairs[0].T12.apply(p2 + shift2)
    np.testing.assert_allclose(at - shift1, p1, atol=1e-5 + origin * 1e-10)
    # what doesn't depend on the origin is as it was: landmarks and their covariances, the rotation's
    for landmark, was in zip(fused.landmarks, near.landmarks, strict=True):
        np.testing.assert_allclose((landmark.x, landmark.y) - shift1, (was.x, was.y), atol=1e-5 + origin * 1e-10)
        np.testing.assert_allclose(landmark.covariance, was.covariance, rtol=1e-4)
    assert fused.pairs[0].T12.covariance[2, 2] == pytest.approx(near.pairs[0].T12.covariance[2, 2], rel=1e-4)
    assert fused.pairs[0].T12.covariance[0, 0] > near.pairs[0].T12.covariance[0, 0]
    assert fused.frames["B"].T == fused.pairs[0].T12
    assert not fused.frames["A"].T.array.any()
    assert fused.sources["B"].landmarks[0].x == (p2 + shift2)[0, 0]


def test_floors_in_survey_coordinates_give_the_same_either_way_round(tmp_path):
    map1, map2, _ = simulated_pair(3)
    shift = np.array([5e5, 5.4e6])
    far = map1.replace(
        landmarks=tuple(replace(l, x=l.x + shift[0], y=l.y + shift[1]) for l in map1.landmarks),
        path=np.array([[0.0, *shift, 0.0]]),
        walls=(),
    )
    near, one, two = fuse([map1, map2]), checked_fuse([far, map2], tmp_path, None), fuse([map2, far])
    assert near.pairs[0].correspondences == one.pairs[0].correspondences
    np.testing.assert_allclose(one.pairs[0].T12.array - [*shift, 0.0], near.pairs[0].T12.array, atol=1e-6)
    np.testing.assert_allclose(two.pairs[0].T12.covariance, one.pairs[0].T12.inverse().covariance, rtol=1e-6, atol=1e-6)
    both = one.to_map(name="both")
    assert both.path[0, 1:3].tolist() == pytest.approx(shift.tolist())
    assert fuse([both, map2.replace(name="third")]).decision == "merged"


def test_one_landmark_far_from_all_others(tmp_path):
    p1, p2 = field()
    astray = np.array([[1e5, 1e5]])
    fused = checked_fuse([trees("A", np.concatenate([p1, astray])), trees("B", p2)], tmp_path)
    assert fused.decision == "merged"
    assert is_T12(fused)


def third_map(seed):
    """Three robots on one floor: maps A, B and C with their true frames."""
    rng = np.random.default_rng(seed)
    floor = make_floor("irregular", rng)
    return [
        record(floor, explore(floor, rng, 0.8), robot.with_compass(False), rng, name)
        for robot, name in ((VESPUCCI, "A"), (MILKA, "B"), (VESPUCCI, "C"))
    ]


def test_a_fused_map_is_written_read_and_fused_with_a_third(tmp_path):
    a, b, c = third_map(4)
    first = fuse([a.map, b.map])
    assert first.decision == "merged"
    write_map(first.to_map(name="AB"), tmp_path / "ab.map.json")
    ab = read_map(tmp_path / "ab.map.json")
    both = checked_fuse([ab, c.map], tmp_path, None)
    assert both.decision == "merged"
    # (A+B)+C against all three at once with the same matches: T_AC within its stated covariance, by far
    sources = {l.id: l.sources for l in first.landmarks}
    matches = [(LandmarkKey(0, x), LandmarkKey(1, y)) for x, y in first.pairs[0].correspondences]
    for merged_id, z in both.pairs[0].correspondences:
        matches += [
            (LandmarkKey(r, id_), LandmarkKey(2, z))
            for r, name in enumerate("AB")
            for id_ in sources[merged_id].get(name, ())[:1]
        ]
    T_AC, T_AB = both.pairs[0].T12, first.pairs[0].T12
    problem = build_problem([a.map, b.map, c.map], [np.zeros(3), T_AB, T_AC], matches)
    at_once = solve(problem, SolvingConfig())
    off = se2.wrap(T_AC.array - at_once.poses[FrameKey(2)])
    C = at_once.transform(2).covariance
    assert off @ np.linalg.solve(C, off) < 1.0
    np.testing.assert_allclose(np.sqrt(np.diag(T_AC.covariance) / np.diag(C)), 1, atol=0.15)
    # and against the truth, within what is stated
    truth = se2.between(a.frame, c.frame)
    off = T_AC.array - truth
    off[2] = se2.wrap(off[2])
    assert off @ np.linalg.solve(T_AC.covariance, off) < 20.0


def test_points_are_fused_and_fused_again(tmp_path):
    p1, p2 = field(18, seed=2)
    rng = np.random.default_rng(3)
    noise = Noise(position_sigma=0.1)
    maps = [
        trees(name, p + rng.normal(0, 0.1, p.shape), noise=noise)
        for name, p in (("A", p1[:12]), ("B", p2[4:16]), ("C", p2[2:]))
    ]
    first = checked_fuse(maps[:2], tmp_path)
    both = checked_fuse([first.to_map(name="AB"), maps[2]], tmp_path)
    assert first.decision == both.decision == "merged"
    assert is_T12(first)
    assert is_T12(both)
    assert len(both.landmarks) == 18
    surest = min(both.landmarks, key=lambda l: np.trace(l.covariance))
    assert set(surest.sources) == {"AB", "C"}


TEN_THOUSAND = np.random.default_rng(4).uniform(0, 1000, (10_000, 2))
REFUSAL = "10000 landmarks.*: split the map, or fuse parts of it"


def test_ten_thousand_landmarks_are_refused_in_little_memory():
    maps = [trees(name, TEN_THOUSAND) for name in "AB"]
    tracemalloc.start()
    try:
        with pytest.raises(TooLargeError, match=REFUSAL):
            fuse(maps)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 300e6  # one dense covariance alone would take 7 GB


def test_ten_thousand_landmarks_are_refused_in_paper_mode():
    places = TEN_THOUSAND.tolist()
    maps = [LandmarkMap(name, tuple(corner(f"c{k}", *at) for k, at in enumerate(places))) for name in "AB"]
    with pytest.raises(TooLargeError, match=REFUSAL):
        fuse(maps, FuseConfig(matching=MatchingConfig(mode="paper")))


def test_mistakes_of_the_caller_are_errors_that_say_so():
    m = trees("A", field()[0])
    with pytest.raises(MapfuseError, match="at least one map"):
        fuse([])
    with pytest.raises(MapfuseError, match="two maps are named 'A'"):
        fuse([m, m.replace(name="B"), m])
    broken = LandmarkMap("B", (Landmark("t", "tree", float("nan"), 0.0), Landmark("t", "tree", 0.0, 0.0)))
    with pytest.raises(MapError) as caught:
        fuse([m, broken])
    assert len(caught.value.problems) >= 2


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_a_map_of_a_few_landmarks_against_a_whole_one(tmp_path, count):
    # compiled loops take both maps at once: an array of one row has another memory layout than one of many
    whole, other, _ = simulated_pair(3)
    kept = {landmark.id for landmark in other.landmarks[:count]}
    few = other.replace(
        landmarks=tuple(
            replace(landmark, links=tuple(link for link in landmark.links if link.connected_to_id in {None, *kept}))
            for landmark in other.landmarks[:count]
        )
    )
    answers = [checked_fuse(maps, tmp_path) for maps in ([whole, few], [few, whole])]
    assert len({fused.decision for fused in answers}) == 1
    assert answers[0].decision != "merged"
