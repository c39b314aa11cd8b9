"""What an event changed: small values that `Mapper.update` returns, for whoever follows the map as it grows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True, slots=True)
class LandmarkAdded:
    """A landmark that wasn't in the map."""

    id: str


@dataclass(frozen=True, slots=True)
class LandmarkUpdated:
    """A landmark was seen again."""

    id: str


@dataclass(frozen=True, slots=True)
class LandmarkRemoved:
    """A landmark turned out to be another one, ``joined_to``."""

    id: str
    joined_to: str


@dataclass(frozen=True, slots=True)
class LoopClosed:
    """Landmarks met again after a long way: (newer, older) ids, with the log-odds [nats] for it."""

    pairs: tuple[tuple[str, str], ...]
    log_odds: float


@dataclass(frozen=True, slots=True)
class Corrected:
    """All of the map moved a little: it was computed anew from all that is remembered; the robot by ``shift`` [m]."""

    shift: float


Change: TypeAlias = LandmarkAdded | LandmarkUpdated | LandmarkRemoved | LoopClosed | Corrected
