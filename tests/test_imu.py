"""Ideal IMU readings: against differences of positions and rotations, and against motions known in closed form."""

import numpy as np
import pytest
import torch
from batteries import generator, tangents
from scipy.interpolate import BSpline as ScipyBSpline
from scipy.spatial.transform import Rotation
from spline_cases import chain

from torchspline import R3, SE3, SO3, BSpline, Rn, SplitBSpline, imu, product
from torchspline.imu import STANDARD_GRAVITY, measure

F32, F64 = torch.float32, torch.float64
G = 9.80665
SPLIT = product(R3, SO3)
GROUPS = pytest.mark.parametrize("group", [SE3, SPLIT], ids=str)
MOUNT = torch.tensor([0.3, -0.2, 0.5, 1.6, -0.4, 0.8, 0.2], dtype=F64)  # not of unit length
WEIGHTLESS = (0.0, 0.0, 0.0)


def vector(*numbers):
    return torch.tensor(numbers, dtype=F64)


def random_spline(group, *batch, order=5, count=9, seed=0):
    """Neighbours about 0.7 rad and 0.7 m apart, 0.4 s in between."""
    total = (count - 1) * int(torch.Size(batch).numel())
    steps = 0.7 * tangents(group, [1.0], each=total, seed=seed).reshape(*batch, count - 1, 6)
    return BSpline(chain(group, steps, seed), group=group, order=order, dt=0.4, t0=-1.0, learnable=False)


def spun(axis, angles, positions=None, order=4, **options):
    """A split spline that turns about `axis` by the B-spline of `angles`; rotations about one axis commute."""
    q = SO3.exp(angles[:, None] * torch.nn.functional.normalize(axis, dim=0))
    positions = torch.zeros(len(angles), 3, dtype=F64) if positions is None else positions
    return SplitBSpline(torch.cat([positions, q], dim=-1), order=order, **options)


def inside(spline, count=40):
    """Times in the middle fifth of knot intervals, where differences do not reach over a knot."""
    start, stop = spline.domain
    dt = float(spline.dt)
    first = torch.randint(round((stop - start) / dt), (count,), generator=generator(1))
    return start + dt * (first + 0.4 + 0.2 * torch.rand(count, generator=generator(2), dtype=F64))


def derivative(f, t, which, h=0.012):
    """The first or second derivative of f at each time by central differences of sixth order."""
    coefficients = {1: (-1 / 60, 3 / 20, -3 / 4, 0, 3 / 4, -3 / 20, 1 / 60),
                    2: (1 / 90, -3 / 20, 3 / 2, -49 / 18, 3 / 2, -3 / 20, 1 / 90)}[which]  # fmt: skip
    return sum(c * f(t + (i - 3) * h) for i, c in enumerate(coefficients)) / h**which


# ---------------------------------------------------------------------- against differences


@GROUPS
@pytest.mark.parametrize("mount", [None, MOUNT], ids=["body", "mounted"])
@pytest.mark.parametrize("order", [4, 6])
def test_readings_are_what_differences_of_the_pose_say(group, mount, order):
    spline = random_spline(group, order=order)
    t, gravity = inside(spline), np.array([0.3, -9.7, 1.0])

    def pose(at):  # of the IMU, by matrices of SciPy
        values = spline(at).detach().numpy()
        p, R = values[:, :3], Rotation.from_quat(np.roll(values[:, 3:], -1, axis=1))
        if mount is not None:
            p = p + R.apply(mount[:3].numpy())
            R = R * Rotation.from_quat(np.roll(mount[3:].numpy(), -1))
        return p, R

    now = pose(t)[1].inv()
    angular_velocity = derivative(lambda at: (now * pose(at)[1]).as_rotvec(), t, 1)
    acceleration = derivative(lambda at: pose(at)[0], t, 2)
    reading = measure(spline, t, gravity=tuple(gravity), T_body_imu=mount)
    assert np.abs(acceleration).max() > 1.0
    np.testing.assert_allclose(reading.gyroscope.numpy(), angular_velocity, atol=2e-8)
    np.testing.assert_allclose(reading.accelerometer.numpy(), now.apply(acceleration - gravity), atol=2e-6)


