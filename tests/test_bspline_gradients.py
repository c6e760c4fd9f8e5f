"""The gradient contract of `functional.bspline`: every differentiable argument, group, order and precision, from
identical control points to ones nearly half a turn apart.
"""

import itertools

import pytest
import torch
from batteries import GROUPS, LENGTHS, normal, rescaled, scale_blocks
from oracles import exact_directional
from spline_cases import (
    DT,
    GAPS,
    ORDERS,
    T0,
    close,
    configurations,
    control_points,
    exactly_pi_apart,
    fields,
    number,
    sizes,
    times,
)

from torchspline.functional import bspline
from torchspline.groups import SE3, SO3

each_group = pytest.mark.parametrize("group", GROUPS, ids=str)
each_order = pytest.mark.parametrize("order", ORDERS)


# ---------------------------------------------------------------------- first derivatives


@pytest.mark.contract(function="bspline", properties="forward finite")
@each_group
@each_order
def test_forward_mode_is_the_transpose_of_reverse_mode(group, order):
    """<g, J x> = <J^T g, x> to 1e-9, for each configuration by itself, in all four arguments."""
    points = configurations(group, order + 1, seed=order)
    t = times(points.shape[:1])
    function = fields(group, order)
    given = (points, t, number(DT), number(T0))
    rates = (
        normal(*points.shape, seed=1) * sizes(group, points),
        normal(*t.shape, seed=2),
        number(0.4),
        number(-0.7),
    )
    primal = [x.clone().requires_grad_() for x in given]
    out = function(*primal)
    g = normal(*out.shape, seed=3)
    grads = torch.autograd.grad(out, primal, g)
    for which in range(4):
        chosen = [rate if i == which else torch.zeros_like(rate) for i, rate in enumerate(rates)]
        value, forwards = torch.func.jvp(function, given, tuple(chosen))
        assert close(value, out, 1e-14)
        ahead = (g * forwards).sum((-1, -2))
        back = sum(
            ((grad * rate).flatten(1).sum(1) for grad, rate in zip(grads[:2], chosen[:2], strict=True))
        )
        scale = (g * forwards).abs().sum((-1, -2))
        if which < 2:
            assert torch.all((ahead - back).abs() <= 1e-9 * scale.clamp_min(1e-9))
        back = back.sum() + sum(grad * rate for grad, rate in zip(grads[2:], chosen[2:], strict=True))
        assert (ahead.sum() - back).abs() <= 1e-9 * scale.sum()


@pytest.mark.contract(function="bspline", arguments="control_points t", properties="first")
@each_group
@each_order
def test_forward_mode_in_multi_precision(group, order):
    """Directional derivatives by differences on 60 digits: no step size, so nothing hides near zero or pi."""
    u, u_rate = 0.37, 0.8
    for i, points in enumerate(configurations(group, order, seed=2 * order)):
        rate = normal(*points.shape, seed=order + i) * sizes(group, points)

        def function(points, t):
            state = bspline(points, t, group=group, order=order, dt=1.0, derivatives=3, validate=False)
            return tuple(state)

        given, direction = (points, number(u)), (rate, number(u_rate))
        ours = torch.func.jvp(function, given, direction)
        theirs = exact_directional(group, points, u, rate, u_rate, 3)
        for start, stop in group.arithmetic.sign_blocks:
            sign = (ours[0][0][start:stop] @ theirs[0][0][start:stop]).sign()
            for result in theirs:
                result[0][start:stop] *= sign
        for mine, exact in zip(itertools.chain(*ours), itertools.chain(*theirs), strict=True):
            assert close(mine, exact, 2e-13)


@each_group
@pytest.mark.parametrize("order", [2, 4, 7])
def test_time_arguments_against_differences(group, order):
    """t, dt and t0 by central differences; their derivatives are tied: t0 moves all times, dt scales them."""
    points = control_points(group, order + 1, gap=0.9, seed=order)
    t, h = times(), 1e-6
    function = fields(group, order, derivatives=2)
    given = (points, t, number(DT), number(T0))
    for i in (1, 2, 3):
        rate = [torch.ones_like(x) if i == j else torch.zeros_like(x) for j, x in enumerate(given)]
        ours = torch.func.jvp(function, given, tuple(rate))[1]
        ahead, behind = (
            function(*(x + s * h * v for x, v in zip(given, rate, strict=True))) for s in (1.0, -1.0)
        )
        assert close(ours, (ahead - behind) / (2 * h), 1e-8)


