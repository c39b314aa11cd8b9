"""What must not matter: coordinates, ids, order of landmarks and links, order of maps, and the run itself."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from mapfuse.datasets import se2, write_map
from mapfuse.datasets.maps import JointCovariance
from mapfuse.datasets.simulation import simulated_pair
from mapfuse.fusion import fuse, write_fused

CASES = ("irregular with compass", "oblique", "points", "different floors")


def points_only(recorded):
    """The map's landmarks without their arms and links."""
    return recorded.replace(landmarks=tuple(replace(l, links=()) for l in recorded.landmarks), path=None)


def example(case):
    if case == "points":
        return [points_only(m) for m in simulated_pair(8)[:2]]
    if case == "different floors":
        return list(simulated_pair(9, same=False)[:2])
    kind = "oblique" if case == "oblique" else "irregular"
    return list(simulated_pair({"oblique": 5}.get(case, 3), kind, compass="compass" in case)[:2])


@pytest.fixture(scope="module", params=CASES)
def case(request):
    """The maps and what their fusion answers."""
    maps = example(request.param)
    return maps, fuse(maps)


def axes_turned(C, theta):
    B = np.eye(len(C))
    B[:2, :2] = se2.rotation(theta)
    return B @ C @ B.T


def moved(recorded, G):
    """The map in coordinates whose origin lies at ``G`` (3,) of the old ones' place: p -> G p."""
    G = np.asarray(G, dtype=float)

    def turned(angle):
        return None if angle is None else float(se2.wrap(angle + G[2]))

    landmarks = []
    for l in recorded.landmarks:
        x, y = se2.transform(G, [l.x, l.y]).tolist()
        links = tuple(replace(link, heading=turned(link.heading)) for link in l.links)
        C = None if l.covariance is None else axes_turned(l.covariance, G[2])
        landmarks.append(replace(l, x=x, y=y, heading=turned(l.heading), links=links, covariance=C))
    path = recorded.path
    if path is not None:
        path = np.column_stack([path[:, :1], se2.compose(G, path[:, 1:])])
    elif any(l.links for l in recorded.landmarks):
        path = np.array([[0.0, *G]])  # where the robot started isn't the origin any more
    joint = recorded.joint_covariance
    if joint is not None:
        B = np.kron(np.eye(len(joint.order)), np.eye(joint.rows))
        for k in range(len(joint.order)):
            B[joint.rows * k : joint.rows * k + 2, joint.rows * k : joint.rows * k + 2] = se2.rotation(G[2])
        joint = JointCovariance(joint.order, joint.rows, B @ joint.matrix @ B.T)
    walls = tuple(se2.transform(G, wall) for wall in recorded.walls)
    return recorded.replace(landmarks=tuple(landmarks), path=path, walls=walls, joint_covariance=joint)


def by_sources(fused):
    """Landmarks by what they are made of."""
    return {tuple(sorted((name, ids) for name, ids in l.sources.items())): l for l in fused.landmarks}


def assert_same(found, expected, G=(0.0, 0.0, 0.0), H=(0.0, 0.0, 0.0), *, nats=1e-6):
    """Equal answers, where map 1 was moved by ``G`` and map 2 by ``H``; ``nats``: what log evidence may differ by."""
    G, H = np.asarray(G, dtype=float), np.asarray(H, dtype=float)
    pair, other = found.pairs[0], expected.pairs[0]
    assert found.decision == expected.decision
    # where nothing fits, hundreds of single pairs fit alike, and which of them are looked at is no answer
    tolerance = 1e-3 if found.decision == "no_overlap" else 1e-5
    assert pair.probability == pytest.approx(other.probability, abs=tolerance)
    assert pair.no_overlap_probability == pytest.approx(other.no_overlap_probability, abs=tolerance)
    if found.decision != "no_overlap":
        assert pair.correspondences == other.correspondences
        assert pair.hypotheses[0].log_evidence == pytest.approx(other.hypotheses[0].log_evidence, abs=nats)
        A = se2.compose(G, other.T12.array)
        np.testing.assert_allclose(se2.between(se2.compose(A, se2.inverse(H)), pair.T12.array), 0, atol=1e-5)
        J = se2.compose_jacobians(A, se2.inverse(H))[0]
        C = J @ axes_turned(other.T12.covariance, G[2]) @ J.T
        np.testing.assert_allclose(pair.T12.covariance, C, rtol=1e-5, atol=1e-7 * np.abs(C).max())
    ours, theirs = by_sources(found), by_sources(expected)
    assert ours.keys() == theirs.keys()
    for sources, landmark in ours.items():
        was = theirs[sources]
        # the merged map stands in map 1's frame; of two that aren't merged, each in its own
        F = H if {name for name, _ in sources} == {found.maps[1]} and found.decision != "merged" else G
        np.testing.assert_allclose((landmark.x, landmark.y), se2.transform(F, (was.x, was.y)), atol=1e-5)
        C = axes_turned(was.covariance, F[2])
        np.testing.assert_allclose(landmark.covariance, C, rtol=1e-4, atol=1e-6 * np.abs(C).max())
        assert landmark.existence == pytest.approx(was.existence, abs=1e-4)
        # not the heading: of arms that are alike the first in the map's frame stands for the landmark
        assert (landmark.heading is None) == (was.heading is None)
        arms, were = (np.array([link.heading for link in l.links]) for l in (landmark, was))
        assert len(arms) == len(were)
        if len(arms):
            off = np.abs(se2.wrap(arms[:, None] - were - F[2]))
            assert max(off.min(axis=0).max(), off.min(axis=1).max()) < 1e-5


