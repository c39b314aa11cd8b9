"""Pictures of maps and results; matplotlib is imported only when one is drawn."""

from .charts import charts, plot_ellipses
from .picture import draw_building, draw_fused, draw_log, draw_map, draw_pair
from .plots import plot_building, plot_fused, plot_log, plot_map, plot_pair

__all__ = [
    "charts",
    "draw_building",
    "draw_fused",
    "draw_log",
    "draw_map",
    "draw_pair",
    "plot_building",
    "plot_ellipses",
    "plot_fused",
    "plot_log",
    "plot_map",
    "plot_pair",
]
