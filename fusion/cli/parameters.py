"""All parameters as TOML: written from the config classes and their docstrings, read back with every error listed."""

from __future__ import annotations

import difflib
import json
import math
import re
import textwrap
import tomllib
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from mapfuse.datasets.errors import ConfigError
from mapfuse.fusion.config import FuseConfig

_ENTRY = re.compile(r"(?P<names>``\w+``(?:, ``\w+``)*)(?: \[(?P<unit>[^\]]+)\])?: ")


def parameter_notes(section: Any) -> dict[str, str]:
    """What a config class's docstring says of each field: ``{"tolerance_m": "tolerance_m [m]: ..."}``.

    Fields explained together share one text.

    >>> from mapfuse.fusion.config import DecisionConfig
    >>> parameter_notes(DecisionConfig)["overlap_prior"]
    'overlap_prior: probability, before looking, that two maps overlap.'
    """
    text = " ".join((section.__doc__ or "").split())
    known = {f.name for f in fields(section)}
    entries = [e for e in _ENTRY.finditer(text) if known.issuperset(_names(e))]
    notes = {}
    for k, entry in enumerate(entries):
        end = entries[k + 1].start() if k + 1 < len(entries) else len(text)
        names = _names(entry)
        unit = f" [{entry['unit']}]" if entry["unit"] else ""
        meaning = text[entry.end() : end].strip().replace("``", "`")
        notes.update(dict.fromkeys(names, f"{', '.join(names)}{unit}: {meaning}"))
    return notes


def _names(entry: re.Match[str]) -> list[str]:
    return re.findall(r"\w+", entry["names"])


def config_as_toml(config: FuseConfig) -> str:
    """All parameters with values, units and meaning, as TOML that `config_from_toml` reads back."""
    lines = [
        "# The parameters of `mapfuse fuse`. Change what you need and give the file to --config;",
        "# what a file leaves out keeps its default.",
        "",
    ]
    for section in fields(config):
        values = getattr(config, section.name)
        lines += [*_comment((values.__doc__ or "").strip().partition("\n")[0]), f"[{section.name}]"]
        notes = parameter_notes(type(values))
        said = ""
        for parameter in fields(values):
            note = notes.get(parameter.name, "")
            if note and note != said:
                lines += _comment(note)
            said = note
            lines.append(f"{parameter.name} = {_toml(getattr(values, parameter.name))}")
        lines.append("")
    return "\n".join(lines)


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, 100, initial_indent="# ", subsequent_indent="#   ", break_long_words=False)


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, int | float):
        return repr(value)
    raise TypeError(f"no TOML for a parameter of type {type(value).__name__}")


def config_from_toml(path: Path) -> FuseConfig:
    """Read parameters; raises `ConfigError` naming the file and every unknown key and wrong type in it."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is not TOML: {error}") from error
    problems: list[str] = []
    values = _arguments(FuseConfig, table, "", problems)
    if problems:
        raise ConfigError(f"{path}:\n" + "\n".join(f"  {problem}" for problem in problems))
    sections = get_type_hints(FuseConfig)
    try:
        return FuseConfig(**{name: sections[name](**given) for name, given in values.items()})
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _arguments(cls: Any, table: dict[str, Any], place: str, problems: list[str]) -> dict[str, Any]:
    hints = get_type_hints(cls)
    known = [f.name for f in fields(cls)]
    values: dict[str, Any] = {}
    for key, value in table.items():
        here = f"{place}{key}"
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            problems.append(f"{here}: is no parameter" + (f"; did you mean {place}{near[0]}?" if near else ""))
        elif is_dataclass(hints[key]):
            if isinstance(value, dict):
                values[key] = _arguments(hints[key], value, f"{here}.", problems)
            else:
                problems.append(f"{here}: is a section, written [{here}]")
        elif reason := _mismatch(hints[key], value):
            problems.append(f"{here}: {reason}")
        else:
            values[key] = float(value) if hints[key] is float else value
    return values


def _mismatch(hint: Any, value: Any) -> str | None:
    """Why a value is not of a parameter's type, or None where it is."""
    if get_origin(hint) is Literal:
        allowed = get_args(hint)
        return None if value in allowed else f"must be one of {', '.join(map(repr, allowed))}, not {value!r}"
    if hint is float:
        good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        return None if good else f"must be a finite number, not {value!r}"
    good = isinstance(value, hint) and (hint is bool or not isinstance(value, bool))
    return None if good else f"must be of type {hint.__name__}, not {value!r}"
