"""Charts of numbers in the look of the maps, and ellipses of covariances drawn into them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .style import INK

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import EllipseCollection
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

#: Size of text [points]; width of a page [inches].
TEXT, WIDTH = 8.5, 8.0


def charts(
    columns: int = 1, rows: int = 1, *, height: float = 3.0, width: float = WIDTH, dpi: float = 80.0
) -> tuple[Figure, list[Axes]]:
    """A figure ``width`` by ``height`` per row [inches], and its axes row by row, to be drawn into.

    >>> figure, axes = charts(2, height=2.5)
    >>> len(axes), figure.get_size_inches().tolist()
    (2, [8.0, 2.5])
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height * rows), dpi=dpi, layout="constrained")
    axes = list(np.ravel(figure.subplots(rows, columns, squeeze=False)))
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=TEXT - 0.5, color=INK, labelcolor=INK)
        for text in (ax.xaxis.label, ax.yaxis.label, ax.title):
            text.set_fontsize(TEXT)
        ax.grid(color="#00000012", linewidth=0.6)
        ax.set_axisbelow(True)
    return figure, axes


def plot_ellipses(
    ax: Axes,
    positions: ArrayLike,
    covariances: ArrayLike,
    *,
    colour: str = INK,
    label: str | None = None,
    linestyle: str = "-",
    linewidth: float = 1.2,
    fill: float = 0.0,
    scale: float = 1.0,
) -> EllipseCollection:
    """Draws 95 % ellipses of covariances (n, 2, 2) about positions (n, 2), or of one (2, 2) about (2,), both in the
    units of the axes; ``scale`` times larger than they are, ``fill`` their opacity inside.

    >>> figure, (ax,) = charts()
    >>> len(plot_ellipses(ax, [0.0, 0.0], [[0.04, 0.0], [0.0, 0.01]]).get_offsets())
    1
    """
    from matplotlib.collections import EllipseCollection
    from matplotlib.colors import to_rgba

    from .panel import ellipse_axes

    at = np.asarray(positions, dtype=float).reshape(-1, 2)
    width, height, angle = ellipse_axes(np.asarray(covariances, dtype=float).reshape(-1, 2, 2))
    ellipses = EllipseCollection(
        scale * width,
        scale * height,
        angle,
        units="xy",
        offsets=at,
        offset_transform=ax.transData,
        facecolors=[to_rgba(colour, fill)],
        edgecolors=[to_rgba(colour)],
        linewidths=linewidth,
        linestyles=linestyle,
    )
    ax.add_collection(ellipses, autolim=False)
    reach = scale * np.maximum(width, height)[:, None] / 2
    ax.update_datalim(np.vstack([at - reach, at + reach]))
    ax.autoscale_view()
    if label is not None:
        ax.plot([], [], color=colour, linestyle=linestyle, linewidth=linewidth, label=label)
    return ellipses
