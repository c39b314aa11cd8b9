"""Pages for a browser: one file each, without network, of maps, logs, results and batch runs."""

from .batch import batch_report
from .pages import fused_report, log_report, map_report

__all__ = ["batch_report", "fused_report", "log_report", "map_report"]
