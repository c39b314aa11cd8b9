"""Sparse elimination of a symmetric matrix of 3x3 blocks, and what follows from its factor; compiled.

The factor is ``H = L D L'`` with a unit diagonal: column j of L has its blocks at ``start[j]:start[j + 1]``, of the
rows ``below`` (ascending), each (3, 3) with H's row along its own row. Everything is in elimination order.
"""

from __future__ import annotations

import numpy as np

from mapfuse.datasets.compiled import kernel


@kernel
def column_counts(above_start, above, n):
    """How many blocks stand below the diagonal in each column of L (n,), and each column's parent (n,).

    ``above[above_start[j]:above_start[j + 1]]``: rows of H's blocks in column j, above the diagonal.
    """
    parent = np.full(n, -1, dtype=np.int64)
    count = np.zeros(n, dtype=np.int64)
    seen = np.full(n, -1, dtype=np.int64)
    for j in range(n):
        seen[j] = j
        for p in range(above_start[j], above_start[j + 1]):
            i = above[p]
            while seen[i] != j:
                if parent[i] < 0:
                    parent[i] = j
                count[i] += 1
                seen[i] = j
                i = parent[i]
    return count, parent


@kernel
def pattern(above_start, above, start, parent):
    """Rows ``below`` the diagonal of every column of L."""
    n = len(parent)
    below = np.empty(start[n], dtype=np.int64)
    at = start[:n].copy()
    seen = np.full(n, -1, dtype=np.int64)
    for j in range(n):
        seen[j] = j
        for p in range(above_start[j], above_start[j + 1]):
            i = above[p]
            while seen[i] != j:
                below[at[i]] = j
                at[i] += 1
                seen[i] = j
                i = parent[i]
    return below


@kernel
def place_of(start, below, i, j):
    """Where block (i, j), i > j, stands in the factor; -1 where the pattern has none."""
    low, high = start[j], start[j + 1]
    while low < high:
        middle = (low + high) // 2
        if below[middle] < i:
            low = middle + 1
        else:
            high = middle
    return low if low < start[j + 1] and below[low] == i else -1


@kernel
def places_of(start, below, rows, columns):
    """`place_of` of many blocks."""
    found = np.empty(len(rows), dtype=np.int64)
    for k in range(len(rows)):
        found[k] = place_of(start, below, rows[k], columns[k])
    return found


@kernel
def invert(block, scale, out):
    """Inverse of a symmetric 3x3 block into ``out``; its least pivot as a share of ``scale`` (3,)."""
    a, b, c = block[0, 0], block[1, 0], block[2, 0]
    least = a / scale[0]
    l10, l20 = b / a, c / a
    d1 = block[1, 1] - l10 * b
    least = min(least, d1 / scale[1])
    l21 = (block[2, 1] - l20 * b) / d1
    d2 = block[2, 2] - l20 * c - l21 * l21 * d1
    least = min(least, d2 / scale[2])
    m20 = l10 * l21 - l20  # of the inverse of the unit triangle
    out[0, 0] = 1 / a + l10 * l10 / d1 + m20 * m20 / d2
    out[1, 0] = -l10 / d1 - l21 * m20 / d2
    out[1, 1] = 1 / d1 + l21 * l21 / d2
    out[2, 0] = m20 / d2
    out[2, 1] = -l21 / d2
    out[2, 2] = 1 / d2
    out[0, 1], out[0, 2], out[1, 2] = out[1, 0], out[2, 0], out[2, 1]
    return least


@kernel
def subtract_product(target, left, right):
    """``target -= left @ right.T`` of 3x3 blocks."""
    for r in range(3):
        for c in range(3):
            target[r, c] -= left[r, 0] * right[c, 0] + left[r, 1] * right[c, 1] + left[r, 2] * right[c, 2]


@kernel
def add_product(target, left, right):
    """``target += left @ right`` of 3x3 blocks."""
    for r in range(3):
        for c in range(3):
            target[r, c] += left[r, 0] * right[0, c] + left[r, 1] * right[1, c] + left[r, 2] * right[2, c]


@kernel
def add_transposed_product(target, left, right):
    """``target += left.T @ right`` of 3x3 blocks."""
    for r in range(3):
        for c in range(3):
            target[r, c] += left[0, r] * right[0, c] + left[1, r] * right[1, c] + left[2, r] * right[2, c]


