"""Occupancy grids of ROS' map_server (YAML and picture): landmarks are extracted from them.

The frame is the grid's map frame, metres, x to the right and y up in the picture as ``origin`` turns it. What is read
of the files is said in `extract.gridfile`, how landmarks are found in docs/extraction.md. A grid states no noise: the
map's is what such an extraction was measured to be.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..errors import ConfigError
from .heads import plain_name
from .reading import Reading

_IMAGE, _RESOLUTION = (re.compile(rb"(?m)^\s*" + key + rb"\s*:") for key in (b"image", b"resolution"))


def detect(path: Path, head: bytes) -> bool:
    """YAML that names a picture and a resolution, or a PGM picture."""
    name = plain_name(path)
    if name.endswith((".yaml", ".yml")):
        return _IMAGE.search(head) is not None and _RESOLUTION.search(head) is not None
    return name.endswith(".pgm") and head[:2] in (b"P2", b"P5")


def read(path: Path, **options: Any) -> Reading:
    """The landmarks of the grid; ``options`` are fields of `ExtractConfig`."""
    from ..extract import ExtractConfig, extract_landmarks, read_grid

    found = read_grid(path)
    return Reading((extract_landmarks(found.grid, _config(ExtractConfig(), options)),), found.remarks)


def _config(config: Any, options: dict[str, Any]) -> Any:
    changes = {}
    for name, value in options.items():
        try:
            changes[name] = type(getattr(config, name))(value)
        except ValueError:
            raise ConfigError(f"option {name} must be a number, not {value!r}") from None
    return replace(config, **changes)
