"""Floors, robots and the maps they record, with their truth, drawn from the measurement model by a seed."""

from .explore import Route, SimulationError, explore, start_places
from .floors import Arm, Corridor, DoorAt, Floor, Place, floor_from_graph
from .generate import FloorKind, alike_floor, irregular_floor, make_floor, oblique_floor, symmetric_floor
from .pairs import ELSEWHERE, TEST_SEEDS, TUNING_SEEDS, elsewhere, simulated_pair, truth_of
from .record import Recording, record
from .robots import MILKA, VESPUCCI, Robot

__all__ = [
    "ELSEWHERE",
    "MILKA",
    "TEST_SEEDS",
    "TUNING_SEEDS",
    "VESPUCCI",
    "Arm",
    "Corridor",
    "DoorAt",
    "Floor",
    "FloorKind",
    "Place",
    "Recording",
    "Robot",
    "Route",
    "SimulationError",
    "alike_floor",
    "elsewhere",
    "explore",
    "floor_from_graph",
    "irregular_floor",
    "make_floor",
    "oblique_floor",
    "record",
    "simulated_pair",
    "start_places",
    "symmetric_floor",
    "truth_of",
]
