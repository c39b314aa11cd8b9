"""Table 1 of Dedeoglu and Sukhatme (DARS 2000): 26 combinations of 19 maps, and what follows from it.

The maps themselves are lost. `mapfuse.datasets.recordings` holds a reconstruction of them with the same sizes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Relation = Literal["same", "opposite"]
Direction = Literal["clockwise", "counter-clockwise"]


@dataclass(frozen=True, slots=True)
class Combination:
    """A row of the table: ``maps`` as printed, and whether the robots went round the loop the ``same`` way.

    ``candidates``: all pairs of landmarks; ``selected``: those that H1 and H2 leave. ``correctness`` [%]: correct ones
    of the reported matches. ``eliminated`` [%]: false alarms that the combination removed, None where there were none.
    ``likely``: the pair whose sizes give ``candidates``, where that isn't the printed one.
    """

    maps: tuple[str, str]
    relation: Relation
    candidates: int
    selected: int
    correctness: int
    eliminated: int | None
    likely: tuple[str, str] | None = None

    @property
    def pair(self) -> tuple[str, str]:
        """The maps that were combined, as far as the sizes tell.

        >>> TABLE_1[8].maps, TABLE_1[8].pair
        (('D15', 'D16'), ('D15', 'D17'))
        """
        return self.maps if self.likely is None else self.likely

    @property
    def label(self) -> str:
        """The pair as the paper prints it, the likely one beside a wrong one.

        >>> TABLE_1[0].label, TABLE_1[8].label
        ('D1 - D2', 'D15 - D16 (likely D15 - D17)')
        """
        printed = " - ".join(self.maps)
        return printed if self.likely is None else f"{printed} (likely {' - '.join(self.likely)})"

    @property
    def selected_share(self) -> float:
        """Selected by all candidates, which Fig. 2 of the paper draws in percent."""
        return self.selected / self.candidates


#: The rows in the paper's order.
TABLE_1: tuple[Combination, ...] = (
    Combination(("D1", "D2"), "same", 15, 4, 100, None),
    Combination(("D15", "D16"), "opposite", 15, 4, 100, None),
    Combination(("D3", "D4"), "same", 30, 8, 100, None),
    Combination(("D16", "D17"), "same", 33, 6, 100, 100),
    Combination(("D3", "D5"), "same", 40, 11, 100, 100),
    Combination(("D4", "D5"), "same", 48, 8, 100, 100),
    Combination(("D1", "D6"), "opposite", 51, 4, 100, None),
    Combination(("D1", "D7"), "opposite", 54, 5, 100, None),
    Combination(("D15", "D16"), "opposite", 55, 11, 100, 100, likely=("D15", "D17")),
    Combination(("D1", "D8"), "same", 60, 5, 100, 100),
    Combination(("D1", "D9"), "opposite", 60, 6, 100, 100),
    Combination(("D10", "D11"), "same", 65, 9, 50, 50, likely=("D10", "D14")),
    Combination(("D11", "D12"), "opposite", 70, 7, 100, None),
    Combination(("D12", "D13"), "same", 70, 10, 100, 100),
    Combination(("D2", "D6"), "opposite", 85, 12, 75, None),
    Combination(("D18", "D19"), "opposite", 88, 6, 86, 80),
    Combination(("D2", "D7"), "opposite", 90, 15, 100, None),
    Combination(("D12", "D14"), "opposite", 91, 9, 100, 100),
    Combination(("D2", "D8"), "same", 100, 13, 60, 50),
    Combination(("D2", "D9"), "opposite", 100, 16, 100, 100),
    Combination(("D11", "D13"), "opposite", 100, 11, 100, 100),
    Combination(("D12", "D13"), "opposite", 130, 12, 100, None, likely=("D13", "D14")),
    Combination(("D6", "D7"), "same", 306, 20, 92, 0),
    Combination(("D6", "D9"), "same", 340, 21, 100, 33),
    Combination(("D7", "D9"), "same", 360, 25, 92, 66),
    Combination(("D8", "D9"), "opposite", 400, 22, 70, 33),
)

#: Landmarks of each map, from the products in the table. It leaves open which of D18 and D19 has 8 and which 11, and
#: D10's size follows only if its row is D10 - D14.
SIZES: Mapping[str, int] = {
    "D1": 3, "D2": 5, "D3": 5, "D4": 6, "D5": 8, "D6": 17, "D7": 18, "D8": 20, "D9": 20, "D10": 5, "D11": 10,
    "D12": 7, "D13": 10, "D14": 13, "D15": 5, "D16": 3, "D17": 11, "D18": 8, "D19": 11,
}  # fmt: skip

#: Maps whose robots went clockwise. The paper says it of D1 and the contrary of D9; the table's column then settles
#: the maps that it ties to these. In the other groups (3 to 5, 10 to 14, 15 to 17, 18 and 19) it tells only who went
#: the same way; which way is a choice made here.
_CLOCKWISE = ("D1", "D2", "D8", "D3", "D4", "D5", "D10", "D11", "D14", "D15", "D18")

#: Which way round the loop each map's robot went.
DIRECTIONS: Mapping[str, Direction] = {
    name: "clockwise" if name in _CLOCKWISE else "counter-clockwise" for name in SIZES
}

#: Length of the loop [m] on the floor of the 19 maps.
LOOP_LENGTH = 80.0
#: Corridor [m] over which the walls of the hospital's merged map were compared with its plan, and how far each was off
#: at most [m]: the paper's "about 2 %" (section 4.2).
HOSPITAL_CORRIDOR, HOSPITAL_WALL_ERROR = 50.0, 1.0
