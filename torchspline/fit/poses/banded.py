"""Least squares on B-spline coefficients: normal equations in LAPACK band storage, cost linear in their number."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def gram_band(weights: FloatArray, first: NDArray[np.int64], count: int) -> FloatArray:
    """Lower band of `B^T B`, where row n of B has the entries `weights[n]` from column `first[n]` on.

    Args:
        weights: (N, k). first: (N,). count: number of columns of B.
    Returns:
        (k, count), `band[i, j] = (B^T B)[i + j, j]`.
    """
    k = weights.shape[1]
    band = np.zeros((k, count))
    for a in range(k):
        for b in range(a, k):
            band[b - a] += np.bincount(first + a, weights[:, a] * weights[:, b], minlength=count)
    return band


def transpose_apply(
    weights: FloatArray, first: NDArray[np.int64], count: int, values: FloatArray
) -> FloatArray:
    """`B^T values`, (count, C), for values (N, C)."""
    result = np.zeros((count, values.shape[1]))
    for a in range(weights.shape[1]):
        for c in range(values.shape[1]):
            result[:, c] += np.bincount(first + a, weights[:, a] * values[:, c], minlength=count)
    return result


def difference_band(count: int, difference: int, width: int) -> FloatArray:
    """Lower band (width, count) of `D^T D` for differences of the given order of neighbouring coefficients."""
    stencil = np.array([1.0])
    for _ in range(difference):
        stencil = np.convolve(stencil, [1.0, -1.0])
    rows = count - difference
    return _pad(gram_band(np.tile(stencil, (rows, 1)), np.arange(rows), count), width)


def _pad(band: FloatArray, width: int) -> FloatArray:
    return np.vstack([band, np.zeros((width - band.shape[0], band.shape[1]))])


def solve_band(band: FloatArray, right_side: FloatArray) -> FloatArray:
    """Solution of a positive definite system given by its lower band, for one right side or several as columns."""
    from scipy.linalg import solveh_banded  # as long to import as the rest of the library

    return solveh_banded(band, right_side, lower=True, check_finite=False)
