"""The legend below the panels: only what the picture shows, in as few rows as the page allows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from matplotlib.lines import Line2D

from .backdrop import Backdrop
from .layout import Panel
from .panel import look
from .scene import COMMON_OWNER, Scene
from .style import ALARM, BUILDING, GREY, INK, MAPPED, MARKER_FROM_KIND, ODOMETRY, SENSED, WALL, LineStyle
from .words import shortened

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.legend import Legend

FONT = 8.0


#: What stands beside a label: one line or marker, or several on top of each other.
Handle = Line2D | tuple[Line2D, ...]
Entry = tuple[Handle, str]


def _handle(marker: str = "none", line: LineStyle = "none", size: float = 5.5, **looks: Any) -> Line2D:
    return Line2D([], [], marker=marker, linestyle=line, markersize=size, **looks)


def _owner_entries(scenes: Sequence[Scene], names: Sequence[str]) -> list[Entry]:
    entries: list[Entry] = []
    shown = {int(k) for scene in scenes for k in scene.owners}
    for k in sorted(shown, key=lambda k: (k == COMMON_OWNER, k)):
        style = look(k)
        square = _handle(
            "s", style.linestyle, color=style.line, linewidth=1.1, markerfacecolor=style.fill,
            markeredgecolor=style.edge, markeredgewidth=0.6,
        )  # fmt: skip
        if k == COMMON_OWNER:
            ring = _handle("o", size=11.0, markerfacecolor="none", markeredgecolor=INK, markeredgewidth=0.9)
            entries.append(((square, ring), "in both maps" if len(names) == 2 else "in several maps"))
        else:
            entries.append((square, shortened(names[k], 28)))
    return entries


def _entries(scenes: Sequence[Scene], names: Sequence[str], ellipse_scale: float, wall: str = "wall") -> list[Entry]:
    """Who recorded it, and what the other signs mean."""
    entries = _owner_entries(scenes, names)
    if any(scene.doubtful.any() for scene in scenes):
        hollow = _handle("s", markerfacecolor="white", markeredgecolor=INK)
        entries.append((hollow, "doubtful (existence < 0.5)"))
    if any(len(scene.covariances) for scene in scenes):
        enlarged = "" if ellipse_scale == 1.0 else f", {ellipse_scale:g} × enlarged"
        ellipse = _handle("o", size=9.0, markerfacecolor="#00000014", markeredgecolor=GREY, markeredgewidth=0.6)
        entries.append((ellipse, f"95 % ellipse{enlarged}"))
    if any(arm.passable for scene in scenes for arm in scene.arms):
        entries.append((_handle("_", size=6.0, color=INK), "way on"))
    if any(not arm.passable for scene in scenes for arm in scene.arms):
        entries.append((_handle("|", size=6.0, color=INK), "blocked"))
    if any(scene.walls for scene in scenes):
        entries.append((_handle(line="-", color=WALL, linewidth=1.0), wall))
    return entries


def _ground_entries(grounds: Sequence[Backdrop]) -> list[Entry]:
    """What is true and what was sensed, where a panel shows it."""
    looks: tuple[tuple[bool, Handle, str], ...] = (
        (any(len(g.walls) for g in grounds), _handle(line="-", color=BUILDING, linewidth=2.2), "true wall"),
        (any(len(g.places) for g in grounds), _handle("+", size=6.0, color=INK), "true landmark"),
        (any(len(g.true_path) for g in grounds), _handle(line="-", color=INK, linewidth=0.9), "true path"),
        (
            any(len(g.odometry) for g in grounds),
            _handle(line=(0, (4.0, 2.0)), color=ODOMETRY, linewidth=0.9),
            "path by odometry",
        ),
        (
            any(len(g.mapped) for g in grounds),
            _handle(line=(0, (1.0, 1.0)), color=MAPPED, linewidth=0.9),
            "path in the map",
        ),
        (any((~g.false).any() for g in grounds), _handle("o", size=3.5, color=SENSED), "detection"),
        (any(g.false.any() for g in grounds), _handle("x", size=4.5, color=ALARM), "false alarm"),
        (any(len(g.points) for g in grounds), _handle(".", size=1.5, color=SENSED), "scan point"),
    )
    return [(handle, label) for shown, handle, label in looks if shown]


def _kind_entries(scenes: Sequence[Scene]) -> list[Entry]:
    kinds = {kind for scene in scenes for kind in scene.kinds}
    return [
        (_handle(marker, size=5.0, color=GREY), kind.value)
        for kind, marker in MARKER_FROM_KIND.items()
        if kind in kinds
    ]


def draw_legends(
    figure: Figure, panels: Sequence[Panel], names: Sequence[str], width_in: float, ellipse_scale: float
) -> list[tuple[Legend, float]]:
    """Legends of these panels with their heights [inches]: who recorded it, the ground, kinds; no empty ones."""
    scenes = [panel.scene for panel in panels]
    grounds = [panel.ground for panel in panels if panel.ground is not None]
    wall = "wall in the map" if grounds else "wall"
    parts = (_entries(scenes, names, ellipse_scale, wall), _ground_entries(grounds), _kind_entries(scenes))
    return [_legend(figure, entries, width_in) for entries in parts if entries]


def _legend(figure: Figure, entries: Sequence[Entry], width_in: float) -> tuple[Legend, float]:
    """In as few rows as the width [inches] allows."""
    handles: list[Any] = [handle for handle, _ in entries]  # a tuple is drawn one on the other, which stubs don't know
    for columns in range(len(entries), 0, -1):
        legend = figure.legend(
            handles, [label for _, label in entries], loc="upper left", ncols=columns,
            frameon=False, fontsize=FONT, handlelength=2.6, columnspacing=1.2, handletextpad=0.5,
            borderaxespad=0.0, borderpad=0.0, labelcolor=INK,
        )  # fmt: skip
        for text in legend.get_texts():
            text.set_parse_math(False)
        box = legend.get_window_extent()
        if box.width <= width_in * figure.dpi or columns == 1:
            break
        legend.remove()
    return legend, float(box.height / figure.dpi)
