"""Pictures of maps and results; matplotlib is imported only when one is drawn."""

from .picture import draw_building, draw_fused, draw_log, draw_map

__all__ = ["draw_building", "draw_fused", "draw_log", "draw_map"]
