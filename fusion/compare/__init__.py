"""Heuristic against optimised: methods that merge two maps, measured on the same pairs.

`method` says what a method is, `methods` which there are, `run` puts pairs through them, `evaluation` is what is known
of one merge, `statistics` of many; `paper` is the table of Dedeoglu and Sukhatme with ours beside it.
"""

from .evaluation import AgainstTruth, Evaluation, evaluated
from .method import Merge, MergedLandmark, Method
from .methods import METHODS, methods
from .paper import PaperRow, paper_rows
from .run import all_pairs, compare, compare_pair
from .statistics import Interval, MethodSummary, PairedTest, paired, summaries

__all__ = [
    "METHODS",
    "AgainstTruth",
    "Evaluation",
    "Interval",
    "Merge",
    "MergedLandmark",
    "Method",
    "MethodSummary",
    "PairedTest",
    "PaperRow",
    "all_pairs",
    "compare",
    "compare_pair",
    "evaluated",
    "methods",
    "paired",
    "paper_rows",
    "summaries",
]
