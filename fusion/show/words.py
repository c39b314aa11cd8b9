"""Names, probabilities and transformations as text for people; nothing in here draws."""

from __future__ import annotations

import numpy as np

from mapfuse.datasets.transform import Transform


def shortened(name: str, longest: int = 60) -> str:
    """A name with its middle left out where it is longer.

    >>> shortened("ground floor, northern wing", 20)
    'ground floor…rn wing'
    """
    name = drawable(name)
    return name if len(name) <= longest else f"{name[: longest - 8]}…{name[-7:]}"


def drawable(text: str) -> str:
    """Text of a file without what would steer its drawing (control characters, changes of writing direction).

    >>> drawable("a\u202eb")
    'a�b'
    """
    return "".join(c if c.isprintable() or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in text)


def percent(probability: float) -> str:
    """A probability in percent; nothing that a computer weighed is quite 0 or 100.

    >>> percent(0.9983), percent(0.99999999), percent(1e-9), percent(0.5)
    ('99.83 %', '> 99.99 %', '< 0.01 %', '50 %')
    """
    if probability > 0.9999:
        return "> 99.99 %"
    if probability < 0.0001:
        return "< 0.01 %"
    return f"{100 * probability:.4g} %"


def probability_text(p: float) -> str:
    """A probability with as many digits as keep it apart from certainty.

    >>> [probability_text(p) for p in (0.5, 0.998, 0.99987, 0.99999999, 1.0, 0.0001)]
    ['0.500', '0.998', '0.9999', '> 0.9999', '> 0.9999', '< 0.001']
    """
    if p < 0.0005:
        return "< 0.001"
    if p < 0.9985:
        return f"{p:.3f}"
    return f"{p:.4f}" if p < 0.99995 else "> 0.9999"


def transform_text(T: Transform) -> str:
    """A transformation with its standard deviations, for people: metres and degrees.

    >>> transform_text(Transform(3.1, -2.0, 0.0, np.diag([1e-2, 4e-2, 1e-4])))
    'x = 3.10 ± 0.10 m,  y = −2.00 ± 0.20 m,  θ = 0.00 ± 0.57°'
    """
    sigma = [None] * 3 if T.covariance is None else np.sqrt(np.maximum(np.diag(T.covariance), 0.0)).tolist()
    degrees = None if sigma[2] is None else float(np.degrees(sigma[2]))
    return ",  ".join(
        (
            _value("x", T.x, sigma[0], " m"),
            _value("y", T.y, sigma[1], " m"),
            _value("θ", float(np.degrees(T.theta)), degrees, "°"),
        )
    )


def _value(name: str, value: float, sigma: float | None, unit: str) -> str:
    digits = 2 if sigma is None or sigma >= 0.01 else 3
    number = f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")
    return f"{name} = {number}{unit}" if sigma is None else f"{name} = {number} ± {sigma:.{digits}f}{unit}"
