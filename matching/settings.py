"""Constants of the search by votes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Settings:
    """Constants of the search; bounds of its work first.

    ``direct``: up to so many proposals are all tried without a vote. ``votes``: cast at most, by ``voters`` landmarks
    of map 2 at least. ``cells``: of the grid of counters, 40 a landmark
    between these bounds. ``peaks``: of each rotation mode; ``modes``: at most.
    ``glance``: landmarks of map 2 by which all candidates are compared, ``refined``: how many of them remain.
    ``sample``: landmarks by which these are refined where a map has more than ``full`` of them, and ``last``: how many
    are then still compared by all landmarks, at least, however large the maps are; ``few``: how many remain of large
    maps' after the glance, at least. Of more only those remain whose score is within ``behind`` [nats], times the root
    of the number of landmarks compared by, of the best one's: so the error of a sum over landmarks grows.
    ``ways``: how many places a robot's ways are sampled at. Maps of more than ``sorted`` landmarks are worked on in the
    order of place.
    ``cell_m`` [m]: of the grid. ``rotation_width`` [rad]: of a mode. ``looseness`` [rad]: by how much a candidate's
    rotation may be off. ``gate``: standard deviations. ``arm``, ``contradiction`` [nats]: for each arm that meets one
    of the same or of the other passability. ``least_gain`` [nats]: of a match. To measure what they are worth:
    ``against``: charge misses and credit the void; ``grow``: tolerance with distance; ``refine``: align; ``repeats``:
    charge matches with what wrong places win by them.
    """

    direct: int = 2048
    votes: int = 200_000
    voters: int = 200
    cells: tuple[int, int] = (100_000, 2_000_000)
    peaks: int = 48
    modes: int = 32
    glance: int = 64
    refined: int = 80
    sample: int = 300
    full: int = 400
    last: int = 8
    few: int = 8
    behind: float = 4.0
    ways: int = 1500
    sorted: int = 2000
    cell_m: float = 1.5
    rotation_width: float = 0.12
    looseness: float = 0.04
    gate: float = 3.0
    most_sigma_m: float = 1.5
    arm: float = 0.5
    contradiction: float = 3.5
    least_gain: float = -1.0
    against: bool = True
    grow: bool = True
    refine: bool = True
    repeats: bool = True


SETTINGS = Settings()
