"""The exhaustive matcher against a literal one: plain loops in the paper's order, on many small random maps."""

import itertools
from dataclasses import dataclass

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.arms import ARM_TOLERANCE, heading_of, signature, turns
from mapfuse.datasets.errors import TooLargeError
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.matching import exhaustive
from mapfuse.matching.config import MatchingConfig
from mapfuse.matching.exhaustive import match_exhaustively


# --------------------------------------------------------------------------------------- the literal version
@dataclass
class Literal:
    total: int = 0
    after_h1: int = 0
    after_h1_h2: int = 0
    after_compass: int = 0
    hypotheses: tuple = ()  # (count, rms, T12, id 1, id 2)


def reading(landmark, arm):
    """Compass of an arm: its own, else that of the arm opposite to it plus half a turn, else none."""
    arms = signature(landmark)
    link = landmark.links[arms.links[arm]]
    if link.compass is not None:
        return link.compass
    best = None
    for other in landmark.links:
        if other.heading is None or other.compass is None:
            continue
        off = abs(float(se2.wrap(other.heading - link.heading - np.pi)))
        if off < ARM_TOLERANCE and (best is None or off < best[0]):
            best = (off, float(se2.wrap(other.compass + np.pi)))
    return None if best is None else best[1]


def compass_mismatch(one, two, turn, gate_deg):
    agree = disagree = 0
    for arm1, arm2 in turn.pairs:
        reading1, reading2 = reading(one, arm1), reading(two, arm2)
        if reading1 is None or reading2 is None:
            continue
        if abs(float(se2.wrap(reading1 - reading2))) <= np.deg2rad(gate_deg):
            agree += 1
        else:
            disagree += 1
    return disagree > agree


def rotations(one, two, config):
    """(all rotations of the pair, those that the compass leaves)."""
    if signature(one).headings and signature(two).headings:
        every = turns(signature(one), signature(two))
        kept = [
            t for t in every if not config.use_compass or not compass_mismatch(one, two, t, config.compass_gate_deg)
        ]
        return [t.rotation for t in every], [t.rotation for t in kept]
    if heading_of(one) is None or heading_of(two) is None:
        return [], []
    only = [float(se2.wrap(heading_of(one) - heading_of(two)))]
    return only, only


def largest_matching(map1, map2, T12, config):
    """Most matches, and of those the least sum of squares: every choice is tried."""
    options = []
    for two in map2.landmarks:
        x, y = se2.transform(T12, [two.x, two.y])
        near = []
        for place, one in enumerate(map1.landmarks):
            squared = (one.x - x) ** 2 + (one.y - y) ** 2
            if squared <= config.tolerance_m**2 and (one.type == two.type or not config.use_h1):
                near.append((place, squared))
        if near:
            options.append([*near, (None, 0.0)])
    # States by the set of used landmarks of map 1: the exhaustive choice without trying equal ones twice.
    states = {frozenset(): 0.0}
    for near in options:
        following = {}
        for used, cost in states.items():
            for place, squared in near:
                if place in used:
                    continue
                now = used if place is None else used | {place}
                following[now] = min(following.get(now, np.inf), cost + squared)
        states = following
    count = max(len(used) for used in states)
    return count, min(cost for used, cost in states.items() if len(used) == count)


def literal(map1, map2, config):
    out, found = Literal(), []
    for one in map1.landmarks:
        for two in map2.landmarks:
            out.total += 1
            if config.use_h1 and one.type != two.type:
                continue
            out.after_h1 += 1
            if config.use_h2 and not (one.type in ("corner", "junction") and two.type in ("corner", "junction")):
                continue
            out.after_h1_h2 += 1
            every, kept = rotations(one, two, config)
            if every and not kept:
                continue
            out.after_compass += 1
            for theta in kept:
                turned = se2.transform([0, 0, theta], [two.x, two.y])
                T12 = np.array([one.x - turned[0], one.y - turned[1], theta])
                count, squares = largest_matching(map1, map2, T12, config)
                found.append((count, np.sqrt(squares / max(count, 1)), T12, one.id, two.id))
    found.sort(key=lambda f: (-f[0], round(f[1], 6), *np.round(f[2][::-1], 6)))
    out.hypotheses = tuple(found)
    return out


