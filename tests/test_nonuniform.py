"""B-splines over knot vectors: SciPy on R^n, the uniform spline on groups, repeated knots, knot insertion,
gradients."""

import batteries as kit
import numpy as np
import pytest
import scipy.interpolate
import torch
from batteries import each_group, normal
from oracles import body_rates, product_rule, scipy_rate
from spline_cases import chain, close, control_points
from test_jet import derivatives_of

from torchspline import R3, SE3, SO3, NonuniformBSpline, Trajectory
from torchspline.functional import bspline, nonuniform_bspline
from torchspline.splines.nonuniform import cumulative_weights, local_knots

float64 = torch.float64
each_order = pytest.mark.parametrize("order", [2, 3, 4, 6])


def knot_vector(order, count=9, repeated=False):
    """Not uniform, ends of the domain in between, or met exactly by `order` knots with a double knot inside."""
    steps = 0.2 + torch.rand(count + order, generator=kit.generator(order), dtype=float64)
    knots = steps.cumsum(0) - 2.0
    if repeated:
        knots[:order], knots[count:] = knots[order - 1], knots[count]
        knots[order + 1] = knots[order]
    return knots


def times_in(knots, order, count=9, number=17):
    return torch.linspace(knots[order - 1].item(), knots[count].item(), number, dtype=float64)


@each_order
@pytest.mark.parametrize("repeated", [False, True])
def test_scipy_on_numbers(order, repeated):
    knots, points = knot_vector(order, repeated=repeated), normal(9, 3, seed=1)
    t = times_in(knots, order)
    theirs = scipy.interpolate.BSpline(knots.numpy(), points.numpy(), order - 1)
    state = nonuniform_bspline(points, t, group=R3, knots=knots, order=order, derivatives=3)
    for r, ours in enumerate(state):
        inside = slice(None) if r < order - 1 else slice(1, -1)
        assert close(ours[inside], torch.as_tensor(scipy_rate(theirs, t.numpy(), r))[inside], 1e-11)


@each_group
@each_order
def test_even_knots_are_the_uniform_spline(group, order):
    points = kit.rescaled(group, control_points(group, order + 4, seed=order), (2.0, -0.3, 1.0))
    knots = 0.25 * torch.arange(2 * order + 4, dtype=float64) - 1.0
    t = torch.linspace(0.01, 0.24, 4, dtype=float64)
    t = torch.cat([knots[order - 1 : order + 4] + x for x in t])
    ours = nonuniform_bspline(points, t, group=group, knots=knots, order=order, derivatives=3)
    theirs = bspline(points, t, group=group, order=order, dt=0.25, t0=knots[order - 1].item(), derivatives=3)
    for r, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        assert close(a, b, 1e-13 * 100 ** min(r, 2))


@each_group
def test_product_rule(group):
    """The cumulative product on uneven knots, its factors differentiated one by one."""
    order, knots = 4, knot_vector(4)
    steps = kit.tangents(group, [1.1], each=8)
    points, local = chain(group, steps), local_knots(knots, order)
    for segment in (0, 3, 5):
        u = torch.tensor([0.1, 0.8], dtype=float64)
        h = knots[segment + order] - knots[segment + order - 1]
        weights = cumulative_weights(local[segment].expand(2, -1), u, 3)
        rows = [row.unbind(-1) for row in weights.unbind(1)]
        matrices = product_rule(group, group.to_matrix(points[segment]), steps[segment : segment + 3], rows)
        state = nonuniform_bspline(
            points, knots[segment + 3] + u * h, group=group, knots=knots, derivatives=3
        )
        assert close(group.to_matrix(state.value), matrices[0], 1e-13)
        for r, (ours, exact) in enumerate(zip(state[1:], body_rates(group, matrices), strict=True), start=1):
            assert close(ours * h**r, exact, 1e-12)


@each_order
def test_weights_against_scipy(order):
    """Cumulative sums of SciPy's basis functions, one after the other."""
    knots, u = knot_vector(order), torch.tensor([0.2, 0.7], dtype=float64)
    local = local_knots(knots, order)
    for segment in (0, 3):
        start, h = knots[segment + order - 1], knots[segment + order] - knots[segment + order - 1]
        basis = [
            scipy.interpolate.BSpline.basis_element(knots[i : i + order + 1].numpy(), extrapolate=False)
            for i in range(segment, segment + order)
        ]
        t = (start + u * h).numpy()
        sums = np.cumsum([b(t) for b in reversed(basis)], axis=0)[::-1][1:]
        ours = cumulative_weights(local[segment].expand(2, -1), u, 1)
        assert close(ours[:, 0], torch.as_tensor(sums.copy()).T, 1e-13)
        slopes = derivatives_of(
            lambda u, s=segment: cumulative_weights(local[s].expand(2, -1), u, 0)[:, 0], u, 1
        )[1]
        assert close(ours[:, 1], slopes, 1e-13)


@each_group
def test_ends_and_repeated_knots(group):
    """`order` equal knots: the curve starts and ends at its control points. A double knot takes one derivative away."""
    points, knots = control_points(group, 9, gap=0.7), knot_vector(4, repeated=True)
    spline = NonuniformBSpline(points, group=group, knots=knots)
    ends = spline(torch.tensor(spline.domain, dtype=float64))
    assert kit.equal_up_to_sign(group, ends, points[[0, -1]]) < 50
    for knot, smooth in ((knots[4], 1), (knots[6], 2)):
        before, after = (spline.evaluate(knot[None] + s * 1e-8, 3) for s in (-1, 1))
        for r in (1, 2, 3):
            jump = (before[r] - after[r]).abs().max()
            assert jump < 1e-4 if r <= smooth else jump > 1e-3


