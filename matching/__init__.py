"""Two maps to ranked hypotheses of the transformation between them."""

from .config import MatchingConfig
from .hypothesis import Hypothesis
from .propose import propose

__all__ = ["Hypothesis", "MatchingConfig", "propose"]
