"""Two floors with names, drawn by hand after what the paper says of them; nothing in them is random."""

from __future__ import annotations

import numpy as np

from .floors import DoorAt, Floor, floor_from_graph

#: Magnetic north [rad, world] of the named floors: 12 degrees off their corridors, like most buildings' isn't along.
_NORTH = float(np.deg2rad(78.0))


def salvatori_like() -> Floor:
    """One loop of exactly 80 m and one cul-de-sac of 7 m, after the floor of the paper's Table 1.

    Six corners, a junction, an end and ten doors: 18 places, so that a full exploration with its false alarms makes a
    map of about 20 landmarks, the size of the paper's largest. The loop is no rectangle and its doors have no pitch:
    no part of it looks like another one.

    >>> floor = salvatori_like()
    >>> floor.length, len(floor.places)
    (87.0, 18)
    """
    nodes = [(0, 0), (25, 0), (25, 9), (17, 9), (17, 15), (0, 15), (0, 6), (-7, 6)]
    loop = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (6, 0)]
    doors = [
        *(DoorAt(0, 1, along, side) for along, side in ((4.5, -1), (8.5, -1), (14.0, 1), (19.5, -1))),
        DoorAt(1, 2, 4.0, -1),
        DoorAt(2, 3, 4.5, 1),
        *(DoorAt(4, 5, along, side) for along, side in ((4.0, -1), (8.0, 1), (13.0, -1))),
        DoorAt(5, 6, 4.5, 1),
    ]
    return floor_from_graph("salvatori-like", nodes, [*loop, (6, 7)], doors, _NORTH)


def hospital_like() -> Floor:
    """A West and an East wing on either side of a central block of lifts, which a loop of corridor goes round.

    66 m from the West end to the East end, 141.5 m of corridor: the loop of 60 m, 41 m in the West wing and 40.5 m in
    the East wing, each with a branch and a bend. Both wings meet the loop at a junction, so that a robot that starts
    in either of them comes to it and can go round. 10 corners and ends, four junctions and 17 doors, three of them
    the lifts', on the loop's inner side.

    >>> floor = hospital_like()
    >>> floor.length, sum(place.type == "junction" for place in floor.places)
    (141.5, 4)
    """
    block = [(-9, -6), (9, -6), (9, -2), (9, 6), (-9, 6), (-9, 1.5)]
    west = [(-22, 1.5), (-22, 10), (-34, 1.5), (-34, -6)]
    east = [(19, -2), (19, -10), (32, -2), (32, 7.5)]
    ring = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 0)]
    wings = [(5, 6), (6, 7), (6, 8), (8, 9), (2, 10), (10, 11), (10, 12), (12, 13)]
    doors = [
        *(DoorAt(0, 1, along, side) for along, side in ((6.0, 1), (9.5, 1), (14.0, -1))),
        *(DoorAt(3, 4, along, side) for along, side in ((4.5, -1), (10.0, 1))),
        DoorAt(2, 3, 4.0, -1),
        *(DoorAt(5, 6, along, side) for along, side in ((4.0, 1), (9.0, -1))),
        DoorAt(6, 7, 4.5, 1),
        *(DoorAt(6, 8, along, side) for along, side in ((3.5, 1), (8.0, -1))),
        DoorAt(8, 9, 3.5, -1),
        DoorAt(2, 10, 6.0, -1),
        DoorAt(10, 11, 3.5, 1),
        *(DoorAt(10, 12, along, side) for along, side in ((4.0, 1), (9.5, -1))),
        DoorAt(12, 13, 5.0, 1),
    ]
    return floor_from_graph("hospital-like", [*block, *west, *east], [*ring, *wings], doors, _NORTH)
