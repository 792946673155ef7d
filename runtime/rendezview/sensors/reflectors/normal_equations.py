"""The six normal equations of a pose, solved without allocation by the compiled loops."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def solve(matrix, rhs, out):  # type: ignore[no-untyped-def]
    """Cholesky solution in place of ``matrix`` (6, 6), scaled to a unit diagonal."""
    n = 6
    scale = np.empty(n)
    for a in range(n):
        if not matrix[a, a] > 0.0:
            return False
        scale[a] = 1.0 / math.sqrt(matrix[a, a])
    for a in range(n):
        for b in range(n):
            matrix[a, b] *= scale[a] * scale[b]
    for a in range(n):
        for b in range(a + 1):
            total = matrix[a, b]
            for c in range(b):
                total -= matrix[a, c] * matrix[b, c]
            if a == b:
                if not total > 1e-14:
                    return False
                matrix[a, a] = math.sqrt(total)
            else:
                matrix[a, b] = total / matrix[b, b]
    for a in range(n):
        total = rhs[a] * scale[a]
        for c in range(a):
            total -= matrix[a, c] * out[c]
        out[a] = total / matrix[a, a]
    for a in range(n - 1, -1, -1):
        total = out[a]
        for c in range(a + 1, n):
            total -= matrix[c, a] * out[c]
        out[a] = total / matrix[a, a]
    for a in range(n):
        out[a] *= scale[a]
    return True


@njit(cache=True, nogil=True)
def invert(matrix, out):  # type: ignore[no-untyped-def]
    """Inverse of a symmetric (6, 6), column by column; false where it is not positive."""
    work, unit, column = np.empty((6, 6)), np.empty(6), np.empty(6)
    for a in range(6):
        work[:] = matrix
        unit[:] = 0.0
        unit[a] = 1.0
        if not solve(work, unit, column):
            return False
        for b in range(6):
            out[b, a] = column[b]
    return True
