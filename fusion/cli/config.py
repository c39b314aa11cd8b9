"""``mapfuse config``: all parameters with their defaults, units and meaning."""

from __future__ import annotations

from .console import say


def config() -> None:
    """Print all parameters with defaults, units and meaning, as a TOML file that `fuse --config` reads."""
    from mapfuse.fusion.config import FuseConfig

    from .parameters import config_as_toml

    say(config_as_toml(FuseConfig()).rstrip())
