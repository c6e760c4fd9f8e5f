"""Slow, obvious twins of the recurrences: product rule on matrices, multi-precision numbers, [S20]'s Jacobians."""

import itertools
import math
from collections import Counter
from collections.abc import Sequence
from fractions import Fraction
from types import SimpleNamespace

import mpmath as mp
import numpy as np
import scipy.interpolate
import scipy.linalg
import torch
from batteries import hat, vee
from torch import Tensor

from torchspline.arithmetic.recurrence import forward
from torchspline.arithmetic.scalar import namespace
from torchspline.groups import SO3, Group
from torchspline.splines.basis import blending_matrix, cumulative_matrix, derivative_matrix

namespace.register(
    mp.mpf,
    lambda x: SimpleNamespace(
        sqrt=mp.sqrt, sin=mp.sin, cos=mp.cos, where=lambda condition, yes, no: yes if condition else no
    ),
)

# ---------------------------------------------------------------------- product rule


def expm(matrices: Tensor) -> Tensor:
    """SciPy's matrix exponential: that of torch 2.13 is off by 3e-11 where the norm is about 0.03."""
    return torch.from_numpy(scipy.linalg.expm(matrices.numpy()))


def scipy_rate(spline: scipy.interpolate.BSpline, t: np.ndarray, r: int) -> np.ndarray:
    """The `r`-th derivative. Above the degree it is zero, and not to be asked for: SciPy 1.11 then writes where it must
    not, and the process dies at some later time in some other place."""
    return spline(t, r) if r <= spline.k else np.zeros((len(t), *spline.c.shape[1:]))


def geodesic_derivatives(D: Tensor, weights: Sequence[Tensor]) -> list[Tensor]:
    """A = exp(l D) and its first three derivatives, [S20] (31): D commutes with A, so l behaves as a number.

    `weights` are l and its derivatives, shape (N,); D is (n, n) or (N, n, n).
    """
    l, l1, l2, l3 = ([w[..., None, None] for w in weights] + [torch.zeros(1, 1)] * 3)[:4]
    A = expm(l * D)
    inner = [l1 * D, l2 * D + l1**2 * D @ D, l3 * D + 3 * l1 * l2 * D @ D + l1**3 * D @ D @ D]
    return [A, *(A @ factor for factor in inner)]


def product_rule(
    group: Group, start: Tensor, steps: Tensor, weights: Sequence[Sequence[Tensor]]
) -> list[Tensor]:
    """Matrix of the cumulative product and its derivatives, [S20] (26), (30) and (32), term by term.

    Args:
        start: matrix of X_0, (n, n); steps: (order - 1, D) or (order - 1, N, D); `weights[r][j]`: (N,).
    Returns:
        As many matrices (N, n, n) as there are rows of weights: X, X', X'', X'''.
    """
    count = len(steps)
    A = [geodesic_derivatives(hat(group, steps[j]), [row[j] for row in weights]) for j in range(count)]
    results = []
    for r in range(len(weights)):
        total = torch.zeros_like(A[0][0])
        # Every way to hand out r derivatives among the factors, one after the other.
        for taken in itertools.product(range(count), repeat=r):
            times = Counter(taken)
            term = start.expand_as(total)
            for j in range(count):
                term = term @ A[j][times[j]]
            total = total + term
        results.append(total)
    return results


def body_rates(group: Group, matrices: Sequence[Tensor]) -> list[Tensor]:
    """Velocity, acceleration and jerk from X, X', X'', X''': [S20] (33), (40) and (74)."""
    back = torch.linalg.inv(matrices[0])
    rates: list[Tensor] = []
    for r, derivative in enumerate(matrices[1:]):
        rest = back @ derivative
        if r == 1:
            (w,) = (hat(group, x) for x in rates)
            rest = rest - w @ w
        if r == 2:
            w, a = (hat(group, x) for x in rates)
            rest = rest - w @ w @ w - 2 * w @ a - a @ w
        rates.append(vee(group, rest))
    return rates


def polynomial_weights(u: Tensor, order: int, derivatives: int) -> list[list[Tensor]]:
    """Cumulative weights and derivatives as sums of powers; `weights[r][j]` for j = 1 ... order - 1."""

    def value(row: tuple[Fraction, ...], r: int) -> Tensor:
        terms = (float(row[n] * math.perm(n, r)) * u ** (n - r) for n in range(r, order))
        return sum(terms, torch.zeros_like(u))

    return [[value(row, r) for row in cumulative_matrix(order)[1:]] for r in range(derivatives + 1)]


# ---------------------------------------------------------------------- multi-precision numbers


def exact_weights(u: mp.mpf, order: int, derivatives: int, cumulative: bool = True) -> list[list[mp.mpf]]:
    matrix = cumulative_matrix(order)[1:] if cumulative else blending_matrix(order)

    def value(row: tuple[Fraction, ...]) -> mp.mpf:
        return mp.fsum(mp.mpf(c.numerator) / c.denominator * u**n for n, c in enumerate(row))

    return [[value(row) for row in derivative_matrix(matrix, r)] for r in range(derivatives + 1)]