# ---------------------------------------------------------------------- known readings


@GROUPS
def test_at_rest_it_reads_minus_gravity(group):
    pose = SE3.random(generator=generator(0))
    t = torch.linspace(0, 0.5, 7, dtype=F64)
    reading = measure(BSpline(pose.expand(8, -1), group=group, dt=0.1), t)
    R = SO3.to_matrix(pose[3:])
    assert reading.gyroscope.abs().max() < 1e-14
    assert torch.allclose(reading.accelerometer, (R.mT @ vector(0, 0, G)).expand(7, 3), rtol=0, atol=1e-13)
    level = measure(BSpline(SE3.identity(8), group=group, dt=0.1), t)
    assert level.accelerometer.tolist() == [[0.0, 0.0, G]] * 7
    assert STANDARD_GRAVITY == (0.0, 0.0, -G)


def test_gravity_of_a_world_whose_y_axis_points_down():
    still = BSpline(SE3.identity(6), group=SE3, dt=0.1)
    reading = measure(still, vector(0.1), gravity=(0.0, G, 0.0))
    assert reading.accelerometer.tolist() == [[0.0, -G, 0.0]]


def test_free_fall_reads_nothing_however_it_tumbles():
    dt = 0.2
    tau = (torch.arange(9, dtype=F64) - 1) * dt  # where control points of order 4 act
    height = -0.5 * G * (tau**2 - dt**2 / 3)  # the coefficients of -G t^2 / 2
    positions = torch.stack([3 * tau, 1 - tau, height], dim=-1)
    spline = spun(vector(1, 2, 3), 0.9 * torch.arange(9, dtype=F64).sin(), positions, dt=dt)
    t = torch.linspace(*spline.domain, 30, dtype=F64)
    assert torch.allclose(spline(t)[:, 2], -0.5 * G * t**2, rtol=0, atol=1e-13)
    reading = measure(spline, t)
    assert reading.accelerometer.abs().max() < 1e-12
    assert reading.gyroscope.abs().max() > 0.5


@GROUPS
def test_lever_arm_of_a_steady_turn_reads_centripetal_acceleration(group):
    rate, arm = 2.5, vector(0.4, -0.3, 0.7)
    angles = rate * 0.1 * torch.arange(10, dtype=F64)
    points = spun(vector(0, 0, 1), angles, dt=0.1).control_points.detach()
    spline = BSpline(points, group=group, dt=0.1)
    T = torch.cat([arm, vector(1, 0, 0, 0)])
    reading = measure(spline, torch.linspace(0, 0.7, 15, dtype=F64), gravity=WEIGHTLESS, T_body_imu=T)
    expected = -(rate**2) * arm * vector(1, 1, 0)
    assert torch.allclose(reading.gyroscope, vector(0, 0, rate).expand(15, 3), rtol=0, atol=1e-12)
    assert torch.allclose(reading.accelerometer, expected.expand(15, 3), rtol=0, atol=1e-11)


def test_lever_arm_of_a_turn_that_speeds_up_reads_tangential_acceleration():
    angles = torch.tensor([0.0, 0.3, 0.2, 1.0, 1.5, 1.2, 2.4], dtype=F64)
    axis, arm, dt = vector(0.36, 0.48, 0.8), vector(0.5, 0.1, -0.3), 0.25
    t = torch.linspace(0, 1.0, 21, dtype=F64)
    scalar = ScipyBSpline(dt * (np.arange(11) - 3), angles.numpy(), 3)
    w, a = (torch.from_numpy(scalar(t.numpy(), nu))[:, None] * axis for nu in (1, 2))
    T = torch.cat([arm, vector(1, 0, 0, 0)])
    reading = measure(spun(axis, angles, dt=dt), t, gravity=WEIGHTLESS, T_body_imu=T)
    cross = torch.linalg.cross
    expected = cross(a, arm.expand(21, 3)) + cross(w, cross(w, arm.expand(21, 3)))
    assert torch.allclose(reading.gyroscope, w, rtol=0, atol=1e-12)
    assert torch.allclose(reading.accelerometer, expected, rtol=0, atol=1e-10)


