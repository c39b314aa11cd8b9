"""Makers of files that no writer of ours makes: bags of ROS 2 and GraphNav maps."""

import math

import numpy as np
import pytest

TUBES = np.array([[3.0, 1.0], [6.0, -1.0], [9.0, 1.5]])


def bag(path, kind="PoseArray", frame="base_link", storage="MCAP", topic="/seen", second=False, packed=False):
    """A robot drives 12 m along x and sees three things within 2.5 m."""
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    T = store.types

    def header(t, name):
        stamp = T["builtin_interfaces/msg/Time"](sec=int(t), nanosec=round(t % 1 * 1e9))
        return T["std_msgs/msg/Header"](stamp=stamp, frame_id=name)

    def pose(x, y):
        Pose, Point, Quaternion = (T[f"geometry_msgs/msg/{name}"] for name in ("Pose", "Point", "Quaternion"))
        return Pose(position=Point(x, y, 0.0), orientation=Quaternion(0.0, 0.0, 0.0, 1.0))

    def marker(t, k, x, y):
        blank = {"sec": 0, "nanosec": 0}
        V, Colour = T["geometry_msgs/msg/Vector3"], T["std_msgs/msg/ColorRGBA"]
        Marker = T["visualization_msgs/msg/Marker"]
        values = {
            "header": header(t, frame),
            "ns": "tube",
            "id": k + 1,
            "type": 0,
            "action": 0,
            "pose": pose(x, y),
            "scale": V(0.0, 0.0, 0.0),
            "color": Colour(0.0, 0.0, 0.0, 0.0),
            "lifetime": T["builtin_interfaces/msg/Duration"](**blank),
            "frame_locked": False,
            "points": [],
            "colors": [],
            "texture_resource": "",
            "texture": T["sensor_msgs/msg/CompressedImage"](header(t, ""), "", np.zeros(0, np.uint8)),
            "uv_coordinates": [],
            "text": "",
            "mesh_resource": "",
            "mesh_file": T["visualization_msgs/msg/MeshFile"]("", np.zeros(0, np.uint8)),
            "mesh_use_embedded_materials": False,
        }
        return Marker(**values)

    zero = T["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    twist = T["geometry_msgs/msg/TwistWithCovariance"](T["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36))
    name = {"PoseArray": "geometry_msgs/msg/PoseArray", "MarkerArray": "visualization_msgs/msg/MarkerArray"}[kind]
    writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage])
    if packed:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        moves = writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=store)
        looks = writer.add_connection(topic, name, typestore=store)
        if second:
            writer.add_connection("/other", name, typestore=store)
        for k in range(61):
            t, x = 100 + k / 2, 0.2 * k
            with_covariance = T["geometry_msgs/msg/PoseWithCovariance"](pose(x, 0.0), np.zeros(36))
            message = T["nav_msgs/msg/Odometry"](header(t, "odom"), "base_link", with_covariance, twist)
            writer.write(moves, int(t * 1e9), store.serialize_cdr(message, "nav_msgs/msg/Odometry"))
            shift = 0.0 if frame == "odom" else x
            seen = [(n, px - shift, py) for n, (px, py) in enumerate(TUBES) if math.hypot(px - x, py) < 2.5]
            if kind == "PoseArray":
                message = T[name](header(t, frame), [pose(px, py) for _, px, py in seen])
            else:
                message = T[name]([marker(t, n, px, py) for n, px, py in seen])
            writer.write(looks, int(t * 1e9), store.serialize_cdr(message, name))
    return path


def graphnav(folder, anchored=True, stray=False):
    map_pb2 = pytest.importorskip("bosdyn.api.graph_nav.map_pb2")
    graph = map_pb2.Graph()
    for name in ("w0", "w1", "w2"):
        graph.waypoints.add(id=name).annotations.name = f"place {name}"
    # each edge goes 2 m ahead and turns left by a quarter
    for a, b in (("w0", "w1"), *(() if stray else (("w1", "w2"),))):
        edge = graph.edges.add()
        edge.id.from_waypoint, edge.id.to_waypoint = a, b
        edge.from_tform_to.position.x = 2.0
        edge.from_tform_to.rotation.z = edge.from_tform_to.rotation.w = math.sqrt(0.5)
    if anchored:
        for k, name in enumerate(("w0", "w1", "w2")):
            anchor = graph.anchoring.anchors.add(id=name)
            anchor.seed_tform_waypoint.position.x = 10.0 + k
            anchor.seed_tform_waypoint.rotation.w = 1.0
        found = graph.anchoring.objects.add(id="523")
        found.seed_tform_object.position.y = -3.0
    (folder / "waypoint_snapshots").mkdir(parents=True)
    (folder / "graph").write_bytes(graph.SerializeToString())
    return folder


@pytest.fixture(name="bag")
def bag_maker():
    """Makes a bag; see `bag`."""
    return bag


@pytest.fixture(name="graphnav")
def graphnav_maker():
    """Makes a GraphNav map; see `graphnav`."""
    return graphnav