@pytest.mark.contract(function="bspline", regimes="identity, small, general", properties="first second")
@pytest.mark.parametrize(
    ("group", "order"), [*((g, (4, 4, 3, 3, 2, 7)[i % 6]) for i, g in enumerate(GROUPS)), (SO3, 2)], ids=str
)
def test_gradcheck(group, order):
    """First and second derivatives by differences, forward over reverse, reverse over reverse, and batched."""
    points = torch.stack([
        control_points(group, order, 0.0, seed=1), control_points(group, order, 1e-8, seed=2),
        control_points(group, order, 0.8, seed=3) * (2.0 if group.arithmetic.unit_blocks else 1.0),
    ])  # fmt: skip
    given = [points, times()[:2].expand(3, -1).clone(), number(DT), number(T0)]
    given = [x.requires_grad_() for x in given]
    function = fields(group, order, derivatives=2, validate=False)
    fast = {"fast_mode": True, "atol": 1e-6, "rtol": 1e-5}
    assert torch.autograd.gradcheck(
        function,
        given,
        check_forward_ad=True,
        check_batched_grad=True,
        check_batched_forward_grad=True,
        **fast,
    )
    assert torch.autograd.gradgradcheck(
        function, given, check_fwd_over_rev=True, check_rev_over_rev=True, **fast
    )


