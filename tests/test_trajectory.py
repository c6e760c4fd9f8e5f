"""Motion in the terms of mechanics: `kinematics` and `mounted` against finite differences and explicit products."""

import itertools

import pytest
import torch
from batteries import GROUPS, hat, normal
from spline_cases import close, control_points

from torchspline import BSpline, SplitBSpline
from torchspline.groups import R3, SE3, SO3, DualQuaternion, convert, product

float64 = torch.float64
SPLIT = product(R3, SO3)
MOVING = (SO3, R3, SPLIT, SE3, DualQuaternion)
BODIES = (SO3, SPLIT, SE3, DualQuaternion)
each_moving = pytest.mark.parametrize("group", MOVING, ids=str)
each_body = pytest.mark.parametrize("group", BODIES, ids=str)
TIMES = torch.tensor([0.31, 1.07, 2.44], dtype=float64)


def trajectory(group, batch=(), order=6, seed=0):
    """Order 6: its jerk is continuous, so that differences across knots are harmless."""
    size = max(1, torch.Size(batch).numel())
    points = torch.stack([control_points(group, order + 3, gap=0.9, seed=seed + i) for i in range(size)])
    return BSpline(points.reshape(*batch, order + 3, -1), group=group, order=order, dt=0.7)


def poses(count=2, seed=40):
    return control_points(SE3, count + 1, gap=1.5, seed=seed)[1:]


def rotation_matrix(q):
    return SO3.to_matrix(q, validate=False)


def slope(function, t, h=1e-5):
    """Fourth-order central difference."""
    return (8 * (function(t + h) - function(t - h)) - (function(t + 2 * h) - function(t - 2 * h))) / (12 * h)


def spin(motion, t):
    """Body angular velocity from rotation matrices: the vector of R^T dR/dt."""
    rate = slope(lambda s: rotation_matrix(motion(s).rotation), t)
    W = rotation_matrix(motion(t).rotation).mT @ rate
    assert close(W, -W.mT, 1e-8)
    return torch.stack([W[..., 2, 1], W[..., 0, 2], W[..., 1, 0]], dim=-1)


# ---------------------------------------------------------------------- kinematics


@each_moving
@pytest.mark.parametrize("batch", [(), (2,)], ids=str)
def test_kinematics_against_differences(group, batch):
    motion = trajectory(group, batch).kinematics
    k = motion(TIMES)
    if group is R3:
        assert k.rotation is None
        assert k.angular_velocity is None
        assert k.angular_acceleration is None
    else:
        assert k.rotation.shape == (*batch, 3, 4)
        assert close(spin(motion, TIMES), k.angular_velocity, 1e-9)
        assert close(slope(lambda t: motion(t).angular_velocity, TIMES), k.angular_acceleration, 1e-9)
    if group is SO3:
        assert k.position is None
        assert k.velocity is None
        assert k.acceleration is None
    else:
        assert k.position.shape == (*batch, 3, 3)
        assert close(slope(lambda t: motion(t).position, TIMES), k.velocity, 1e-9)
        assert close(slope(lambda t: motion(t).velocity, TIMES), k.acceleration, 1e-9)


def test_conventions_of_velocities():
    """SE3 rates are body-frame tangents, those of R3xSO3 a world velocity and a body angular velocity."""
    for group in (SE3, SPLIT):
        spline = trajectory(group)
        state, k = spline.evaluate(TIMES), spline.kinematics(TIMES)
        R = rotation_matrix(k.rotation)
        body = state.velocity[:, :3, None]
        assert close(R @ body if group is SE3 else body, k.velocity[..., None], 1e-13)
        assert torch.equal(state.velocity[:, 3:], k.angular_velocity)
        if group is SE3:  # [S20] (33) and (40) in matrices
            w, a = hat(SE3, state.velocity), hat(SE3, state.acceleration)
            second = SE3.to_matrix(state.value) @ (w @ w + a)
            assert close(second[:, :3, 3], k.acceleration, 1e-13)
            assert not close(R @ state.acceleration[:, :3, None], k.acceleration[..., None], 1e-2)
        else:
            assert torch.equal(state.acceleration[:, :3], k.acceleration)


