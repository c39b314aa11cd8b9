"""JSON as every mapfuse format needs it: what is wrong with a document, said with its place, and bounded memory.

Reading is by msgspec. A document that it refuses is read once more by the standard library, which names line and
column, and lets NaN and numbers beyond the range of a double through, so that those are named by their place.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from .errors import FileFormatError, Problem
from .files import read_whole

Value = TypeVar("Value")

#: A document whose values would take more memory than this is refused [bytes], by a count of its punctuation.
MAX_MEMORY_BYTES = 4 * 2**30
#: Objects and lists within each other, at most; what a format doesn't know may be nested that deeply.
MAX_DEPTH = 64
#: A document that breaks more rules than this is not looked at further.
MAX_PROBLEMS = 100_000
#: Longer integers can't be turned into a number by Python without risk.
MAX_DIGITS = 1000

# what an object, a list, an element and half a string cost in memory at most, as measured on CPython 3.11
_BYTES_PER_MARK = ((b"{", 240), (b"[", 72), (b",", 48), (b'"', 48))
_JSON_TYPES = {type(None), bool, int, float, str, list, tuple, dict}
_PLAIN_KEY = re.compile(r"[\w-]+")

#: Where a value stands: keys and indices from the top.
Place = tuple[str | int, ...]


def render(place: Place, prefix: str = "") -> str:
    """A place as errors show it.

    >>> render(("landmarks", 3, "links", 0, "heading")), render(("same_as", "c 1"), "sources.D7")
    ('landmarks[3].links[0].heading', 'sources.D7.same_as["c 1"]')
    """
    text = prefix
    for part in place:
        if isinstance(part, int):
            text += f"[{part}]"
        elif _PLAIN_KEY.fullmatch(part):
            text += f".{part}" if text else part
        else:
            text += f"[{_quoted(part)}]"
    return text


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=text_fault(text) is not None)


def said(value: object) -> str:
    """A value as errors show it, on one short line whatever it is."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, str):
        return _quoted(value if len(value) <= 60 else value[:57] + "...")
    if isinstance(value, float):
        return "NaN" if math.isnan(value) else ("-" * (value < 0) + "Infinity" if math.isinf(value) else repr(value))
    if isinstance(value, int):
        return repr(value) if abs(value) < 10**30 else "a number of more than 30 digits"
    if isinstance(value, Mapping):
        return "an object"
    return "a list" if isinstance(value, (list, tuple)) else f"a Python {type(value).__name__}"


class _Repeating(dict[str, Any]):
    """An object whose text has some key more than once."""

    repeated: tuple[str, ...] = ()


def _members(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) == len(pairs):
        return members
    found = _Repeating(members)
    found.repeated = tuple(key for key, times in Counter(key for key, _ in pairs).items() if times > 1)
    return found


def _integer(digits: str) -> int | float:
    return int(digits) if len(digits) <= MAX_DIGITS else math.inf


def _read_leniently(data: bytes, path: str | Path) -> Any:
    """Read by the standard library: slower, but it says where a document breaks, and keeps repeated keys."""
    try:
        text = data.decode()
        return json.loads(text, object_pairs_hook=_members, parse_int=_integer)
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        reason = f"is not UTF-8 text: byte 0x{data[error.start]:02x} at position {error.start} (line {line})"
    except json.JSONDecodeError as error:
        where = f"line {error.lineno} column {error.colno} (character {error.pos})"
        if error.pos >= len(error.doc.rstrip()) or error.msg.startswith("Unterminated string"):
            reason = f"is not complete JSON: it ends, or a string isn't closed, at {where}"
        else:
            reason = f"is not JSON: {error.msg[:1].lower()}{error.msg[1:]} at {where}"
    except RecursionError:
        reason = f"is nested too deeply; at most {MAX_DEPTH} objects and lists may stand within each other"
    raise FileFormatError(path, (Problem("", reason),)) from None


def walk(value: Any, place: Place = ()) -> Iterator[tuple[Place, Any]]:
    """Every value within ``value``, itself first, with its place; not by recursion, so depth doesn't matter."""
    yield place, value
    open_values = [(place, _parts(value))]
    while open_values:
        outer, parts = open_values[-1]
        for key, item in parts:
            where = (*outer, key)
            yield where, item
            if isinstance(item, (Mapping, list, tuple)):
                open_values.append((where, _parts(item)))
                break
        else:
            open_values.pop()


def _parts(value: Any) -> Iterator[tuple[Any, Any]]:
    if isinstance(value, Mapping):
        return iter(value.items())
    return iter(enumerate(value)) if isinstance(value, (list, tuple)) else iter(())


def text_fault(text: str) -> str | None:
    """Why a string can't stand in a file, or None: half of a surrogate pair is no character."""
    if text.isascii():
        return None
    try:
        text.encode()
    except UnicodeEncodeError:
        return "holds half of a surrogate pair, which is no character"
    return None


def json_faults(value: Any, place: Place) -> Iterator[tuple[Place, str]]:
    """What in a value that no format knows can't be written as JSON and read back the same."""
    start = len(place)
    for where, item in walk(value, place):
        if len(where) - start > MAX_DEPTH:
            yield where[: start + 1], f"is nested more than {MAX_DEPTH} deep"
            return  # it may hold itself
        if isinstance(item, str):
            if fault := text_fault(item):
                yield where, fault
        elif isinstance(item, float):
            if not math.isfinite(item):
                yield where, f"must be a finite number, not {said(item)}"
        elif isinstance(item, Mapping):
            for key in item:
                if not isinstance(key, str):
                    yield where, f"has a key that is not text: {said(key)}"
                    return
                if fault := text_fault(key):
                    yield where, f"has a key that {fault}"
        if type(item) not in _JSON_TYPES and not isinstance(item, _Repeating):
            yield where, f"is a Python {type(item).__name__}, which JSON has no form for"


