"""Dual quaternions against SE(3), mpmath and their own axioms; planar groups against their place in space."""

import math

import batteries as kit
import mpmath as mp
import pytest
import torch
from batteries import error, tangents

from torchspline import BSpline, imu
from torchspline.arithmetic import dual_quaternion
from torchspline.groups import SE2, SE3, SO2, SO3, DualQuaternion, convert
from torchspline.groups.components import join, split

float64 = torch.float64
ALGEBRA = DualQuaternion.arithmetic


def poses(angles=kit.ANGLES, each=2, seed=0):
    return SE3.exp(tangents(SE3, angles, each=each, seed=seed))


def distance(a, b):
    """Of poses, up to the sign of quaternions."""
    return kit.equal_up_to_sign(SE3, a, b) * torch.finfo(a.dtype).eps


def dual(pose):
    return convert.pose_to_dual_quaternion(pose)


def back(Q):
    return convert.pose_from_dual_quaternion(Q)


# ---------------------------------------------------------------------- the same group as SE(3)


@kit.each_dtype
def test_conversion_there_and_back(dtype):
    X = kit.rescaled(SE3, kit.points(SE3, kit.ANGLES), (1.0, -0.3, 20.0)).to(dtype)
    Q = dual(X)
    assert kit.equal_up_to_sign(SE3, back(Q), SE3.normalize(X)) < 6
    assert error(DualQuaternion.to_matrix(Q), SE3.to_matrix(X.double()), 2) < 12
    scaled = kit.rescaled(DualQuaternion, Q, (1e-15, -3.0, 1e15))
    shifted = scaled.clone()
    shifted[:, 4:] += 0.7 * scaled[:, :4]  # the part of q' along q is no part of a motion
    for other in (scaled, shifted):
        assert kit.equal_up_to_sign(SE3, back(other), SE3.normalize(X)) < 20


def test_every_operation_is_that_of_se3():
    """To 1e-13, at all angles: values in the same numbers once converted."""
    angles = (*kit.SHORTEST, *kit.BEYOND_PI)
    x, y = tangents(SE3, angles), tangents(SE3, angles, seed=3).flip(0)
    X, Y = SE3.exp(x), SE3.exp(y)
    p, s = kit.normal(len(x), 3, seed=1), kit.normal(len(x), seed=2)
    D = DualQuaternion
    assert distance(back(D.exp(x)), X) < 1e-13
    assert error(D.log(dual(X)), SE3.log(X)) * 2.3e-16 < 1e-13
    assert distance(back(D.compose(dual(X), dual(Y))), SE3.compose(X, Y)) < 1e-13
    assert distance(back(D.inverse(dual(X))), SE3.inverse(X)) < 1e-13
    assert distance(back(D.interpolate(dual(X), dual(Y), s)), SE3.interpolate(X, Y, s)) < 1e-13
    assert distance(back(D.power(dual(X), s)), SE3.power(X, s)) < 1e-13
    for ours, theirs in (
        (D.act(dual(X), p), SE3.act(X, p)),
        (D.adjoint_act(dual(X), y), SE3.adjoint_act(X, y)),
        (D.adjoint(dual(X)), SE3.adjoint(X)),
        (D.left_jacobian(x), SE3.left_jacobian(x)),
        (D.bracket(x, y), SE3.bracket(x, y)),
    ):
        assert (ours - theirs).abs().max() < 1e-13 * theirs.abs().max()


def test_splines_readings_and_their_gradients_are_those_of_se3():
    """One trajectory in both: kinematics, mounted frames, IMU readings, and the way gradients take back to poses."""
    t = torch.linspace(0.0, 0.5, 12, dtype=float64)
    control = SE3.random(8, generator=kit.generator(5))
    mount = SE3.random(generator=kit.generator(6))
    results = []
    for group, convert_points in ((SE3, lambda x: x), (DualQuaternion, dual)):
        leaf = control.clone().requires_grad_()
        spline = BSpline(convert_points(leaf), group=group, dt=0.1)
        k = spline.mounted(mount).kinematics(t)
        fields = [*k[1:], *imu.measure(spline, t, T_body_imu=mount), SO3.to_matrix(k.rotation)]
        weights = [kit.normal(*f.shape, seed=i) for i, f in enumerate(fields)]
        total = sum((a * b).sum() for a, b in zip(fields, weights, strict=True))
        (gradient,) = torch.autograd.grad(total, leaf)
        results.append([*fields, gradient])
    for ours, theirs in zip(*results, strict=True):
        assert (ours - theirs).abs().max() < 1e-13 * theirs.abs().max()