@GROUPS
def test_a_turned_imu_reads_the_same_vectors_in_its_own_axes(group):
    spline = random_spline(group)
    t = inside(spline)
    body = measure(spline, t)
    turned = measure(spline, t, T_body_imu=torch.cat([torch.zeros(3, dtype=F64), MOUNT[3:]]))
    R = SO3.to_matrix(MOUNT[3:])
    for a, b in zip(turned, body, strict=True):
        assert torch.allclose(a, b @ R, rtol=0, atol=1e-12)  # rows: R^T b


def test_steady_screw_on_se3():
    """X = Exp(t xi): w is constant, and so is w x v, what a body in a circle feels."""
    v, w = vector(1.0, -2.0, 0.5), vector(0.3, 0.8, -1.1)
    points = SE3.exp(0.2 * torch.arange(9, dtype=F64)[:, None] * torch.cat([v, w]))
    reading = measure(
        BSpline(points, group=SE3, order=5, dt=0.2), torch.linspace(0, 1.0, 9, dtype=F64), WEIGHTLESS
    )
    assert torch.allclose(reading.gyroscope, w.expand(9, 3), rtol=0, atol=1e-12)
    assert torch.allclose(
        reading.accelerometer, torch.linalg.cross(v, w).neg().expand(9, 3), rtol=0, atol=1e-11
    )


@pytest.mark.parametrize("mount", [None, MOUNT], ids=["body", "mounted"])
def test_one_screw_axis_is_one_motion_for_both_groups(mount):
    """Along an axis through the origin SE3 and R3xSO3 splines with the same control points coincide."""
    s = vector(0.0, 0.7, 0.5, 1.9, 2.2, 3.5, 3.1)
    axis = vector(2.0, -1.0, 2.0) / 3
    points = SE3.exp(s[:, None] * torch.cat([1.5 * axis, 0.8 * axis]))
    t = torch.linspace(0, 0.6, 25, dtype=F64)
    joint, split = (
        measure(BSpline(points, group=g, order=5, dt=0.2), t, T_body_imu=mount) for g in (SE3, SPLIT)
    )
    for a, b in zip(joint, split, strict=True):
        assert torch.allclose(a, b, rtol=0, atol=1e-10)
    if mount is None:
        scalar = ScipyBSpline(0.2 * (np.arange(12) - 4), s.numpy(), 4)
        rate, change = (torch.from_numpy(scalar(t.numpy(), nu))[:, None] for nu in (1, 2))
        q = SO3.exp(0.8 * torch.from_numpy(scalar(t.numpy()))[:, None] * axis)
        weight = SO3.act(SO3.inverse(q), vector(0, 0, G).expand(25, 3))
        assert torch.allclose(joint.gyroscope, 0.8 * rate * axis, rtol=0, atol=1e-11)
        assert torch.allclose(joint.accelerometer, 1.5 * change * axis + weight, rtol=0, atol=1e-10)


# ---------------------------------------------------------------------- biases, shapes, dtypes


@GROUPS
def test_biases_are_added(group):
    spline = random_spline(group)
    t = inside(spline, 6)
    plain = measure(spline, t, T_body_imu=MOUNT)
    for size in ((3,), (6, 3)):
        bg, ba = (torch.randn(size, generator=generator(i), dtype=F64) for i in range(2))
        biased = measure(spline, t, gyroscope_bias=bg, accelerometer_bias=ba, T_body_imu=MOUNT)
        assert torch.equal(biased.gyroscope, plain.gyroscope + bg)
        assert torch.equal(biased.accelerometer, plain.accelerometer + ba)
    listed = measure(spline, t, accelerometer_bias=(1, 2, 3), T_body_imu=MOUNT)
    assert torch.equal(listed.accelerometer, plain.accelerometer + vector(1, 2, 3))
    assert torch.equal(listed.gyroscope, plain.gyroscope)


