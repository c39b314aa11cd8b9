"""A corridor that a half turn maps onto itself, as a robot has it in a frame of its own; messages of maps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import pytest

from mapfuse.datasets import Landmark, LandmarkMap, Link, se2
from mapfuse.fusion.online import Correction, LandmarkSeen, Message

ARMS = {
    "end": ((0, "open"), (90, "blocked"), (180, "blocked"), (-90, "blocked")),
    "end2": ((180, "open"), (90, "blocked"), (0, "blocked"), (-90, "blocked")),
    "junction+": ((0, "open"), (180, "open"), (90, "open"), (-90, "blocked")),
    "junction-": ((0, "open"), (180, "open"), (-90, "open"), (90, "blocked")),
    "door+": ((0, "open"), (180, "open"), (90, "door"), (-90, "blocked")),
    "door-": ((0, "open"), (180, "open"), (-90, "door"), (90, "blocked")),
}
TYPES = {"end": "corner", "end2": "corner", "junction+": "junction", "junction-": "junction"}
#: Half of the corridor, from its one end to the middle; the other half is the same, turned.
HALF = ((-36.0, "end"), (-30.0, "door+"), (-25.0, "door-"), (-18.0, "door+"), (-10.0, "junction+"), (-4.0, "door-"))
TURNED = {"door+": "door-", "door-": "door+", "junction+": "junction-", "end": "end2"}
WHOLE = (*HALF, *((-x, TURNED[kind]) for x, kind in reversed(HALF)))


def corridor(
    name: str, places: Sequence[tuple[float, str]], frame: np.ndarray, rng: np.random.Generator
) -> LandmarkMap:
    """Places (along the corridor, what is there) as a robot maps them whose frame is at ``frame`` in the world."""
    order = sorted(range(len(places)), key=lambda k: places[k][0])
    found = []
    for k, (x, kind) in enumerate(places):
        rank = order.index(k)
        xy = se2.transform(se2.inverse(frame), np.array([x, 0.0])) + rng.normal(0, 0.1, 2)
        links = []
        for degrees, type_ in ARMS[kind]:
            heading = float(se2.wrap(np.deg2rad(degrees) - frame[2] + rng.normal(0, 0.02)))
            far = order[rank + 1] if degrees == 0 and rank + 1 < len(places) else None
            far = order[rank - 1] if degrees == 180 and rank else far
            if far is None or type_ != "open":
                links.append(Link(type_, heading))
            else:
                d = abs(places[far][0] - x)
                links.append(Link(type_, heading, None, f"l{far}", d + rng.normal(0, 0.05 + 0.01 * d), 1))
        found.append(Landmark(f"l{k}", TYPES.get(kind, "door"), float(xy[0]), float(xy[1]), links=tuple(links)))
    return LandmarkMap(name, tuple(found), name)


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
