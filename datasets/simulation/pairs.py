"""`simulated_pair`: two maps with their truth from one seed, of one floor or of two different ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..maps import LandmarkMap
from ..truth import Truth
from .explore import SimulationError, explore
from .floors import Floor
from .generate import FloorKind, make_floor
from .record import Recording, record
from .robots import MILKA, VESPUCCI, Robot

Array = NDArray[np.float64]

#: Seeds for tuning and development, and seeds for reported figures: never look at the second to choose anything.
TUNING_SEEDS = range(0, 100_000)
TEST_SEEDS = range(1_000_000, 2_000_000)

#: Where the second of two different floors stands in the world, so that nothing of it lies on the first [m].
ELSEWHERE: tuple[float, float, float] = (500.0, 0.0, 0.0)
_TRIES = 500


def simulated_pair(
    seed: int | np.random.Generator,
    floor_kind: FloorKind = "irregular",
    *,
    same: bool = True,
    compass: bool = False,
    min_common: int = 8,
    robots: tuple[Robot, Robot] = (VESPUCCI, MILKA),
    share: tuple[float, float] = (0.4, 0.9),
    loops_closed: bool = True,
) -> tuple[LandmarkMap, LandmarkMap, Truth]:
    """Two robots' maps ``A`` and ``B`` of one floor (or of two different floors of a kind), and the truth.

    ``min_common``: true places that both maps hold at least (same floor only); routes are drawn again until so.
    ``share``: bounds of the share of the corridors that each robot explores. ``loops_closed``: see `record`. The same
    seed gives the same pair.

    Raises `SimulationError` where the wanted overlap doesn't come about.

    >>> map1, map2, truth = simulated_pair(7)
    >>> len(truth.true_pairs("A", "B")) >= 8
    True
    """
    rng = np.random.default_rng(seed)
    for _ in range(_TRIES):
        floors = _floors(floor_kind, same, rng)
        recordings = [
            record(
                floor,
                explore(floor, rng, float(rng.uniform(*share))),
                robot.with_compass(compass),
                rng,
                name,
                loops_closed=loops_closed,
            )
            for floor, robot, name in zip(floors, robots, ("A", "B"), strict=True)
        ]
        if not same or len(recordings[0].true_places & recordings[1].true_places) >= min_common:
            return recordings[0].map, recordings[1].map, truth_of(recordings, floors)
    raise SimulationError(f"no pair with {min_common} common landmarks came about in {_TRIES} draws")


def truth_of(recordings: Sequence[Recording], floors: Sequence[Floor]) -> Truth:
    """The truth of some recordings, whose floors stand in one world with ids of their own."""
    places: dict[str, Array] = {}
    landmarks: dict[str, Mapping[str, str | None]] = {}
    for recording, floor in zip(recordings, floors, strict=True):
        places |= {place.id: place.xy for place in floor.places}
        landmarks[recording.map.name] = recording.place_from_id
    return Truth({r.map.name: r.frame for r in recordings}, landmarks, places)


def _floors(kind: FloorKind, same: bool, rng: np.random.Generator) -> tuple[Floor, Floor]:
    first = make_floor(kind, rng)
    return (first, first) if same else (first, elsewhere(make_floor(kind, rng), first, prefix="other-"))


def elsewhere(floor: Floor, beside: Floor, prefix: str) -> Floor:
    """A floor set `ELSEWHERE` in the world of another one: parallel to it, one north, ids prefixed.

    Parallel, because buildings often are, and then a compass can't tell their corridors apart.
    """
    return replace(floor, north=beside.north).moved(ELSEWHERE, prefix)
