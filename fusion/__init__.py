"""Solve, judge, merge, show: from several recorded maps to one with its uncertainty.

The names below are loaded when they are first used: importing ``mapfuse.fusion`` alone takes no time, so that
the command line answers ``--help`` without loading numpy and GTSAM.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .config import FuseConfig
    from .fusedfile import read_fused, write_fused
    from .groups import fuse
    from .known import KnownTransform, as_reference
    from .online.fuser import OnlineFuser
    from .result import FusedMap

__all__ = [
    "FuseConfig",
    "FusedMap",
    "KnownTransform",
    "OnlineFuser",
    "as_reference",
    "fuse",
    "read_fused",
    "write_fused",
]

_MODULE_FROM_NAME = {
    "FuseConfig": "config",
    "FusedMap": "result",
    "KnownTransform": "known",
    "OnlineFuser": "online.fuser",
    "as_reference": "known",
    "fuse": "groups",
    "read_fused": "fusedfile",
    "write_fused": "fusedfile",
}


def __getattr__(name: str) -> object:
    if name not in _MODULE_FROM_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_MODULE_FROM_NAME[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