# ---------------------------------------------------------------------------------------------- random maps
def random_landmark(rng, name, true, position, types, angles):
    """A landmark at ``position`` turned by ``true`` [rad]; some of its arms are unlisted, some unread."""
    kind = types[rng.integers(len(types))]
    if kind == "tree":
        return Landmark(name, kind, *position, heading=float(true) if rng.random() < 0.5 else None)
    skew = np.deg2rad(rng.choice(angles))
    open_arms = {
        "corner": ([1, 1, 0, 0], [1, 0, 0, 0]),
        "junction": ([1, 1, 1, 0], [1, 1, 1, 1]),
        "door": ([1, 0, 1, 0],),
    }[kind]
    opened = open_arms[rng.integers(len(open_arms))]
    links = []
    for k, direction in enumerate((0.0, skew, np.pi, np.pi + skew)):
        heading = float(se2.wrap(true + direction + rng.normal(0, 0.05)))
        compass = float(se2.wrap(heading + 0.7 + rng.normal(0, 0.2))) if rng.random() < 0.4 else None
        if rng.random() < 0.1:
            continue
        type_ = "open" if opened[k] else "blocked"
        links.append(Link("unknown" if rng.random() < 0.05 else type_, heading, compass))
    rng.shuffle(links)
    return Landmark(name, kind, *position, links=tuple(links))


def random_maps(seed, n=8, angles=(90.0, 90.0, 65.0)):
    """Two maps that share some landmarks, on a coarse lattice so that neighbours and duplicates are common."""
    rng = np.random.default_rng(seed)
    types = ["corner", "junction", "door", "tree"][: rng.integers(2, 5)]
    T12 = rng.uniform([-5, -5, -np.pi], [5, 5, np.pi])
    n1, n2 = rng.integers(1, n + 1, size=2)
    places = rng.integers(0, 4, size=(n1, 2)) * 1.1 + rng.normal(0, 0.2, size=(n1, 2))
    one = [random_landmark(rng, f"a{k}", rng.integers(4) * np.pi / 2, p, types, angles) for k, p in enumerate(places)]
    two = []
    for k in range(n2):
        source = one[rng.integers(n1)]
        p = se2.transform(se2.inverse(T12), [source.x, source.y]) + rng.normal(0, 0.2, size=2)
        two.append(random_landmark(rng, f"b{k}", rng.integers(4) * np.pi / 2 - T12[2], p, types, angles))
        if rng.random() < 0.5:
            arms = [
                Link(l.type, float(se2.wrap(l.heading - T12[2])), l.compass if rng.random() < 0.7 else None)
                for l in source.links
            ]
            own = None if source.heading is None else float(se2.wrap(source.heading - T12[2]))
            two[-1] = Landmark(f"b{k}", source.type, *p, heading=own, links=tuple(arms))
    return LandmarkMap("one", tuple(one)), LandmarkMap("two", tuple(two))


def busy_maps(seed, **kind):
    """Random maps that propose more than ten transformations."""
    options = (random_maps(1000 * (seed + 1) + k, n=12, **kind) for k in itertools.count())
    return next(maps for maps in options if len(match_exhaustively(*maps, MatchingConfig())) > 10)


SWITCHES = [
    MatchingConfig(use_h1=h1, use_h2=h2, use_compass=compass, tolerance_m=tolerance)
    for h1, h2, compass in itertools.product([True, False], repeat=3)
    for tolerance in (0.6, 1.5)
]


@pytest.mark.parametrize("config", SWITCHES)
def test_equals_the_literal_version(config):
    tried = 0
    for seed in range(12):
        map1, map2 = random_maps(seed)
        expected, found = literal(map1, map2, config), match_exhaustively(map1, map2, config)
        counts = found.counts
        assert (counts.total, counts.after_h1, counts.selected, counts.after_compass) == (
            expected.total,
            expected.after_h1,
            expected.after_h1_h2,
            expected.after_compass,
        )
        assert counts.transformations == len(expected.hypotheses) == len(found) == len(found.hypotheses)
        assert found.match_counts.tolist() == [h[0] for h in expected.hypotheses]
        np.testing.assert_allclose(found.rms, [h[1] for h in expected.hypotheses], atol=2e-6)
        by_seed = {}
        for count, _, T12, *pair in expected.hypotheses:
            by_seed.setdefault(tuple(pair), []).append((count, T12))
        for h in found.hypotheses:
            options = by_seed[h.seed[0]]
            near = [k for k, (_, T12) in enumerate(options) if _same_pose(h.T12.array, T12)]
            assert len(near) == 1
            assert options.pop(near[0])[0] == h.count
        tried += len(expected.hypotheses)
    assert tried > 30


