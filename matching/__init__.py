"""Two maps to ranked hypotheses of the transformation between them."""

from .config import MatchingConfig
from .explain import Explanation, explain
from .hypothesis import Correspondences, Hypothesis
from .propose import propose

__all__ = ["Correspondences", "Explanation", "Hypothesis", "MatchingConfig", "explain", "propose"]
