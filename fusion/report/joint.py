"""How closely the errors of each two landmarks go together, from their joint covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.maps import JointCovariance

Array = NDArray[np.float64]


def coupling(joint: JointCovariance) -> Array:
    """Largest canonical correlation (n, n) between the positions of each two landmarks, in [0, 1].

    1: whoever knows one landmark's error knows the other one's along some direction; 0: nothing in common. Landmarks
    whose position is exactly known are coupled with none.

    >>> C = np.array([[2.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 2.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    >>> coupling(JointCovariance(("a", "b"), 2, C)).round(3).tolist()
    [[1.0, 0.5], [0.5, 1.0]]
    """
    n, rows = len(joint.order), joint.rows
    if not n:
        return np.zeros((0, 0))
    blocks = joint.matrix.reshape(n, rows, n, rows)[:, :2, :, :2].transpose(0, 2, 1, 3)
    own = blocks[np.arange(n), np.arange(n)]
    values, vectors = np.linalg.eigh((own + own.transpose(0, 2, 1)) / 2)
    known = values > 1e-12 * np.maximum(values[:, -1:], 1e-300)
    scale = np.where(known, 1 / np.sqrt(np.where(known, values, 1.0)), 0.0)
    whiten = vectors * scale[:, None, :]
    white = np.einsum("iab,ijac->ijbc", whiten, blocks)
    white = np.einsum("ijbc,jcd->ijbd", white, whiten)
    # largest singular value of each 2x2 in closed form
    squares = (white**2).sum(axis=(2, 3))
    determinant = white[..., 0, 0] * white[..., 1, 1] - white[..., 0, 1] * white[..., 1, 0]
    spread = np.sqrt(np.maximum(squares**2 - 4 * determinant**2, 0.0))
    return np.asarray(np.clip(np.sqrt((squares + spread) / 2), 0.0, 1.0))
