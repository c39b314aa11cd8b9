"""Makes the reconstruction of the paper's maps D1 to D19, and the hospital pair, again from fixed seeds.

The original maps are lost; these are **a reconstruction**. Simulated robots explore a floor that is like the one of
the paper's Table 1 in what the paper says of it (one loop of 80 m, a cul-de-sac), go round it as the table's directions
ask, and stop before they would detect more landmarks than the paper's map had. After a change to the simulation
or the mapper, from the repository's root, with the environment's Python::

    .venv/bin/python -m mapfuse.datasets.recordings.make_paper_maps

writes the files beside this one, or into the folder given to `main`: the same bytes on the same machine; on another
one a number here and there may differ by one in its last digit.

What was chosen by hand, and by what: the starts, so that maps that the paper combined lie on the same part of the
loop by the lengths of their ways; the robots in turn, since the paper names Milka for D1 alone. Seeds are the first
ones from `FIRST_SEED` on whose map has exactly that size (and, where the paper says it, is of that part of the floor:
D1 of the north side, D7 without and D9 with the cul-de-sac). No result of matching or fusion was looked at for any of
it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import MapfuseError
from ..mapfile import write_map
from ..mapper import Mapper, truth_of_map
from ..maps import LandmarkMap, Noise
from ..paper import DIRECTIONS, SIZES
from ..simulation import (
    MILKA,
    VESPUCCI,
    Building,
    Robot,
    SimulatedLog,
    Stop,
    build,
    hospital_like,
    salvatori_like,
    simulate_log,
)
from ..truth import Truth, write_truth
from . import HOSPITAL, PAPER_MAPS
from .make_recordings import DIGITS, rounded

FIRST_SEED = 1999
#: Seeds tried for one map before it is given up.
MAX_TRIES = 200
_NOTE = "{what}: a simulated robot in a simulated building, mapped by mapfuse. The truth is in {truth}."
_WHAT = "Reconstruction of the lost map {name} of Dedeoglu and Sukhatme (2000), made to have its size and direction"

#: Where each robot starts; which way it goes is `paper.DIRECTIONS`. Counter-clockwise the loop is p0 (south-west), the
#: south side to p1, p2, p3, p4 (north-east), the north side to p5, and back by the junction p6, from which the
#: cul-de-sac to p7 leads away. D1 begins the north side from its west end, clockwise, as section 4.1 says.
STARTS: Mapping[str, str] = {
    "D1": "p5", "D2": "p6", "D6": "p0", "D7": "p4", "D8": "p3", "D9": "p5",
    "D3": "p1", "D4": "p1", "D5": "p2",
    "D10": "p1", "D11": "p3", "D12": "p0", "D13": "p6", "D14": "p2",
    "D15": "p5", "D16": "p4", "D17": "p3",
    "D18": "p0", "D19": "p4",
}  # fmt: skip
#: All that D1 may hold: "the northern corridor" (section 4.1).
NORTH_SIDE = frozenset({"p5", "d8", "d7", "d6", "p4"})
#: Whether a map holds the end of the cul-de-sac, where the paper says so (section 4.1).
CUL_DE_SAC = "p7"
HOLDS_CUL_DE_SAC: Mapping[str, bool] = {"D7": False, "D9": True}


@dataclass(frozen=True, eq=False, slots=True)
class Taken:
    """One drive, the map of it, and the map's truth."""

    drive: SimulatedLog
    map: LandmarkMap
    map_truth: Truth


def main(folder: str | Path | None = None, names: Sequence[str] = (*PAPER_MAPS, *HOSPITAL)) -> tuple[Path, ...]:
    """Writes maps and truth files into folders ``paper`` and ``hospital`` of ``folder`` (default: this package's).

    ``names``: which maps; the truth files are written where all of theirs are made. Returns the paths.
    """
    target = Path(folder) if folder is not None else Path(__file__).parent
    written: list[Path] = []
    for scene, scene_names in (("paper", PAPER_MAPS), ("hospital", HOSPITAL)):
        (target / scene).mkdir(exist_ok=True)
        wanted = [name for name in scene_names if name in names]
        taken = [paper_map(name) if scene == "paper" else hospital_map(name) for name in wanted]
        for take in taken:
            written.append(target / scene / f"{take.map.name}.map.json")
            write_map(take.map, written[-1])
        if len(wanted) == len(scene_names):
            written.append(target / scene / f"{scene}.truth.json")
            write_truth(_together(taken), written[-1])
    return tuple(written)


def paper_building() -> Building:
    """The building that the 19 maps are of."""
    return build(salvatori_like(), seed=FIRST_SEED)