@each_order
def test_knot_insertion(order):
    """The same curve on R^n, as often as the order allows; on a group it stays outside of order - 1 segments."""
    knots, points = knot_vector(order), normal(9, 3, seed=1)
    t = times_in(knots, order, number=101)
    spline = NonuniformBSpline(points, group=R3, knots=knots, order=order)
    finer, at = spline, knots[5:7].mean().item()
    for count in range(1, order):
        finer = finer.insert_knot(at)
        assert finer.control_points.shape[0] == 9 + count
        assert close(finer(t), spline(t), 1e-12)
    with pytest.raises(ValueError, match=f"time: expected a knot that comes less than {order - 1} times"):
        finer.insert_knot(at)
    if order > 2:
        for end in spline.domain:
            assert close(spline.insert_knot(end)(t), spline(t), 1e-12)
    turning = NonuniformBSpline(control_points(SO3, 9, gap=0.5), group=SO3, knots=knots, order=order)
    finer = turning.insert_knot(at)
    segment = int((knots <= at).sum()) - 1
    near = (t > knots[max(segment - order + 2, 0)]) & (t < knots[segment + order - 1])
    step = SO3.log(SO3.between(turning(t), finer(t))).norm(dim=-1)
    assert (step[~near] < 1e-12).all()
    assert step[near].max() < 0.1
    assert order == 2 or step[near].max() > 1e-6


@pytest.mark.parametrize("group", [SO3, SE3], ids=str)
@pytest.mark.parametrize("order", [3, 4])
def test_gradients(group, order):
    """By control points, queries and knots."""
    knots = knot_vector(order, count=order + 1)
    given = [
        kit.rescaled(group, control_points(group, order + 1), (2.0, -1.0)),
        times_in(knots, order, order + 1, 5)[1:4].clone(),
        knots,
    ]
    given = [x.requires_grad_() for x in given]

    def fields(points, t, knots):
        state = nonuniform_bspline(points, t, group=group, knots=knots, order=order, validate=False)
        return torch.cat(state[:3], dim=-1)

    fast = {"fast_mode": True, "atol": 1e-5, "rtol": 1e-5}
    assert torch.autograd.gradcheck(fields, given, check_forward_ad=True, **fast)
    assert torch.autograd.gradgradcheck(fields, given, eps=1e-5, **fast)


def test_gradients_at_repeated_knots_are_finite():
    points, knots = control_points(SE3, 9).requires_grad_(), knot_vector(4, repeated=True).requires_grad_()
    t = times_in(knots.detach(), 4)
    state = nonuniform_bspline(points, t, group=SE3, knots=knots, derivatives=3)
    gradients = torch.autograd.grad(sum(x.square().sum() for x in state), (points, knots))
    assert all(torch.isfinite(g).all() for g in gradients)


@kit.each_dtype
def test_shapes_precision_and_extrapolation(dtype):
    points = torch.stack([control_points(SE3, 9, seed=i) for i in range(6)]).reshape(2, 3, 9, 7).to(dtype)
    knots = knot_vector(4)
    t = times_in(knots, 4)
    for times, shape in ((t[1], (2, 3)), (t, (2, 3, 17)), (t.expand(3, 17), (2, 3, 17))):
        state = nonuniform_bspline(points, times, group=SE3, knots=knots)
        assert state.value.shape == (*shape, 7)
        assert state.acceleration.shape == (*shape, 6)
        assert state.value.dtype == dtype
    alone = nonuniform_bspline(points[1, 2].double(), t, group=SE3, knots=knots)
    whole = nonuniform_bspline(points, t, group=SE3, knots=knots)
    for a, b in zip(whole[:3], alone, strict=False):
        assert close(a[1, 2].double(), b, 1e-13 if dtype == float64 else 1e-4)
    outside = torch.cat([t[:1] - 0.5, t[-1:] + 0.5])
    held = nonuniform_bspline(points, outside, group=SE3, knots=knots, extrapolate="clamp")
    assert held.velocity.abs().max() == 0
    assert close(held.value, nonuniform_bspline(points, t[[0, -1]], group=SE3, knots=knots).value, 1e-5)
    kept = nonuniform_bspline(points, outside, group=SE3, knots=knots, extrapolate="linear")
    assert close(kept.velocity, nonuniform_bspline(points, t[[0, -1]], group=SE3, knots=knots).velocity, 1e-4)


def test_module():
    spline = NonuniformBSpline(control_points(SE3, 9), group=SE3, knots=knot_vector(4))
    assert isinstance(spline, Trajectory)
    assert spline.domain == (knot_vector(4)[3].item(), knot_vector(4)[9].item())
    assert list(dict(spline.named_parameters())) == ["control_points"]
    assert spline.to(torch.float32).knots.dtype == float64
    leaf = knot_vector(4).requires_grad_()
    moving = NonuniformBSpline(control_points(SE3, 9), group=SE3, knots=leaf)
    moving(times_in(leaf.detach(), 4)).sum().backward()
    assert leaf.grad.abs().max() > 0
    other = NonuniformBSpline(control_points(SE3, 9, seed=3), group=SE3, knots=knot_vector(4) + 1.0)
    other.load_state_dict(moving.state_dict())
    t = times_in(knot_vector(4), 4)
    assert torch.equal(other(t), moving(t))
    assert moving.kinematics(t).angular_velocity.shape == (17, 3)
