"""B-spline bases: exact matrices against the recursion of de Boor and Cox, SciPy, and their own derivatives."""

import math
import re
from fractions import Fraction
from functools import cache

import numpy as np
import pytest
import torch
from oracles import scipy_rate
from scipy.interpolate import BSpline

from torchspline.splines.basis import (
    blending_matrix,
    cumulative_matrix,
    cumulative_weights,
    derivative_matrix,
)

ORDERS = range(2, 11)
each_order = pytest.mark.parametrize("order", ORDERS)
#: Rational places within a segment, more of them than any polynomial here has coefficients.
PLACES = [Fraction(i, 12) for i in range(13)]


@cache
def de_boor_cox(i: int, degree: int, t: Fraction) -> Fraction:
    """B_i of the given degree on the knots 0, 1, 2, ...; corrects [S20] (12)-(14), where j counts from order 0.

    A spline of order k has degree k - 1, so (12) has to sum B_{i,k-1}, and its domain starts with knot k - 1.
    """
    if degree == 0:
        return Fraction(int(i <= t < i + 1))
    rising = (t - i) / degree * de_boor_cox(i, degree - 1, t)
    return rising + (i + degree + 1 - t) / degree * de_boor_cox(i + 1, degree - 1, t)


def polynomial(row: tuple[Fraction, ...], u: Fraction) -> Fraction:
    return sum((c * u**n for n, c in enumerate(row)), Fraction(0))


@each_order
def test_blending_matrix_is_the_de_boor_cox_recursion(order):
    matrix = blending_matrix(order)
    assert len(matrix) == order
    assert all(len(row) == order for row in matrix)
    for u in PLACES[:-1]:  # the recursion's pieces are open on the right
        for s, row in enumerate(matrix):
            assert polynomial(row, u) == de_boor_cox(s, order - 1, order - 1 + u)


@each_order
def test_cumulative_matrix_sums_from_the_row_on(order):
    blending, cumulative = blending_matrix(order), cumulative_matrix(order)
    for j, n in np.ndindex(order, order):
        assert cumulative[j][n] == sum(blending[s][n] for s in range(j, order))


@each_order
def test_partition_of_unity(order):
    """[S20] (20): the first cumulative row is one, so the blending weights sum to one; none is negative."""
    assert cumulative_matrix(order)[0] == (1, *(0,) * (order - 1))
    for u in PLACES:
        weights = [polynomial(row, u) for row in blending_matrix(order)]
        assert sum(weights) == 1
        assert min(weights) >= 0


@each_order
def test_entries_are_exact(order):
    """Every entry times (k-1)! is whole, which no rounded number would be."""
    for row in (*blending_matrix(order), *cumulative_matrix(order)):
        for entry in row:
            assert isinstance(entry, Fraction)
            assert (entry * math.factorial(order - 1)).denominator == 1


def test_printed_matrices():
    """The cubic matrices as the literature prints them, over 6, and the linear one."""
    cubic = ((1, -3, 3, -1), (4, 0, -6, 3), (1, 3, 3, -3), (0, 0, 0, 1))
    cumulative = ((6, 0, 0, 0), (5, 3, -3, 1), (1, 3, 3, -2), (0, 0, 0, 1))
    assert blending_matrix(4) == tuple(tuple(Fraction(c, 6) for c in row) for row in cubic)
    assert cumulative_matrix(4) == tuple(tuple(Fraction(c, 6) for c in row) for row in cumulative)
    assert cumulative_matrix(2) == ((1, 0), (0, 1))


@each_order
def test_derivative_matrix_differentiates(order):
    for matrix in (blending_matrix(order), cumulative_matrix(order)):
        for r in range(order + 1):
            for row, differentiated in zip(matrix, derivative_matrix(matrix, r), strict=True):
                exact = [row[n] * math.perm(n, r) for n in range(r, order)]
                assert differentiated == (*exact, *(0,) * (order - len(exact)))
    assert all(c == 0 for row in derivative_matrix(blending_matrix(order), order) for c in row)


@each_order
def test_cumulative_functions_join_smoothly(order):
    """C^(k-2), corrects [S20] 4.1: piece j ends where piece j - 1 begins one segment later; the next one jumps."""
    for r in range(order):
        matrix = derivative_matrix(cumulative_matrix(order), r)
        ends = [polynomial(row, Fraction(1)) for row in matrix]
        starts = [polynomial(row, Fraction(0)) for row in matrix]
        before_and_after = list(zip([*ends[1:], Fraction(0)], starts, strict=True))
        # Before its first piece a cumulative function is 0, after its last one it is 1, as row 0 says.
        joins = [(end, start) for end, start in before_and_after[:-1]] + [(Fraction(0), starts[-1])]
        if r <= order - 2:
            assert all(end == start for end, start in joins)
        else:
            assert all(end != start for end, start in joins)


@each_order
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_weights_of_tensors(order, dtype):
    u = torch.linspace(0, 1, 13, dtype=torch.float64).reshape(13, 1).to(dtype)
    weights = cumulative_weights(u, order, 4)
    assert len(weights) == 5
    for r, row in enumerate(weights):
        matrix = derivative_matrix(cumulative_matrix(order), r)[1:]
        assert len(row) == order - 1
        for coefficients, w in zip(matrix, row, strict=True):
            assert w.dtype == dtype
            assert w.shape == u.shape
            exact = [float(polynomial(coefficients, Fraction(x))) for x in u.flatten().tolist()]
            scale = max(1.0, *(abs(float(c)) for c in coefficients))
            assert np.abs(w.double().flatten().numpy() - exact).max() < 5 * torch.finfo(dtype).eps * scale


@each_order
def test_scipy_agrees(order):
    coefficients = np.random.default_rng(order).standard_normal(order + 3)
    spline = BSpline(np.arange(2 * order + 3) - (order - 1.0), coefficients, order - 1)
    segment, u = 2, np.linspace(0, 1, 9)[:-1]
    for r in range(4):
        matrix = np.array(derivative_matrix(blending_matrix(order), r), dtype=float)
        ours = coefficients[segment : segment + order] @ matrix @ u ** np.arange(order)[:, None]
        assert ours == pytest.approx(scipy_rate(spline, segment + u, r), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("order", [1, 0, -3, 4.5, "4", None])
def test_orders_that_are_none(order):
    with pytest.raises(
        ValueError, match=re.escape(f"order: expected a whole number of at least 2, got {order!r}")
    ):
        blending_matrix(order)