def _repeats_keys(data: bytes, document: Any) -> bool:
    """Whether some object may hold a key twice: msgspec keeps the last and says nothing.

    Each member of an object has one colon, and so has its copy without repetitions; colons within strings are in both,
    unless they are written as an escape.
    """
    return b"\\u003" in data or data.count(b":") != msgspec.json.encode(document).count(b":")


def decode(data: bytes, path: str | Path) -> tuple[Any, tuple[Problem, ...]]:
    """A document, and its problems that need no knowledge of its format, each with its place.

    Those are NaN, Infinity and numbers beyond a double (left in the document as such), keys that stand twice, and
    strings with half a surrogate pair. ``path`` is named in errors only.

    Raises `FileFormatError` where there is no document to speak of: empty, cut off, not JSON, not UTF-8, nested
    beyond Python's limit, or so large that it would take more than `MAX_MEMORY_BYTES`.

    >>> decode(b'{"x": NaN}', "a.json")[1]
    (Problem(place='x', reason='must be a finite number, not NaN'),)
    """
    if not data.strip(b" \t\r\n"):
        raise FileFormatError(path, (Problem("", "is empty"),))
    if data.startswith(b"\xef\xbb\xbf"):
        raise FileFormatError(path, (Problem("", "begins with a byte order mark; save it as UTF-8 without one"),))
    needed = len(data) + sum(data.count(mark) * cost for mark, cost in _BYTES_PER_MARK)
    if needed > MAX_MEMORY_BYTES:
        reason = f"would take {needed / 2**30:.1f} GiB of memory; at most {MAX_MEMORY_BYTES / 2**30:.0f} are allowed"
        raise FileFormatError(path, (Problem("", reason),))
    try:
        document = msgspec.json.decode(data)
        if not _repeats_keys(data, document):
            return document, ()
    except (msgspec.MsgspecError, UnicodeError, RecursionError):
        pass
    document = _read_leniently(data, path)
    return document, tuple(islice(_text_problems(document), MAX_PROBLEMS))


def checked(path: str | Path, check: Callable[[Any], tuple[Value | None, Iterable[Problem]]]) -> Value:
    """What ``check`` makes of the document in a file.

    Raises `FileFormatError`, which lists every broken rule, each place once, and `InputError` where the file can't be
    read.
    """
    document, faults = decode(read_whole(path), path)
    value, found = check(document)
    said_already = {problem.place for problem in faults}
    problems = [*faults, *(problem for problem in found if problem.place not in said_already)]
    if problems or value is None:
        raise FileFormatError(path, tuple(problems))
    return value


def _text_problems(document: Any) -> Iterator[Problem]:
    for place, item in walk(document):
        if isinstance(item, _Repeating):
            yield from (Problem(render((*place, key)), "stands twice") for key in item.repeated)
        if isinstance(item, Mapping):
            faults = filter(None, map(text_fault, item))
            yield from (Problem(render(place), f"has a key that {fault}") for fault in faults)
        elif isinstance(item, str) and (fault := text_fault(item)):
            yield Problem(render(place), fault)
        elif isinstance(item, float) and not math.isfinite(item):
            yield Problem(render(place), f"must be a finite number, not {said(item)}")


#: What the documents of each family of formats are.
_FAMILIES = {
    "mapfuse.map": "recorded map",
    "mapfuse.fused": "fused map",
    "mapfuse.truth": "truth",
    "mapfuse.log": "log",
    "mapfuse.logtruth": "log's truth",
}


def format_fault(found: Any, expected: str) -> str | None:
    """What is wrong with the ``format`` that a document states, where it should be ``expected``; None: nothing.

    >>> format_fault("mapfuse.map/2", "mapfuse.map/1")
    'is "mapfuse.map/2", which is newer than this version of mapfuse reads (mapfuse.map/1)'
    """
    if found == expected:
        return None
    own, _, latest = expected.partition("/")
    if found is None:
        return f"is missing; a {_FAMILIES[own]} says {said(expected)}"
    family, _, number = found.partition("/") if isinstance(found, str) else ("", "", "")
    if family == own and number.isdecimal() and len(number) < 10 and int(number) > int(latest):
        return f"is {said(found)}, which is newer than this version of mapfuse reads ({expected})"
    if family in _FAMILIES and family != own:
        return f"is {said(found)}: a {_FAMILIES[family]}, where a {_FAMILIES[own]} ({expected}) is expected"
    return f"must be {said(expected)}, not {said(found)}"


def encode(document: Mapping[str, Any]) -> bytes:
    """A document as UTF-8 text: one line per member, and one per item of a list of objects or lists.

    The same document gives the same bytes, and every float is read back to the last bit. What `json_faults` refuses
    must not be in it: NaN would become null.

    >>> print(encode({"name": "D7", "landmarks": [{"id": "c1"}, {"id": "c2"}]}).decode(), end="")
    {
    "name": "D7",
    "landmarks": [
    {"id":"c1"},
    {"id":"c2"}
    ]
    }
    """
    text = msgspec.json.encode
    members = []
    for key, value in document.items():
        if isinstance(value, (list, tuple)) and value and isinstance(value[0], (Mapping, list)):
            content = b"[\n" + b",\n".join(map(text, value)) + b"\n]"
        else:
            content = text(value)
        members.append(text(key) + b": " + content)
    return b"{\n" + b",\n".join(members) + b"\n}\n" if members else b"{}\n"
