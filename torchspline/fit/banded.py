"""Least squares on B-spline coefficients: normal equations in LAPACK band storage, cost linear in their number."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

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


class NormalEquations:
    """`J^T J` and `J^T r` of residuals that each depend on a few neighbouring points.

    Args:
        count: number of points. width: how many neighbours a residual depends on at most. size: unknowns a point.
    """

    def __init__(self, count: int, width: int, size: int):
        self._blocks = torch.zeros(width, count, size, size, dtype=torch.float64)
        self._right = torch.zeros(count, size, dtype=torch.float64)

    def add(self, jacobian: Tensor, residual: Tensor, first: Tensor) -> None:
        """Rows that depend on the points from `first` (N,) on: jacobian (N, R, k, size), residual (N, R)."""
        columns = jacobian.unbind(2)
        for a, left in enumerate(columns):
            self._right.index_add_(0, first + a, torch.einsum("nrc,nr->nc", left, residual))
            for b, right in enumerate(columns[a:]):
                self._blocks[b].index_add_(0, first + a, right.mT @ left)

    def band(self) -> FloatArray:
        """(width size, count size), `band[i, j] = (J^T J)[i + j, j]`, unknowns of a point side by side."""
        width, count, size, _ = self._blocks.shape
        band = np.zeros((width * size, count, size))
        for d, blocks in enumerate(self._blocks.numpy()):
            for row in range(size):
                for column in range(size if d else row + 1):
                    band[d * size + row - column, :, column] = blocks[:, row, column]
        return band.reshape(width * size, count * size)

    def right_side(self) -> FloatArray:
        """`J^T r`, (count size,)."""
        return self._right.numpy().reshape(-1)


class BandedCholesky:
    """Factor of a positive definite matrix given by its lower band."""

    def __init__(self, band: FloatArray):
        from scipy.linalg import cholesky_banded  # as long to import as the rest of the library

        self._factor = cholesky_banded(band, lower=True, check_finite=False)

    def solve(self, right_side: FloatArray) -> FloatArray:
        """Solution for one right side (count,) or several as columns (count, C)."""
        from scipy.linalg import cho_solve_banded

        return cho_solve_banded((self._factor, True), right_side, check_finite=False)
