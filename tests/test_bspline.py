"""Shapes, domains and their ends, clocks, and the signs of quaternions."""

import numpy as np
import pytest
import torch
from batteries import GROUPS, normal, rescaled
from spline_cases import ORDERS, close, control_points, number

from torchspline import BSpline
from torchspline.functional import bspline
from torchspline.groups import R3, SE3, SO3, Group

each_group = pytest.mark.parametrize("group", GROUPS, ids=str)
float64 = torch.float64


def at(*values, dtype=float64):
    return torch.tensor(values, dtype=dtype)


def stack(group, *batch, count=6):
    size = int(np.prod(batch))
    rows = [control_points(group, count, seed=i) for i in range(size)]
    return (
        torch.stack(rows).reshape(*batch, count, -1)
        if size
        else torch.zeros(*batch, count, group.point_size).double()
    )


# ---------------------------------------------------------------------- shapes

SHAPES = [  # batch of control points, shape of times, shape of results
    ((), (), ()),
    ((), (5,), (5,)),
    ((), (0,), (0,)),
    ((), (2, 5), (2, 5)),
    ((), (2, 3, 5), (2, 3, 5)),
    ((4,), (), (4,)),
    ((4,), (5,), (4, 5)),
    ((4,), (4,), (4, 4)),
    ((4,), (4, 5), (4, 5)),
    ((4,), (1, 5), (4, 5)),
    ((1,), (5,), (1, 5)),
    ((1,), (4, 5), (4, 5)),
    ((0,), (5,), (0, 5)),
    ((0,), (), (0,)),
    ((0,), (0, 5), (0, 5)),
    ((4,), (4, 0), (4, 0)),
    ((2, 3), (5,), (2, 3, 5)),
    ((2, 3), (3, 5), (2, 3, 5)),
    ((2, 1), (3, 5), (2, 3, 5)),
    ((2, 1), (1, 3, 5), (2, 3, 5)),
    ((3,), (2, 1, 5), (2, 3, 5)),
    ((2, 3), (), (2, 3)),
]


@pytest.mark.parametrize("group", [SE3, R3], ids=str)
@pytest.mark.parametrize(("batch", "times", "shape"), SHAPES, ids=str)
def test_shapes(group, batch, times, shape):
    points = stack(group, *batch)
    t = (3.0 * torch.rand(times, dtype=float64, generator=torch.Generator().manual_seed(0))).requires_grad_()
    x = points.clone().requires_grad_()
    state = bspline(x, t, group=group, dt=1.0, derivatives=3)
    for r, field in enumerate(state):
        assert field.shape == (*shape, group.point_size if r == 0 else group.tangent_size)
    grads = torch.autograd.grad(sum(field.square().sum() for field in state), (x, t))
    assert [g.shape for g in grads] == [x.shape, t.shape]
    if 0 in shape:
        return
    # Each number is that of its own trajectory at its own time.
    dims = len(shape) - (len(times) > 0)
    whole = points.expand(*shape[:dims], *points.shape[-2:]).reshape(-1, *points.shape[-2:])
    own = (
        t.detach().expand(shape if times else ()).reshape(len(whole), -1)
        if times
        else t.detach().expand(len(whole), 1)
    )
    for r, field in enumerate(state):
        rows = [bspline(p, s, group=group, dt=1.0, derivatives=3)[r] for p, s in zip(whole, own, strict=True)]
        assert close(field.detach(), torch.stack(rows).reshape(field.shape), 1e-14)


def test_shapes_that_do_not_broadcast():
    with pytest.raises(ValueError, match=r"batch shapes do not broadcast: control_points \(4,\), t \(3,\)"):
        bspline(stack(SE3, 4), torch.zeros(3, 5).double(), group=SE3, dt=1.0)


@each_group
@pytest.mark.parametrize("order", ORDERS)
def test_number_of_control_points(group, order):
    points = control_points(group, order, seed=order)
    state = bspline(points, at(0.0, 1.0), group=group, order=order, dt=1.0)
    assert torch.isfinite(state.acceleration).all()
    with pytest.raises(
        ValueError, match=f"order {order} needs at least {order} control points, got {order - 1}"
    ):
        bspline(points[1:], at(0.0), group=group, order=order, dt=1.0)
    standing = bspline(
        points[:1].expand(order + 3, -1), at(0.0, 0.3, 3.9), group=group, order=order, dt=1.0, derivatives=3
    )
    assert close(standing.value, group.normalize(points[:1]).expand(3, -1), 1e-15)
    assert all(rate.abs().max() < 1e-14 for rate in standing[1:])


