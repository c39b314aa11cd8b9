"""Maps that are merged while they grow: `OnlineFuser`, what goes into it, and what comes out."""

from __future__ import annotations

from .config import OnlineConfig
from .events import Event, Merged, Proposed, Refuted, Revised, Unmerged, event_to_dict, write_events
from .fuser import OnlineFuser
from .messages import Correction, LandmarkLink, LandmarkSeen, Message, Placed, Removed

__all__ = [
    "Correction",
    "Event",
    "LandmarkLink",
    "LandmarkSeen",
    "Merged",
    "Message",
    "OnlineConfig",
    "OnlineFuser",
    "Placed",
    "Proposed",
    "Refuted",
    "Removed",
    "Revised",
    "Unmerged",
    "event_to_dict",
    "write_events",
]