def _same_pose(T, T_other):
    return bool(np.all(np.abs(T[:2] - T_other[:2]) < 1e-9) and abs(se2.wrap(T[2] - T_other[2])) < 1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_correspondences_are_one_to_one_within_tolerance_and_as_many_as_counted(seed):
    map1, map2 = busy_maps(seed)
    config = MatchingConfig(use_compass=False)
    for h in match_exhaustively(map1, map2, config).hypotheses:
        assert len(h.correspondences) == h.count == h.score
        assert len({a for a, _ in h.correspondences}) == len({b for _, b in h.correspondences}) == h.count
        for a, b in h.correspondences:
            one, two = map1[a], map2[b]
            assert one.type == two.type
            assert np.hypot(*(h.T12.apply([two.x, two.y]) - [one.x, one.y])) <= config.tolerance_m + 1e-12


# --------------------------------------------------------------------------------------------- by hand
def faced(name, x=0.0):
    """A corner without arms that faces along x."""
    return Landmark(name, "corner", x, 0.0, heading=0.0)


def cross(name, x, y, turned=0.0, compass=None):
    links = tuple(
        Link("open", float(se2.wrap(turned + k * np.pi / 2)), None if compass is None else compass(k)) for k in range(4)
    )
    return Landmark(name, "junction", x, y, links=links)


def test_crossing_proposes_four_turns_and_the_compass_leaves_one():
    def north(k):
        return float(se2.wrap(k * np.pi / 2 + 0.3))

    one = LandmarkMap("one", (cross("a", 3.0, 1.0, compass=north),))
    two = LandmarkMap("two", (cross("b", 0.0, 0.0, turned=0.2, compass=lambda k: north(k) + 0.1),))
    free = match_exhaustively(one, two, MatchingConfig(use_compass=False))
    assert sorted(round(h.T12.theta, 6) for h in free.hypotheses) == pytest.approx(
        sorted(float(se2.wrap(k * np.pi / 2 - 0.2)) for k in range(4)), abs=1e-6
    )
    gated = match_exhaustively(one, two)
    assert (gated.counts.after_compass, gated.counts.transformations) == (1, 1)
    assert gated.hypotheses[0].T12.array == pytest.approx([3.0, 1.0, -0.2])


def t_junction(name, read, reading_rad):
    """Open along x both ways and to +y; only arm ``read`` (0: +x, 1: -x) was travelled and read."""
    compass = [None, None]
    compass[read] = reading_rad
    links = (
        Link("open", 0.0, compass[0]),
        Link("open", np.pi / 2),
        Link("open", np.pi, compass[1]),
        Link("blocked", -np.pi / 2),
    )
    return LandmarkMap(name, (Landmark(name, "junction", 0.0, 0.0, links=links),))


def test_opposite_travel_is_compared_with_the_hypothesised_compass():
    """Robot 1 went along +x and read 0.4; robot 2 along -x: the same building must read 0.4 + pi there."""
    along = t_junction("one", 0, 0.4)
    assert match_exhaustively(along, t_junction("two", 1, se2.wrap(0.4 + np.pi + 0.3))).counts.after_compass == 1
    turned_building = match_exhaustively(along, t_junction("two", 1, 0.4))
    assert turned_building.counts.after_compass == 0
    assert turned_building.hypotheses == ()


def test_gate_is_thirty_degrees_unless_said_otherwise():
    one = t_junction("one", 0, 0.0)
    for degrees, gate, left in ((29.0, 30.0, 1), (31.0, 30.0, 0), (31.0, 40.0, 1), (5.0, 4.0, 0)):
        config = MatchingConfig(compass_gate_deg=gate)
        two = t_junction("two", 0, np.deg2rad(degrees))
        assert match_exhaustively(one, two, config).counts.after_compass == left


def test_doors_and_points_never_propose_but_count():
    def corner(name, x):
        return Landmark(name, "corner", x, 0.0, links=(Link("open", 0.0), Link("blocked", 1.57), Link("blocked", 3.14)))

    one = LandmarkMap("one", (corner("a", 0.0), Landmark("d", "door", 3.0, 0.0), Landmark("t", "tree", 3.0, 1.0)))
    two = LandmarkMap("two", (corner("b", 9.0), Landmark("e", "door", 12.0, 0.0), Landmark("u", "tree", 12.0, 1.0)))
    result = match_exhaustively(one, two)
    assert result.counts.after_h1 == 3
    assert [h.seed for h in result.hypotheses] == [(("a", "b"),)]
    assert result.hypotheses[0].correspondences == (("a", "b"), ("d", "e"), ("t", "u"))


def test_headings_without_arms_propose_one_turn():
    one = LandmarkMap("one", (Landmark("a", "corner", 1.0, 1.0, heading=np.pi / 2),))
    two = LandmarkMap("two", (Landmark("b", "corner", 2.0, 0.0, heading=0.0), Landmark("c", "corner", 0.0, 0.0)))
    result = match_exhaustively(one, two)
    assert (result.counts.selected, result.counts.transformations) == (2, 1)
    assert result.hypotheses[0].T12.array == pytest.approx([1.0, -1.0, np.pi / 2])


def test_count_is_a_maximum_matching_not_a_greedy_one():
    """b lies between a1 and a2, nearer to a1; c reaches a1 only: greedy by distance would count one."""

    def marks(prefix, xs):
        return tuple(Landmark(f"{prefix}{k}", "tree", 10 + x, 0.0) for k, x in enumerate(xs))

    one = LandmarkMap("one", (faced("o"), *marks("a", (0.0, 1.2))))
    two = LandmarkMap("two", (faced("p"), *marks("b", (0.3, -0.9))))
    best = match_exhaustively(one, two).hypotheses[0]
    assert best.correspondences == (("o", "p"), ("a0", "b1"), ("a1", "b0"))


def test_duplicates_at_one_spot_are_counted_once_each():
    one = LandmarkMap("one", tuple(faced(f"a{k}") for k in range(5)))
    two = LandmarkMap("two", tuple(faced(f"b{k}") for k in range(3)))
    result = match_exhaustively(one, two)
    assert result.match_counts.tolist() == [3] * 15


# ---------------------------------------------------------------------------------------- invariances, limits
def test_shuffling_and_renaming_change_nothing():
    map1, map2 = busy_maps(7)
    config = MatchingConfig(use_compass=False)
    rng = np.random.default_rng(1)
    other1, other2 = (m.replace(landmarks=tuple(m.landmarks[k] for k in rng.permutation(len(m)))) for m in (map1, map2))
    first, second = match_exhaustively(map1, map2, config), match_exhaustively(other1, other2, config)
    assert first.match_counts.tolist() == second.match_counts.tolist()
    np.testing.assert_allclose(first.T12s, second.T12s, atol=1e-9)
    assert [h.seed for h in first.hypotheses] == [h.seed for h in second.hypotheses]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("angle", [90.0, 65.0])
def test_swapped_maps_give_the_inverse_transformations(seed, angle):
    map1, map2 = busy_maps(seed, angles=(angle,))
    there, back = match_exhaustively(map1, map2), match_exhaustively(map2, map1)
    assert there.counts == back.counts
    assert len(there) > 10
    forward = {}
    for h in there.hypotheses:
        forward.setdefault(h.seed[0], []).append((h.count, h.T12.inverse().array))
    for h in back.hypotheses:
        assert sum(c == h.count and _same_pose(T21, h.T12.array) for c, T21 in forward[h.seed[0][::-1]]) == 1


@pytest.mark.parametrize(("n1", "n2"), [(0, 0), (0, 3), (3, 0)])
def test_empty_maps_have_no_hypotheses(n1, n2):
    one, two = (LandmarkMap("m", tuple(faced(f"a{k}", k) for k in range(n))) for n in (n1, n2))
    result = match_exhaustively(one, two)
    assert result.hypotheses == ()
    assert (result.counts.total, result.counts.transformations) == (0, 0)


def test_ten_thousand_landmarks_are_refused_with_the_advice():
    marks = tuple(faced(str(k), float(k)) for k in range(10_000))
    with pytest.raises(TooLargeError, match=r"100000000 pairs on 10000 landmarks.*mode 'default'"):
        match_exhaustively(LandmarkMap("one", marks), LandmarkMap("two", marks))


def test_a_heap_of_duplicates_too_large_to_sort_out_is_refused():
    heap = LandmarkMap("heap", tuple(faced(str(k)) for k in range(300)))
    with pytest.raises(TooLargeError, match="mode 'default'"):
        match_exhaustively(heap, heap)


def test_many_landmarks_that_cannot_propose_are_no_reason_to_refuse():
    doors = tuple(Landmark(str(k), "door", float(k), 0.0) for k in range(10_000))
    result = match_exhaustively(LandmarkMap("one", doors), LandmarkMap("two", doors))
    assert (result.counts.total, result.counts.selected, len(result)) == (100_000_000, 0, 0)


def test_pieces_of_the_work_add_up(monkeypatch):
    map1, map2 = busy_maps(11)
    config = MatchingConfig(use_compass=False)
    whole = match_exhaustively(map1, map2, config)
    monkeypatch.setattr(exhaustive, "_PLACES_AT_ONCE", 1)
    piecewise = match_exhaustively(map1, map2, config)
    np.testing.assert_array_equal(whole.T12s, piecewise.T12s)
    assert whole.hypotheses == piecewise.hypotheses
