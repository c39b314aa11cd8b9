"""How things look: colours, markers and sizes that hold for the colour-blind, in greyscale and from 1 to 300 landmarks.

Colours are those of Okabe and Ito, *Color Universal Design* (2008). Who recorded a landmark is never said by colour
alone: each map has its own edge and line style as well, and common landmarks wear a ring.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.arms import Kind

#: Solid, nothing, or dashes as (offset, (on, off, ...)) in line widths.
LineStyle = Literal["-", "none"] | tuple[float, tuple[float, ...]]

INK = "#1a1a1a"
WALL = "#b8b8b8"
GREY = "#6e6e6e"
#: A true building; the robot's path by odometry and by its map; what was sensed, and sensed wrongly.
BUILDING, ODOMETRY, MAPPED, SENSED, ALARM = "#d9d9d9", "#D55E00", "#009E73", "#56B4E9", "#B0578A"

#: Ends of the 95 % region of a position: the chi-square quantile for two degrees of freedom.
CHI2_95 = 5.991464547107979

#: A landmark whose existence is less probable than this is drawn hollow.
DOUBTFUL = 0.5

MARKER_FROM_KIND: dict[Kind, str] = {
    Kind.CORNER: "s",
    Kind.T_JUNCTION: "^",
    Kind.CROSSING: "P",
    Kind.END: "p",
    Kind.DOOR: "D",
    Kind.CORRIDOR: "d",
    Kind.UNKNOWN: "h",
    Kind.POINT: "o",
}


@dataclass(frozen=True, slots=True)
class Owner:
    """How the landmarks and links of one map look, or those common to several."""

    fill: str
    edge: str
    line: str
    linestyle: LineStyle


#: What several maps recorded.
COMMON = Owner(fill=INK, edge=INK, line=INK, linestyle="-")

#: Map 1 without a dark edge and with solid links, map 2 light, with a dark edge and dashed links, and so on.
OWNERS: tuple[Owner, ...] = (
    Owner("#0072B2", "#0072B2", "#0072B2", "-"),
    Owner("#E69F00", INK, "#C47F00", (0, (4.0, 2.0))),
    Owner("#009E73", "#ffffff", "#009E73", (0, (1.0, 1.2))),
    Owner("#CC79A7", INK, "#B0578A", (0, (6.0, 1.5, 1.0, 1.5))),
    Owner("#56B4E9", INK, "#3A9AD0", (0, (8.0, 2.0))),
    Owner("#D55E00", "#ffffff", "#D55E00", (0, (2.0, 2.0))),
)


def owner(k: int) -> Owner:
    """The look of the k-th map; beyond six maps the looks repeat."""
    return OWNERS[k % len(OWNERS)]


@dataclass(frozen=True, slots=True)
class Sizes:
    """Sizes in points for a panel: ``marker`` diameter, ``ring`` diameter, ``line`` width, ``label`` of ids or None."""

    marker: float
    ring: float
    line: float
    label: float | None


#: More landmarks than this in one panel are drawn without their ids, unless asked for.
MAX_LABELLED = 40


def sizes(
    positions: NDArray[np.float64],
    width_in: float,
    height_in: float,
    metres_per_point: float,
    ids: bool | None = None,
) -> Sizes:
    """Sizes for landmarks at ``positions`` (n, 2) [m] in a panel of that size [inches] and scale.

    Markers shrink with their number and with the distance between neighbours, rings likewise; ``ids`` None: shown
    where there are few.

    >>> few, many = np.arange(20.0)[:, None] * [3.0, 1.0], np.arange(300.0)[:, None] * [0.2, 0.1]
    >>> sizes(few, 6.0, 4.0, 0.15).label is not None, sizes(many, 6.0, 4.0, 0.15).label
    (True, None)
    """
    n = len(positions)
    # If all landmarks shared the panel evenly, each had about this much room [points].
    room = 72.0 * float(np.sqrt(width_in * height_in / max(n, 1)))
    spacing = _spacing(positions) / metres_per_point
    marker = float(np.clip(min(0.2 * room, 0.6 * spacing), 2.8, 6.5))
    labelled = (n <= MAX_LABELLED and room > 30) if ids is None else ids
    return Sizes(
        marker=marker,
        ring=marker + float(np.clip(0.9 * marker, 3.0, 6.0)),
        line=float(np.clip(0.17 * marker, 0.6, 1.1)),
        label=(6.0 if room > 30 else 4.5) if labelled else None,
    )


def _spacing(positions: NDArray[np.float64]) -> float:
    """Distance [m] to the nearest neighbour that three quarters of the landmarks exceed."""
    if not 2 <= len(positions) <= 2000:
        return float("inf") if len(positions) < 2 else 0.0
    away = np.hypot(*(positions[:, None] - positions[None]).transpose(2, 0, 1))
    np.fill_diagonal(away, np.inf)
    return float(np.quantile(away.min(axis=1), 0.25))