# ---------------------------------------------------------------------- domain


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    ("t0", "dt"), [(0.0, 1.0), (0.1, 0.1), (-7.3, 1 / 3), (1.7e9 + 0.123, 0.007), (1e5, 1e-3)]
)
def test_domain(order, t0, dt):
    """Both ends belong to it, however they are computed; a thousandth of a segment further does not."""
    points = control_points(SO3, order + 6)
    spline = BSpline(points, group=SO3, order=order, t0=t0, dt=dt)
    start, end = spline.domain
    assert (start, end) == (t0, t0 + 7 * dt)
    for t in (
        torch.linspace(start, end, 50, dtype=float64),
        at(start, end),
        t0 + dt * torch.arange(8, dtype=float64),
    ):
        assert torch.isfinite(spline.evaluate(t, 3).jerk).all()
    sums = at(t0, *([dt] * 7)).cumsum(0)
    assert torch.isfinite(spline(sums)).all()
    for outside in (start - 1e-3 * dt, end + 1e-3 * dt):
        with pytest.raises(ValueError, match="t: 1 of 2 times lie outside the domain"):
            spline(at(start, outside))
    for inside, limit in ((start, 1.0), (end, -1.0)):
        gap = spline.evaluate(at(inside + limit * 1e-6 * dt), 0).value - spline(at(inside))
        assert gap.abs().max() < 1e-4


def test_one_sided_derivatives_at_the_ends():
    points, h = control_points(SE3, 7), 1e-6
    spline = BSpline(points, group=SE3, dt=0.5)
    for end, side in zip(spline.domain, (1.0, -1.0), strict=True):
        t = number(end).requires_grad_()
        state = spline.evaluate(t)
        (slope,) = torch.autograd.grad(state.velocity.sum(), t)
        assert close(slope, state.acceleration.detach().sum(), 1e-12)
        inner = spline.evaluate(t.detach() + side * h).velocity
        assert close((inner - state.velocity).detach() / (side * h), state.acceleration.detach(), 1e-4)


@each_group
@pytest.mark.parametrize("extrapolate", ["clamp", "linear"])
def test_extrapolation(group, extrapolate):
    """End pose and zero, or end velocity kept; inside nothing changes; the value has no gap at the ends."""
    points, dt, t0 = control_points(group, 7), 0.5, 1.0
    inner = bspline(points, at(1.0, 2.2, 3.0), group=group, dt=dt, t0=t0, derivatives=3)
    t = at(-4.0, 0.7, 1.0, 2.2, 3.0, 3.1, 50.0).requires_grad_()
    x = points.clone().requires_grad_()
    state = bspline(x, t, group=group, dt=dt, t0=t0, derivatives=3, extrapolate=extrapolate)
    ends = [0, 0, 0, 1, 2, 2, 2]
    for ours, exact in zip(state, inner, strict=True):
        assert close(ours[2:5], exact, 1e-14)
    outside = [0, 1, 5, 6]
    assert torch.all(state.acceleration[outside] == 0)
    assert torch.all(state.jerk[outside] == 0)
    held = [ends[i] for i in outside]
    if extrapolate == "clamp":
        assert close(state.value[outside], inner.value[held], 1e-15)
        assert torch.all(state.velocity[outside] == 0)
    else:
        beyond = at(-5.0, -0.3, 0.1, 47.0)[:, None]
        expected = group.compose(inner.value[held], group.exp(beyond * inner.velocity[held]))
        assert close(state.value[outside], expected, 1e-13)
        assert close(state.velocity[outside], inner.velocity[held], 1e-14)

    for count in range(3):
        fewer = bspline(points, t, group=group, dt=dt, t0=t0, derivatives=count, extrapolate=extrapolate)
        assert all(close(a, b, 1e-15) for a, b in zip(fewer[: count + 1], state, strict=False))
        assert all(x is None for x in fewer[count + 1 :])

    # The gradient by t is the velocity, inside and outside; by control points, that of the end.
    g = normal(*state.value.shape, seed=1)
    t_grad, x_grad = torch.autograd.grad(state.value, (t, x), g, retain_graph=True)
    algebra = group.arithmetic
    rates = torch.stack(
        [
            torch.stack(algebra.push(v.unbind(-1), w.unbind(-1)), -1)
            for v, w in zip(state.value, state.velocity, strict=True)
        ]
    )
    assert close(t_grad, (g * rates).sum(-1), 1e-12)
    assert torch.isfinite(x_grad).all()
    (only,) = torch.autograd.grad(state.value[0], x, g[0])
    assert torch.all(only[5:] == 0)
    assert only[:3].abs().max() > 0
    for end in (1.0, 3.0):
        near = bspline(points, at(end - 1e-9, end + 1e-9), group=group, dt=dt, t0=t0, extrapolate=extrapolate)
        assert close(near.value[:1], near.value[1:], 1e-7)
        if extrapolate == "linear":
            assert close(near.velocity[:1], near.velocity[1:], 1e-5)


def test_extrapolation_learns_time_offsets():
    """A step past the end still has a slope to come back by, in t and in dt."""
    points = control_points(SE3, 7)
    for wanted in ("t0", "dt"):
        options = {"t0": number(0.0), "dt": number(1.0)}

        def function(x, options=options, wanted=wanted):
            given = {**options, wanted: x}
            return bspline(points, at(-0.3, 4.2), group=SE3, extrapolate="linear", **given).value

        assert torch.autograd.gradcheck(function, options[wanted].requires_grad_(), check_forward_ad=True)