# ---------------------------------------------------------------------- the algebra


def table(P, Q):
    """The product from the units 1, i, j, k, e alone: signs and places of i j = k, e e = 0."""
    place = [[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]]
    sign = [[1, 1, 1, 1], [1, -1, 1, -1], [1, -1, -1, 1], [1, 1, -1, -1]]
    result = torch.zeros_like(P)
    for a in range(8):
        for b in range(8):
            if a < 4 or b < 4:
                where = place[a % 4][b % 4] + (4 if a >= 4 or b >= 4 else 0)
                result[:, where] += sign[a % 4][b % 4] * P[:, a] * Q[:, b]
    return result


def test_product_and_the_three_conjugates():
    P, Q = (kit.normal(6, 8, seed=i) for i in (1, 2))  # no units: the algebra knows all numbers

    def product(a, b):
        return join(dual_quaternion.multiply(split(a), split(b)), a)

    def conjugate(kind, a):
        return join(kind(split(a)), a)

    assert error(product(P, Q), table(P, Q)) < 4
    both, duals, points = (
        dual_quaternion.conjugate,
        dual_quaternion.dual_conjugate,
        dual_quaternion.point_conjugate,
    )
    for kind, reverses in ((both, True), (duals, False), (points, True)):
        pair = (
            (conjugate(kind, Q), conjugate(kind, P)) if reverses else (conjugate(kind, P), conjugate(kind, Q))
        )
        assert error(conjugate(kind, product(P, Q)), product(*pair)) < 8
        assert torch.equal(conjugate(kind, conjugate(kind, P)), P)
    square = product(P, conjugate(both, P))  # |P|^2, a dual number
    assert square[:, [1, 2, 3, 5, 6, 7]].abs().max() < 1e-14
    assert error(square[:, :1], P[:, :4].square().sum(-1, keepdim=True)) < 8
    assert error(square[:, 4:5], 2 * (P[:, :4] * P[:, 4:]).sum(-1, keepdim=True)) < 8
    X, p = poses(), kit.normal(2 * len(kit.ANGLES), 3, seed=4)
    one = torch.cat([torch.ones(len(p), 1), torch.zeros(len(p), 4)], dim=-1).double()
    moved = product(product(dual(X), torch.cat([one, p], dim=-1)), conjugate(points, dual(X)))
    assert error(moved, torch.cat([one, SE3.act(X, p)], dim=-1)) < 20


def test_normalisation_meets_both_constraints():
    Q = kit.normal(50, 8, seed=3) * 7.0
    unit = DualQuaternion.normalize(Q)
    assert error(unit[:, :4].square().sum(-1, keepdim=True), torch.ones(50, 1, dtype=float64)) < 4
    assert (unit[:, :4] * unit[:, 4:]).sum(-1).abs().max() < 1e-15
    # Q / |Q|: times the dual number |Q| it is Q again.
    length = Q[:, :4].norm(dim=-1, keepdim=True)
    dual_length = (Q[:, :4] * Q[:, 4:]).sum(-1, keepdim=True) / length
    again = torch.cat([length * unit[:, :4], length * unit[:, 4:] + dual_length * unit[:, :4]], dim=-1)
    assert error(again, Q) < 4


def test_gradients_do_not_leave_the_constraints():
    """Nothing depends on the length of Q nor on the part of q' along q."""
    Q = (kit.normal(20, 8, seed=3) * 3.0).requires_grad_()
    (g,) = torch.autograd.grad(DualQuaternion.log(Q).sin().sum(), Q)
    assert (g * Q).sum(-1).abs().max() < 1e-13
    assert (g[:, 4:] * Q[:, :4]).sum(-1).abs().max() < 1e-13


# ---------------------------------------------------------------------- screws


def exact_screw_exp(x):
    """cos and sin of dual angles, [H18] (24), by the screw itself."""
    v, w = x[:3], x[3:]
    angle = mp.sqrt(mp.fsum(c * c for c in w))
    if angle == 0:
        return [mp.mpf(1), 0, 0, 0, mp.mpf(0), *(c / 2 for c in v)]
    axis = [c / angle for c in w]
    pitch = mp.fsum(a * b for a, b in zip(axis, v, strict=True))
    moment = [(b - pitch * a) / angle for a, b in zip(axis, v, strict=True)]
    c, s = mp.cos(angle / 2), mp.sin(angle / 2)
    dual_part = [m * s + pitch / 2 * a * c for m, a in zip(moment, axis, strict=True)]
    return [c, *(a * s for a in axis), -pitch / 2 * s, *dual_part]