@kernel
def factorise(start, below, blocks, diagonal):
    """H's blocks to L's in place; the inverse of D (n, 3, 3) and each column's least pivot by H's diagonal (n,)."""
    n = len(diagonal)
    inverse = np.empty((n, 3, 3))
    least = np.empty(n)
    scale = np.empty((n, 3))
    for j in range(n):
        for r in range(3):
            scale[j, r] = max(diagonal[j, r, r], 1e-300)
    for j in range(n):
        least[j] = invert(diagonal[j], scale[j], inverse[j])
        first, last = start[j], start[j + 1]
        scaled = np.zeros((last - first, 3, 3))
        for a in range(first, last):
            add_product(scaled[a - first], blocks[a], inverse[j])
        for a in range(first, last):
            k = below[a]
            subtract_product(diagonal[k], scaled[a - first], blocks[a])
            at = start[k]
            for b in range(a + 1, last):
                i = below[b]
                while below[at] != i:
                    at += 1
                subtract_product(blocks[at], scaled[b - first], blocks[a])
        blocks[first:last] = scaled
    return inverse, least


@kernel
def selected_inverse(start, below, factor, inverse):
    """The blocks of ``H^-1`` that stand where L's do (nnz, 3, 3), and those of its diagonal (n, 3, 3).

    Takahashi: with Z the inverse, ``Z_ij = -sum_k Z_ik L_kj`` over the rows k of column j, from the last column on.
    """
    n = len(inverse)
    diagonal = inverse.copy()
    blocks = np.empty_like(factor)
    for j in range(n - 1, -1, -1):
        first, last = start[j], start[j + 1]
        total = np.zeros((last - first, 3, 3))
        for a in range(first, last):
            k = below[a]
            add_product(total[a - first], diagonal[k], factor[a])
            at = start[k]
            for b in range(a + 1, last):
                i = below[b]
                while below[at] != i:
                    at += 1
                add_product(total[b - first], blocks[at], factor[a])
                add_transposed_product(total[a - first], blocks[at], factor[b])
        for a in range(first, last):
            add_transposed_product(diagonal[j], factor[a], total[a - first])
            blocks[a] = -total[a - first]
    return blocks, diagonal


@kernel
def whole_inverse(start, below, factor, inverse):
    """All of ``H^-1`` (3n, 3n) by the same recursion, each column from those after it."""
    n = len(inverse)
    whole = np.zeros((3 * n, 3 * n))
    for j in range(n - 1, -1, -1):
        tail = 3 * (j + 1)
        for a in range(start[j], start[j + 1]):
            k = 3 * below[a]
            for r in range(3):
                l0, l1, l2 = factor[a, 0, r], factor[a, 1, r], factor[a, 2, r]
                row, z0, z1, z2 = whole[3 * j + r], whole[k], whole[k + 1], whole[k + 2]
                for i in range(tail, 3 * n):
                    row[i] -= l0 * z0[i] + l1 * z1[i] + l2 * z2[i]
        for r in range(3):
            for c in range(3):
                total = inverse[j, r, c]
                for a in range(start[j], start[j + 1]):
                    k = 3 * below[a]
                    for s in range(3):
                        total -= factor[a, s, r] * whole[3 * j + c, k + s]
                whole[3 * j + r, 3 * j + c] = total
            for i in range(tail, 3 * n):
                whole[i, 3 * j + r] = whole[3 * j + r, i]
    return whole


@kernel
def solve_columns(start, below, factor, inverse, columns):
    """``H^-1`` times ``columns`` (n, 3, m), in place."""
    n, m = len(inverse), columns.shape[2]
    for j in range(n):
        for a in range(start[j], start[j + 1]):
            target = columns[below[a]]
            for r in range(3):
                l0, l1, l2 = factor[a, r, 0], factor[a, r, 1], factor[a, r, 2]
                for c in range(m):
                    target[r, c] -= l0 * columns[j, 0, c] + l1 * columns[j, 1, c] + l2 * columns[j, 2, c]
    for j in range(n - 1, -1, -1):
        for c in range(m):
            x, y, z = columns[j, 0, c], columns[j, 1, c], columns[j, 2, c]
            for r in range(3):
                columns[j, r, c] = inverse[j, r, 0] * x + inverse[j, r, 1] * y + inverse[j, r, 2] * z
        for a in range(start[j], start[j + 1]):
            source = columns[below[a]]
            for r in range(3):
                l0, l1, l2 = factor[a, 0, r], factor[a, 1, r], factor[a, 2, r]
                for c in range(m):
                    columns[j, r, c] -= l0 * source[0, c] + l1 * source[1, c] + l2 * source[2, c]
