"""Growing one entropy tree on samples whose readings are bytes: a split is found in a histogram.

The gain of a split is eq. 5 of Cleghorn & Sternberg. The histogram counts the samples of both
categories at every level of a bin, so all thresholds of a bin cost one pass over the samples
(S. Ranka & V. Singh, CLOUDS, KDD 1998).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array

Bytes = npt.NDArray[np.uint8]
Int64s = npt.NDArray[np.int64]
LEVELS = 256  # of a byte
BRANCHLESS = -1  # component of a leaf. Source: by construction
_ON = 1 << 32  # a sample that is on, in a counter that holds both categories


class Rules(NamedTuple):
    """When a part is not split."""

    least_split: int  # samples of a part
    least_leaf: int  # samples of each side
    least_gain: float  # nats of all samples


class GrownTree(NamedTuple):
    """M entries, depth first: a left child follows its parent."""

    component: Int64s  # (M,) bin; BRANCHLESS at a leaf
    level: Int64s  # (M,) samples at or below go left
    right: Int64s  # (M,) entries ahead of the right child
    on: Int64s  # (M,) samples
    off: Int64s  # (M,) samples


def entropies(count: int) -> Array:
    """(count + 1,) ``n ln n``, from which the gain of a split is added up."""
    n = np.arange(count + 1, dtype=np.float64)
    return n * np.log(np.maximum(n, 1.0))


@njit(cache=True, nogil=True)
def grow(
    levels: Bytes, labels: npt.NDArray[np.bool_], drawn: Int64s, keys: Int64s, rules: Rules,
    table: Array,
) -> GrownTree:  # fmt: skip
    """Grow a tree.

    Args:
        levels: (B, K) of B bins of K samples.
        labels: (K,) whether a sample is on.
        drawn: (N,) the samples; one may be drawn several times.
        keys: (M, T) random: entry i tries T bins, chosen by row i; all bins where T is 0. There
            are at most M entries.
        rules: when a part is not split.
        table: (N + 1,) of ``entropies``, or more.
    """
    most = len(keys)
    component, level = np.full(most, BRANCHLESS), np.zeros(most, np.int64)
    right, on, off = np.zeros(most, np.int64), np.zeros(most, np.int64), np.zeros(most, np.int64)
    samples, bins = drawn.copy(), np.arange(levels.shape[0])
    counts, weights = np.empty(LEVELS, np.int64), np.empty(len(drawn), np.int64)
    # First and last sample of parts that wait, and the entry whose right child they are.
    first, last, parent = np.zeros(most, np.int64), np.zeros(most, np.int64), np.full(most, -1)
    last[0], waiting, count = len(drawn), 1, 0
    while waiting > 0:
        waiting -= 1
        begin, end, above = first[waiting], last[waiting], parent[waiting]
        if above >= 0:
            right[above] = count - above
        entry = count
        count += 1
        for i in range(begin, end):
            on[entry] += labels[samples[i]]
            weights[i] = _ON if labels[samples[i]] else 1
        off[entry] = end - begin - on[entry]
        # A split makes two entries; room is kept for those that wait.
        if on[entry] == 0 or off[entry] == 0 or count + waiting + 2 > most:
            continue
        best, at = split(
            levels, weights[begin:end], samples[begin:end], bins, keys[entry], rules, table, counts
        )
        if best < 0:
            continue
        component[entry], level[entry] = best, at
        middle = begin
        for i in range(begin, end):
            if levels[best, samples[i]] <= at:
                samples[i], samples[middle] = samples[middle], samples[i]
                middle += 1
        first[waiting], last[waiting], parent[waiting] = middle, end, entry
        first[waiting + 1], last[waiting + 1], parent[waiting + 1] = begin, middle, -1
        waiting += 2
    return GrownTree(component[:count], level[:count], right[:count], on[:count], off[:count])


@njit(cache=True, nogil=True)
def split(
    levels: Bytes, weights: Int64s, samples: Int64s, bins: Int64s, keys: Int64s, rules: Rules,
    table: Array, counts: Int64s,
) -> tuple[int, int]:  # fmt: skip
    """Bin and level of the greatest gain; bin −1 where no split is allowed.

    The level is half way between the two that the split separates. ``bins`` is shuffled by the
    keys. ``counts`` (LEVELS,) is scratch. Of equal gains, the first is taken.
    """
    total, size = np.int64(0), len(samples)
    for i in range(size):
        total += weights[i]
    on, off = total // _ON, total % _ON
    whole = table[on] + table[off] - table[size]
    best, where, level = rules.least_gain - 1e-9, -1, 0
    if size < rules.least_split or -whole < best:  # no split gains more than all entropy
        return where, level
    for t in range(len(keys) if len(keys) else len(bins)):
        if len(keys):
            swap = t + keys[t] % (len(bins) - t)
            bins[t], bins[swap] = bins[swap], bins[t]
        counts[:] = 0
        row = levels[bins[t]]
        low, high = LEVELS, 0
        for i in range(size):
            v = row[samples[i]]
            counts[v] += weights[i]
            low, high = min(low, v), max(high, v)
        below, last, taken = np.int64(0), 0, False  # samples at or below the last level
        for v in range(low, high + 1):
            if counts[v] == 0:
                continue
            if taken:  # the best split ends half way to this level
                level, taken = (last + v) // 2, False
            below += counts[v]
            last = v
            a, b = below // _ON, below % _ON
            if a + b < rules.least_leaf or size - a - b < max(rules.least_leaf, 1):
                continue
            gain = table[a] + table[b] - table[a + b] - whole
            gain += table[on - a] + table[off - b] - table[size - a - b]
            if gain > best:
                best, where, taken = gain, bins[t], True
    return where, level
