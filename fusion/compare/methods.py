"""The methods that are compared, the paper's first: all others are measured against it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from mapfuse.datasets.errors import ConfigError

from ..config import FuseConfig
from .clouds import merge_by_icp, merge_by_ransac, missing_open3d
from .heuristic import merge_by_heuristic
from .kalman import merge_by_kalman
from .method import Method
from .optimised import merge_optimised

HEURISTIC, OPTIMISED = "heuristic", "optimised"
#: Names of all methods, in the order in which they are shown.
METHODS = (HEURISTIC, "kalman", "ransac", "icp", OPTIMISED)


def methods(names: Sequence[str] = METHODS, config: FuseConfig | None = None) -> tuple[Method, ...]:
    """The methods of these names, under one set of parameters; those that can't run here say why.

    Raises `ConfigError` for a name that no method has.

    >>> [method.title for method in methods(("heuristic", "optimised"))]
    ['heuristic (paper mode)', 'optimised']
    """
    config = config or FuseConfig()
    matching, open3d = config.matching, missing_open3d()
    known = {
        method.name: method
        for method in (
            Method(HEURISTIC, "heuristic (paper mode)", partial(merge_by_heuristic, config=matching)),
            Method("kalman", "heuristic + Kalman filter", partial(merge_by_kalman, config=config)),
            Method("ransac", "Open3D RANSAC", partial(merge_by_ransac, config=matching), open3d),
            Method("icp", "Open3D RANSAC + ICP", partial(merge_by_icp, config=matching), open3d),
            Method(OPTIMISED, "optimised", partial(merge_optimised, config=config)),
        )
    }
    if unknown := [name for name in names if name not in known]:
        raise ConfigError(f"there is no method {unknown[0]!r}; there are {', '.join(METHODS)}")
    return tuple(known[name] for name in names)
