"""A small floor without symmetry, recorded twice without errors, and what is really so."""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link, Noise
from mapfuse.datasets.truth import Truth

#: A loop with a spur; the doors are where no rotation brings them onto each other.
PLACES = {
    "a": ("corner", 0.0, 0.0),
    "b": ("corner", 14.0, 0.0),
    "c": ("corner", 14.0, 9.0),
    "d": ("corner", 0.0, 9.0),
    "e": ("junction", 9.0, 0.0),
    "f": ("end", 9.0, -6.0),
    "g": ("door", 4.0, 0.0),
    "h": ("door", 14.0, 3.0),
    "i": ("door", 11.0, 9.0),
    "j": ("door", 0.0, 7.0),
    "x": ("door", 2.0, 9.0),
}
WAYS = ("ag", "ge", "eb", "ef", "bh", "hc", "ci", "id", "dj", "ja")
#: Where map's frames are; ``x`` isn't there, but map 1 has it on its way from i to d.
FRAMES = {"one": np.array([3.0, -2.0, 0.4]), "two": np.array([-5.0, 8.0, -2.1]), "three": np.array([1.0, 1.0, 1.0])}
NOISE = Noise(
    distance_sigma_per_metre=0.01,
    distance_sigma_floor=0.02,
    heading_sigma=0.02,
    position_sigma=0.05,
    detection_rate=0.95,
    false_alarm_rate=0.05,
    door_detection_rate=0.95,
    door_false_alarm_rate=0.2,
)


def recorded(name: str, seen: str) -> LandmarkMap:
    """The places ``seen`` as a robot whose frame lies at ``FRAMES[name]`` records them; ids tell nothing."""
    T = se2.inverse(FRAMES[name])
    at = {k: se2.transform(T, PLACES[k][1:]) for k in PLACES}
    drawn = (*WAYS, "ix", "xd") if "x" in seen else WAYS
    landmarks = []
    for k in seen:
        ways = [way.replace(k, "") for way in drawn if k in way and not ("x" in seen and way == "id")]
        towards = {o: float(np.arctan2(*(at[o] - at[k])[::-1])) for o in ways}
        links = [
            Link(
                "open",
                towards[o],
                connected_to_id=f"{name}-{o}" if o in seen else None,
                distance=float(np.hypot(*(at[o] - at[k]))) if o in seen else None,
            )
            for o in ways
        ]
        first = next(iter(towards.values()))
        for quarter in np.arange(4) * np.pi / 2:
            if all(abs(se2.wrap(first + quarter - heading)) > 0.5 for heading in towards.values()):
                links.append(Link("blocked", float(se2.wrap(first + quarter))))
        x, y = at[k].tolist()
        landmarks.append(Landmark(f"{name}-{k}", PLACES[k][0], x, y, links=tuple(links)))
    return LandmarkMap(name, tuple(landmarks), noise=NOISE)


@pytest.fixture
def pair() -> tuple[LandmarkMap, LandmarkMap, Truth]:
    """Two maps of most of the floor, each with a door less; map 1 has one that isn't there, where map 2 drove."""
    one = recorded("one", "abcdefghix")
    two = recorded("two", "abcdeghij")
    landmarks = {m.name: {i: None if i.endswith("x") else i.rpartition("-")[2] for i in m.ids} for m in (one, two)}
    return (
        one,
        two,
        Truth(
            {m.name: FRAMES[m.name] for m in (one, two)},
            landmarks,
            {k: np.array(v[1:]) for k, v in PLACES.items() if k != "x"},
        ),
    )


@pytest.fixture
def third() -> LandmarkMap:
    """A map of a part of the floor."""
    return recorded("three", "abeghc")
