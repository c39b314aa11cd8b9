"""Parameters of the extraction, all lengths in metres."""

from __future__ import annotations

from dataclasses import dataclass, fields

from ..errors import ConfigError

_BOUNDS = {
    "cell_m": (0.005, 1.0),
    "occupied_from": (1, 100),
    "smooth_m": (0.0, 1.0),
    "furniture_m": (0.0, 10.0),
    "speckle_m": (0.0, 10.0),
    "passage_m": (0.05, 5.0),
    "part_m2": (0.0, 1e6),
    "spur_m": (0.0, 20.0),
    "shortest_m": (0.1, 20.0),
    "straight_m": (0.05, 5.0),
    "bend_deg": (5.0, 90.0),
    "widest_m": (0.5, 100.0),
    "door_narrowest_m": (0.2, 5.0),
    "door_widest_m": (0.2, 10.0),
    "door_narrowing": (0.1, 0.99),
    "door_reach_m": (0.2, 10.0),
    "looks": (1, 100),
    "agreement": (0.01, 1.0),
    "same_m": (0.05, 5.0),
    "wall_straight_m": (0.01, 5.0),
    "wall_shortest_m": (0.0, 50.0),
}


@dataclass(frozen=True, slots=True)
class ExtractConfig:
    """How landmarks are read out of a grid.

    ``cell_m``: finer grids are looked at with cells of this size [m].
    ``occupied_from`` [percent]: cells from here on are wall; between a file's thresholds for free and occupied.
    ``smooth_m``: the edge of free space is smoothed over this length [m].
    ``furniture_m``: what stands alone in free space and is no larger [m] than this doesn't divide it.
    ``speckle_m``: occupied specks up to this size [m] are no walls.
    ``passage_m``: narrower gaps [m] are no way for a robot, and rays that narrow through a window are no space.
    ``part_m2``: free parts smaller than this [m^2], apart from the largest, are left out.
    ``spur_m``: a side way that leads less than this [m] further than the space it leaves is no corridor.
    ``shortest_m``: places nearer to each other than this [m] are one.
    ``straight_m``: a corridor is straight as far as its middle line is no further off than this [m].
    ``bend_deg``: a corridor that turns by less [degrees] goes on.
    ``widest_m``: in a wider space than this [m] the middle line is no corridor.
    ``door_narrowest_m``, ``door_widest_m``: widths [m] of a doorway.
    ``door_narrowing``: a doorway is narrower than the way before and behind it by this factor,
    ``door_reach_m``: within this distance [m].
    ``looks``: landmarks are looked for so often, each time with the grid turned differently;
    ``agreement``: kept is what is found again in this share of all looks, within ``same_m`` [m].
    ``wall_straight_m``: walls are drawn to within this [m]; ``wall_shortest_m``: shorter ones are left out.
    """

    cell_m: float = 0.1
    occupied_from: int = 10
    smooth_m: float = 0.1
    furniture_m: float = 1.2
    speckle_m: float = 0.3
    passage_m: float = 0.5
    part_m2: float = 10.0
    spur_m: float = 1.0
    shortest_m: float = 1.2
    straight_m: float = 0.4
    bend_deg: float = 30.0
    widest_m: float = 5.0
    door_narrowest_m: float = 0.5
    door_widest_m: float = 1.3
    door_narrowing: float = 0.75
    door_reach_m: float = 1.5
    looks: int = 7
    agreement: float = 0.5
    same_m: float = 0.6
    wall_straight_m: float = 0.1
    wall_shortest_m: float = 0.5

    def __post_init__(self) -> None:
        for field in fields(self):
            low, high = _BOUNDS[field.name]
            value = getattr(self, field.name)
            if not low <= value <= high:
                raise ConfigError(f"extract.{field.name} is {value!r}; it must lie between {low!r} and {high!r}")
