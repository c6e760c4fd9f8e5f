"""The recurrences of velocity, acceleration and jerk and their sweeps, against everything that can tell better.

Product rule on matrices, nested forward mode, finite differences, multi-precision numbers, [S20]'s own Jacobians.
"""

import mpmath as mp
import pytest
import torch
from batteries import GROUPS, generator, normal, tangents
from oracles import body_rates, exact_bspline, polynomial_weights, product_rule, so3_jacobians
from spline_cases import ORDERS, chain, configurations, control_points

from torchspline.arithmetic.recurrence import forward, reverse, tangent
from torchspline.arithmetic.vector import dot
from torchspline.functional import bspline
from torchspline.groups import SO3
from torchspline.groups.components import join, split

each_group = pytest.mark.parametrize("group", GROUPS, ids=str)
each_order = pytest.mark.parametrize("order", ORDERS)


def close(actual: torch.Tensor, expected: torch.Tensor, tolerance: float) -> bool:
    """Relative to the largest number expected, at least to one."""
    assert actual.shape == expected.shape
    return bool((actual - expected).abs().max() <= tolerance * expected.abs().max().clamp_min(1.0))


def random_problem(group, order, queries=5, seed=0):
    """Components of a start point, and steps and weights without any relation to each other."""
    steps = tangents(group, [0.3, 2.9, 1.4, 0.9, 2.0, 0.05][: order - 1], each=queries, seed=seed)
    steps = steps.reshape(order - 1, queries, -1)
    weights = normal(4, order - 1, queries, seed=seed + 1)
    weights[0] = weights[0].sigmoid()
    start = group.random(queries, generator=generator(seed + 2))
    return start, steps, weights


# ---------------------------------------------------------------------- values


@each_group
@each_order
def test_product_rule_of_prior_work(group, order):
    """[S20] (30)-(32) and the same for the second and third derivative, for weights of any kind."""
    start, steps, weights = random_problem(group, order)
    expected = product_rule(group, group.to_matrix(start), steps, weights)
    rates = body_rates(group, expected)
    for derivatives in range(4):
        value, trace = forward(
            group.arithmetic, split(start), [split(d) for d in steps], weights[: derivatives + 1], derivatives
        )
        assert close(group.to_matrix(join(value, start)), expected[0], 2e-14)
        assert len(trace[-1].rates) == derivatives
        for rate, exact in zip(trace[-1].rates, rates, strict=False):
            assert close(join(rate, start), exact, 2e-13)


@each_group
@each_order
def test_bspline_is_the_product_of_its_segment(group, order):
    """Definition 5.1 of [S20]: segment i takes control points i to i + k - 1; rates are per second."""
    dt, t0, count = 0.375, -2.0, order + 3  # exact in binary, so that knots are met exactly
    steps = tangents(group, [1.7, 0.4], each=count, seed=order)[: count - 1]
    points = chain(group, steps, seed=1)
    u = torch.tensor([0.0, 0.03, 0.5, 0.97], dtype=torch.float64)
    for segment in (0, count - order):
        state = bspline(
            points, t0 + (segment + u) * dt, group=group, order=order, dt=dt, t0=t0, derivatives=3
        )
        weights = polynomial_weights(u, order, 3)
        start = group.to_matrix(points[segment])
        matrices = product_rule(group, start, steps[segment : segment + order - 1], weights)
        assert close(group.to_matrix(state.value), matrices[0], 2e-14)
        for r, (rate, exact) in enumerate(zip(state[1:], body_rates(group, matrices), strict=True), start=1):
            assert close(rate * dt**r, exact, 1e-13)


@each_group
@each_order
def test_nested_forward_mode(group, order):
    """Derivatives of the value by automatic differentiation, three times over, are the recurrences' derivatives."""
    points = control_points(group, order + 2, gap=1.2, seed=order)
    t = torch.tensor([0.1, 0.77, 1.5, 2.4], dtype=torch.float64) * 0.6

    def value(t):
        state = bspline(points, t, group=group, order=order, dt=0.6, derivatives=0, validate=False)
        return group.to_matrix(state.value)

    def differentiated(f):
        return lambda t: torch.func.jvp(f, (t,), (torch.ones_like(t),))

    both = differentiated(differentiated(differentiated(value)))(t)
    matrices = [both[0][0][0], both[1][0][0], both[1][1][0], both[1][1][1]]
    state = bspline(points, t, group=group, order=order, dt=0.6, derivatives=3)
    for rate, exact in zip(state[1:], body_rates(group, matrices), strict=True):
        assert close(rate, exact, 1e-13)


@each_group
def test_each_rate_is_the_slope_of_the_one_before(group):
    """Central differences, away from the knots where an order 4 jerk jumps."""
    points, h = control_points(group, 8, gap=1.0, seed=3), 1e-5
    t = torch.tensor([0.2, 1.5, 2.9, 4.4], dtype=torch.float64)

    def evaluate(t):
        return bspline(points, t, group=group, derivatives=3, dt=1.0, order=4)

    here, ahead, behind = evaluate(t), evaluate(t + h), evaluate(t - h)
    logs = (group.log(group.between(here.value, x.value)) for x in (ahead, behind))
    slopes = [next(logs) - next(logs), ahead[1] - behind[1], ahead[2] - behind[2]]
    for slope, rate in zip(slopes, here[1:], strict=True):
        assert close(slope / (2 * h), rate, 2e-9)


