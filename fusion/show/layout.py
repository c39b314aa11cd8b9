"""Where panels go on the page: boxes in inches, sized by what they show."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .backdrop import Backdrop, extent
from .scene import Array, Scene, widened

#: Breaks a title into lines of at most that width [inches].
Wrap = Callable[[str, float], str]

#: Page width and margins [inches].
PAGE_WIDTH, MARGIN, GAP = 10.0, 0.25, 0.25

#: Room around the axes for title, tick labels and axis labels [inches].
LEFT, RIGHT, BOTTOM = 0.52, 0.05, 0.44

#: Up to this many maps have a panel of their own.
MAX_SOURCES = 6


@dataclass(frozen=True, slots=True)
class Panel:
    """A scene with its title, on a ``ground`` where there is one; ``labelled`` False: never with ids."""

    title: str
    scene: Scene
    labelled: bool = True
    ground: Backdrop | None = None

    @property
    def extent(self) -> tuple[Array, Array]:
        """Lower and upper corner (2,) [m] of scene and ground, at least four metres wide."""
        found = None if self.ground is None else extent([*self.ground.spots, self.scene.positions, *self.scene.walls])
        return self.scene.extent if found is None else widened(*found)

    @property
    def aspect(self) -> float:
        """Height over width of what is shown."""
        low, high = self.extent
        width, height = high - low
        return float(height / width)


@dataclass(frozen=True, slots=True)
class Slot:
    """Where a panel's axes are: lower left corner below the panels' top, size [inches], and its scale [m per inch]."""

    panel: Panel
    left: float
    below_top: float
    width: float
    height: float
    metres_per_inch: float


def scale(panel: Panel, width: float, height: float) -> float:
    """Metres per inch at which a panel fits into a box [inches], with room for markers at the edge."""
    low, high = panel.extent
    across, up = high - low
    return float(max(across / max(width - 0.4, 0.5), up / max(height - 0.4, 0.5)))


def title_height(title: str) -> float:
    """Room [inches] above axes for a title of that many lines."""
    return 0.12 + 0.17 * (title.count("\n") + 1)


def _row(
    panels: Sequence[Panel], left: float, top: float, width: float, limits: tuple[float, float], wrap: Wrap
) -> list[Slot]:
    """Panels side by side at one common scale; ``top`` is measured downwards, heights kept within ``limits``."""
    each = (width - GAP * (len(panels) - 1)) / len(panels)
    inner = each - LEFT - RIGHT
    panels = [replace(p, title=wrap(p.title, inner)) for p in panels]
    height = float(np.clip(max(p.aspect * (inner - 0.4) + 0.4 for p in panels), *limits))
    metres = max(scale(p, inner, height) for p in panels)
    above = max(title_height(p.title) for p in panels)
    return [
        Slot(p, left + k * (each + GAP) + LEFT, top + above + height, inner, height, metres)
        for k, p in enumerate(panels)
    ]


def _rows(panels: Sequence[Panel], per_row: int, top: float, limits: tuple[float, float], wrap: Wrap) -> list[Slot]:
    slots: list[Slot] = []
    for first in range(0, len(panels), per_row):
        below = _bottom(slots, top)
        # A last row with room to spare keeps the panels' width: equal widths read as equal scales.
        row = panels[first : first + per_row]
        full = PAGE_WIDTH - 2 * MARGIN
        width = full if len(panels) <= per_row else (full + GAP) * len(row) / per_row - GAP
        slots += _row(row, MARGIN, below, width, limits, wrap)
    return slots


def _bottom(slots: Sequence[Slot], top: float) -> float:
    return max((slot.below_top + BOTTOM for slot in slots), default=top)


def _beside(sources: Sequence[Panel], main: Panel, wrap: Wrap) -> list[Slot]:
    """Maps in a column at the left, the merged map large at the right, both columns equally high."""
    left_width = 3.1
    slots: list[Slot] = []
    for panel in sources:
        slots += _row([panel], MARGIN, _bottom(slots, 0.0), left_width, (1.5, 3.0), wrap)
    right = MARGIN + left_width + GAP
    inner = PAGE_WIDTH - MARGIN - right - LEFT - RIGHT
    main = replace(main, title=wrap(main.title, inner))
    above = title_height(main.title)
    wanted = float(np.clip(main.aspect * inner, 4.2, 6.6))
    column = slots[-1].below_top
    height = max(wanted, column - above)
    spare = (above + height - column) / len(slots)
    # What the merged map is higher is shared out among the maps at the left.
    metres = max(scale(s.panel, s.width, s.height + spare) for s in slots)
    slots = [
        Slot(s.panel, s.left, s.below_top + (k + 1) * spare, s.width, s.height + spare, metres)
        for k, s in enumerate(slots)
    ]
    main_scale = scale(main, inner, height)
    return [*slots, Slot(main, right + LEFT, above + height, inner, height, main_scale)]


def arrange(sources: Sequence[Panel], mains: Sequence[Panel], wrap: Wrap) -> tuple[list[Slot], float]:
    """Slots of all panels, maps first, and their total height [inches].

    One merged map that isn't wide stands beside its maps; all else stands below them.
    """
    if len(mains) == 1 and 1 <= len(sources) <= 3 and mains[0].aspect > 0.62:
        slots = _beside(sources, mains[0], wrap)
        return slots, _bottom(slots, 0.0)
    slots = _rows(sources, min(3, max(1, len(sources))), 0.0, (1.5, 3.4), wrap) if sources else []
    if mains:
        flat = max(panel.aspect for panel in mains) < 0.25
        per_row = 1 if flat or len(mains) == 1 else min(3, len(mains))
        limits = (1.9 if flat else 2.6, 6.6 if len(mains) == 1 else 4.4)
        slots += _rows(mains, per_row, _bottom(slots, 0.0), limits, wrap)
    return slots, _bottom(slots, 0.0)
