"""Other people's programs read what mapfuse writes.

GDAL (by pyogrio, which GeoPandas reads with) for GeoJSON, evo for TUM, GTSAM for g2o, plyfile for PLY; GeoPandas itself
and Open3D (extra ``open3d``), which is a gigabyte, where they are installed.
"""

import numpy as np
import pytest

from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.formats import write_any
from mapfuse.datasets.formats.gis import CHI2_95, ellipse
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link

PATH = np.array([[0.0, 0.0, 0.0, 0.0], [0.5, 1.0, 0.0, 0.3], [2.0, 2.0, 1.0, -3.0]])
MAP = LandmarkMap(
    "D7",
    (
        Landmark(
            "c1", "corner", 1.0, 2.0, links=(Link("open", 0.0, connected_to_id="d1"),), covariance=np.diag([4, 1])
        ),
        Landmark("d1", "door", 5.0, 2.5, existence=0.9),
        Landmark("Baum ß", "tree", -3.0, 0.25),
    ),
    walls=(np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]]),),
    path=PATH,
)


def test_gdal_reads_gis_geojson_in_metres_of_a_robots_map(tmp_path):
    pyogrio = pytest.importorskip("pyogrio")
    path = tmp_path / "D7.gis.geojson"
    write_any(MAP, path)
    about = pyogrio.read_info(path)
    # without a word on it GDAL would take metres for degrees
    assert about["crs"].startswith('LOCAL_CS["robot map"')
    assert 'UNIT["metre",1]' in about["crs"]
    assert about["features"] == 3 + 1 + 1 + 1 + 1  # landmarks, ellipse, way, wall, path
    meta, _, geometry, columns = pyogrio.raw.read(path)
    told = dict(zip(meta["fields"], columns, strict=True))
    kinds = told["kind"].tolist()
    assert kinds == ["landmark"] * 3 + ["ellipse", "way", "wall", "path"]
    assert told["id"].tolist()[:4] == ["c1", "d1", "Baum ß", "c1"]
    assert told["existence"][1] == 0.9
    assert np.frombuffer(geometry[0], dtype="<f8", offset=5).tolist() == [1.0, 2.0]  # a point of well-known binary


def test_gdal_reads_nav2_geojson(tmp_path):
    pyogrio = pytest.importorskip("pyogrio")
    write_any(MAP, tmp_path / "D7.geojson")
    meta, _, _, columns = pyogrio.raw.read(tmp_path / "D7.geojson")
    told = dict(zip(meta["fields"], columns, strict=True))
    assert told["id"].tolist() == [0, 1, 2, 3, 4]
    assert told["startid"][3:].tolist() == [0, 1]


def test_an_ellipse_holds_95_percent():
    rng = np.random.default_rng(4)
    covariance = np.array([[2.0, 1.2], [1.2, 1.0]])
    ring = ellipse(np.array([3.0, -1.0]), covariance)
    distances = np.einsum("ki,ij,kj->k", ring - [3, -1], np.linalg.inv(covariance), ring - [3, -1])
    np.testing.assert_allclose(distances, CHI2_95)
    area = 0.5 * np.sum(ring[:-1, 0] * ring[1:, 1] - ring[1:, 0] * ring[:-1, 1])
    assert area > 0  # counter-clockwise, as RFC 7946 has it
    drawn = rng.multivariate_normal([0, 0], covariance, 100_000)
    inside = np.einsum("ki,ij,kj->k", drawn, np.linalg.inv(covariance), drawn) < CHI2_95
    assert abs(inside.mean() - 0.95) < 0.003


def test_evo_reads_tum(tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    _, lost = write_any(MAP, tmp_path / "D7.tum")
    trajectory = file_interface.read_tum_trajectory_file(str(tmp_path / "D7.tum"))
    assert trajectory.check()[0]
    np.testing.assert_array_equal(trajectory.timestamps, PATH[:, 0])
    np.testing.assert_array_equal(trajectory.positions_xyz, np.column_stack([PATH[:, 1:3], np.zeros(3)]))
    yaw = [np.arctan2(pose[1, 0], pose[0, 0]) for pose in trajectory.poses_se3]
    np.testing.assert_allclose(yaw, PATH[:, 3])
    assert "landmarks" in lost


def test_a_map_without_path_is_no_trajectory(tmp_path):
    with pytest.raises(MapfuseError, match="has no path, and TUM holds nothing else"):
        write_any(MAP.replace(path=None), tmp_path / "D7.tum")
    assert not (tmp_path / "D7.tum").exists()


def test_gtsam_reads_the_poses_of_a_g2o_graph(tmp_path):
    gtsam = pytest.importorskip("gtsam")
    write_any(MAP, tmp_path / "D7.g2o")
    _, values = gtsam.readG2o(str(tmp_path / "D7.g2o"), False)
    poses = [values.atPose2(k) for k in range(3)]
    np.testing.assert_allclose([[pose.x(), pose.y(), pose.theta()] for pose in poses], PATH[:, 1:])


def test_plyfile_reads_ply(tmp_path):
    plyfile = pytest.importorskip("plyfile")
    write_any(MAP, tmp_path / "D7.ply")
    read = plyfile.PlyData.read(str(tmp_path / "D7.ply"))
    vertices, edges = read["vertex"], read["edge"]
    assert vertices.count == 3 + 3 + 3
    np.testing.assert_array_equal(vertices["x"][:3], MAP.positions[:, 0])
    np.testing.assert_array_equal(vertices["y"][6:], PATH[:, 2])
    assert vertices["type"].tolist() == [0, 1, 2] + [-1] * 6
    assert [tuple(edge) for edge in edges.data] == [(3, 4), (4, 5), (6, 7), (7, 8)]
    assert "type 1 door" in read.comments


def test_open3d_reads_ply(tmp_path):
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    write_any(MAP, tmp_path / "D7.ply")
    points = np.asarray(open3d.io.read_point_cloud(str(tmp_path / "D7.ply")).points)
    np.testing.assert_allclose(points[:3], np.column_stack([MAP.positions, np.zeros(3)]))
    np.testing.assert_allclose(points[6:, :2], PATH[:, 1:3])


def test_geopandas_reads_gis_geojson(tmp_path):
    geopandas = pytest.importorskip("geopandas")
    write_any(MAP, tmp_path / "D7.gis.geojson")
    told = geopandas.read_file(tmp_path / "D7.gis.geojson")
    landmarks = told[told["kind"] == "landmark"]
    np.testing.assert_allclose(np.column_stack([landmarks.geometry.x, landmarks.geometry.y]), MAP.positions)
    # the 95 % ellipse of a landmark with standard deviations of 2 m and 1 m
    (area,) = told[told["kind"] == "ellipse"].geometry.area
    assert area == pytest.approx(np.pi * CHI2_95 * 2, rel=0.01)


def test_pandas_reads_the_lists(tmp_path):
    pandas = pytest.importorskip("pandas")
    write_any(MAP, tmp_path / "D7.csv")
    write_any(MAP, tmp_path / "D7.parquet")
    for table in (pandas.read_csv(tmp_path / "D7.csv"), pandas.read_parquet(tmp_path / "D7.parquet")):
        assert table["id"].tolist() == ["c1", "d1", "Baum ß"]
        assert table["x"].tolist() == [1.0, 5.0, -3.0]
        assert table["cov_xx"].isna().tolist() == [False, True, True]
