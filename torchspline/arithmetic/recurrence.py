"""The cumulative product `X(u) = X_0 Exp(l_1 d_1) ... Exp(l_n d_n)` on any group, O(n) in every direction.

Written once, for every group and every family of curves that is a product of geodesics: B-splines ([S20] 4-5) and
geodesic interpolation; Hermite segments ([E17]) have the same form.

===============  =======================================================================  ===================
symbol           meaning                                                                  [S20]
===============  =======================================================================  ===================
start            X_0, the point the product starts from                                   X_i in (26)
steps            d_1 ... d_n, tangents                                                    (24)
weights[r][j]    r-th derivative of the scalar l_j by the parameter u                     (21)
value            X(u)                                                                     (28)
rates            w, a, b: velocity, acceleration, jerk in the body frame, by u            (34), (41), (75)
factor           A_j = Exp(l_j d_j)                                                       (25)
carried          Ad_{A_j^-1} of the rates before step j: rates without the step's own     (43)
eta              body tangent of A_j when d_j and l_j change                              (10)
===============  =======================================================================  ===================

A perturbation of `value` is a body tangent (`X Exp(xi)`), a cotangent the dual of one.
"""

from collections.abc import Sequence
from typing import NamedTuple

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector, add, dot, is_zero, negate, plus, scale, times, zero

Weights = Sequence[Sequence[Scalar]]

#: Value, velocity, acceleration and jerk: what the recurrences know.
MAX_DERIVATIVES = 3


class Step(NamedTuple):
    """What one step leaves behind for the sweeps that follow it."""

    factor: Vector
    carried: tuple[Vector, ...]
    rates: tuple[Vector, ...]


def difference(group: GroupArithmetic, X: Vector, Y: Vector) -> Vector:
    """d = Log(X^-1 Y), [S20] (24)."""
    return group.log(group.between(X, Y))


def difference_reverse(group: GroupArithmetic, d: Vector, g: Vector) -> tuple[Vector, Vector]:
    """Body cotangents of X and Y, from that of their difference; [S20] (47), transposed, for any group."""
    of_first = negate(group.left_jacobian_inverse_transpose(d, g, short=True))
    return of_first, group.right_jacobian_inverse_transpose(d, g, short=True)


def difference_tangent(group: GroupArithmetic, d: Vector, first_rate: Vector, second_rate: Vector) -> Vector:
    """Change of the difference when X and Y move with these body tangents."""
    of_first = negate(group.left_jacobian_inverse(d, first_rate, short=True))
    return add(of_first, group.right_jacobian_inverse(d, second_rate, short=True))


def parameter_cotangent(weights_g: Weights, weights: Weights) -> Scalar:
    """Cotangent of u: each derivative of a weight moves with u at the rate of the next one."""
    total: Scalar = 0.0
    for row_g, next_row in zip(weights_g, weights[1:], strict=True):
        for g, rate in zip(row_g, next_row, strict=True):
            total = plus(total, times(g, rate))
    return total


def _transport(group: GroupArithmetic, factor: Vector, v: Vector) -> Vector:
    return v if is_zero(v) else group.adjoint_inverse(factor, v)


def forward_step(
    group: GroupArithmetic, rates: tuple[Vector, ...], d: Vector, l: Sequence[Scalar], short: bool
) -> Step:
    """One step of [S20] (34), (41) and (75); corrects (75), which lost its dots: they are read off (77)."""
    factor = group.exp(scale(l[0], d), short)
    carried = tuple(_transport(group, factor, rate) for rate in rates)
    after: list[Vector] = []
    if len(rates) > 0:
        w = add(carried[0], scale(l[1], d))
        after.append(w)
    if len(rates) > 1:
        w_d = group.bracket(w, d)
        a = add(carried[1], scale(l[1], w_d), scale(l[2], d))
        after.append(a)
    if len(rates) > 2:
        inner = _jerk_inner(w, a, w_d, l)
        after.append(add(carried[2], group.bracket(inner, d), scale(l[3], d)))
    return Step(factor, carried, tuple(after))


