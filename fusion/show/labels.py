"""Text in pictures: ids beside landmarks without covering others, lines wrapped to a measured width."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from .scene import Scene
from .style import GREY, Sizes
from .words import drawable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text

Array = NDArray[np.float64]

_DIRECTIONS = np.deg2rad(np.array([45, 135, -45, -135, 0, 180, 90, -90], dtype=float))
#: Keeps an id readable where it lies on a wall or an ellipse.
_HALO = withStroke(linewidth=1.6, foreground="white")
_CHARACTER_WIDTH, _LINE_HEIGHT = 0.62, 1.05  # of the font size


def place_labels(axes: Axes, scene: Scene, size: Sizes, metres_per_point: float) -> None:
    """Each id on the side of its landmark where it covers least; corners first, since corridors go straight out."""
    assert size.label is not None
    at = scene.positions / metres_per_point
    obstacles = np.concatenate([at, *_along_links(at, scene)])
    weights = np.concatenate([np.full(len(at), 3.0), np.full(len(obstacles) - len(at), 0.5)])
    low, high = (np.array(limits) / metres_per_point for limits in zip(axes.get_xlim(), axes.get_ylim(), strict=True))
    for k, identifier in enumerate(scene.ids):
        extent = np.array([_CHARACTER_WIDTH * len(identifier), _LINE_HEIGHT]) * size.label
        reach = (size.ring if scene.common[k] else size.marker) / 2 + 0.35 * size.marker
        ways = np.stack([np.cos(_DIRECTIONS), np.sin(_DIRECTIONS)], axis=1)
        centres = at[k] + ways * reach + np.sign(ways.round(6)) * extent / 2
        covered = np.abs(obstacles[None] - centres[:, None]) < extent / 2 + size.marker / 3
        outside = ((centres - extent / 2 < low) | (centres + extent / 2 > high)).any(axis=1)
        cost = (covered.all(axis=2) * weights).sum(axis=1) + 10.0 * outside
        centre = centres[int(np.argmin(cost))]
        obstacles = np.concatenate([obstacles, centre + np.array([[-0.35, 0.0], [0.0, 0.0], [0.35, 0.0]]) * extent])
        weights = np.concatenate([weights, np.full(3, 4.0)])
        axes.text(
            float(centre[0] * metres_per_point),
            float(centre[1] * metres_per_point),
            drawable(identifier),
            fontsize=size.label,
            color=GREY,
            ha="center",
            va="center_baseline",
            zorder=8,
            parse_math=False,
            clip_on=True,
            path_effects=[_HALO],
        )


def _along_links(at: Array, scene: Scene) -> list[Array]:
    """Points every few points of length along each link."""
    found = []
    for a, b in scene.links:
        steps = max(2, int(np.hypot(*(at[b] - at[a])) / 4.0))
        found.append(at[a] + np.linspace(0.0, 1.0, steps)[1:-1, None] * (at[b] - at[a]))
    return found


def wrapped(
    figure: Figure, text: str, fontsize: float, width_in: float, max_lines: int = 12, weight: str = "normal"
) -> str:
    """The text in lines that are at most that wide [inches] as drawn; words longer than a line are broken.

    What doesn't fit into ``max_lines`` ends in an ellipsis.
    """
    probe = figure.text(0, 0, "", fontsize=fontsize, weight=weight, parse_math=False)
    text = drawable(text)
    try:
        lines = [line for part in text.splitlines() or [""] for line in _fitting(probe, figure, part, width_in)]
    finally:
        probe.remove()
    if len(lines) > max_lines:
        lines = [*lines[: max_lines - 1], lines[max_lines - 1][:-2].rstrip() + " …"]
    return "\n".join(lines)


def _fitting(probe: Text, figure: Figure, text: str, width_in: float) -> list[str]:
    characters = max(8, len(text))
    while True:
        lines = textwrap.wrap(text, characters) or [""]
        probe.set_text("\n".join(lines))
        drawn = probe.get_window_extent().width / figure.dpi
        if drawn <= width_in or characters <= 8:
            return lines
        characters = max(8, min(characters - 1, int(characters * width_in / drawn)))
