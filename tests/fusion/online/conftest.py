"""A corridor that a half turn maps onto itself, as a robot has it in a frame of its own; messages of maps."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest

from mapfuse.datasets import LandmarkMap
from mapfuse.fusion.online import Correction, LandmarkSeen, Message

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "benchmarks"))
try:
    from online_corridor import HALF, WHOLE, corridor
finally:
    sys.path.pop(0)


def one_by_one(recorded: LandmarkMap, ids: Iterable[str] | None = None, first: int = 0) -> list[Message]:
    """Its landmarks, one message each."""
    wanted = recorded.ids if ids is None else tuple(ids)
    return [
        LandmarkSeen(robot=recorded.name, sequence=first + k, t=float(first + k), landmark=recorded[name])
        for k, name in enumerate(wanted)
    ]


def as_one(recorded: LandmarkMap, sequence: int = 0, t: float = 0.0, frame: int = 0) -> Correction:
    """A map as one message."""
    return Correction(robot=recorded.name, sequence=sequence, t=t, frame=frame, map=recorded)


@pytest.fixture
def frames() -> tuple[np.ndarray, np.ndarray]:
    """Where the two robots' frames are in the world."""
    return np.array([3.0, -4.0, 0.7]), np.array([-8.0, 5.0, -2.1])


@pytest.fixture
def two(frames: tuple[np.ndarray, np.ndarray]) -> Callable[[Sequence[tuple[float, str]]], list[LandmarkMap]]:
    """Both robots' maps of some places."""

    def made(places: Sequence[tuple[float, str]]) -> list[LandmarkMap]:
        rng = np.random.default_rng(5)
        return [corridor(name, places, frame, rng) for name, frame in zip("AB", frames, strict=True)]

    return made


@pytest.fixture
def half() -> Sequence[tuple[float, str]]:
    """One half of the corridor."""
    return HALF


@pytest.fixture
def both_ends() -> Sequence[tuple[float, str]]:
    """All of it."""
    return WHOLE


@pytest.fixture
def landmarks_of() -> Callable[..., list[Message]]:
    """A map's landmarks, one message each."""
    return one_by_one


@pytest.fixture
def whole() -> Callable[..., Correction]:
    """A map as one message."""
    return as_one
