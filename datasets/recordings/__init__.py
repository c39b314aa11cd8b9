"""The built-in recordings: simulated maps with their truth, found without reading them.

`make_recordings` makes the scenes, `make_paper_maps` the reconstruction of the paper's maps and the hospital pair.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

#: Scene -> names of its two maps: one floor that both robots saw a part of, and two floors that share nothing.
SCENES = {
    "ground-floor": ("ground-floor-vespucci", "ground-floor-milka"),
    "two-buildings": ("north-building-vespucci", "south-building-milka"),
}

#: The 19 maps of the paper's Table 1, **a reconstruction**: `mapfuse.datasets.paper` has the table.
PAPER_MAPS = tuple(f"D{k}" for k in range(1, 20))
#: Two robots in one hospital, from its West and from its East wing, both round the lifts (section 4.2 of the paper).
HOSPITAL = ("hospital-west-vespucci", "hospital-east-milka")
_FOLDERS = {"paper": PAPER_MAPS, "hospital": HOSPITAL}


def names() -> tuple[str, ...]:
    """Names of the maps of all `SCENES`.

    >>> names()[:2]
    ('ground-floor-vespucci', 'ground-floor-milka')
    """
    return tuple(name for pair in SCENES.values() for name in pair)


def path(name: str) -> Path:
    """File of the built-in map ``name``, of a scene, `PAPER_MAPS` or `HOSPITAL`; KeyError for another name.

    >>> path("ground-floor-milka").name
    'ground-floor-milka.map.json'
    """
    if name in names():
        return _file(f"{name}.map.json")
    for folder, held in _FOLDERS.items():
        if name in held:
            return _file(f"{folder}/{name}.map.json")
    raise KeyError(name)


def truth_path(scene: str) -> Path:
    """Truth file of a scene of `SCENES`, of "paper" or of "hospital"; KeyError for one that isn't there.

    >>> truth_path("ground-floor").name
    'ground-floor.truth.json'
    """
    if scene in _FOLDERS:
        return _file(f"{scene}/{scene}.truth.json")
    if scene not in SCENES:
        raise KeyError(scene)
    return _file(f"{scene}.truth.json")


def _file(file_name: str) -> Path:
    return Path(str(files(__name__).joinpath(file_name)))