def test_gradcheck_entry_by_entry():
    points = control_points(SO3, 3, 0.7).requires_grad_()
    given = [points, times()[:1].requires_grad_(), number(DT).requires_grad_(), number(T0).requires_grad_()]
    function = fields(SO3, 3, derivatives=3)
    assert torch.autograd.gradcheck(function, given, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(function, given, check_fwd_over_rev=True)


@each_group
@each_order
def test_each_result_alone(group, order):
    """Cotangents of single results, where the sweep leaves out what nobody asked for, sum to that of all."""
    points, t = control_points(group, order + 1, seed=3).requires_grad_(), times().requires_grad_()
    state = bspline(points, t, group=group, order=order, dt=DT, t0=T0, derivatives=3)
    g = [normal(*x.shape, seed=i) for i, x in enumerate(state)]
    together = torch.autograd.grad(state, (points, t), g, retain_graph=True)
    alone = [torch.autograd.grad(x, (points, t), y, retain_graph=True) for x, y in zip(state, g, strict=True)]
    for i in range(2):
        assert close(sum(one[i] for one in alone), together[i], 1e-13)
    for count in range(3):
        fewer = bspline(points, t, group=group, order=order, dt=DT, t0=T0, derivatives=count)
        assert all(x is None for x in fewer[count + 1 :])
        assert all(torch.equal(x, y) for x, y in zip(fewer[: count + 1], state, strict=False))
        assert close(torch.autograd.grad(fewer[count], points, g[count])[0], alone[count][0], 1e-13)


# ---------------------------------------------------------------------- second derivatives


@each_group
@each_order
def test_second_derivatives_in_every_mode(group, order):
    """Forward over reverse, reverse over reverse, forward over forward, for each configuration by itself."""
    points = configurations(group, order, seed=order)
    scale, t = sizes(group, points), times(points.shape[:1])[:, :1]
    function = fields(group, order, validate=False)
    g = normal(len(points), 1, group.point_size + 3 * group.tangent_size, seed=1)

    def losses(x, t):
        return (function(x * scale, t) * g).sum((-1, -2))

    given = (points / scale, t)
    v, w = ((normal(*points.shape, seed=i), normal(*t.shape, seed=i + 1)) for i in (2, 4))
    gradient = torch.func.grad(lambda *given: losses(*given).sum(), argnums=(0, 1))
    forward_reverse = torch.func.jvp(gradient, given, v)[1]
    primal = [x.clone().requires_grad_() for x in given]
    first = torch.autograd.grad(losses(*primal).sum(), primal, create_graph=True)
    slope = sum((x * rate).sum() for x, rate in zip(first, v, strict=True))
    reverse_reverse = torch.autograd.grad(slope, primal)
    forward_forward = torch.func.jvp(lambda *given: torch.func.jvp(losses, given, w)[1], given, v)[1]
    for i in range(len(points)):
        for one, other in zip(forward_reverse, reverse_reverse, strict=True):
            assert close(one[i], other[i], 1e-12)
    products = [(rate * x).flatten(1) for rate, x in zip(w, forward_reverse, strict=True)]
    products = torch.cat(products, dim=1)
    assert torch.all(
        (products.sum(1) - forward_forward).abs() <= 1e-12 * products.abs().sum(1).clamp_min(1e-3)
    )


def test_hessian_is_symmetric():
    points = control_points(SE3, 4, 0.8)
    function = fields(SE3, 4, validate=False)

    def loss(x):
        return function(x, times()[:1]).square().sum()

    hessian = torch.func.hessian(loss)(points).reshape(28, 28)
    assert close(hessian, hessian.mT, 1e-13)
    assert close(torch.autograd.functional.hessian(loss, points).reshape(28, 28), hessian, 1e-13)


# ---------------------------------------------------------------------- special control points


@pytest.mark.parametrize("group", [g for g in GROUPS if g.arithmetic.unit_blocks], ids=str)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_exactly_pi_apart(group, dtype):
    """The logarithm jumps there: finite and always the same, whatever the signs of the quaternions."""
    for order in ORDERS:
        points = exactly_pi_apart(group, order + 1).to(dtype)
        flipped = rescaled(group, points.flatten(0, 1), (1.0, -1.0, 1.0, 1.0, -1.0)).reshape(points.shape)
        results = []
        for x in (points, points, flipped):
            x = x.clone().requires_grad_()
            out = fields(group, order)(x, times())
            (gradient,) = torch.autograd.grad(out.square().sum(), x)
            results.append((out, gradient))
        for out, gradient in results:
            assert torch.isfinite(out).all()
            assert torch.isfinite(gradient).all()
        assert all(torch.equal(a, b) for a, b in zip(*results[:2], strict=True))
        rates = [out[..., group.point_size :] for out, _ in results]
        assert torch.equal(rates[0], rates[2])


@pytest.mark.parametrize("group", [g for g in GROUPS if g.arithmetic.unit_blocks], ids=str)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_length_and_sign_of_quaternions(group, dtype):
    """Results do not depend on them; gradients are orthogonal to quaternions and shrink as these grow."""
    for order in ORDERS:
        points = control_points(group, 9, seed=order).to(dtype)
        factors = torch.tensor(LENGTHS, dtype=torch.float64).repeat(2)[:9] * normal(9, seed=order).sign()
        factors[0] = 70.0  # its sign would be that of all results
        scale = torch.ones_like(points)
        for start, stop, signed in scale_blocks(group):
            scale[:, start:stop] = (factors if signed else factors.abs())[:, None].to(dtype)
        results = []
        for numbers, size in ((points, torch.ones_like(scale)), (points * scale, scale)):
            x = numbers.clone().requires_grad_()
            out = fields(group, order)(x, times(dtype=dtype))
            (gradient,) = torch.autograd.grad(
                out, x, normal(*out.shape, seed=5, dtype=dtype), create_graph=True
            )
            direction = size * normal(*x.shape, seed=6, dtype=dtype)
            (second,) = torch.autograd.grad((gradient * direction).sum(), x)
            results.append((out, gradient * size, second * size))
            for start, stop, _ in scale_blocks(group):
                along = (gradient * numbers)[:, start:stop].sum(-1)
                assert close(along, torch.zeros_like(along), 100 * torch.finfo(dtype).eps)
        for mine, others in zip(*results, strict=True):
            assert close(mine, others, 1e3 * torch.finfo(dtype).eps)


@pytest.mark.contract(
    function="bspline", arguments="control_points t", regimes="identity, small, general", dtypes="float32",
    properties="single",
)  # fmt: skip
@pytest.mark.contract(function="bspline", arguments="control_points t", dtypes="float32", properties="finite")
@each_group
@each_order
def test_single_precision(group, order):
    """float32 results and gradients against float64 from the same rounded numbers."""
    points = configurations(group, order + 1, seed=order).float()
    almost_pi = list(GAPS).index("almost pi apart")
    results = []
    for dtype in (torch.float32, torch.float64):
        x, t = (y.clone().to(dtype).requires_grad_() for y in (points, times((len(points),), torch.float32)))
        out = fields(group, order)(x, t)
        g = normal(*out.shape, seed=4).to(dtype)
        grads = torch.autograd.grad(out, (x, t), g)
        assert all(y.dtype == dtype for y in (out, *grads))
        assert all(torch.isfinite(y).all() for y in (out, *grads))
        results.append((out, grads[0] * sizes(group, points.to(dtype)), grads[1]))
    for single, double in zip(*results, strict=True):
        for i, (a, b) in enumerate(zip(single.double(), double, strict=True)):
            if i != almost_pi:  # which side of pi it is, single precision cannot tell
                assert close(a, b, 2e-5)
