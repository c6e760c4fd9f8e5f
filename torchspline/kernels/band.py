"""The band of the inverse of a band matrix, from its Cholesky factor [Takahashi 1973]: cost linear in the length."""

import inspect
from functools import cache

import numpy as np

from torchspline.kernels.build import compiled
from torchspline.kernels.rowwise import Array

_SOURCE = '''"""Loop of torchspline/kernels/band.py."""

import numpy as np
from numba import njit


@njit("{{signature}}", cache={{cache}}, nogil=True, error_model="numpy", fastmath={{"contract", "nsz", "reassoc"}})
{loop}
'''


def invert_band(lower, out):
    """Fill `out[j, d]` = `Z[j + d, j]` of the inverse Z of `L L^T`, from `lower[j, d]` = `L[j + d, j]`, both (n, w).

    Row by row from the last: `L^T Z = L^-1` is zero above its diagonal, so that column j of Z follows from the w - 1
    columns after it, of which a square window is kept.
    """
    n, width = lower.shape
    reach = width - 1
    window, column = np.zeros((reach, reach)), np.zeros(reach)
    for j in range(n - 1, -1, -1):
        scale = 1.0 / lower[j, 0]
        line = lower[j, 1:]
        for a in range(reach):
            total = 0.0
            row = window[a]
            for b in range(reach):
                total += row[b] * line[b]
            column[a] = -total * scale
        total = scale
        for b in range(reach):
            total -= column[b] * line[b]
        own = total * scale
        out[j, 0] = own
        for a in range(reach):
            out[j, a + 1] = column[a]
        for a in range(reach - 1, 0, -1):
            here, before = window[a], window[a - 1]
            for b in range(reach - 1, 0, -1):
                here[b] = before[b - 1]
        if reach > 0:
            window[0, 0] = own
            for a in range(1, reach):
                window[a, 0] = column[a - 1]
                window[0, a] = column[a - 1]


@cache
def _compiled():
    source = _SOURCE.format(loop=inspect.getsource(invert_band))
    return compiled("invert_band", source, "void(float64[:, ::1], float64[:, ::1])")


def inverse_band(fused: bool, lower: Array) -> Array:
    """`Z[j + d, j]`, (n, w), compiled if `fused`, else block by block on whole arrays."""
    # Beyond the end the factor may hold anything.
    n, width = lower.shape
    lower = np.where(np.arange(n)[:, None] + np.arange(width) < n, lower, 0.0)
    if n == 0:
        return lower
    if not fused:
        return _reference(lower)
    out = np.empty((n, width))
    _compiled()(lower, out)
    return out


def _reference(lower: Array) -> Array:
    """The same by blocks as wide as the band: one on the diagonal and one below it."""
    n, width = lower.shape
    size = max(width - 1, 1)
    count = -(-n // size)
    dense = np.zeros((count, 2 * size, size))
    column, down = np.meshgrid(np.arange(n), np.arange(width), indexing="ij")
    block, at = column // size, column % size
    keep = column + down < n
    dense[block[keep], (at + down)[keep], at[keep]] = lower[column[keep], down[keep]]
    dense[-1, np.arange(size), np.arange(size)] += np.arange(size) >= n - (count - 1) * size
    # Three blocks in a row hold every element of the band.
    whole = np.zeros((count, 2 * size, size))
    below = np.zeros((size, size))
    for b in reversed(range(count)):
        inverse = np.linalg.inv(dense[b, :size])
        diagonal = inverse.T @ inverse
        if b < count - 1:
            after = whole[b + 1, :size]
            carried = dense[b, size:] @ inverse
            below = -after @ carried
            diagonal += carried.T @ after @ carried
        whole[b, :size], whole[b, size:] = diagonal, below
    out = np.zeros((n, width))
    out[keep] = whole[block[keep], (at + down)[keep], at[keep]]
    return out