def _jerk_inner(w: Vector, a: Vector, w_d: Vector, l: Sequence[Scalar]) -> Vector:
    """The left side of the bracket in [S20] (75)."""
    return add(scale(l[2], w), scale(2.0 * l[1], a), scale(-(l[1] * l[1]), w_d))


def forward(
    group: GroupArithmetic,
    start: Vector,
    steps: Sequence[Vector],
    weights: Weights,
    derivatives: int,
    short: bool = False,
) -> tuple[Vector, list[Step]]:
    """Value and, in the last of the returned steps, its derivatives; all steps for the sweeps below.

    Args:
        derivatives: 0 to 3; `weights` has one row more.
        short: promises that no rotation of `l_j d_j` exceeds pi, as in a B-spline inside its domain.
    """
    value, trace = start, []
    rates: tuple[Vector, ...] = (zero(group.tangent_size),) * derivatives
    for j, d in enumerate(steps):
        step = forward_step(group, rates, d, [row[j] for row in weights], short)
        value = group.compose(value, step.factor)
        rates = step.rates
        trace.append(step)
    return value, trace


def reverse(
    group: GroupArithmetic,
    steps: Sequence[Vector],
    weights: Weights,
    trace: Sequence[Step],
    value_cotangent: Vector,
    rate_cotangents: Sequence[Vector],
    short: bool = False,
    steps_move: bool = True,
) -> tuple[Vector, list[Vector], list[list[Scalar]]]:
    """Reverse sweep: cotangents of start (body frame), of every step (if `steps_move`) and of every weight.

    Perturbing `A_j -> A_j Exp(eta)` moves the value by eta and each carried rate c by [c, eta]; then eta itself is
    `l_j J_r(l_j d_j)` of the change of d_j, plus d_j times the change of l_j. Everything else is linear. The
    generalisation of [S20] Theorems 5.4-5.6 to any group, transposed.
    """
    g, rates_g = value_cotangent, list(rate_cotangents)
    steps_g: list[Vector] = [()] * len(steps)
    weights_g: list[list[Scalar]] = [[0.0] * len(steps) for _ in weights]
    for j in reversed(range(len(steps))):
        d, l, step = steps[j], [row[j] for row in weights], trace[j]
        d_g, l_g, eta_g = _reverse_step(group, d, l, step, rates_g)
        eta_g = add(g, eta_g)
        if steps_move:
            through_exp = group.right_jacobian_transpose(scale(l[0], d), eta_g, short)
            steps_g[j] = add(d_g, scale(l[0], through_exp))
        l_g[0] = plus(l_g[0], dot(d, eta_g))
        for row, component in zip(weights_g, l_g, strict=True):
            row[j] = component
        g = group.coadjoint_inverse(step.factor, g)
        if j > 0:  # the rates before the first step are zero, nobody asks for their cotangents
            rates_g = [r if is_zero(r) else group.coadjoint_inverse(step.factor, r) for r in rates_g]
    return g, steps_g, weights_g


