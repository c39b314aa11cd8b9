"""A page drawn: title and facts on top, panels, statement, legend and notes below, each as high as it needs."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mapfuse.datasets.errors import ConfigError
from mapfuse.datasets.files import write_whole

from .backdrop import draw_backdrop
from .fused_page import Page
from .labels import wrapped
from .layout import MARGIN, PAGE_WIDTH, Slot, arrange
from .legend import draw_legends
from .panel import draw_scene
from .style import GREY, INK, sizes

if TYPE_CHECKING:
    from matplotlib.text import Text

SUFFIXES = (".png", ".svg", ".pdf")
_TEXT_WIDTH = PAGE_WIDTH - 2 * MARGIN


def draw_page(page: Page, path: str | Path | None, *, ids: bool | None, ellipse_scale: float, dpi: float) -> Figure:
    """The page as a figure, saved where a path is given. The figure is no part of pyplot's state."""
    if path is not None:
        _checked_suffix(path)
    figure = Figure(figsize=(PAGE_WIDTH, 10.0), dpi=dpi)
    FigureCanvasAgg(figure)
    head = [_title(figure, page.title), *(_text(figure, fact, 9.0) for fact in page.facts)]
    slots, panels_height = arrange(page.sources, page.mains, lambda title, width: wrapped(figure, title, 8.5, width, 4))
    statement = _statement(figure, page)
    legends = draw_legends(figure, [slot.panel for slot in slots], page.names, _TEXT_WIDTH, ellipse_scale)
    notes = [_text(figure, note, 8.5, max_lines=8) for note in page.notes]

    head_height = MARGIN + sum(_height(text) + 0.07 for text in head) + 0.08
    statement_height = 0.0 if statement is None else _height(statement) + 0.55
    notes_height = sum(_height(text) + 0.07 for text in notes)
    legend_height = sum(height + 0.08 for _, height in legends) + 0.1
    total = head_height + panels_height + statement_height + legend_height + notes_height + MARGIN
    figure.set_size_inches(PAGE_WIDTH, total)
    _stack(head, MARGIN, total)
    for slot in slots:
        _draw_slot(figure, slot, head_height, total, ids, ellipse_scale)
    below = head_height + panels_height
    if statement is not None:
        _place_statement(figure, statement, below + 0.1, statement_height - 0.3, total)
    below += statement_height
    for legend, height in legends:
        legend.set_bbox_to_anchor((MARGIN / PAGE_WIDTH, 1 - below / total))
        below += height + 0.08
    _stack(notes, below + 0.1, total)
    if path is not None:
        save(figure, path)
    return figure


def _title(figure: Figure, content: str) -> Text:
    lines = wrapped(figure, content, 13.0, _TEXT_WIDTH, 4, weight="bold")
    return figure.suptitle(
        lines, x=0, y=0, fontsize=13.0, weight="bold", color=INK, ha="left", va="top", parse_math=False
    )


def _text(figure: Figure, content: str, fontsize: float, max_lines: int = 4) -> Text:
    lines = wrapped(figure, content, fontsize, _TEXT_WIDTH, max_lines)
    return figure.text(0, 0, lines, fontsize=fontsize, color=INK, va="top", linespacing=1.25, parse_math=False)


def _statement(figure: Figure, page: Page) -> Text | None:
    """The box that stands where a merged map would."""
    if page.statement is None:
        return None
    lines = wrapped(figure, page.statement, 10.0, _TEXT_WIDTH - 0.4)
    return figure.text(0, 0, lines, fontsize=10.0, color=INK, va="center", linespacing=1.35, parse_math=False)


def _place_statement(figure: Figure, statement: Text, top: float, height: float, total: float) -> None:
    """The statement in a box across the page."""
    box = Rectangle(
        (MARGIN / PAGE_WIDTH, 1 - (top + height) / total), _TEXT_WIDTH / PAGE_WIDTH, height / total,
        transform=figure.transFigure, facecolor="#f4f4f4", edgecolor=GREY, linewidth=0.8,
    )  # fmt: skip
    figure.add_artist(box)
    statement.set_position(((MARGIN + 0.2) / PAGE_WIDTH, 1 - (top + height / 2) / total))
    statement.set_zorder(box.get_zorder() + 1)


def _height(text: Text) -> float:
    figure = text.get_figure()
    assert figure is not None
    return float(text.get_window_extent().height / figure.dpi)


def _stack(texts: list[Text], top: float, total: float) -> None:
    for text in texts:
        text.set_position((MARGIN / PAGE_WIDTH, 1 - top / total))
        top += _height(text) + 0.07


def _draw_slot(figure: Figure, slot: Slot, above: float, total: float, ids: bool | None, ellipse_scale: float) -> None:
    bottom = total - above - slot.below_top
    axes = figure.add_axes((slot.left / PAGE_WIDTH, bottom / total, slot.width / PAGE_WIDTH, slot.height / total))
    low, high = slot.panel.extent
    centre = (low + high) / 2
    reach_x, reach_y = slot.width * slot.metres_per_inch / 2, slot.height * slot.metres_per_inch / 2
    axes.set_xlim(centre[0] - reach_x, centre[0] + reach_x)
    axes.set_ylim(centre[1] - reach_y, centre[1] + reach_y)
    axes.set_aspect("equal", adjustable="box")
    axes.tick_params(labelsize=7, colors=GREY, length=2.5, width=0.6)
    axes.set_xlabel("x [m]", fontsize=7.5, color=GREY, labelpad=1.5)
    axes.set_ylabel("y [m]", fontsize=7.5, color=GREY, labelpad=1.5)
    for spine in axes.spines.values():
        spine.set_color("#9a9a9a")
        spine.set_linewidth(0.6)
    axes.set_title(slot.panel.title, fontsize=8.5, loc="left", color=INK, pad=5, parse_math=False)
    scene = slot.panel.scene
    ground = slot.panel.ground
    if not len(scene) and ground is None:
        axes.text(0.5, 0.5, "no landmarks", transform=axes.transAxes, ha="center", color=GREY, fontsize=9)
    metres_per_point = slot.metres_per_inch / 72.0
    wanted = ids if slot.panel.labelled else False
    size = sizes(scene.positions, slot.width, slot.height, metres_per_point, wanted)
    if ground is not None:
        draw_backdrop(axes, ground, size)
    draw_scene(axes, scene, size, metres_per_point, ellipse_scale)


def _checked_suffix(path: str | Path) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise ConfigError(f"picture {str(path)!r}: its name must end in one of {', '.join(SUFFIXES)}")
    return suffix


def save(figure: Figure, path: str | Path) -> None:
    """The figure's file, whole or not at all; the same picture gives the same bytes."""
    kind = _checked_suffix(path)[1:]
    dateless = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {}}[kind]
    buffer = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "mapfuse"}):
        figure.savefig(buffer, format=kind, metadata=dateless)
    write_whole(path, buffer.getvalue())
