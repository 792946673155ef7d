"""The entropy of a split as the paper has it, beside scikit-learn's."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def split_entropy(left_counts: npt.ArrayLike, right_counts: npt.ArrayLike) -> float:
    """Entropy of a split (Cleghorn & Sternberg, eq. 5, its scanned ``+ ln`` read as ``× ln``).

    ``H = Σ_i L_i ln(L_i/L) + R_i ln(R_i/R) − (L_i+R_i) ln((L_i+R_i)/(L+R))``: the number
    of samples times the information gained, in nats. The best split has the greatest.

    Args:
        left_counts: (C,) samples of each category that go left.
        right_counts: (C,) samples of each category that go right.
    """
    left = np.asarray(left_counts, dtype=np.float64)
    right = np.asarray(right_counts, dtype=np.float64)

    def n_log(counts: np.ndarray) -> float:
        some = counts[counts > 0]
        return float(np.sum(some * np.log(some / counts.sum())))

    return n_log(left) + n_log(right) - n_log(left + right)
