"""Uniform B-spline bases as exact rational matrices, [S20] 4.1-4.2.

Rows belong to control points (blending) or to differences of neighbours (cumulative), columns to powers of u, the
time within a segment in units of the knot spacing.
"""

from fractions import Fraction
from functools import cache, lru_cache
from math import comb, factorial

import torch
from torch import Tensor

RationalMatrix = tuple[tuple[Fraction, ...], ...]


@lru_cache(maxsize=None, typed=True)  # 4.0 equals 4, but is no order
def blending_matrix(order: int) -> RationalMatrix:
    """M of [S20] (17)-(18), k x k: control point s of a segment has weight `sum_n M[s][n] u^n`.

    Raises:
        ValueError: an order below 2.
    """
    if not isinstance(order, int) or order < 2:
        raise ValueError(f"order: expected a whole number of at least 2, got {order!r}")
    k = order

    def entry(s: int, n: int) -> Fraction:
        total = sum((-1) ** (l - s) * comb(k, l - s) * (k - 1 - l) ** (k - 1 - n) for l in range(s, k))
        return Fraction(comb(k - 1, n) * total, factorial(k - 1))

    return tuple(tuple(entry(s, n) for n in range(k)) for s in range(k))


@lru_cache(maxsize=None, typed=True)  # 4.0 equals 4, but is no order
def cumulative_matrix(order: int) -> RationalMatrix:
    """The cumulative matrix of [S20] (19), k x k: row j is the sum of the blending rows from j on.

    Row 0 is (1, 0, ..., 0), [S20] (20), so that l_0 = 1 and only k - 1 rows are needed.
    """
    blending = blending_matrix(order)
    return tuple(
        tuple(sum((blending[s][n] for s in range(j, order)), Fraction(0)) for n in range(order))
        for j in range(order)
    )


@cache
def derivative_matrix(matrix: RationalMatrix, derivative: int) -> RationalMatrix:
    """The rows' polynomials differentiated; as many columns as before, the last ones zero."""
    for _ in range(derivative):
        matrix = tuple((*(n * row[n] for n in range(1, len(row))), Fraction(0)) for row in matrix)
    return matrix


@cache
def _columns(order: int, derivative: int) -> list[tuple[float, ...]]:
    """Coefficients by power, then by j, of the derivatives of `l_1 ... l_(k-1)`."""
    rows = derivative_matrix(cumulative_matrix(order), derivative)[1:]
    return [tuple(float(row[n]) for row in rows) for n in range(order)]


def cumulative_weights(u: Tensor, order: int, derivatives: int) -> list[tuple[Tensor, ...]]:
    """`l_j(u)` of [S20] (21) and its derivatives by u.

    Args:
        u: any shape, within [0, 1].
    Returns:
        A list over the derivatives 0 to `derivatives` of tuples over j = 1 ... order - 1 of tensors like `u`.
    """
    rows = []
    for r in range(derivatives + 1):
        columns = torch.tensor(_columns(order, r), dtype=u.dtype, device=u.device)
        columns = columns.reshape(order, order - 1, *(1,) * u.ndim)
        # Horner's rule rather than a matrix product, which autocast or TF32 would round.
        value = columns[-1].expand(order - 1, *u.shape)
        for column in reversed(columns[:-1].unbind(0)):
            value = value * u + column
        rows.append(value.unbind(0))
    return rows