@each_group
@each_order
def test_multi_precision_numbers(group, order):
    """The same lines of code on 50 digits: tensors lose nothing but rounding, at any distance of neighbours."""
    places = (0.0, 0.3, 0.999)
    for points in configurations(group, order, seed=order):
        t = torch.tensor(places, dtype=torch.float64)
        state = bspline(points, t, group=group, order=order, dt=1.0, derivatives=3)
        with mp.workdps(50):
            rows = [[mp.mpf(x) for x in row] for row in points.tolist()]
            exact = [exact_bspline(group, rows, mp.mpf(u), 3) for u in places]
            exact = [to_float64(query[r] for query in exact) for r in range(4)]
        exact[0] = aligned(group, exact[0], state.value)
        for ours, theirs in zip(state, exact, strict=True):
            assert close(ours, theirs, 2e-14)


def to_float64(rows):
    return torch.tensor([[float(x) for x in row] for row in rows], dtype=torch.float64)


def aligned(group, points, like):
    """With the signs of other quaternions: those of the oracle do not continue from point to point."""
    points = points.clone()
    for start, stop in group.arithmetic.sign_blocks:
        same = (points[..., start:stop] * like[..., start:stop]).sum(-1, keepdim=True)
        points[..., start:stop] *= same.sign()
    return points


# ---------------------------------------------------------------------- sweeps


def sweeps(group, order, derivatives, seed=0):
    """Arguments of the two sweeps on random directions."""
    start, steps, weights = random_problem(group, order, seed=seed)
    weights = weights[: derivatives + 1]
    start_rate, *rates_g = (normal(*steps.shape[1:], seed=seed + 7 + i) for i in range(derivatives + 2))
    steps_rate, weights_rate = normal(*steps.shape, seed=seed + 5), normal(*weights.shape, seed=seed + 6)
    return (start, steps, weights), (start_rate, steps_rate, weights_rate), rates_g


@each_group
@each_order
def test_tangent_sweep_is_the_derivative(group, order):
    """First variations against automatic differentiation of the forward recurrence on components."""
    algebra = group.arithmetic
    for derivatives in range(4):
        given, (start_rate, steps_rate, weights_rate), _ = sweeps(group, order, derivatives)
        start, steps, weights = given

        def run(start, steps, weights, derivatives=derivatives):
            value, trace = forward(algebra, split(start), [split(d) for d in steps], weights, derivatives)
            return tuple(join(x, start) for x in (value, *trace[-1].rates))

        numbers_rate = join(algebra.push(split(start), split(start_rate)), start)
        exact = torch.func.jvp(run, given, (numbers_rate, steps_rate, weights_rate))[1]
        value, trace = forward(algebra, split(start), [split(d) for d in steps], weights, derivatives)
        xi, rates = tangent(
            algebra, [split(d) for d in steps], weights, trace,
            split(start_rate), [split(d) for d in steps_rate], weights_rate,
        )  # fmt: skip
        assert close(join(algebra.push(value, xi), start), exact[0], 2e-14)
        for rate, expected in zip(rates, exact[1:], strict=True):
            assert close(join(rate, start), expected, 2e-14)


@each_group
@each_order
def test_reverse_sweep_is_its_transpose(group, order):
    """<g, tangent(x)> = <reverse(g), x> for random g and x: all cotangents, to rounding."""
    algebra = group.arithmetic
    for derivatives in range(4):
        (start, steps, weights), (start_rate, steps_rate, weights_rate), (g, *rates_g) = sweeps(
            group, order, derivatives
        )
        d = [split(x) for x in steps]
        _, trace = forward(algebra, split(start), d, weights, derivatives)
        xi, rates = tangent(
            algebra, d, weights, trace, split(start_rate), [split(x) for x in steps_rate], weights_rate
        )
        start_g, steps_g, weights_g = reverse(
            algebra, d, weights, trace, split(g), [split(r) for r in rates_g]
        )
        one = torch.ones(5, dtype=torch.float64)
        forwards = [dot(split(a), b) for a, b in zip((g, *rates_g), (xi, *rates), strict=True)]
        backwards = [dot(start_g, split(start_rate))]
        backwards += [dot(a, split(b)) for a, b in zip(steps_g, steps_rate, strict=True)]
        backwards += [dot(a, b) for a, b in zip(weights_g, weights_rate, strict=True)]
        size = sum((x * one).abs() for x in (*forwards, *backwards))
        assert torch.all((sum(forwards) - sum(backwards)).abs() < 1e-13 * size)


# ---------------------------------------------------------------------- Jacobians


@each_order
def test_jacobians_of_theorems_5_4_to_5_6(order):
    """Autograd of the library, turned into Jacobians for left perturbations, against [S20]'s recurrence."""
    points = control_points(SO3, order, gap=1.1, seed=order)
    for u in (0.15, 0.5, 0.92):
        t = torch.tensor(u, dtype=torch.float64)

        def outputs(delta, t=t):
            moved = SO3.retract(points, delta, side="left", validate=False)
            state = bspline(moved, t, group=SO3, order=order, dt=1.0, validate=False)
            origin = bspline(points, t, group=SO3, order=order, dt=1.0).value
            left = SO3.log(SO3.compose(state.value, SO3.inverse(origin), validate=False), validate=False)
            return left, state.velocity, state.acceleration

        expected = so3_jacobians(points, t)
        for mode in (torch.func.jacrev, torch.func.jacfwd):
            for ours, exact in zip(mode(outputs)(torch.zeros(order, 3).double()), expected, strict=True):
                assert close(ours.movedim(1, 0), exact, 1e-13)