@GROUPS
def test_batches_equal_a_loop(group):
    spline = random_spline(group, 2, 3)
    mounts = SE3.random(2, 3, generator=generator(5))
    shared, own = inside(spline, 4), inside(spline, 24).reshape(2, 3, 4)
    bias = torch.randn(2, 3, 1, 3, generator=generator(6), dtype=F64)
    for t in (shared, own, shared[0]):
        b = bias[..., 0, :] if t.ndim == 0 else bias
        together = measure(spline, t, gyroscope_bias=b, T_body_imu=mounts)
        assert together.gyroscope.shape == together.accelerometer.shape == (2, 3, *t.shape[-1:], 3)
        for i in range(2):
            for j in range(3):
                one = BSpline(spline.control_points[i, j], group=group, order=5, dt=0.4, t0=-1.0)
                at = t[i, j] if t.ndim == 3 else t
                alone = measure(one, at, gyroscope_bias=b[i, j], T_body_imu=mounts[i, j])
                for x, y in zip(together, alone, strict=True):
                    assert torch.allclose(x[i, j], y, rtol=0, atol=1e-11)


def test_nanoseconds_and_mounted_trajectories():
    spline = random_spline(SE3)
    ns = BSpline(
        spline.control_points, group=SE3, order=5, dt_ns=400_000_000, t0_ns=1_520_530_308_000_000_000
    )
    elapsed = torch.tensor([0, 123_456_789, 1_999_999_999])
    seconds = measure(spline, elapsed.double() * 1e-9 - 1.0, T_body_imu=MOUNT)
    for whole in (
        measure(ns, elapsed + ns.t0_ns, T_body_imu=MOUNT),
        measure(ns.mounted(MOUNT), elapsed + ns.t0_ns),
    ):
        for a, b in zip(seconds, whole, strict=True):
            assert torch.allclose(a, b, rtol=0, atol=1e-11)


@GROUPS
@pytest.mark.parametrize("default", [F32, F64])
def test_dtype_follows_the_trajectory(group, default):
    spline = random_spline(group)
    t = inside(spline)
    exact = measure(spline, t, accelerometer_bias=(1.0, 2.0, 3.0), T_body_imu=MOUNT)
    before = torch.get_default_dtype()
    torch.set_default_dtype(default)
    try:
        single = measure(spline.to(F32), t, accelerometer_bias=(1.0, 2.0, 3.0), T_body_imu=MOUNT.float())
    finally:
        torch.set_default_dtype(before)
    for a, b in zip(single, exact, strict=True):
        assert a.dtype == F32
        assert b.dtype == F64
        assert torch.allclose(a.double(), b, rtol=1e-5, atol=2e-4)


# ---------------------------------------------------------------------- gradients


@GROUPS
@pytest.mark.parametrize("mounted", [False, True])
def test_gradients_by_everything(group, mounted):
    points = random_spline(group, order=4, count=5).control_points.clone()
    t = vector(-0.93, -0.3)
    arguments = [points, t, vector(0.1, -0.2, -9.8), vector(0.1, 0.2, 0.3), vector(-0.2, 0.1, 0.4)]
    arguments += [MOUNT.clone()] if mounted else []

    def readings(points, t, gravity, bg, ba, mount=None):
        spline = BSpline(points, group=group, dt=0.4, t0=-1.0)
        return tuple(measure(spline, t, gravity, bg, ba, mount))

    leaves = tuple(x.requires_grad_() for x in arguments)
    assert torch.autograd.gradcheck(readings, leaves, atol=1e-6)
    sum(x.square().sum() for x in readings(*leaves)).backward()
    for x in leaves:
        assert x.grad.norm() > 1e-3
    for start, stop in group.arithmetic.sign_blocks:
        along = (points.grad[:, start:stop] * points[:, start:stop]).sum(-1)
        assert along.abs().max() < 1e-9


def test_only_bodies_carry_an_imu():
    for group in (SO3, R3, Rn(6)):
        spline = BSpline(group.random(5, generator=generator(0)), group=group, dt=0.1)
        with pytest.raises(ValueError, match=f"^trajectory: .* got {group}"):
            measure(spline, vector(0.1))
    assert set(imu.__all__) >= {"STANDARD_GRAVITY", "ImuReading", "measure"}
