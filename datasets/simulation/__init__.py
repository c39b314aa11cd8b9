"""Floors, robots and the maps they record, with their truth, drawn from the measurement model by a seed."""

from .building import Building, build, make_building
from .drive import Drive, drive
from .explore import Route, SimulationError, explore, start_places
from .floors import Arm, Corridor, DoorAt, Floor, Place, floor_from_graph
from .generate import FloorKind, alike_floor, irregular_floor, make_floor, oblique_floor, symmetric_floor, wings_floor
from .named import hospital_like, salvatori_like
from .pairs import ELSEWHERE, TEST_SEEDS, TUNING_SEEDS, elsewhere, simulated_pair, truth_of
from .plan import Plan, building_from_plan, read_plan
from .policy import POLICIES, Policy, walk
from .record import Recording, record
from .robots import MILKA, VESPUCCI, Driving, Robot
from .simulated_log import SimulatedLog, Stop, simulate_log, simulate_logs
from .steel import Steel, draw_steel

__all__ = [
    "ELSEWHERE",
    "MILKA",
    "POLICIES",
    "TEST_SEEDS",
    "TUNING_SEEDS",
    "VESPUCCI",
    "Arm",
    "Building",
    "Corridor",
    "DoorAt",
    "Drive",
    "Driving",
    "Floor",
    "FloorKind",
    "Place",
    "Plan",
    "Policy",
    "Recording",
    "Robot",
    "Route",
    "SimulatedLog",
    "SimulationError",
    "Steel",
    "Stop",
    "alike_floor",
    "build",
    "building_from_plan",
    "draw_steel",
    "drive",
    "elsewhere",
    "explore",
    "floor_from_graph",
    "hospital_like",
    "irregular_floor",
    "make_building",
    "make_floor",
    "oblique_floor",
    "read_plan",
    "record",
    "salvatori_like",
    "simulate_log",
    "simulate_logs",
    "simulated_pair",
    "start_places",
    "symmetric_floor",
    "truth_of",
    "walk",
    "wings_floor",
]