def test_the_coordinates_that_maps_are_written_in(case):
    G, H = (500.0, -300.0, 0.5), (200.0, 700.0, 3.0)
    maps, expected = case
    found = fuse([moved(maps[0], G), moved(maps[1], H)])
    # areas are measured on grids along the axes, and T12's prior is flat around the origin, but not quite
    assert_same(found, expected, G, H, nats=0.1)


def test_ids_and_the_order_of_landmarks_and_links(case):
    maps, expected = case
    rng = np.random.default_rng(5)
    renamed, old_of = [], {}
    for m in maps:
        new = {id_: f"{m.name}-{k:03d}" for k, id_ in enumerate(rng.permutation(m.ids).tolist())}
        old_of[m.name] = {b: a for a, b in new.items()}
        landmarks = []
        for l in m.landmarks:
            links = [replace(link, connected_to_id=new.get(link.connected_to_id)) for link in l.links]
            links = tuple(links[k] for k in rng.permutation(len(links)))
            landmarks.append(replace(l, id=new[l.id], links=links))
        renamed.append(m.replace(landmarks=tuple(landmarks[k] for k in rng.permutation(len(landmarks)))))
    found = fuse(renamed)
    pair = found.pairs[0]
    back = tuple(sorted((old_of[maps[0].name][a], old_of[maps[1].name][b]) for a, b in pair.correspondences))
    landmarks = tuple(
        replace(l, sources={name: tuple(sorted(old_of[name][i] for i in ids)) for name, ids in l.sources.items()})
        for l in found.landmarks
    )
    found = replace(found, pairs=(replace(pair, correspondences=back),), landmarks=landmarks)
    assert_same(found, expected, nats=0.02)


def test_the_order_of_the_maps(case):
    maps, expected = case
    found = fuse(maps[::-1])
    pair, other = found.pairs[0], expected.pairs[0]
    assert pair.maps == other.maps[::-1]
    assert (found.decision, pair.probability, pair.no_overlap_probability) == (
        expected.decision,
        other.probability,
        other.no_overlap_probability,
    )
    assert pair.correspondences == tuple(sorted((b, a) for a, b in other.correspondences))
    assert [h.log_evidence for h in pair.hypotheses] == [h.log_evidence for h in other.hypotheses]
    # T21 is the inverse, its covariance J C J' with J = -[[R', R' (t_y, -t_x)'], [0, 1]]
    T = other.T12
    J = -np.eye(3)
    J[:2, :2] = -se2.rotation(-T.theta)
    J[:2, 2] = -se2.rotation(-T.theta) @ (T.y, -T.x)
    np.testing.assert_allclose(se2.compose(pair.T12.array, T.array), 0, atol=1e-9)
    np.testing.assert_allclose(pair.T12.covariance, J @ T.covariance @ J.T, rtol=1e-9, atol=1e-12)
    ours, theirs = by_sources(found), by_sources(expected)
    assert ours.keys() == theirs.keys()
    for sources, landmark in ours.items():
        was = theirs[sources]
        here = se2.transform(pair.T12.array, (was.x, was.y)) if found.decision == "merged" else (was.x, was.y)
        np.testing.assert_allclose((landmark.x, landmark.y), here, atol=1e-4)
        assert landmark.existence == pytest.approx(was.existence, abs=1e-9)
    if found.decision == "merged":
        # a landmark's covariance is seen from another frame now; that of distances doesn't depend on the frame
        for first, second in itertools.pairwise(ours):
            assert distance_variance(found, ours[first], ours[second]) == pytest.approx(
                distance_variance(expected, theirs[first], theirs[second]), rel=1e-3, abs=1e-6
            )


def distance_variance(fused, a, b):
    joint = fused.joint_covariances[0]
    at = [joint.rows * joint.order.index(l.id) + row for l in (a, b) for row in (0, 1)]
    C = joint.matrix[np.ix_(at, at)]
    step = np.array([b.x - a.x, b.y - a.y])
    if np.hypot(*step) < 1.0:
        return 0.0  # the distance of neighbours isn't linear in their errors
    u = step / np.hypot(*step)
    g = np.concatenate([-u, u])
    return float(g @ C @ g)


def test_a_joint_covariance_moves_with_its_map():
    one, two = example("oblique")
    both = fuse([one, two]).to_map(name="both")
    third = one.replace(name="third")
    G, H = (300.0, -200.0, 2.5), (-40.0, 10.0, 1.0)
    assert_same(fuse([moved(both, G), moved(third, H)]), fuse([both, third]), G, H, nats=0.1)


def test_the_same_input_gives_the_same_bytes(case, tmp_path):
    maps, expected = case
    write_fused(expected, tmp_path / "first.fused.json")
    write_fused(fuse(maps), tmp_path / "again.fused.json")
    assert (tmp_path / "first.fused.json").read_bytes() == (tmp_path / "again.fused.json").read_bytes()


def test_another_process_with_other_hashes_gives_the_same_bytes(tmp_path):
    maps = example("irregular with compass")
    for m in maps:
        write_map(m, tmp_path / f"{m.name}.map.json")
    program = (
        "import sys\n"
        "from mapfuse.datasets import read_map\n"
        "from mapfuse.fusion import fuse, write_fused\n"
        "write_fused(fuse([read_map(path) for path in sys.argv[2:]]), sys.argv[1])\n"
    )
    written = []
    for seed in ("1", "77"):
        out = tmp_path / f"{seed}.fused.json"
        paths = [str(tmp_path / f"{m.name}.map.json") for m in maps]
        subprocess.run(
            [sys.executable, "-c", program, str(out), *paths], check=True, env={**os.environ, "PYTHONHASHSEED": seed}
        )
        written.append(out.read_bytes())
    assert written[0] == written[1]