def _reverse_step(
    group: GroupArithmetic, d: Vector, l: Sequence[Scalar], step: Step, rates_g: list[Vector]
) -> tuple[Vector, list[Scalar], Vector]:
    """Cotangents of d (outside the exponential), of the weights and of eta; turns `rates_g` into those carried."""
    d_g, l_g = zero(len(d)), [0.0] * len(l)
    if len(rates_g) == 0:
        return d_g, l_g, zero(len(d))
    w = step.rates[0]
    w_g = rates_g[0]
    if len(rates_g) > 1:
        a_g = rates_g[1]
        w_d = group.bracket(w, d)
        w_d_g = zero(len(d))
        if len(rates_g) > 2:
            a, b_g = step.rates[1], rates_g[2]
            inner = _jerk_inner(w, a, w_d, l)
            inner_g = negate(group.cobracket(d, b_g))
            d_g = add(d_g, scale(l[3], b_g), group.cobracket(inner, b_g))
            l_g[3] = dot(b_g, d)
            l_g[2] = dot(inner_g, w)
            l_g[1] = plus(times(2.0, dot(inner_g, a)), times(-2.0, times(l[1], dot(inner_g, w_d))))
            w_g = add(w_g, scale(l[2], inner_g))
            a_g = add(a_g, scale(2.0 * l[1], inner_g))
            w_d_g = scale(-(l[1] * l[1]), inner_g)
        w_d_g = add(w_d_g, scale(l[1], a_g))
        l_g[1] = plus(l_g[1], dot(a_g, w_d))
        l_g[2] = plus(l_g[2], dot(a_g, d))
        d_g = add(d_g, scale(l[2], a_g), group.cobracket(w, w_d_g))
        w_g = add(w_g, negate(group.cobracket(d, w_d_g)))
        rates_g[1] = a_g
    l_g[1] = plus(l_g[1], dot(w_g, d))
    d_g = add(d_g, scale(l[1], w_g))
    rates_g[0] = w_g
    eta_g = add(*(group.cobracket(c, c_g) for c, c_g in zip(step.carried, rates_g, strict=True)))
    return d_g, l_g, eta_g


def tangent(
    group: GroupArithmetic,
    steps: Sequence[Vector],
    weights: Weights,
    trace: Sequence[Step],
    start_rate: Vector,
    steps_rate: Sequence[Vector],
    weights_rate: Weights,
    short: bool = False,
) -> tuple[Vector, tuple[Vector, ...]]:
    """Forward sweep of first variations: body tangent of the value and rates of its derivatives.

    Args:
        start_rate: body tangent of `start`; `steps_rate`, `weights_rate`: changes of the steps and weights.
    """
    xi = start_rate
    rates: tuple[Vector, ...] = (zero(group.tangent_size),) * len(trace[0].rates)
    for j, step in enumerate(trace):
        d, dd = steps[j], steps_rate[j]
        l, dl = [row[j] for row in weights], [row[j] for row in weights_rate]
        eta = add(scale(l[0], group.right_jacobian(scale(l[0], d), dd, short)), scale(dl[0], d))
        xi = add(_transport(group, step.factor, xi), eta)
        rates = _tangent_step(group, (d, dd), (l, dl), step, rates, eta)
    return xi, rates


def _tangent_step(
    group: GroupArithmetic,
    d_pair: tuple[Vector, Vector],
    l_pair: tuple[Sequence[Scalar], Sequence[Scalar]],
    step: Step,
    rates: tuple[Vector, ...],
    eta: Vector,
) -> tuple[Vector, ...]:
    (d, dd), (l, dl) = d_pair, l_pair
    moved = [
        add(_transport(group, step.factor, rate), group.bracket(c, eta))
        for rate, c in zip(rates, step.carried, strict=True)
    ]
    after: list[Vector] = []
    if len(rates) > 0:
        w = step.rates[0]
        dw = add(moved[0], scale(l[1], dd), scale(dl[1], d))
        after.append(dw)
    if len(rates) > 1:
        a = step.rates[1]
        w_d = group.bracket(w, d)
        dw_d = add(group.bracket(dw, d), group.bracket(w, dd))
        da = add(moved[1], scale(l[1], dw_d), scale(dl[1], w_d), scale(l[2], dd), scale(dl[2], d))
        after.append(da)
    if len(rates) > 2:
        inner = _jerk_inner(w, a, w_d, l)
        dinner = add(
            _jerk_inner(dw, da, dw_d, l),
            scale(dl[2], w),
            scale(2.0 * dl[1], a),
            scale(-2.0 * l[1] * dl[1], w_d),
        )
        brackets = add(group.bracket(dinner, d), group.bracket(inner, dd))
        after.append(add(moved[2], brackets, scale(l[3], dd), scale(dl[3], d)))
    return tuple(after)
