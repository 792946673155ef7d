"""Small positive definite systems in compiled loops, without the overhead of LAPACK.

Measured against ``np.linalg.solve`` inside compiled code: three times faster for six unknowns,
because nothing is allocated. Larger systems belong to numpy.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array

# Of a diagonal element: a smaller pivot is rounding, the matrix is singular.
_PIVOT = 1e-14  # Source: about 50 times the rounding of float64


@njit(cache=True, nogil=True, error_model="numpy")
def cholesky(matrix: Array, lower: Array) -> bool:
    """Fill the lower triangle of ``lower`` (n, n) with L of ``matrix = L Lᵀ``.

    Only the lower triangle of ``matrix`` is read; ``lower`` may be the same array. False where
    the matrix is not positive definite.
    """
    n = matrix.shape[0]
    for i in range(n):
        diagonal = matrix[i, i]
        for j in range(i + 1):
            s = matrix[i, j]
            for k in range(j):
                s -= lower[i, k] * lower[j, k]
            if i == j:
                if not s > _PIVOT * diagonal:
                    return False
                lower[i, i] = math.sqrt(s)
            else:
                lower[i, j] = s / lower[j, j]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def substitute(lower: Array, right: Array, out: Array) -> None:
    """Fill ``out`` (n,) with the solution of ``L Lᵀ out = right``; may be the same array."""
    n = right.shape[0]
    for i in range(n):
        s = right[i]
        for k in range(i):
            s -= lower[i, k] * out[k]
        out[i] = s / lower[i, i]
    for i in range(n - 1, -1, -1):
        s = out[i]
        for k in range(i + 1, n):
            s -= lower[k, i] * out[k]
        out[i] = s / lower[i, i]


@njit(cache=True, nogil=True, error_model="numpy")
def solve(matrix: Array, right: Array, lower: Array, out: Array) -> bool:
    """Fill ``out`` (n,) with the solution of ``matrix out = right``; ``lower`` (n, n) is scratch.

    False where the matrix is not positive definite.
    """
    if not cholesky(matrix, lower):
        return False
    substitute(lower, right, out)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def solve_scaled(matrix: Array, right: Array, lower: Array, out: Array) -> bool:
    """As `solve`, with rows and columns scaled to a unit diagonal first.

    For unknowns of unlike units, metres beside radians: the test for singularity then means the
    same for each.
    """
    n = right.shape[0]
    scale = np.empty(n)
    for i in range(n):
        if not matrix[i, i] > 0.0:
            return False
        scale[i] = 1.0 / math.sqrt(matrix[i, i])
    for i in range(n):
        for j in range(i + 1):
            lower[i, j] = matrix[i, j] * scale[i] * scale[j]
        out[i] = right[i] * scale[i]
    if not cholesky(lower, lower):
        return False
    substitute(lower, out, out)
    for i in range(n):
        out[i] *= scale[i]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def invert(matrix: Array, lower: Array, out: Array) -> bool:
    """Fill ``out`` (n, n) with the inverse of a positive definite matrix; ``lower`` is scratch.

    False where the matrix is not positive definite.
    """
    if not cholesky(matrix, lower):
        return False
    n = matrix.shape[0]
    for i in range(n):  # the factor's own inverse, in its place
        lower[i, i] = 1.0 / lower[i, i]
        for j in range(i):
            s = 0.0
            for k in range(j, i):
                s -= lower[i, k] * lower[k, j]
            lower[i, j] = s * lower[i, i]
    for i in range(n):
        for j in range(i + 1):
            s = 0.0
            for k in range(i, n):
                s += lower[k, i] * lower[k, j]
            out[i, j] = out[j, i] = s
    return True


@njit(cache=True, nogil=True)
def quantile(values: Array, share: float) -> float:
    """The value (of N > 0) below which a share of the others lies, between two linearly.

    As ``np.quantile``, which takes numba three seconds to compile. Hoare's selection.
    """
    chosen = values.copy()
    low, high = 0, len(chosen) - 1
    at = share * high
    wanted = int(at)
    while low < high:
        pivot = chosen[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while chosen[i] < pivot:
                i += 1
            while chosen[j] > pivot:
                j -= 1
            if i <= j:
                chosen[i], chosen[j] = chosen[j], chosen[i]
                i += 1
                j -= 1
        if wanted <= j:
            high = j
        elif wanted >= i:
            low = i
        else:
            break
    value = chosen[wanted]
    if wanted + 1 < len(chosen):
        above = chosen[wanted + 1]
        for k in range(wanted + 2, len(chosen)):
            above = min(above, chosen[k])
        value += (at - wanted) * (above - value)
    return float(value)


@njit(cache=True, nogil=True)
def copy_into(values: Array, out: Array) -> None:
    """``out[:] = values``, which numba compiles for a second, for its message on wrong sizes."""
    for k in range(len(values)):
        out[k] = values[k]


@njit(cache=True, nogil=True)
def copy_matrix_into(values: npt.NDArray[Any], out: npt.NDArray[Any]) -> None:
    """``out[:] = values`` of (N, M) arrays, as ``copy_into``."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            out[i, j] = values[i, j]


@njit(cache=True, nogil=True)
def largest_size(values: Array) -> float:
    """Largest absolute value of (N,) numbers, NaN if one is; 0 of none."""
    largest = 0.0
    for k in range(len(values)):
        size = abs(values[k])
        if size > largest or size != size:  # NaN: nothing is larger from then on
            largest = size
    return largest


@njit(cache=True, nogil=True)
def largest_at(values: Array) -> int:
    """Index of the largest of (N,) numbers, the first of equals."""
    best = 0
    for k in range(1, len(values)):
        if values[k] > values[best]:
            best = k
    return best


@njit(cache=True, nogil=True)
def descending(values: Array) -> npt.NDArray[np.int64]:
    """Indices of (N,) numbers from the largest to the least; of equals the first comes first.

    Shell's sort with Knuth's steps: ``np.argsort`` compiles for two seconds in every loop.
    """
    order = np.arange(len(values))
    step = 1
    while step < len(values):
        step = 3 * step + 1
    while step > 1:
        step //= 3
        for i in range(step, len(values)):
            k, j = order[i], i
            while j >= step:
                before = order[j - step]
                if values[before] > values[k] or (values[before] == values[k] and before < k):
                    break
                order[j] = before
                j -= step
            order[j] = k
    return order
