"""Covariance as a query: against GTSAM's marginals, a dense inverse, and inverses worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.errors import UndeterminedError
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.datasets.simulation import simulated_pair
from mapfuse.factors import (
    FrameAnchor,
    FrameKey,
    Gauge,
    LandmarkKey,
    LinkMeasurement,
    pair_problem,
    single_map_problem,
)
from mapfuse.factors.axes import cross_to_axes, pose_to_axes
from mapfuse.fusion import covariance
from mapfuse.fusion.config import SolvingConfig
from mapfuse.fusion.covariance import Linearised, Marginals, SingularError
from mapfuse.fusion.solve import solve


@pytest.fixture(params=["dense", "sparse"])
def either(request, monkeypatch):
    """Both ways of inverting, whatever the size."""
    monkeypatch.setattr(covariance, "DENSE_UNKNOWNS", {"dense": 10**6, "sparse": 0}[request.param])
    return request.param


def grid(n, seed=0, name="m", shuffle=None):
    """n x n corners on streets 10 m apart, every street travelled, measured with errors."""
    rng = np.random.default_rng(seed)
    landmarks = []
    for row in range(n):
        for column in range(n):
            links = []
            for turn, (dx, dy) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
                inside = 0 <= column + dx < n and 0 <= row + dy < n
                heading = float(se2.wrap(turn * np.pi / 2 + rng.normal(0, 0.01)))
                to = f"c{row + dy:03}-{column + dx:03}" if inside else None
                distance = 10 + rng.normal(0, 0.1) if inside else None
                links.append(Link("open" if inside else "blocked", heading, None, to, distance, int(inside)))
            x, y = 10 * column + rng.normal(0, 0.3), 10 * row + rng.normal(0, 0.3)
            landmarks.append(Landmark(f"c{row:03}-{column:03}", "corner", x, y, links=tuple(links)))
    if shuffle is not None:
        landmarks = [landmarks[k] for k in np.random.default_rng(shuffle).permutation(len(landmarks))]
    return LandmarkMap(name, tuple(landmarks))


def of_gtsam(solution, unknowns):
    """Covariances by GTSAM's own marginals, the gauge's frame held as tightly as GTSAM's elimination bears."""
    graph, values = solution.problem.graph(), solution.problem.values(solution.poses)
    marginals = gtsam.Marginals(graph, values)
    keys = [solution.problem.keys.key(u) for u in unknowns]
    thetas = np.array([solution.poses[u][2] for u in unknowns])
    return pose_to_axes(thetas, np.array([marginals.marginalCovariance(key) for key in keys])), marginals


def with_gauge(solution):
    """What `Marginals` says where the gauge's own uncertainty counts, as it does for GTSAM."""
    held = solution.linearised
    free = np.ones_like(held.free)
    return Marginals(replace(held, free=free))


@pytest.mark.parametrize("compass", [False, True])
def test_blocks_equal_the_marginals_of_gtsam(either, compass):
    map1, map2, truth = simulated_pair(3, compass=compass)
    matches = list(truth.true_pairs("A", "B"))
    solution = solve(pair_problem(map1, map2, truth.T12("A", "B"), matches, robust=False), SolvingConfig())
    unknowns = solution.problem.keys.in_order
    expected, marginals = of_gtsam(solution, unknowns)
    ours = with_gauge(solution)
    found = ours.blocks(np.arange(len(unknowns)))
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)
    # blocks off the diagonal: of matched landmarks, which a measurement ties, and of landmarks that nothing ties
    place = {u: k for k, u in enumerate(unknowns)}
    pairs = [(LandmarkKey(0, a), LandmarkKey(1, b)) for a, b in [*matches[:4], (map1.ids[0], map2.ids[-1])]]
    cross = ours.blocks([place[a] for a, _ in pairs], [place[b] for _, b in pairs])
    for (a, b), block in zip(pairs, cross, strict=True):
        keys = [solution.problem.keys.key(u) for u in (a, b)]
        joint = marginals.jointMarginalCovariance(keys).at(*keys)
        expected = cross_to_axes(solution.poses[a][2], solution.poses[b][2], joint)
        np.testing.assert_allclose(block, expected, rtol=1e-8, atol=1e-8)


def test_both_ways_agree_on_blocks_and_joint_covariances(monkeypatch):
    solution = solve(single_map_problem(grid(7)), SolvingConfig())
    monkeypatch.setattr(covariance, "DENSE_UNKNOWNS", 10**6)
    dense = Marginals(solution.linearised)
    monkeypatch.setattr(covariance, "DENSE_UNKNOWNS", 0)
    sparse = Marginals(solution.linearised)
    n = len(solution.linearised.free)
    rng = np.random.default_rng(1)
    a, b = rng.integers(0, n, 300), rng.integers(0, n, 300)
    np.testing.assert_allclose(sparse.blocks(a, b), dense.blocks(a, b), rtol=1e-8, atol=1e-10)
    for some in ([4], [0, 7, 3], rng.permutation(n), [], [0]):
        places = np.array(some, dtype=int)
        np.testing.assert_allclose(sparse.joint(places), dense.joint(places), rtol=1e-8, atol=1e-10)
    # the frame that the gauge holds is known
    assert not sparse.blocks([0]).any()
    assert not sparse.joint([0, 5])[:3].any()