@kit.each_dtype
def test_exp_through_the_screw_in_every_digit(dtype):
    x = torch.cat([tangents(SE3, kit.ANY_ANGLE), tangents(SE3, (1e-5, 1e-3, 0.1), seed=2) * 1e-3]).to(dtype)
    assert error(DualQuaternion.exp(x), kit.through_mpmath(exact_screw_exp, x)) < 10


@pytest.mark.parametrize("angle", [0.0, 1e-200, 1e-30, 1e-9, 1e-4, 1.0, math.pi - 1e-9, math.pi])
def test_screws_there_and_back(angle):
    Q = DualQuaternion.exp(tangents(SE3, [angle], each=4, seed=1))
    screw = convert.to_screw(Q)
    assert torch.allclose(screw.axis.norm(dim=-1), torch.ones(4, dtype=float64), rtol=0, atol=1e-15)
    assert (screw.axis * screw.moment).sum(-1).abs().max() < 1e-14 * screw.moment.abs().max().clamp_min(1.0)
    assert kit.equal_up_to_sign(DualQuaternion, convert.from_screw(*screw), Q) < 20
    if angle > 1e-9:
        point = torch.linalg.cross(screw.axis, screw.moment)  # of the line, nearest to the origin
        moved = DualQuaternion.act(Q, point)
        assert (moved - point - screw.pitch[:, None] * screw.axis).abs().max() < 1e-6


def test_screws_without_an_axis():
    slide = dual(torch.tensor([0.0, -3.0, 4.0, 1.0, 0.0, 0.0, 0.0], dtype=float64))
    angle, pitch, axis, moment = convert.to_screw(slide)
    assert angle == 0
    assert pitch == 5
    assert torch.equal(axis, torch.tensor([0.0, -0.6, 0.8], dtype=float64))
    assert torch.equal(moment, torch.zeros(3, dtype=float64))
    still = convert.to_screw(DualQuaternion.identity(dtype=torch.float32))
    assert all(torch.isfinite(x).all() and x.dtype == torch.float32 for x in still)
    assert still.angle == still.pitch == 0
    half = DualQuaternion.power(slide, 0.5)
    assert error(back(half), torch.tensor([0, -1.5, 2, 1, 0, 0, 0], dtype=float64)) < 2


# ---------------------------------------------------------------------- the plane


def test_planar_motions_are_motions_in_the_plane():
    """SO2 and SE2 put into space: rotation about z, no z anywhere."""
    x = tangents(SE2, (*kit.SHORTEST, *kit.BEYOND_PI))
    spatial = torch.zeros(len(x), 6, dtype=float64)
    spatial[:, :2], spatial[:, 5] = x[:, :2], x[:, 2]
    X, S = SE2.exp(x), SE3.exp(spatial)
    assert error(X[:, :2], S[:, :2]) < 10
    assert error(SE2.to_matrix(X)[:, :2, :2], SE3.to_matrix(S)[:, :2, :2], 2) < 10
    planar = torch.tensor([0, 1, 5])
    assert error(SE2.log(X), SE3.log(S)[:, planar]) < 10
    for name in ("left_jacobian", "right_jacobian_inverse"):
        ours, theirs = getattr(SE2, name)(x), getattr(SE3, name)(spatial)
        assert error(ours, theirs[:, planar][:, :, planar], 2) < 30
    assert error(SO2.exp(x[:, 2:]), X[:, 2:]) == 0
    assert error(SO2.log(X[:, 2:]), SE2.log(X)[:, 2:]) == 0


def test_angles_in_every_digit():
    angles = torch.tensor([*kit.SHORTEST, *(-a for a in kit.SHORTEST)], dtype=float64)
    z = torch.stack([angles.cos(), angles.sin()], dim=-1)
    exact = torch.atan2(z[:, 1], z[:, 0])
    assert error(SO2.log(z), exact[:, None], floor=1e-14) < 3
    assert SO2.log(torch.tensor([-1.0, -0.0])) == SO2.log(torch.tensor([-1.0, 0.0])) == math.pi
