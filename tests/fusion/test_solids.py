"""Maps as bodies: closed, where they belong, coloured by who recorded what; files of them; no window is opened."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapfuse.datasets import read_map, recordings
from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.datasets.transform import Transform
from mapfuse.fusion.result import Frame, FusedLandmark, FusedMap, PairResult, RankedHypothesis
from mapfuse.fusion.show import viewer
from mapfuse.fusion.show.scene import scene_of_map
from mapfuse.fusion.show.solids import WALL_M, Body, between, body_of, layers_of_fused, layers_of_map, together
from mapfuse.fusion.show.style import CHI2_95

T12 = Transform(3.0, -1.0, 0.5, np.diag([0.01, 0.01, 1e-4]))


def map_of(*landmarks: Landmark, name: str = "D1", **more: Any) -> LandmarkMap:
    return LandmarkMap(name, landmarks, **more)


def fused_pair(decision: str = "merged") -> FusedMap:
    maps = {name: map_of(Landmark("a", "tree", 0.0, 0.0), Landmark("b", "tree", 5.0, 0.0), name=name) for name in "AB"}
    pair = PairResult(("A", "B"), decision, 0.99, 0.01, (RankedHypothesis(T12, 2, 9.0, 0.99),), (), "")
    merged = decision == "merged"
    landmarks = (FusedLandmark("m1", 0, "tree", 0.0, 0.0, None, np.eye(2), {"A": ("a",), "B": ("a",)}, 0.9),)
    home = Transform(0, 0, 0, np.zeros((3, 3)))
    frames = {"A": Frame(0, home), "B": Frame(0, T12) if merged else Frame(1, home)}
    groups = (("A", "B"),) if merged else (("A",), ("B",))
    return FusedMap(decision, 0.99, ("A", "B"), groups, frames, (pair,), landmarks, {}, maps)


def volume(body: Body) -> float:
    """By the divergence theorem; positive where all triangles look outwards."""
    a, b, c = (body.vertices[body.triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def test_an_ellipsoid_reaches_as_far_as_the_95_percent_ellipse() -> None:
    C = np.array([[4.0, 1.0], [1.0, 2.0]])
    with_ellipse = body_of(scene_of_map(map_of(Landmark("a", "tree", 1.0, 2.0, covariance=C))))
    without = body_of(scene_of_map(map_of(Landmark("a", "tree", 1.0, 2.0))))
    ring = with_ellipse.vertices[: len(with_ellipse.vertices) - len(without.vertices)]
    d2 = np.einsum("ki,ij,kj->k", ring[:, :2] - [1.0, 2.0], np.linalg.inv(C), ring[:, :2] - [1.0, 2.0])
    assert d2.max() == pytest.approx(CHI2_95)
    assert np.abs(ring[:, 2]).max() < 0.2


def test_walls_stand_upright_from_end_to_end() -> None:
    map_ = map_of(walls=(np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]]),))
    body = body_of(scene_of_map(map_))
    assert body.vertices[:, 2].min() == 0
    assert body.vertices[:, 2].max() == WALL_M
    assert body.vertices[:, :2].min(axis=0) == pytest.approx([0.0, -0.03])
    assert body.vertices[:, :2].max(axis=0) == pytest.approx([4.03, 3.0])


def test_triangles_look_outwards_and_name_vertices_that_are_there() -> None:
    links = (Link("open", 0.0, connected_to_id="b", distance=4.0),)
    body = body_of(
        scene_of_map(map_of(Landmark("a", "corner", 0.0, 0.0, links=links), Landmark("b", "door", 4.0, 0.0)))
    )
    assert volume(body) > 0
    assert body.triangles.min() == 0
    assert body.triangles.max() == len(body.vertices) - 1
    assert body.colours.shape == body.vertices.shape
    assert together(()).vertices.shape == (0, 3)


def test_layers_of_a_merged_pair_lie_above_each_other_where_the_result_has_them() -> None:
    first, second, merged = layers_of_fused(fused_pair())
    assert [layer.name for layer in (first, second, merged)] == ["A", "B", "merged map"]
    assert 0 == first.height < second.height < merged.height
    assert second.pose == pytest.approx(T12.array)
    moved = second.at(1.0).vertices
    expected = T12.apply(second.body.vertices[:, :2])
    assert moved[:, :2] == pytest.approx(expected)
    assert moved[:, 2] == pytest.approx(second.body.vertices[:, 2] + second.height)
    assert second.at(0.0).vertices[:, 0].min() > first.at(0.0).vertices[:, 0].max() - 1.0


def test_an_undecided_pair_shows_its_best_placement_and_no_merged_map() -> None:
    layers = layers_of_fused(fused_pair("ambiguous"))
    assert [layer.name for layer in layers] == ["A", "B"]
    assert layers[1].pose == pytest.approx(T12.array)


def test_the_way_to_a_pose_is_straight_and_turns_the_short_way() -> None:
    start, end = np.array([1.0, 2.0, 3.0]), np.array([3.0, 0.0, -3.0])
    assert between(start, end, 0.0) == pytest.approx(start)
    assert between(start, end, 1.0) == pytest.approx(end)
    turned = [between(start, end, share)[2] for share in (0.25, 0.75)]
    assert np.abs(turned).min() > 3.0


# With Open3D ---------------------------------------------------------------------------------------------------------


def needs_open3d() -> None:
    try:
        import open3d  # noqa: F401
    except (ImportError, OSError) as error:
        if os.environ.get("CI") == "true":
            pytest.fail(f"Open3D can't be loaded, though the set-up installs it: {error}")
        pytest.skip(f"Open3D isn't here: {error}")


def test_a_ply_file_holds_all_triangles_and_is_read_back(tmp_path: Path) -> None:
    needs_open3d()
    layers = layers_of_map(read_map(recordings.path(recordings.SCENES["ground-floor"][0])))
    target = tmp_path / "floor.ply"
    viewer.write_ply(layers, target)
    assert target.read_bytes().startswith(b"ply\n")
    mesh = viewer.open3d().io.read_triangle_mesh(str(target))
    body = layers[0].at(1.0)
    assert np.asarray(mesh.vertices) == pytest.approx(body.vertices)
    assert Counter(map(tuple, np.asarray(mesh.triangles).tolist())) == Counter(map(tuple, body.triangles.tolist()))
    assert np.asarray(mesh.vertex_colors) == pytest.approx(body.colours, abs=1 / 255)
    assert [file.name for file in tmp_path.iterdir()] == ["floor.ply"]


def test_a_mesh_s_normals_look_out_of_it() -> None:
    needs_open3d()
    mesh = viewer.mesh_of(body_of(scene_of_map(map_of(Landmark("a", "tree", 0.0, 0.0)))))
    tops = np.asarray(mesh.triangle_normals)[-16:]
    assert (tops[:, 2] > 0.9).all()


def test_without_open3d_it_is_said_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def without(name: str) -> Any:
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(viewer, "import_module", without)
    with pytest.raises(MapfuseError, match=r"needs Open3D.*install mapfuse\[open3d\]"):
        viewer.open3d()


def test_a_missing_library_of_open3d_s_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(name: str) -> Any:
        raise OSError("libusb-1.0.so.0: cannot open shared object file")

    monkeypatch.setattr(viewer, "import_module", broken)
    with pytest.raises(MapfuseError, match=r"libusb-1\.0\.so\.0.*on Debian it needs the packages libusb"):
        viewer.open3d()


def test_a_machine_without_display_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(MapfuseError, match=r"no display.*--3d -o OUT\.ply"):
        viewer.view((), "title")
