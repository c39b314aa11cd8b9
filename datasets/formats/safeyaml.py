"""YAML as foreign files have it: plain values only, in bounded memory and time, whatever the file does.

Tags that would make Python objects are refused. Anchors are honoured (files written by programs have them), but what
they expand to is counted before anything walks over it, and one that contains itself is refused. Dates stay text, as
do keys, and ``<<`` is a key like any other. A key that stands twice in one mapping is refused: either value might be
meant.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import FileFormatError, Problem
from .heads import read_text

#: Larger files are refused [bytes].
MAX_YAML_BYTES = 2**24
#: Values of a document, aliases expanded, at most.
MAX_VALUES = 500_000
#: Lists and mappings within each other, at most.
MAX_DEPTH = 64

_PLAIN = tuple(f"tag:yaml.org,2002:{name}" for name in ("null", "bool", "int", "float"))
_TEXT = "tag:yaml.org,2002:str"
_ALLOWED = frozenset((*_PLAIN, *(f"tag:yaml.org,2002:{name}" for name in ("str", "seq", "map"))))


def load(path: Path) -> Any:
    """The one document of a YAML file, as dicts, lists, str, int, float, bool and None.

    Raises `InputError` where it can't be read, `FileFormatError` where it is no such YAML.
    """
    return loads(read_text(path, MAX_YAML_BYTES), path)


def loads(text: str, path: Path) -> Any:
    """As `load`, of text; ``path`` is what errors name."""
    import yaml

    loader = _loader(yaml)
    try:
        _check_depth(yaml, loader, text)
        node = yaml.compose(text, Loader=loader)
        if node is None:
            raise _RefusedError("is empty")
        _check_size(yaml, node)
        return yaml.constructor.SafeConstructor().construct_document(node)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1} column {mark.column + 1}" if mark is not None else ""
        reason = f"is no YAML that can be read: {error.problem or error.context}"
        raise FileFormatError(path, (Problem(where, reason),)) from None
    except yaml.YAMLError as error:
        raise FileFormatError(path, (Problem("", f"is no YAML: {' '.join(str(error).split())[:200]}"),)) from None
    except _RefusedError as error:
        raise FileFormatError(path, (Problem(error.place, error.reason),)) from None
    except (ValueError, KeyError, IndexError, OverflowError) as error:
        # the text says it is a number or a truth value, and it is none
        raise FileFormatError(path, (Problem("", f"holds a value that can't be read: {str(error)[:200]}"),)) from None


class _RefusedError(Exception):
    """What a document is refused for, and where."""

    def __init__(self, reason: str, node: Any = None) -> None:
        self.reason = reason
        mark = getattr(node, "start_mark", None)
        self.place = "" if mark is None else f"line {mark.line + 1}"
        super().__init__(reason)


def _loader(yaml: Any) -> Any:
    """A loader that knows plain values only: no dates, no merge keys, no ``=``."""

    class Plain(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
        pass

    Plain.yaml_implicit_resolvers = {
        first: kept
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
        if (kept := [(tag, pattern) for tag, pattern in resolvers if tag in _PLAIN])
    }
    return Plain


def _check_depth(yaml: Any, loader: Any, text: str) -> None:
    # the composer calls itself for every level, the parser of events doesn't
    depth = 0
    for count, event in enumerate(yaml.parse(text, Loader=loader)):
        if isinstance(event, (yaml.MappingStartEvent, yaml.SequenceStartEvent)):
            depth += 1
            if depth > MAX_DEPTH:
                raise _RefusedError(f"is nested more than {MAX_DEPTH} levels deep", event)
        elif isinstance(event, (yaml.MappingEndEvent, yaml.SequenceEndEvent)):
            depth -= 1
        if count > 2 * MAX_VALUES:
            raise _RefusedError(f"holds more than {MAX_VALUES:,} values", event)


def _check_size(yaml: Any, root: Any) -> None:
    """Refuse a document that contains itself, expands beyond `MAX_VALUES`, repeats a key, or has tags of its own."""
    size: dict[int, int] = {}
    open_: set[int] = set()
    stack = [(root, False)]
    while stack:
        node, done = stack.pop()
        key = id(node)
        if done:
            open_.discard(key)
            size[key] = 1 + sum(size[id(child)] for child in _children(yaml, node))
            if size[key] > MAX_VALUES:
                raise _RefusedError(f"holds more than {MAX_VALUES:,} values where its aliases are expanded", node)
        elif key in open_:
            raise _RefusedError("has an alias for something that it stands in itself", node)
        elif key not in size:
            if node.tag not in _ALLOWED:
                raise _RefusedError(f"has the tag {node.tag[:60]!r}, which is no plain value", node)
            _check_keys(yaml, node)
            open_.add(key)
            stack.append((node, True))
            stack += [(child, False) for child in _children(yaml, node)]


def _children(yaml: Any, node: Any) -> list[Any]:
    if isinstance(node, yaml.MappingNode):
        return [part for pair in node.value for part in pair]
    return list(node.value) if isinstance(node, yaml.SequenceNode) else []


def _check_keys(yaml: Any, node: Any) -> None:
    if not isinstance(node, yaml.MappingNode):
        return
    seen: set[str] = set()
    for key, _ in node.value:
        if not isinstance(key, yaml.ScalarNode):
            raise _RefusedError("has a key that is no plain value", key)
        if key.value in seen:
            raise _RefusedError(f"has the key {key.value[:60]!r} twice", key)
        seen.add(key.value)
        key.tag = _TEXT