def paper_map(name: str) -> Taken:
    """One of D1 to D19 with its drive and truth; KeyError for another name."""
    number = int(name[1:]) if name in SIZES else 0
    if not number:
        raise KeyError(name)
    robot = MILKA if number % 2 else VESPUCCI
    building = paper_building()
    for seed in range(FIRST_SEED, FIRST_SEED + MAX_TRIES):
        rng = np.random.default_rng([seed, number])
        start, stop = STARTS[name], Stop(landmarks=SIZES[name])
        drive = simulate_log(building, robot, rng, name=name, start=start, policy=DIRECTIONS[name], stop=stop)
        taken = _mapped(drive, _WHAT.format(name=name), "paper", reconstruction=True)
        if len(taken.map) == SIZES[name] and _as_said(taken):
            return taken
    raise MapfuseError(f"no seed of {MAX_TRIES} makes a map {name} of {SIZES[name]} landmarks")


def _as_said(taken: Taken) -> bool:
    """Whether the map is of the parts of the floor that the paper says it is of, where it says so."""
    name = taken.map.name
    places = {place for place in taken.map_truth.landmarks[name].values() if place is not None}
    if name == "D1" and not places <= NORTH_SIDE:
        return False
    held = CUL_DE_SAC in places
    return held == HOLDS_CUL_DE_SAC.get(name, held)


def hospital_building() -> Building:
    """The building of the hospital pair."""
    return build(hospital_like(), seed=FIRST_SEED)


#: Of each robot of the pair: where it starts, and what of the floor lies west or east of the lifts' block [m, x].
_HOSPITAL: Mapping[str, tuple[Robot, str, float, float]] = {
    HOSPITAL[0]: (VESPUCCI, "p9", -np.inf, 9.5),
    HOSPITAL[1]: (MILKA, "p13", -9.5, np.inf),
}


def hospital_logs(seed: int = FIRST_SEED) -> dict[str, SimulatedLog]:
    """The two drives through the hospital, by name. `FIRST_SEED` gives those of the maps.

    Vespucci explores the West wing, then goes round the lifts; Milka the East wing, then round the lifts (section
    4.2). Neither enters the other's wing.
    """
    return {name: _hospital_log(name, seed) for name in HOSPITAL}


def _hospital_log(name: str, seed: int) -> SimulatedLog:
    robot, start, west, east = _HOSPITAL[name]
    building = hospital_building()
    floor = building.floor
    kept = tuple(
        corridor
        for corridor in floor.corridors
        if all(west <= floor.place_from_id[place].x <= east for place in corridor.places)
    )
    # what isn't explored stays in the building: its walls and places are seen from the junction
    part = replace(building, floor=replace(floor, corridors=kept))
    return simulate_log(part, robot, np.random.default_rng([seed, HOSPITAL.index(name)]), name=name, start=start)


def hospital_map(name: str) -> Taken:
    """One of the hospital pair with its drive and truth; KeyError for another name."""
    drive = _hospital_log(name, FIRST_SEED)
    return _mapped(drive, "A hospital like that of section 4.2, made up", "hospital")


def _mapped(drive: SimulatedLog, what: str, scene: str, *, reconstruction: bool = False) -> Taken:
    """A drive and the map of it, which says what it is."""
    mapper = Mapper(drive.header)
    for event in drive.events:
        mapper.update(event)
    note = _NOTE.format(what=what, truth=f"{scene}.truth.json")
    extra = {"simulated": True, **({"reconstruction": True} if reconstruction else {}), "note": note}
    made = _rounded(mapper.map(joint=True)).replace(extra=extra)
    return Taken(drive, made, truth_of_map(made, mapper.sources, drive.truth))


def _rounded(made: LandmarkMap) -> LandmarkMap:
    """Numbers to the micrometre and microradian, so that the last bits of a machine's algebra aren't in the file."""
    noise, joint = made.noise, made.joint_covariance
    values = {name: getattr(noise, name) for name in Noise.__dataclass_fields__ if name != "extra"}
    return rounded(made).replace(
        joint_covariance=None if joint is None else replace(joint, matrix=joint.matrix.round(DIGITS)),
        noise=replace(noise, **{key: value and round(value, DIGITS) for key, value in values.items()}),
        landmarks=tuple(
            replace(
                landmark,
                covariance=None if landmark.covariance is None else landmark.covariance.round(DIGITS),
                existence=None if landmark.existence is None else round(landmark.existence, DIGITS),
            )
            for landmark in rounded(made).landmarks
        ),
    )


def _together(taken: Sequence[Taken]) -> Truth:
    """One truth of all maps of a building."""
    frames = {name: xy.round(DIGITS) for take in taken for name, xy in take.map_truth.frames.items()}
    landmarks = {name: ids for take in taken for name, ids in take.map_truth.landmarks.items()}
    places = {place: xy.round(DIGITS) for take in taken for place, xy in take.map_truth.places.items()}
    return Truth(frames, landmarks, places, {"simulated": True})


if __name__ == "__main__":
    main()
