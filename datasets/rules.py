"""Rules for single values of a file: each checks one, and says the same as a JSON Schema.

A rule's ``check`` returns the value as the library holds it, or raises `RuleError` with the place within the value.
Whole floats are whole numbers (JSON has one kind of number); true and false are none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .jsondata import MAX_PROBLEMS, Place, said, text_fault

Array = NDArray[np.float64]
Faults = list[tuple[Place, str]]

#: Angles may lie outside of (-pi, pi] by this [rad], so that a pi that was rounded to three digits is one.
ANGLE_SLACK = 1e-3
#: Eigenvalues of a covariance may be negative, and its halves differ, by this share (rounding of a singular one).
COVARIANCE_TOLERANCE = 1e-9
#: Counters are at most this, the largest whole number that every JSON reader keeps.
MAX_COUNT = 2**53 - 1

_ANGLE_LIMIT = math.pi + ANGLE_SLACK


class RuleError(Exception):
    """What is wrong with one value: (place within the value, reason), one or more."""

    def __init__(self, *faults: tuple[Place, str]) -> None:
        self.faults = faults
        super().__init__(faults)


@dataclass(frozen=True, slots=True)
class Rule:
    """``check(value)`` returns the value or raises `RuleError`; ``schema`` says the same as far as JSON Schema can."""

    check: Callable[[Any], Any]
    schema: Mapping[str, Any]


def _wrong(reason: str, value: object) -> RuleError:
    return RuleError(((), f"{reason}, not {said(value)}"))


def _number(value: Any) -> float:
    if type(value) is float and math.isfinite(value):
        return value
    if type(value) is int and abs(value) < 2**1023:
        return float(value)
    raise _wrong("must be a finite number" if type(value) in (int, float) else "must be a number", value)


def _angle(value: Any) -> float:
    angle = _number(value)
    if -_ANGLE_LIMIT <= angle <= _ANGLE_LIMIT:
        return angle
    raise _wrong("must be an angle in (-pi, pi] [rad]", value)


def _not_negative(value: Any) -> float:
    number = _number(value)
    if number >= 0:
        return number
    raise _wrong("must be 0 or more", value)


def _probability(value: Any) -> float:
    number = _number(value)
    if 0 <= number <= 1:
        return number
    raise _wrong("must be a probability between 0 and 1", value)


def _count(value: Any) -> int:
    number = int(value) if type(value) is float and value.is_integer() else value
    if type(number) is int and 0 <= number <= MAX_COUNT:
        return number
    raise _wrong("must be a whole number, 0 or more", value)


def _text(value: Any) -> str:
    if type(value) is not str:
        raise _wrong("must be text", value)
    if fault := text_fault(value):
        raise RuleError(((), fault))
    return value


def _word(value: Any) -> str:
    if _text(value):
        return str(value)
    raise RuleError(((), "must not be empty"))


NUMBER = Rule(_number, {"type": "number"})
ANGLE = Rule(_angle, {"type": "number", "minimum": -_ANGLE_LIMIT, "maximum": _ANGLE_LIMIT})
NOT_NEGATIVE = Rule(_not_negative, {"type": "number", "minimum": 0})
PROBABILITY = Rule(_probability, {"type": "number", "minimum": 0, "maximum": 1})
COUNT = Rule(_count, {"type": "integer", "minimum": 0, "maximum": MAX_COUNT})
TEXT = Rule(_text, {"type": "string"})
WORD = Rule(_word, {"type": "string", "minLength": 1})


def one_of(*allowed: str | int) -> Rule:
    """One of a few values, and nothing that merely equals one (true is not 1)."""
    kinds = {type(value) for value in allowed}
    listed = ", ".join(said(value) for value in allowed[:-1]) + f" or {said(allowed[-1])}"

    def check(value: Any) -> Any:
        if type(value) in kinds and value in allowed:
            return value
        whole = _whole(value)
        if whole is not None and int in kinds and whole in allowed:
            return whole
        raise _wrong(f"must be {listed}", value)

    return Rule(check, {"enum": list(allowed)})


def _whole(value: Any) -> int | None:
    return int(value) if type(value) is float and value.is_integer() else None


def table(value: Any, width: int | None) -> Array:
    """Rows of ``width`` finite numbers each (None: as many as rows) as an array; `RuleError` lists all bad rows."""
    if isinstance(value, np.ndarray):
        return _array(value, width)
    if type(value) is not list:
        raise _wrong(f"must be a list of rows of {width or 'equally many'} numbers", value)
    columns = len(value) if width is None else width
    faults: Faults = []
    for k, row in enumerate(value):
        if type(row) is not list or len(row) != columns:
            what = f"a list of {len(row)}" if type(row) is list else said(row)
            faults.append(((k,), f"must be a list of {columns} numbers, not {what}"))
        elif not ({*map(type, row)} <= {float} and math.isfinite(sum(row))):
            faults += _row_faults(row, k)
        if len(faults) > MAX_PROBLEMS:
            break
    if faults:
        raise RuleError(*faults)
    return np.array(value, dtype=np.float64).reshape(len(value), columns)


def _row_faults(row: list[Any], k: int) -> Faults:
    """Element by element: a row with whole numbers, or whose sum is no number, may still be right."""
    faults: Faults = []
    for m, item in enumerate(row):
        try:
            _number(item)
        except RuleError as fault:
            faults += [((k, m), reason) for _, reason in fault.faults]
    return faults


def _array(value: NDArray[Any], width: int | None) -> Array:
    columns = len(value) if width is None and value.ndim else width
    if value.dtype.kind not in "fiu" or value.ndim != 2 or value.shape[1] != columns:
        shape = " x ".join(map(str, value.shape))
        raise RuleError(((), f"must have rows of {width or 'equally many'} numbers, not be {shape} of {value.dtype}"))
    bad = np.argwhere(~np.isfinite(value))[:MAX_PROBLEMS]
    if len(bad):
        raise RuleError(
            *(((int(k), int(m)), f"must be a finite number, not {said(float(value[k, m]))}") for k, m in bad)
        )
    return value.astype(np.float64, copy=False)


def covariance_fault(C: Array) -> str | None:
    """What keeps a finite square matrix from being a covariance, or None: symmetric, and no negative eigenvalue.

    Judged on the correlations, so that metres and radians count alike; singular ones, rows of zeros too, are fine.
    """
    variances = np.diagonal(C)
    if not C.size or (len(C) <= 3 and _clearly_positive(C)):
        return None
    if (least := float(variances.min())) < 0:
        return f"is no covariance: the variance {least!r} is negative"
    sigmas = np.sqrt(variances)
    # with a variance of zero there is nothing to be correlated with: such a row has to be zero
    scale = np.where(sigmas > 0, sigmas, 1.0)
    with np.errstate(over="ignore"):
        correlations = C / scale[:, None] / scale
    if not np.abs(correlations).max() <= 1 + COVARIANCE_TOLERANCE:
        return "is no covariance: some correlation is beyond 1"
    uneven = np.abs(correlations - correlations.T)
    if uneven.max() > COVARIANCE_TOLERANCE:
        k, m = np.unravel_index(int(uneven.argmax()), uneven.shape)
        return f"is not symmetric: [{k}][{m}] is {float(C[k, m])!r}, [{m}][{k}] is {float(C[m, k])!r}"
    np.fill_diagonal(correlations, np.where(sigmas > 0, 1.0, 0.0) + COVARIANCE_TOLERANCE)
    try:
        np.linalg.cholesky(correlations)
    except np.linalg.LinAlgError:
        return "is no covariance: it is indefinite (as a matrix of correlations it has a negative eigenvalue)"
    return None


def _clearly_positive(C: Array) -> bool:
    """Whether a small matrix is exactly symmetric with clearly positive pivots: the usual case, without LAPACK."""
    rows: list[list[float]] = C.tolist()
    n = len(rows)
    if any(rows[k][m] != rows[m][k] for k in range(n) for m in range(k)):
        return False
    for k in range(n):
        if not rows[k][k] > 1e-6 * C[k, k] > 0:
            return False
        for m in range(k + 1, n):
            factor = rows[m][k] / rows[k][k]
            for j in range(k + 1, n):
                rows[m][j] -= factor * rows[k][j]
    return True


def covariance(*sizes: int) -> Rule:
    """A covariance of one of these sizes."""

    def check(value: Any) -> Array:
        C = table(value, None)
        if len(C) not in sizes:
            allowed = " or ".join(f"{n}x{n}" for n in sizes)
            raise RuleError(((), f"must be {allowed}, not {len(C)}x{len(C)}"))
        if fault := covariance_fault(C):
            raise RuleError(((), fault))
        return C

    return Rule(check, {"anyOf": [square_schema(n) for n in sizes]})


def square_schema(n: int) -> dict[str, Any]:
    """JSON Schema of n rows of n numbers."""
    return _list_schema(_list_schema({"type": "number"}, n), n)


def rows_schema(*columns: Mapping[str, Any]) -> dict[str, Any]:
    """JSON Schema of any number of rows with these columns."""
    row = {"type": "array", "prefixItems": list(columns), "minItems": len(columns), "maxItems": len(columns)}
    return {"type": "array", "items": row}


def _list_schema(item: Mapping[str, Any], n: int) -> dict[str, Any]:
    return {"type": "array", "items": item, "minItems": n, "maxItems": n}
