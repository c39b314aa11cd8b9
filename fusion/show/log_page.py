"""What stands on the page of a log, and of several simulated drives through one building."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.logs import LogHeader, LogTruth
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.truth import Truth

from .backdrop import backdrop
from .fused_page import Page, counted
from .journey import Journey
from .layout import Panel
from .scene import scene_of_map
from .words import shortened

if TYPE_CHECKING:
    from mapfuse.datasets.simulation.building import Building

Array = NDArray[np.float64]

#: So many drives have a panel; a note says how many there are besides.
MAX_DRIVES = 6


@dataclass(frozen=True, eq=False, slots=True)
class Drive:
    """One robot's drive: its log as a journey, what was true, and the map made of it, where there is one."""

    name: str
    journey: Journey
    truth: LogTruth | None = None
    map: LandmarkMap | None = None


def log_page(header: LogHeader, drive: Drive, *, simulated: bool = False) -> Page:
    """The page of one log: paths and detections, and the map on top where there is one."""
    robot = f" by {header.robot}" if header.robot else ""
    journey = drive.journey
    what = "simulated log" if simulated else "log"
    length = f"{journey.length:.0f} m in {_time(journey.duration)}" if len(journey.odometry) else "no odometry"
    title = f"{shortened(header.name)}: {what}{robot}, {length}"
    facts = [f"{counted(journey.events, 'event')}, {counted(len(journey.detections), 'detection')}"]
    panel = log_panel(drive)
    return Page(title, (drive.map.name if drive.map else header.name,), tuple(facts), mains=(panel,))


def building_page(
    building: Building, drives: Sequence[Drive], truth: Truth | None = None, title: str | None = None
) -> Page:
    """The page of simulated drives through a building, each in its own panel, all in the world.

    ``truth``: that of the maps, by which their errors are told.
    """
    shown = drives[:MAX_DRIVES]
    heading = title or f"{shortened(building.name)}, simulated: {counted(len(drives), 'drive')}"
    panels = [
        replace(
            _panel(drive, _error(drive.map, truth) if drive.map else "no map", building, k),
            labelled=len(drives) == 1,  # the names would cover small panels
        )
        for k, drive in enumerate(shown)
    ]
    if not drives:
        ground = backdrop(walls=building.walls, places=building.floor.positions)
        panels = [Panel("", scene_of_map(LandmarkMap(building.name)), ground=ground)]
    more = len(drives) - len(shown)
    notes = (f"and {counted(more, 'drive')} more",) if more > 0 else ()
    facts = (f"{counted(len(building.floor.places), 'landmark')}, {building.floor.length:.0f} m of corridors",)
    return Page(heading, tuple(_map_name(drive) for drive in drives), facts, mains=tuple(panels), notes=notes)


def _map_name(drive: Drive) -> str:
    return drive.name if drive.map is None else drive.map.name


def log_panel(drive: Drive) -> Panel:
    """One drive with what is known of it, in the world where there is a truth, else in the frame of its start."""
    return _panel(drive, "in the world" if drive.truth is not None else "in the frame of the robot's start")


def _panel(drive: Drive, said: str, building: Building | None = None, k: int = 0) -> Panel:
    path = None if drive.map is None else drive.map.path
    if building is None:
        ground = backdrop(drive.journey, drive.truth, path=path)
    else:
        # true walls need no scan points
        seen = replace(drive.journey, points=np.zeros((0, 3)))
        ground = backdrop(seen, drive.truth, walls=building.walls, places=building.floor.positions, path=path)
    scene = scene_of_map(LandmarkMap(drive.name) if drive.map is None else drive.map, k)
    if drive.truth is not None and len(drive.truth.path):
        scene = scene.moved(drive.truth.path[0, 1:])
    count = f"{counted(len(drive.map), 'landmark')}, " if drive.map is not None else ""
    return Panel(f"{shortened(drive.name)}: {count}{said}", scene, ground=ground)


def _error(map_: LandmarkMap, truth: Truth | None) -> str:
    """How far a map's landmarks are from where they truly are."""
    if truth is None or map_.name not in truth.frames:
        return "in the world"
    apart = position_errors(map_, truth)
    if not len(apart):
        return "none of them true"
    false = len(map_) - len(apart)
    return f"{np.median(apart):.2f} m (median) from the true places" + (f"; {false} not there" if false else "")


def position_errors(map_: LandmarkMap, truth: Truth) -> Array:
    """Distance [m] of each landmark from its true place, without false alarms, the map laid at its true start."""
    where = truth.landmarks[map_.name]
    real = [(landmark, where.get(landmark.id)) for landmark in map_.landmarks]
    at = np.array([(l.x, l.y) for l, place in real if place is not None], dtype=float).reshape(-1, 2)
    true = np.array([truth.places[place] for _, place in real if place is not None], dtype=float).reshape(-1, 2)
    return np.asarray(np.hypot(*(se2.transform(truth.frames[map_.name], at) - true).T), dtype=float)


def _time(seconds: float) -> str:
    """A duration for people.

    >>> _time(42.4), _time(754.0), _time(7300)
    ('42 s', '13 min', '2 h 2 min')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
