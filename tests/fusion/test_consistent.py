"""`choose`: which candidates of many pairs can be true together. Comparisons are made by hand: no map is needed."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.transform import Transform
from mapfuse.fusion.config import FuseConfig
from mapfuse.fusion.consistent import choose
from mapfuse.fusion.decide import log_weights, probabilities
from mapfuse.fusion.evidence import Terms
from mapfuse.fusion.pairwise import Candidate, Comparison
from mapfuse.fusion.placing import group_kernels, places_of
from mapfuse.fusion.posegraph import Edge, PoseGraph

CONFIG = FuseConfig()
SIGMA = np.array([0.1, 0.1, 0.01])


def candidate(T12, nats, matches=((0, 0),)):
    return Candidate(Transform.from_array(T12, np.diag(SIGMA**2)), tuple(matches), Terms(matches=nats))


def comparison(a, b, *candidates):
    candidates = sorted(candidates, key=lambda c: -c.log_odds)
    weights = log_weights(np.array([c.log_odds for c in candidates]), np.zeros(len(candidates)), CONFIG.evidence)
    everything = probabilities(weights, 0.5)
    decision = "ambiguous"
    if candidates and everything[0] >= 0.99:
        decision = "merged"
    elif everything[-1] >= 0.99:
        decision = "no_overlap"
    n = 1 + max((i for c in candidates for m in c.matches for i in m), default=0)
    rates = np.full(n, 0.1)
    none = float(everything[-1])
    return Comparison((a, b), tuple(candidates), everything[:-1], weights, none, decision, ("why", "why"), rates, rates)


def by_pair(*comparisons):
    return {c.maps: c for c in comparisons}


def frame(choice, name):
    return choice.frames[name].array


@pytest.fixture
def world():
    """Frames of maps A to D in one world."""
    rng = np.random.default_rng(3)
    return {name: np.array([*rng.uniform(-30, 30, 2), rng.uniform(-np.pi, np.pi)]) for name in "ABCD"}


def true_T(world, a, b):
    return se2.between(world[a], world[b])


ELSEWHERE = np.array([7.0, -4.0, 1.0])


def test_two_maps_are_decided_as_their_pair_is(world):
    T = true_T(world, "A", "B")
    sure = choose("AB", by_pair(comparison("A", "B", candidate(T, 9.0))), CONFIG)
    assert sure.groups == (("A", "B"),)
    np.testing.assert_allclose(frame(sure, "B"), T)
    assert sure.probability[0] == pytest.approx(1 / (1 + np.exp(-9)))
    unsure = choose("AB", by_pair(comparison("A", "B", candidate(T, 3.0))), CONFIG)
    assert unsure.groups == (("A",), ("B",))
    assert unsure.chosen == {}


def test_an_ambiguous_pair_is_decided_by_its_cycle(world):
    T = {p: true_T(world, *p) for p in combinations("ABC", 2)}
    rivals = (candidate(se2.compose(T["A", "C"], ELSEWHERE), 8.0, [(5, 5)]), candidate(T["A", "C"], 7.9, [(4, 4)]))
    pairs = by_pair(
        comparison("A", "B", candidate(T["A", "B"], 12.0, [(0, 0)])),
        comparison("B", "C", candidate(T["B", "C"], 12.0, [(1, 1)])),
        comparison("A", "C", *rivals),
    )
    assert pairs["A", "C"].decision == "ambiguous"
    choice = choose("ABC", pairs, CONFIG)
    assert choice.groups == (("A", "B", "C"),)
    assert choice.chosen["A", "C"] == 1
    np.testing.assert_allclose(frame(choice, "C"), T["A", "C"], atol=1e-6)


def test_a_symmetric_building_stays_ambiguous_however_many_maps_agree_with_either_answer(world):
    """A and B are sure of each other; C fits both of them in two places, and these agree two by two."""
    T = {p: true_T(world, *p) for p in combinations("ABC", 2)}
    other = se2.compose(T["A", "C"], ELSEWHERE)
    pairs = by_pair(
        comparison("A", "B", candidate(T["A", "B"], 12.0, [(9, 9)])),
        comparison("A", "C", candidate(T["A", "C"], 8.0, [(0, 0)]), candidate(other, 8.0, [(1, 0)])),
        comparison(
            "B",
            "C",
            candidate(T["B", "C"], 8.0, [(0, 0)]),
            candidate(se2.compose(se2.inverse(T["A", "B"]), other), 8.0, [(1, 0)]),
        ),
    )
    choice = choose("ABC", pairs, CONFIG)
    assert choice.groups == (("A", "B"), ("C",))


def test_a_wrong_pair_is_overruled_and_the_cycle_is_named(world):
    T = {p: true_T(world, *p) for p in combinations("ABCD", 2)}
    right = {p: comparison(*p, candidate(T[p], 12.0, [(n, n)])) for n, p in enumerate(T) if p != ("A", "D")}
    wrong = comparison("A", "D", candidate(se2.compose(T["A", "D"], ELSEWHERE), 15.0))
    choice = choose("ABCD", right | {("A", "D"): wrong}, CONFIG)
    assert choice.groups == (("A", "B", "C", "D"),)
    assert ("A", "D") not in choice.chosen
    assert choice.overruled == {("A", "D"): ("A", "B", "D")}
    for name in "BCD":
        np.testing.assert_allclose(frame(choice, name), T["A", name], atol=1e-6)


def test_what_is_weak_alone_is_not_made_strong_by_counting_the_same_landmarks_again(world):
    """C has one landmark in common with A and with B, which is the same landmark of both: it counts once."""
    T = {p: true_T(world, *p) for p in combinations("ABC", 2)}

    def pairs(match_bc):
        return by_pair(
            comparison("A", "B", candidate(T["A", "B"], 12.0, [(0, 0), (1, 1)])),
            comparison("A", "C", candidate(T["A", "C"], 3.0, [(0, 0)])),
            comparison("B", "C", candidate(T["B", "C"], 3.0, [match_bc])),
        )

    assert choose("ABC", pairs((0, 0)), CONFIG).groups == (("A", "B"), ("C",))
    assert choose("ABC", pairs((1, 1)), CONFIG).groups == (("A", "B", "C"),)


def test_emptiness_speaks_against_a_placement(world):
    T = {p: true_T(world, *p) for p in combinations("ABC", 2)}
    pairs = by_pair(
        comparison("A", "B", candidate(T["A", "B"], 12.0)),
        comparison("B", "C", candidate(T["B", "C"], 12.0)),
        comparison("A", "C"),
    )
    asked = []

    def against(a, b, T_ab):
        asked.append((a, b, T_ab))
        return -20.0

    assert choose("ABC", pairs, CONFIG).groups == (("A", "B", "C"),)
    assert len(choose("ABC", pairs, CONFIG, against).groups) == 2
    a, b, T_ab = asked[0]
    np.testing.assert_allclose(T_ab, T[a, b], atol=1e-6)


def test_the_choice_does_not_depend_on_the_order_of_maps_or_pairs(world):
    rng = np.random.default_rng(11)
    names, _, pairs = planted(rng, maps=7, right=12, wrong=4)
    first = choose(names, pairs, CONFIG)
    shuffled = [list(pairs)[k] for k in rng.permutation(len(pairs))]
    second = choose(names[::-1], {p: pairs[p] for p in shuffled}, CONFIG)
    assert (first.groups, first.chosen, first.overruled) == (second.groups, second.chosen, second.overruled)
    assert all(np.array_equal(frame(first, n), frame(second, n)) for n in names)


def planted(rng, maps=12, right=30, wrong=15):
    """Maps in a world, wrong pairs, and right ones, of which every map has three; all are as sure of themselves."""
    names = [f"M{k:02d}" for k in range(maps)]
    poses = {n: np.array([*rng.uniform(-40, 40, 2), rng.uniform(-np.pi, np.pi)]) for n in names}
    every = list(combinations(names, 2))
    while True:
        drawn = [every[k] for k in rng.permutation(len(every))[: right + wrong]]
        good, bad = drawn[:right], drawn[right:]
        if min(sum(name in pair for pair in good) for name in names) >= 3:
            break
    found = {}
    for n, (a, b) in enumerate((*good, *bad)):
        T = se2.between(poses[a], poses[b]) + rng.normal(0, SIGMA)
        if n >= right:
            T = np.array([*rng.uniform(-60, 60, 2), rng.uniform(-np.pi, np.pi)])
        found[a, b] = comparison(a, b, candidate(T, float(rng.uniform(8, 25)), [(n, n)]))
    return names, poses, found | {p: comparison(*p) for p in every if p not in found}


def test_planted_wrong_pairs_are_all_overruled_and_frames_are_as_sure_as_they_are_right():
    """15 wrong among 30 right ones of 12 maps, as sure of themselves; seeds 0 to 99, nothing was tuned on them."""
    nees = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        names, poses, pairs = planted(rng)
        wrong = [p for p, c in pairs.items() if c.candidates][30:]
        choice = choose(names, pairs, CONFIG)
        assert choice.groups == (tuple(names),), seed
        assert not set(wrong) & set(choice.chosen), seed
        assert set(choice.overruled) == set(wrong), seed
        assert len(choice.chosen) == 30, seed
        off = [frame(choice, n) - se2.between(poses[names[0]], poses[n]) for n in names[1:]]
        for found, name in zip(off, names[1:], strict=True):
            found[2] = se2.wrap(found[2])
            nees.append(found @ np.linalg.solve(choice.frames[name].covariance, found))
    # SLACK adds a quarter to each variance; the frames of one seed are taken to be as one: 99.9 % of a mean of 100
    expected = 3 / 1.25
    assert abs(np.mean(nees) - expected) < 3.29 * np.sqrt(2 * 3 / 100) / 1.25


def test_identity_is_transitive_and_one_to_one():
    T = np.zeros(3)
    pairs = by_pair(
        comparison("A", "B", candidate(T, 9.0, [(0, 0), (1, 1)])),
        comparison("B", "C", candidate(T, 8.0, [(0, 5), (1, 6)])),
        # would make landmarks 0 and 1 of A the same: the weakest pair gives way
        comparison("A", "C", candidate(T, 3.0, [(0, 6)])),
    )
    root = places_of(dict.fromkeys(pairs, 0), pairs)
    assert root["A", 0] == root["B", 0] == root["C", 5]
    assert root["A", 1] == root["B", 1] == root["C", 6]
    assert root["A", 0] != root["A", 1]


def test_rivals_that_may_be_right_only_where_the_best_are_images_do_not_add_up(world, monkeypatch):
    """A and B are at one place, C and D at one: chance placements of C on A agree with those of D and B."""
    monkeypatch.setattr("mapfuse.fusion.consistent.MAX_APPEALS", 0)
    world["B"], world["D"] = (se2.compose(world[a], [0.5, 0.2, 0.1]) for a in "AC")
    T = {p: true_T(world, *p) for p in combinations("ABCD", 2)}
    right, pairs = [(n, n) for n in range(20)], {}
    for n, pair in enumerate(T):
        chance = [(20 + 4 * n + k, 20 + 4 * n + k) for k in range(4)]
        a, b = (world[name] for name in pair)
        moved = se2.compose(se2.between(a, world["A"]), se2.compose(ELSEWHERE, se2.between(world["A"], b)))
        together = set(pair) in ({"A", "B"}, {"C", "D"})
        rivals = [] if together else [candidate(moved, -8.0, chance)]
        pairs[pair] = comparison(*pair, candidate(T[pair], 300.0 if together else 120.0, right), *rivals)
    rival = pairs["A", "C"]
    assert rival.weights[1] > 90, "it weighs much, for it may be right if the building repeats itself"
    choice = choose("ABCD", pairs, CONFIG)
    assert choice.groups == (("A", "B", "C", "D"),)
    assert set(choice.chosen.values()) == {0}
    for name in "BCD":
        np.testing.assert_allclose(frame(choice, name), T["A", name], atol=1e-6)


def test_the_compiled_loop_agrees_with_the_algebra_of_se2():
    rng = np.random.default_rng(8)

    def some(n):
        return np.column_stack([rng.uniform(-20, 20, (n, 2)), rng.uniform(-np.pi, np.pi, n)])

    def covariances(n):
        half = rng.normal(0, 0.05, (n, 3, 3))
        return half @ half.swapaxes(1, 2) + 1e-4 * np.eye(3)

    def graph(names):
        X = some(len(names))
        ring = [(k, (k + 1) % len(names)) for k in range(len(names))]
        edges = [
            Edge(names[i], names[j], np.asarray(se2.between(X[i], X[j])), C)
            for (i, j), C in zip(ring, covariances(len(ring)), strict=True)
        ]
        return PoseGraph(tuple(names), edges)

    A, B = graph("abcd"), graph("wxyz")
    k = 40
    a, b = rng.integers(4, size=(2, k))
    T_AB, C = some(1)[0], covariances(k)
    T = se2.compose(se2.compose(se2.inverse(A.solved[0][a]), T_AB), B.solved[0][b])
    T = T + rng.normal(0, 1, (k, 3)) * [0.4, 0.4, 0.03]
    gate, coarse = 16.3, np.array([20.0, 20.0, 0.8])
    found = group_kernels().agreeing(np.arange(k), *A.solved, *B.solved, a, b, T, C, np.arange(k), coarse, gate)
    expected = np.zeros((k, k), dtype=bool)
    for n in range(k):
        for m in range(k):
            T_ca, C_ca = A.between("abcd"[a[m]], "abcd"[a[n]])
            T_bd, C_bd = B.between("wxyz"[b[n]], "wxyz"[b[m]])
            T_cb, C_cb = se2.compose(T_ca, T[n]), se2.compose_covariance(T_ca, C_ca, T[n], C[n])
            off = T[m] - se2.compose(T_cb, T_bd)
            off[2] = se2.wrap(off[2])
            whole = se2.compose_covariance(T_cb, C_cb, T_bd, C_bd) + C[m]
            expected[n, m] = n != m and off @ np.linalg.solve(whole, off) < gate
    assert 0.2 < expected.mean() < 0.8
    np.testing.assert_array_equal(found, expected)


def test_cycles_are_worth_their_weaker_leg_where_they_close():
    rng = np.random.default_rng(9)
    T_pq = np.array([3.0, -2.0, 0.4])
    T_pr = np.column_stack([rng.uniform(-20, 20, (3, 2)), rng.uniform(-3, 3, 3)])
    closing = se2.compose(se2.inverse(T_pr[1]), T_pq + np.array([0.1, 0.1, 0.01]))
    T_rq = np.array([se2.compose(closing, [50.0, 0.0, 0.0]), closing])
    weaker = group_kernels().weaker_leg
    assert weaker(T_pq, T_pr, T_rq, np.array([9.0, 5.0, 9.0]), np.array([9.0, 7.0]), 3.0, 0.2) == 5.0
    assert weaker(T_pq, T_pr, T_rq[:1], np.array([9.0, 5.0, 9.0]), np.array([9.0]), 3.0, 0.2) == -np.inf


def two_groups(world, across, **told):
    """A and B, C and D surely together, and candidates across of ``across`` nats by pair, all of the right place."""
    inside = [comparison(a, b, candidate(true_T(world, a, b), 40.0, ((0, 0), (1, 1)))) for a, b in ("AB", "CD")]
    found = []
    for (a, b), (matches, emptiness) in across.items():
        T12 = Transform.from_array(true_T(world, a, b), np.diag(SIGMA**2))
        one = Candidate(T12, ((5, 5),), Terms(matches=matches, misses=emptiness), **told)
        alone = comparison(a, b, one)
        found.append(replace(alone, decision="ambiguous") if told else alone)
    return choose("ABCD", by_pair(*inside, *found), CONFIG).groups


def test_what_agreeing_pairs_missed_speaks_against_a_placement_that_one_pair_shows(world):
    quiet = {"AC": (6.0, 0.0), "AD": (-1.0, 0.0), "BC": (-1.0, 0.0), "BD": (-1.0, 0.0)}
    assert two_groups(world, quiet) == (("A", "B", "C", "D"),)
    # three pairs agree that lack 8 nats of what they passed; two maps of either group take part: 12 nats against 6
    missed = {"AC": (6.0, 0.0), "AD": (-1.0, -8.0), "BC": (-1.0, -8.0), "BD": (-1.0, -8.0)}
    assert two_groups(world, missed) == (("A", "B"), ("C", "D"))
    # that all agree on much emptiness is no evidence by itself
    faint = dict.fromkeys(quiet, (-9.0, 8.0)) | {"AC": (2.0, 0.0)}
    assert two_groups(world, faint) == (("A", "B"), ("C", "D"))


def test_another_floor_of_one_plan_is_weighed_for_groups_as_for_pairs(world):
    strong = dict.fromkeys(("AC", "AD", "BC", "BD"), (30.0, 0.0))
    assert two_groups(world, strong, alike=-6.0) == (("A", "B", "C", "D"),)
    # a million times as probable on another floor, of which there is one in a thousand
    assert two_groups(world, strong, alike=float(np.log(1e6))) == (("A", "B"), ("C", "D"))