def exact_bspline(
    group: Group, control_points: Sequence[Sequence[mp.mpf]], u: mp.mpf, derivatives: int
) -> list[tuple[mp.mpf, ...]]:
    """One segment on multi-precision numbers: value and derivatives by u; as many points as the order."""
    algebra, order = group.arithmetic, len(control_points)
    points = [algebra.normalize(tuple(p)) for p in control_points]
    steps = [algebra.log(algebra.between(X, Y)) for X, Y in itertools.pairwise(points)]
    weights = exact_weights(u, order, derivatives)
    value, trace = forward(algebra, points[0], steps, weights, derivatives)
    return [value, *trace[-1].rates]


def exact_directional(
    group: Group, control_points: Tensor, u: float, direction: Tensor, u_direction: float, derivatives: int
) -> tuple[list[Tensor], list[Tensor]]:
    """`exact_bspline` and its directional derivative, by differences of width 1e-25 on 60 digits."""
    with mp.workdps(60):
        h = mp.mpf(10) ** -25

        def along(s: mp.mpf) -> list[tuple[mp.mpf, ...]]:
            rows = zip(control_points.tolist(), direction.tolist(), strict=True)
            moved = [
                [x + s * mp.mpf(v) for x, v in zip(map(mp.mpf, row), rate, strict=True)] for row, rate in rows
            ]
            return exact_bspline(group, moved, mp.mpf(u) + s * u_direction, derivatives)

        pairs = [list(zip(*pair, strict=True)) for pair in zip(along(h), along(-h), strict=True)]
        values = [[(ahead + behind) / 2 for ahead, behind in row] for row in pairs]
        slopes = [[(ahead - behind) / (2 * h) for ahead, behind in row] for row in pairs]
        return tuple(
            [torch.tensor([float(c) for c in row], dtype=torch.float64) for row in table]
            for table in (values, slopes)
        )


# ---------------------------------------------------------------------- Jacobians of [S20] 5.2


def so3_jacobians(R: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Jacobians of value, velocity and acceleration by u of one segment on SO(3), as [S20] writes them.

    Theorems 5.4-5.6 and (47)-(49), all perturbations on the left (11): of control points `R` (order, 4), and of
    the value, so that the value's rows are those of (57) times J_l(rho).
    Returns:
        Three tensors (order, 3, 3).
    """
    order = len(R)
    d = SO3.log(SO3.between(R[:-1], R[1:]))
    l, l1, l2 = (torch.stack(row) for row in polynomial_weights(u, order, 2))
    matrix = SO3.to_matrix(R)

    def wedge(v: Tensor) -> Tensor:
        return hat(SO3, v)

    def right_jacobian(v: Tensor) -> Tensor:
        """(72) as the integral of exp(-s v^) over s from 0 to 1: the closed form has no digits at small angles."""
        above = torch.cat([wedge(-v), torch.eye(3, dtype=v.dtype)], dim=1)
        return expm(torch.cat([above, torch.zeros_like(above)]))[:3, 3:]

    A = [expm(wedge(l[j] * d[j])) for j in range(order - 1)]
    w, a, value = [torch.zeros(3, dtype=R.dtype)], [torch.zeros(3, dtype=R.dtype)], matrix[0]
    for j in range(order - 1):
        w.append(A[j].mT @ w[j] + l1[j] * d[j])
        a.append(l1[j] * torch.linalg.cross(w[j + 1], d[j]) + A[j].mT @ a[j] + l2[j] * d[j])
        value = value @ A[j]

    one = torch.eye(3, dtype=R.dtype)
    P, s = one, torch.zeros(3, dtype=R.dtype)
    by_step = []
    for j in reversed(range(order - 1)):
        J = right_jacobian(-l[j] * d[j])
        dw = l[j] * A[j].mT @ wedge(w[j]) @ J + l1[j] * one
        da = l1[j] * (wedge(w[j + 1]) - wedge(d[j]) @ dw) + l[j] * A[j].mT @ wedge(a[j]) @ J + l2[j] * one
        # Exp(J_l(rho) drho) R: (57) times J_l(rho) is R P_j J_r(l_j d_j).
        by_step.append((l[j] * value @ P @ right_jacobian(l[j] * d[j]), P @ dw, P @ da - wedge(s) @ P @ dw))
        s = s + l1[j] * P @ d[j]
        P = P @ A[j].mT
    by_step.reverse()

    totals = []
    for kind in range(3):
        rows = []
        for j in range(order):
            total = one if (j == 0 and kind == 0) else torch.zeros_like(one)
            if j > 0:
                inverse = torch.linalg.inv(right_jacobian(d[j - 1]))
                total = total + by_step[j - 1][kind] @ inverse @ matrix[j].mT
            if j < order - 1:  # (47): minus the derivative by the next control point
                inverse = torch.linalg.inv(right_jacobian(d[j]))
                total = total - by_step[j][kind] @ inverse @ matrix[j + 1].mT
            rows.append(total)
        totals.append(torch.stack(rows))
    return totals[0], totals[1], totals[2]