def test_unknown_extrapolation():
    with pytest.raises(
        ValueError, match="extrapolate: expected one of 'error', 'clamp', 'linear', got 'wrap'"
    ):
        bspline(control_points(SO3, 4), at(0.0), group=SO3, dt=1.0, extrapolate="wrap")


# ---------------------------------------------------------------------- clocks


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("t0_ns", [0, 1_700_000_000_123_456_789, -5_000_000_001])
def test_nanoseconds_are_exact(dtype, t0_ns):
    """At epoch-size stamps the results equal those of small times, which float64 seconds can only approach."""
    points, dt_ns = control_points(SE3, 9).to(dtype), 10_000_003
    offsets = torch.tensor([0, 1, 9_999_999, 10_000_003, 10_000_004, 31_415_926, 6 * dt_ns])
    exact = bspline(points, offsets, group=SE3, dt_ns=dt_ns, derivatives=3)
    state = bspline(points, offsets + t0_ns, group=SE3, dt_ns=dt_ns, t0_ns=t0_ns, derivatives=3)
    assert all(torch.equal(a, b) for a, b in zip(state, exact, strict=True))
    near = bspline(points, offsets.double() * 1e-9, group=SE3, dt=dt_ns * 1e-9, derivatives=3)
    assert all(close(a, b, 200 * torch.finfo(dtype).eps) for a, b in zip(exact, near, strict=True))
    seconds = bspline(
        points,
        (offsets[:-1] + t0_ns).double() * 1e-9,
        group=SE3,
        dt=dt_ns * 1e-9,
        t0=t0_ns * 1e-9,
        extrapolate="linear",
    )
    assert close(seconds.value, exact.value[:-1], 1e-3)
    for past in (-1, 6 * dt_ns + 1):
        with pytest.raises(ValueError, match=f"first is {t0_ns + past}"):
            bspline(points, torch.tensor([past + t0_ns]), group=SE3, dt_ns=dt_ns, t0_ns=t0_ns)


def test_single_precision_times():
    """Accepted while eps times the largest |t| stays below dt/1000, refused beyond, with advice."""
    dt, eps = 0.01, torch.finfo(torch.float32).eps
    points = control_points(SO3, 8).float()
    bound = 1e-3 * dt / eps
    for factor, fine in ((0.99, True), (1.01, False), (-0.99, True), (-1.01, False), (3.0, False)):
        t = torch.tensor([factor * bound], dtype=torch.float32)
        options = {"group": SO3, "dt": dt, "t0": float(t) - 0.02}
        if fine:
            state, exact = bspline(points, t, **options), bspline(points, t.double(), **options)
            tensors = {"dt": number(dt), "t0": number(options["t0"])}
            learnt = bspline(points, t, group=SO3, **tensors)
            for result in (state, learnt):
                assert all(torch.equal(a, b) for a, b in zip(result[:3], exact[:3], strict=True))
        else:
            with pytest.raises(
                ValueError, match=r"float32 rounds times near .* pass float64 times, int64 nanoseconds"
            ):
                bspline(points, t, **options)
    end = torch.linspace(0, 1, 11, dtype=torch.float32) * 0.05
    assert torch.isfinite(bspline(points, end, group=SO3, dt=dt).value).all()


def test_float32_control_points_with_epoch_times():
    """Segment and place are found before anything is rounded to float32."""
    points, t = control_points(SE3, 9), 1.7e9 + torch.linspace(0.0, 0.05, 40, dtype=float64)
    double = bspline(points.float().double(), t, group=SE3, t0=1.7e9, dt=0.01)
    single = bspline(points.float(), t, group=SE3, t0=1.7e9, dt=0.01)
    for ours, exact in zip(single[:3], double[:3], strict=True):
        assert ours.dtype == torch.float32
        assert close(ours.double(), exact, 3e-6)


# ---------------------------------------------------------------------- signs of quaternions


@pytest.mark.parametrize("group", [SO3, SE3, Group("R3xSO3"), Group("SO3xSE3")], ids=str)
def test_signs(group):
    """Flipping a control point flips at most every output; along the curve no output jumps."""
    points, t = control_points(group, 12, gap=3.0), torch.linspace(0, 9, 2000, dtype=float64)
    state = bspline(points, t, group=group, dt=1.0, derivatives=3)
    assert (state.value[1:] - state.value[:-1]).abs().max() < 0.1
    for flipped in range(12):
        factors = [-1.0 if i == flipped else 1.0 for i in range(12)]
        other = bspline(rescaled(group, points, factors), t, group=group, dt=1.0, derivatives=3)
        assert all(torch.equal(a, b) for a, b in zip(other[1:], state[1:], strict=True))
        sign = -1.0 if flipped == 0 else 1.0
        assert torch.equal(other.value, rescaled(group, state.value, [sign]))
    lengths = bspline(points, t, group=group, dt=1.0).value
    for start, stop in group.arithmetic.sign_blocks:
        assert close(lengths[:, start:stop].norm(dim=-1), torch.ones(2000, dtype=float64), 1e-14)
