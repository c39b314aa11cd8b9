"""The built-in recordings: simulated maps with their truth, made by `make_recordings`, found without reading them."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

#: Scene -> names of its two maps: one floor that both robots saw a part of, and two floors that share nothing.
SCENES = {
    "ground-floor": ("ground-floor-vespucci", "ground-floor-milka"),
    "two-buildings": ("north-building-vespucci", "south-building-milka"),
}


def names() -> tuple[str, ...]:
    """Names of all built-in maps, by scene.

    >>> names()[:2]
    ('ground-floor-vespucci', 'ground-floor-milka')
    """
    return tuple(name for pair in SCENES.values() for name in pair)


def path(name: str) -> Path:
    """File of the built-in map ``name``; KeyError for a name that isn't one of `names`.

    >>> path("ground-floor-milka").name
    'ground-floor-milka.map.json'
    """
    if name not in names():
        raise KeyError(name)
    return _file(f"{name}.map.json")


def truth_path(scene: str) -> Path:
    """Truth file of a scene of `SCENES`; KeyError for one that isn't there.

    >>> truth_path("ground-floor").name
    'ground-floor.truth.json'
    """
    if scene not in SCENES:
        raise KeyError(scene)
    return _file(f"{scene}.truth.json")


def _file(file_name: str) -> Path:
    return Path(str(files(__name__).joinpath(file_name)))
