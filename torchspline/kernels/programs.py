"""What is compiled: the library's arithmetic, written out as flat functions of numbers."""

from collections.abc import Sequence
from fractions import Fraction

import torch

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.recurrence import (
    difference_reverse,
    difference_tangent,
    forward,
    parameter_cotangent,
    reverse,
)
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector, dot, plus, scale, times, zero
from torchspline.checks import LONGEST_QUATERNION, SHORTEST_QUATERNION
from torchspline.kernels.trace import Symbol, Trace, indicator, trace

RationalRows = Sequence[Sequence[Fraction]]


def _weights(u: Scalar, rows: RationalRows, derivatives: int) -> list[list[Scalar]]:
    """Polynomials of u and their derivatives, by Horner's rule: the cumulative basis without its first row."""
    table = []
    for _ in range(derivatives + 1):
        values: list[Scalar] = []
        for row in rows:
            value: Scalar = float(row[-1])
            for coefficient in reversed(row[:-1]):
                value = plus(times(value, u), float(coefficient))
            values.append(value)
        table.append(values)
        rows = [[*(n * c for n, c in enumerate(row) if n > 0), Fraction(0)] for row in rows]
    return table


def _chop(v: Vector, size: int) -> list[Vector]:
    return [v[i : i + size] for i in range(0, len(v), size)]


def forward_program(
    group: GroupArithmetic, rows: RationalRows, derivatives: int, dtype: torch.dtype
) -> Trace:
    """Inputs u, start, steps, scale (1/dt, 1/dt^2, ...); outputs value and scaled rates."""
    count = len(rows)

    def run(u: Vector, start: Vector, steps: Vector, scales: Vector) -> list[Scalar]:
        weights = _weights(u[0], rows, derivatives)
        value, sweep = forward(
            group, start, _chop(steps, group.tangent_size), weights, derivatives, short=True
        )
        rates = (scale(s, rate) for s, rate in zip(scales, sweep[-1].rates, strict=True))
        return [*value, *(c for rate in rates for c in rate)]

    return trace(run, [1, group.point_size, count * group.tangent_size, derivatives], dtype)


def reverse_program(
    group: GroupArithmetic, rows: RationalRows, derivatives: int, dtype: torch.dtype
) -> Trace:
    """Inputs u, value, its cotangent, rate cotangents, steps, scale; outputs body cotangents of start and steps, and
    the cotangent of u."""
    count, size = len(rows), group.tangent_size

    def run(
        u: Vector, value: Vector, value_g: Vector, rates_g: Vector, steps: Vector, scales: Vector
    ) -> list[Scalar]:
        weights = _weights(u[0], rows, derivatives + 1)
        chopped = _chop(steps, size)
        used = weights[: derivatives + 1]
        # The value of this sweep is not used: the one of the forward pass is an input, so composing is left out.
        _, sweep = forward(group, value, chopped, used, derivatives, short=True)
        cotangents = [scale(s, g) for s, g in zip(scales, _chop(rates_g, size), strict=True)]
        start_g, steps_g, weights_g = reverse(
            group, chopped, used, sweep, group.pull(value, value_g), cotangents, short=True
        )
        u_g = parameter_cotangent(weights_g, weights)
        return [*start_g, *(c for g in steps_g for c in g), u_g]

    sizes = [1, group.point_size, group.point_size, derivatives * size, count * size, derivatives]
    return trace(run, sizes, dtype)


def row_program(
    group: GroupArithmetic, rows: RationalRows, parts: Sequence[bool], dtype: torch.dtype
) -> Trace:
    """One row of a Jacobian. Inputs u, steps, a body cotangent of each of the `parts` (value, velocity, ...) that is
    True, scale; outputs cotangents of start and steps."""
    count, size, derivatives = len(rows), group.tangent_size, len(parts) - 1

    def run(u: Vector, steps: Vector, cotangents: Vector, scales: Vector) -> list[Scalar]:
        weights = _weights(u[0], rows, derivatives)
        chopped, given = _chop(steps, size), iter(_chop(cotangents, size))
        start = group.identity()  # what is asked for does not depend on it
        _, sweep = forward(group, start, chopped, weights, derivatives, short=True)
        value_g, *rates_g = (next(given) if part else zero(size) for part in parts)
        scaled = [scale(s, g) for s, g in zip(scales, rates_g, strict=True)]
        start_g, steps_g, _ = reverse(group, chopped, weights, sweep, value_g, scaled, short=True)
        return [*start_g, *(c for g in steps_g for c in g)]

    return trace(run, [1, count * size, sum(parts) * size, derivatives], dtype)


def pair_jacobian(group: GroupArithmetic, d: Vector) -> list[Scalar]:
    """The matrices of `difference_tangent`, row by row: how d changes with the first and with the second of a pair."""
    size = group.tangent_size
    columns = []
    for e in (tuple(float(i == j) for i in range(size)) for j in range(size)):
        columns.append(difference_tangent(group, d, e, zero(size)))
    for e in (tuple(float(i == j) for i in range(size)) for j in range(size)):
        columns.append(difference_tangent(group, d, zero(size), e))
    return [columns[half * size + j][i] for half in (0, 1) for i in range(size) for j in range(size)]


def retraction(group: GroupArithmetic, X: Vector, x: Vector) -> Vector:
    """X Exp(x) for stored X."""
    return group.normalize(group.compose(group.normalize(X), group.exp(x)))


def pairs_program(group: GroupArithmetic, dtype: torch.dtype) -> Trace:
    """Inputs stored neighbours a, b; outputs unit a, the logarithm from a to b, 1 for each sign block to flip, and 1 if
    a is not a point: a number that is not finite, a quaternion too short or long to divide by."""

    def run(a: Vector, b: Vector) -> list[Scalar]:
        unit = group.normalize(a)
        between = group.between(unit, group.normalize(b))
        flips = [indicator(flip) for flip in group.long_way(between)]
        return [*unit, *group.log(between), *flips, 1.0 - indicator(valid_point(group, a))]

    return trace(run, [group.point_size, group.point_size], dtype)


def finite(numbers: Vector) -> Symbol:
    """Whether all numbers are finite."""
    difference = numbers[0] - numbers[0]  # 0, or not a number if that is infinite or not a number
    for x in numbers[1:]:
        difference = difference + (x - x)
    return difference == 0.0


def valid_point(group: GroupArithmetic, stored: Vector) -> Symbol:
    """Whether stored numbers are a point: finite, quaternions of a length that can be divided by."""
    valid = finite(stored)
    shortest, longest = (SHORTEST_QUATERNION * 0.999) ** 2, (LONGEST_QUATERNION * 1.001) ** 2
    for start, stop in group.unit_blocks:
        squared = dot(stored[start:stop], stored[start:stop])
        valid = valid & (-squared < -shortest) & (squared < longest)  # `>` would be a far path, see `trace`
    return valid


def pairs_reverse(group: GroupArithmetic, d: Vector, g: Vector) -> list[Scalar]:
    """Body cotangents of second and first of a pair, from its logarithm and the cotangent of that."""
    first, second = difference_reverse(group, d, g)
    return [*second, *first]