def test_both_kinds_of_pose_agree_where_they_must():
    """Rotation about a fixed point of the body frame's origin and pure translation: the same motion either way."""
    turning = control_points(SPLIT, 9)
    turning[:, :3] = turning[0, :3]
    sliding = control_points(SPLIT, 9)
    sliding[:, 3:] = sliding[0, 3:]
    for points in (turning, sliding):
        ours, theirs = (BSpline(points, group=g, dt=0.7).kinematics(TIMES) for g in (SE3, SPLIT))
        for a, b in zip(ours, theirs, strict=True):
            assert close(a, b, 1e-13)
    general = control_points(SPLIT, 9)
    ours, theirs = (BSpline(general, group=g, dt=0.7).kinematics(TIMES) for g in (SE3, SPLIT))
    assert close(ours.rotation, theirs.rotation, 1e-13)
    assert not close(ours.position, theirs.position, 1e-3)


def test_split_is_its_parts():
    points = control_points(SPLIT, 9)
    whole = SplitBSpline(points, dt=0.7, order=5)
    assert whole.group == SPLIT
    position = BSpline(points[:, :3], group=R3, dt=0.7, order=5).evaluate(TIMES, 3)
    rotation = BSpline(points[:, 3:], group=SO3, dt=0.7, order=5).evaluate(TIMES, 3)
    for x, p, q in zip(whole.evaluate(TIMES, 3), position, rotation, strict=True):
        assert close(x, torch.cat([p, q], dim=-1), 1e-15)


@pytest.mark.parametrize("group", [g for g in GROUPS if g not in MOVING], ids=str)
def test_groups_that_are_no_motion(group):
    spline = trajectory(group)
    with pytest.raises(ValueError, match=r"kinematics: .* does not describe the motion of a body"):
        spline.kinematics(TIMES)
    with pytest.raises(ValueError, match="trajectory: expected one in SO3, R3xSO3, SE3"):
        spline.mounted(poses()[0])


@each_moving
def test_kinematics_is_differentiable(group):
    points, g = control_points(group, 5), None

    def total(x):
        nonlocal g
        fields = [f for f in BSpline(x, group=group, dt=0.7).kinematics(TIMES[:2] * 0.5) if f is not None]
        g = g or [normal(*f.shape, seed=i) for i, f in enumerate(fields)]
        return sum((a * b).sum() for a, b in zip(g, fields, strict=True))

    assert torch.autograd.gradcheck(total, points.requires_grad_(), fast_mode=True)


# ---------------------------------------------------------------------- mounted


def explicit(motion, T, t):
    """Rotation matrix and position of the attached frame from the kinematics of the body."""
    k = motion(t)
    R = rotation_matrix(k.rotation)
    position = None if k.position is None else k.position + (R @ T[:3, None])[..., 0]
    return R @ rotation_matrix(T[3:]), position


@each_body
def test_mounted_against_composition(group):
    """Pose by the product, every rate up to the jerk by differences of the one before."""
    spline, T = trajectory(group), poses()[0]
    mounted = spline.mounted(T)
    assert mounted.group == group
    assert mounted.domain == spline.domain
    k = mounted.kinematics(TIMES)
    R, position = explicit(spline.kinematics, T, TIMES)
    assert close(rotation_matrix(k.rotation), R, 1e-14)
    assert close(spin(mounted.kinematics, TIMES), k.angular_velocity, 1e-9)
    assert close(slope(lambda t: mounted.kinematics(t).angular_velocity, TIMES), k.angular_acceleration, 1e-9)
    if position is not None:
        assert close(k.position, position, 1e-14)
        assert close(slope(lambda t: explicit(spline.kinematics, T, t)[1], TIMES), k.velocity, 1e-9)
        assert close(slope(lambda t: mounted.kinematics(t).velocity, TIMES), k.acceleration, 1e-9)

    state = mounted.evaluate(TIMES, 3)
    assert torch.equal(state.value, mounted(TIMES))
    for r in (1, 2):
        assert close(slope(lambda t, r=r: mounted.evaluate(t, 3)[r], TIMES), state[r + 1], 1e-9)
    for count in range(3):
        fewer = mounted.evaluate(TIMES, count)
        assert all(x is None for x in fewer[count + 1 :])
        assert all(torch.equal(x, y) for x, y in zip(fewer[: count + 1], state, strict=False))


@each_body
def test_mounted_body_rates_are_those_of_the_product(group):
    """Nested differentiation of the composed pose, independent of the transport formulas."""
    spline, T = trajectory(group), poses()[1]
    part = {SO3: T[3:], DualQuaternion: convert.pose_to_dual_quaternion(T)}.get(group, T)
    mounted = spline.mounted(T).evaluate(TIMES, 3)

    def matrix(t):
        value = spline(t)
        if group == SPLIT:
            value = SE3.compose(value, part, validate=False)
        else:
            value = group.compose(value, part, validate=False)
        return (SE3 if group == SPLIT else group).to_matrix(value, validate=False)

    spline.validate = False
    X, rate = torch.func.jvp(matrix, (TIMES,), (torch.ones_like(TIMES),))
    if group == SPLIT:
        assert close(rate[:, :3, 3], mounted.velocity[:, :3], 1e-13)
        assert close((X.mT @ rate)[:, :3, :3], hat(SO3, mounted.velocity[:, 3:]), 1e-13)
    else:
        assert close(torch.linalg.inv(X) @ rate, hat(group, mounted.velocity), 1e-13)


