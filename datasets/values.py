"""What frozen values that hold arrays need: read-only copies and equality field by field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def frozen_array(values: ArrayLike) -> NDArray[np.float64]:
    """A read-only float array that nobody else can write to; one that is already such is returned as it is."""
    array = np.asarray(values, dtype=np.float64)
    # a read-only view still changes with the array that it looks into
    if array.flags.writeable or array.base is not None:
        array = array.copy()
        array.flags.writeable = False
    return array


def rebuilt(value: Any) -> tuple[Any, ...]:
    """What ``__reduce__`` returns so that copies and unpickled values pass the constructor and are frozen again.

    An array that was pickled or deep-copied by itself comes back writeable.
    """
    return type(value), tuple(getattr(value, f.name) for f in fields(value))


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return a is not None and b is not None and np.array_equal(a, b)
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(_same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
    return bool(a == b)


def same_fields(a: Any, b: Any) -> bool:
    """Equality of two dataclass values of one type, arrays compared by shape and content."""
    if type(a) is not type(b):
        return False
    return all(_same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a) if f.compare)
