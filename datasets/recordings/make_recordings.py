"""Makes the built-in recordings again, to the byte, from fixed seeds.

After a change to the simulation, from the repository's root, with the environment's Python::

    .venv/bin/python -c "from mapfuse.datasets.recordings.make_recordings import main; main()"

writes them beside this file, or into the folder given to `main`. Seeds were taken as they came: the first ones from
`FIRST_SEED` on that give the stated overlap and shares; no result of matching or fusion was looked at.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from .. import mapfile
from ..maps import LandmarkMap, Link
from ..se2 import wrap
from ..simulation import (
    MILKA,
    VESPUCCI,
    Floor,
    Recording,
    Robot,
    Route,
    elsewhere,
    explore,
    irregular_floor,
    record,
    truth_of,
)
from ..simulation.outline import with_outline
from ..truth import Truth, write_truth
from . import SCENES

FIRST_SEED = 2000
DIGITS = 6
#: Landmarks that both maps of the ground floor hold at least, and the share of the corridors that each robot saw.
MIN_COMMON, WHOLE, UNFINISHED = 9, 0.95, 0.5
NOTE = (
    "Simulated by mapfuse from its measurement model (docs/measurement-model.md): no robot recorded this. "
    "The truth is in {truth}."
)
_Take = tuple[Recording, Floor, Route]


def main(folder: str | Path | None = None) -> tuple[Path, ...]:
    """Writes all maps and truth files into ``folder`` (default: this package's) and returns their paths."""
    target = Path(folder) if folder is not None else Path(__file__).parent
    written: list[Path] = []
    for scene, takes in (("ground-floor", _ground_floor()), ("two-buildings", _two_buildings())):
        truth_name = f"{scene}.truth.json"
        for recording, floor, route in takes:
            recorded = rounded(with_outline(recording, floor, route))
            recorded = recorded.replace(extra={**recorded.extra, "note": NOTE.format(truth=truth_name)})
            written.append(target / f"{recorded.name}.map.json")
            mapfile.write_map(recorded, written[-1])
        written.append(target / truth_name)
        write_truth(_marked(truth_of([take[0] for take in takes], [take[1] for take in takes])), written[-1])
    return tuple(written)


def rounded(recorded: LandmarkMap) -> LandmarkMap:
    """Numbers to the micrometre and microradian, so that the last bits of a machine's algebra aren't in the file."""
    return recorded.replace(
        landmarks=tuple(
            replace(l, x=round(l.x, DIGITS), y=round(l.y, DIGITS), links=tuple(map(_rounded_link, l.links)))
            for l in recorded.landmarks
        ),
        walls=tuple(wall.round(DIGITS) for wall in recorded.walls),
        path=None if recorded.path is None else recorded.path.round(DIGITS),
    )


def _rounded_link(link: Link) -> Link:
    distance = None if link.distance is None else round(link.distance, DIGITS)
    return replace(link, heading=_rounded_angle(link.heading), compass=_rounded_angle(link.compass), distance=distance)


def _rounded_angle(angle: float | None) -> float | None:
    return None if angle is None else float(wrap(round(angle, DIGITS)))


def _marked(truth: Truth) -> Truth:
    frames = {name: frame.round(DIGITS) for name, frame in truth.frames.items()}
    places = {identifier: xy.round(DIGITS) for identifier, xy in truth.places.items()}
    return Truth(frames, truth.landmarks, places, {"simulated": True})


def _take(floor: Floor, robot: Robot, share: float, rng: np.random.Generator, name: str) -> _Take:
    route = explore(floor, rng, share)
    return record(floor, route, robot, rng, name), floor, route


def _ground_floor() -> tuple[_Take, _Take]:
    """One floor: Vespucci saw nearly all of it, Milka half."""
    vespucci, milka = SCENES["ground-floor"]
    seed = FIRST_SEED
    while True:
        rng = np.random.default_rng(seed)
        floor = irregular_floor(rng, "ground-floor")
        takes = _take(floor, VESPUCCI, WHOLE, rng, vespucci), _take(floor, MILKA, UNFINISHED, rng, milka)
        if len(takes[0][0].true_places & takes[1][0].true_places) >= MIN_COMMON:
            return takes
        seed += 1


def _two_buildings() -> tuple[_Take, _Take]:
    """Two floors of one style that have nothing in common."""
    vespucci, milka = SCENES["two-buildings"]
    rng = np.random.default_rng(FIRST_SEED)
    north = irregular_floor(rng, "north-building").moved(np.zeros(3), prefix="north-")
    south = elsewhere(irregular_floor(rng, "south-building"), north, prefix="south-")
    return _take(north, VESPUCCI, WHOLE, rng, vespucci), _take(south, MILKA, WHOLE, rng, milka)
