"""Pictures of one map, of a log, of drives through a building, and of what a fusion answered.

Of a fusion: both maps, then the merged map, or why there is none.

The merged map shows its landmarks with 95 % ellipses, common ones circled as in Figs. 4 and 5 of Dedeoglu and
Sukhatme (2000), doubtful ones hollow. What wasn't merged is never drawn as if it were.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from mapfuse.datasets.maps import LandmarkMap

from ..result import FusedMap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mapfuse.datasets.logs import LogHeader
    from mapfuse.datasets.simulation.building import Building
    from mapfuse.datasets.truth import Truth

    from .log_page import Drive


def draw_fused(
    fused: FusedMap,
    path: str | Path | None = None,
    *,
    ids: bool | None = None,
    ellipse_scale: float = 1.0,
    dpi: float = 150.0,
) -> Figure:
    """A page that shows what a fusion answered; saved to ``path`` (.png, .svg or .pdf) where one is given.

    Each embedded map in its own frame; then per merged group the merged map, or for an ambiguous pair the best three
    rivals side by side, each as map 2 laid onto map 1, or for maps without overlap a statement. Decision and
    probability are the title, T12 with standard deviations stands below it, the reasons below the picture.
    ``ids``: whether landmarks are labelled; by itself where they are few. ``ellipse_scale``: ellipses drawn that
    much larger than they are, which the legend then says.

    Raises ConfigError for another suffix; OSError where the file can't be written, which then isn't there in part.

    >>> from mapfuse.fusion.result import FusedMap, PairResult
    >>> pair = PairResult(("A", "B"), "no_overlap", 0.0, 1.0, (), (), "no landmark kinds in common")
    >>> fused = FusedMap("no_overlap", 1.0, ("A", "B"), (("A",), ("B",)), {}, (pair,), (), {})
    >>> draw_fused(fused).get_suptitle()
    'A + B: no overlap, probability of no overlap > 0.9999'
    """
    from .fused_page import fused_page
    from .page import draw_page

    with _any_script():
        return draw_page(fused_page(fused), path, ids=ids, ellipse_scale=ellipse_scale, dpi=dpi)


def draw_pair(
    fused: FusedMap,
    maps: tuple[str, str] | None = None,
    path: str | Path | None = None,
    *,
    ellipse_scale: float = 1.0,
    dpi: float = 150.0,
) -> Figure:
    """A page that shows one pair of a result: both maps, and the best placements of the second on the first.

    ``maps``: the pair's names in either order, by default those of the first pair. Raises ConfigError where there is
    no such pair; other parameters, errors and file as for `draw_fused`.
    """
    from .fused_page import pair_page
    from .page import draw_page
    from .plots import pair_of

    with _any_script():
        page = pair_page(fused, pair_of(fused, maps))
        return draw_page(page, path, ids=None, ellipse_scale=ellipse_scale, dpi=dpi)


def draw_map(
    map_: LandmarkMap,
    path: str | Path | None = None,
    *,
    ids: bool | None = None,
    ellipse_scale: float = 1.0,
    dpi: float = 150.0,
) -> Figure:
    """A page that shows one map in its own frame; parameters, errors and file as for `draw_fused`.

    >>> from mapfuse.datasets.maps import Landmark, LandmarkMap
    >>> draw_map(LandmarkMap("D1", (Landmark("c1", "corner", 0.0, 0.0),))).get_suptitle()
    'D1: 1 landmark'
    """
    from .fused_page import map_page
    from .page import draw_page

    with _any_script():
        return draw_page(map_page(map_), path, ids=ids, ellipse_scale=ellipse_scale, dpi=dpi)


def draw_log(
    header: LogHeader,
    drive: Drive,
    path: str | Path | None = None,
    *,
    simulated: bool = False,
    ids: bool | None = None,
    ellipse_scale: float = 1.0,
    dpi: float = 150.0,
) -> Figure:
    """A page that shows one drive: path by odometry, detections, scan points, and truth and map where they are known.

    All in the frame of the robot's start, or in the world where there is a truth. Other parameters, errors and file
    as for `draw_fused`.
    """
    from .log_page import log_page
    from .page import draw_page

    with _any_script():
        page = log_page(header, drive, simulated=simulated)
        return draw_page(page, path, ids=ids, ellipse_scale=ellipse_scale, dpi=dpi)


def draw_building(
    building: Building,
    drives: Sequence[Drive] = (),
    path: str | Path | None = None,
    *,
    truth: Truth | None = None,
    title: str | None = None,
    ids: bool | None = None,
    ellipse_scale: float = 1.0,
    dpi: float = 150.0,
) -> Figure:
    """A page that shows simulated drives through a building, each in a panel of its own, all in the world.

    Building, true path, path by odometry, detections, and on top the map; ``truth`` is that of the maps. Other
    parameters, errors and file as for `draw_fused`.
    """
    from .log_page import building_page
    from .page import draw_page

    with _any_script():
        page = building_page(building, drives, truth, title)
        return draw_page(page, path, ids=ids, ellipse_scale=ellipse_scale, dpi=dpi)


@contextmanager
def _any_script() -> Iterator[None]:
    """Names may be in scripts that the font lacks; they are drawn as boxes, which is no reason for warnings."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")
        yield
