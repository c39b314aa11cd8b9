"""Pages for a browser: one file each, without network, of maps, logs, results, batch runs and comparisons."""

from .batch import batch_report
from .compare import compare_report
from .pages import fused_report, log_report, map_report

__all__ = ["batch_report", "compare_report", "fused_report", "log_report", "map_report"]