def test_a_chain_of_priors_and_steps_by_hand(either):
    # x0 ~ N(0, p I), x_k+1 = x_k + N(0, q I): cov(x_i, x_j) = (p + q min(i, j)) I. Written as the Jacobian itself:
    # rows x0 / sqrt p and (x_k+1 - x_k) / sqrt q, for x, y and theta alike.
    p, q, n = 0.5, 0.25, 6
    rows, columns, values = [], [], []
    for axis in range(3):
        rows.append(axis), columns.append(axis), values.append(p**-0.5)
        for k in range(n - 1):
            row = 3 + 3 * k + axis
            rows += [row, row]
            columns += [3 * k + axis, 3 * k + 3 + axis]
            values += [-(q**-0.5), q**-0.5]
    order = np.random.default_rng(2).permutation(n)
    linear = Linearised(
        np.array(rows), np.array(columns), np.array(values), np.ones(n, dtype=bool), np.linspace(-3, 3, n), order
    )
    i, j = (part.ravel() for part in np.meshgrid(np.arange(n), np.arange(n)))
    # errors along a pose's own axes, turned into the frame's by R_i R_j'
    R = np.tile(np.eye(3), (n, 1, 1))
    R[:, :2, :2] = se2.rotation(linear.thetas)
    expected = (p + q * np.minimum(i, j))[:, None, None] * (R[i] @ np.swapaxes(R[j], 1, 2))
    marginals = Marginals(linear)
    np.testing.assert_allclose(marginals.blocks(i, j), expected, rtol=1e-12, atol=1e-12)
    whole = marginals.joint(np.arange(n)).reshape(n, 3, n, 3)
    np.testing.assert_allclose(whole[i, :, j, :], expected, rtol=1e-12, atol=1e-12)
    held = replace(linear, free=np.arange(n) != 2)
    # given x2, what follows starts there and what is before is a bridge: cov(x3) = q, cov(x2, anything) = 0
    np.testing.assert_allclose(
        Marginals(held).blocks([3, 5]), np.array([q, 3 * q])[:, None, None] * np.eye(3), atol=1e-12
    )
    assert not Marginals(held).blocks([2, 1], [1, 2]).any()


def test_the_same_whatever_the_order_of_landmarks(either):
    # to the last bit: keys follow ids, not the file
    one, other = (solve(single_map_problem(grid(4, shuffle=s)), SolvingConfig()) for s in (None, 5))
    keys = one.landmark_keys(0)
    np.testing.assert_array_equal(one.covariances(keys), other.covariances(keys))
    np.testing.assert_array_equal(one.joint_covariance(keys[:3]), other.joint_covariance(keys[:3]))


@pytest.mark.parametrize("count", [1, 20])
def test_what_may_move_at_no_cost_is_named(either, count):
    # islands whose anchors are gone float, and nothing else does
    chain = [
        Landmark(f"{name}{k}", "corner", 20.0 * k, y, links=(Link("open", np.pi / 2, None, to and f"{to}{k}", 8.0, 1),))
        for k in range(count + 30)
        for name, y, to in (("a", 0.0, "b"), ("b", 8.0, None))
    ]
    problem = single_map_problem(LandmarkMap("m", tuple(chain)))
    loose = {LandmarkKey(0, f"a{k}") for k in range(count)}
    kept = [m for m in problem.measurements if not (isinstance(m, FrameAnchor) and m.b in loose)]
    assert len(kept) == len(problem.measurements) - count
    with pytest.raises(UndeterminedError) as caught:
        solve(problem.with_measurements(kept), SolvingConfig()).covariance(FrameKey(0))
    assert set(caught.value.landmarks) == {("m", f"{name}{k}") for name in "ab" for k in range(count)}


def test_a_floating_graph_and_a_pose_that_nothing_mentions_are_singular(either):
    linearised = solve(single_map_problem(grid(3)), SolvingConfig()).linearised
    silent = linearised.values * (linearised.columns // 3 != 4)
    unmentioned = replace(linearised, values=silent, information=None)
    with pytest.raises(SingularError) as caught:
        Marginals(unmentioned)
    assert caught.value.loose.tolist() == [4]
    problem = single_map_problem(grid(3))
    floating = problem.with_measurements(m for m in problem.measurements if not isinstance(m, Gauge | FrameAnchor))
    with pytest.raises(UndeterminedError) as named:
        solve(floating, SolvingConfig()).covariance(FrameKey(0))
    assert len(named.value.landmarks) == 9


def test_a_thousand_landmarks_have_covariances_that_add_up():
    # every block of one pass against the columns of the inverse for some of them
    solution = solve(single_map_problem(grid(33)), SolvingConfig())
    keys = solution.landmark_keys(0)
    blocks = solution.covariances(keys)
    assert np.linalg.eigvalsh(blocks).min() > 0
    some = [0, 500, 1000]
    joint = solution.joint_covariance([keys[k] for k in some])
    for k, place in enumerate(some):
        own = joint[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        np.testing.assert_allclose(own, blocks[place], rtol=1e-8, atol=1e-12)
    links = solution.problem.of_kind(LinkMeasurement)[::500]
    cross = solution.covariances([m.a for m in links], [m.b for m in links])
    for m, block in zip(links, cross, strict=True):
        np.testing.assert_allclose(solution.joint_covariance([m.a, m.b])[:3, 3:], block, rtol=1e-8, atol=1e-12)
