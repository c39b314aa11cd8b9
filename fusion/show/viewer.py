"""`Layer`s in a window of Open3D's, and as a file of triangles; needs the extra ``mapfuse[open3d]``."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.files import write_whole

from .solids import Body, Layer, together

#: Steps of the animation that lays map 2 on map 1.
STEPS = 60
#: From where the window looks at first: from the south, halfway up; and how near.
FRONT, ZOOM = (0.0, -0.75, 0.66), 0.6


def open3d() -> Any:
    """The library, loaded when it is needed: that takes seconds.

    Raises MapfuseError where it isn't installed, or lacks what it needs itself.
    """
    try:
        library = import_module("open3d")
    except ImportError as error:
        raise MapfuseError(
            f"the 3-D view needs Open3D, which can't be loaded ({error}): install mapfuse[open3d]"
        ) from error
    except OSError as error:  # a shared library that Open3D loads
        raise MapfuseError(
            f"Open3D can't be loaded: {error}; on Debian it needs the packages libusb-1.0-0, libgl1 and libgomp1"
        ) from error
    return library


def mesh_of(body: Body) -> Any:
    """A body as Open3D's triangle mesh, with normals; needs no display."""
    o3d = open3d()
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(np.array(body.vertices)),
        o3d.utility.Vector3iVector(np.array(body.triangles, dtype=np.int32)),
    )
    mesh.vertex_colors = o3d.utility.Vector3dVector(np.array(body.colours))
    mesh.compute_vertex_normals()
    return mesh


def write_ply(layers: Sequence[Layer], path: str | Path) -> None:
    """All layers where they finally lie, as one mesh in a PLY file, whole or not at all.

    Raises MapfuseError where Open3D can't be loaded, `OutputError` where the file can't be written.
    """
    o3d = open3d()
    mesh = mesh_of(together(layer.at(1.0) for layer in layers))
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "mesh.ply"
        if not o3d.io.write_triangle_mesh(str(target), mesh):
            raise MapfuseError(f"{path}: Open3D could not write the mesh")
        write_whole(path, target.read_bytes())


def check_display() -> None:
    """Raise MapfuseError where there is no display to open a window on."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise MapfuseError(
            "this machine has no display, so no window can be opened; --3d -o OUT.ply writes a file for other viewers"
        )


def view(layers: Sequence[Layer], title: str) -> None:
    """Opens a window with the layers, and returns when it is closed. The space bar lays the maps on each other again.

    Raises MapfuseError where there is no display, or Open3D can't be loaded.
    """
    check_display()
    o3d = open3d()
    window = o3d.visualization.VisualizerWithKeyCallback()
    if not window.create_window(title, 1280, 860):
        raise MapfuseError("no window can be opened on this display; --3d -o OUT.ply writes a file for other viewers")
    meshes = [mesh_of(layer.at(1.0)) for layer in layers]
    for mesh in meshes:
        window.add_geometry(mesh)
    control = window.get_view_control()  # from above, all layers would lie on each other
    control.set_front(FRONT)
    control.set_up((0.0, 0.0, 1.0))
    control.set_zoom(ZOOM)
    window.register_key_callback(32, lambda shown: _animate(o3d, shown, layers, meshes))
    window.run()
    window.destroy_window()


def _animate(o3d: Any, window: Any, layers: Sequence[Layer], meshes: Sequence[Any]) -> bool:
    """Every map on its way from beside the others to its place, slowly at both ends."""
    for share in (1 - np.cos(np.linspace(0.0, np.pi, STEPS))) / 2:
        for layer, mesh in zip(layers, meshes, strict=True):
            mesh.vertices = o3d.utility.Vector3dVector(np.array(layer.at(float(share)).vertices))
            window.update_geometry(mesh)
        if not window.poll_events():
            break
        window.update_renderer()
    return False