@each_body
@pytest.mark.parametrize(("batch", "frames", "times"), [
    ((), (2,), (3,)), ((), (3,), (3,)), ((), (3,), ()), ((), (2,), (2, 3)), ((2,), (2,), (3,)), ((2,), (2,), ()),
    ((2,), (), (3,)), ((2,), (3, 1), (3,)), ((2, 2), (2,), ()), ((3, 2), (2,), (3,)), ((2,), (2,), (2, 3)),
], ids=str)  # fmt: skip
def test_mounted_in_batches(group, batch, frames, times):
    """Frames belong to trajectories, not to times, whatever sizes happen to coincide."""
    spline = trajectory(group, batch)
    T = poses(torch.Size(frames).numel()).reshape(*frames, 7)
    t = TIMES.expand(times) if times else TIMES[0]
    state = spline.mounted(T).evaluate(t, 3)
    common = torch.broadcast_shapes(batch if batch or len(times) < 2 else times[:-1], frames)
    points = spline.control_points.detach().expand(*common, *spline.control_points.shape[-2:])
    T = T.expand(*common, 7)
    for index in itertools.product(*map(range, common)):
        alone = BSpline(points[index], group=group, order=6, dt=0.7).mounted(T[index])
        own = t if t.ndim < 2 else t[index]
        for field, expected in zip(state, alone.evaluate(own, 3), strict=True):
            assert field.shape == (*common, *times[-1:], expected.shape[-1])
            assert close(field[index], expected, 1e-14)


@each_body
def test_mounted_on_mounted(group):
    spline, (T, S) = trajectory(group), poses()
    twice, once = spline.mounted(T).mounted(S), spline.mounted(SE3.compose(T, S))
    for a, b in zip(twice.evaluate(TIMES, 3), once.evaluate(TIMES, 3), strict=True):
        assert close(a, b, 1e-13)
    back = spline.mounted(T).mounted(SE3.inverse(T))
    for a, b in zip(back.evaluate(TIMES, 3), spline.evaluate(TIMES, 3), strict=True):
        assert close(a, b, 1e-13)


@each_body
def test_mounted_frame_learns(group):
    """A leaf gets its gradient, a Parameter is the module's own, and gradients are right."""
    points, start = control_points(group, 5), poses()[0] * 1.7
    g = [normal(2, size, seed=i) for i, size in enumerate([group.point_size] + [group.tangent_size] * 3)]

    def total(T):
        mounted = BSpline(points, group=group, dt=0.7, learnable=False).mounted(T)
        return sum((a * b).sum() for a, b in zip(g, mounted.evaluate(TIMES[:2] * 0.5, 3), strict=True))

    assert torch.autograd.gradcheck(total, start.clone().requires_grad_(), check_forward_ad=True)
    leaf = start.clone().requires_grad_()
    total(leaf).backward()
    assert (leaf.grad[3:] @ start[3:]).abs() < 1e-12
    assert leaf.grad[3:].abs().max() > 1e-3

    parameter = torch.nn.Parameter(start)
    mounted = trajectory(group).mounted(parameter)
    assert mounted.T_body_sensor is parameter
    assert {name for name, _ in mounted.named_parameters()} == {"T_body_sensor", "trajectory.control_points"}


def test_frames_that_do_not_fit():
    spline = trajectory(SE3)
    for T, error, message in (
        (torch.zeros(4).double(), ValueError, r"T_body_sensor: expected shape \(..., 7\)"),
        (torch.zeros(7).double(), ValueError, "T_body_sensor: expected quaternions"),
        (torch.full((7,), torch.nan).double(), ValueError, "T_body_sensor: expected finite"),
        ([0.0] * 7, TypeError, "T_body_sensor: expected a torch.Tensor"),
    ):
        with pytest.raises(error, match=message):
            spline.mounted(T)
    with pytest.raises(
        TypeError, match=r"T_body_sensor: dtype torch\.float32 differs from that of trajectory"
    ):
        spline.mounted(SE3.identity(dtype=torch.float32))(TIMES)
