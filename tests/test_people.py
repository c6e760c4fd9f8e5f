"""Bodies from motion capture: exact on splines, what is kept of accelerations, and the recipe others use."""

import math

import pytest
import torch

from torchspline import SE3, SO3, SplitBSpline, imu
from torchspline.io import read_bvh
from torchspline.people import fit_body, response

F64 = torch.float64
DOWN = (0.0, -9.80665, 0.0)


def walking(t, joints=3, frequency=1.0, swing=0.6):
    """Poses (J, N, 7) of limbs that swing, and their exact IMU readings, by forward mode."""
    generator = torch.Generator().manual_seed(0)
    axes = torch.nn.functional.normalize(torch.randn(joints, 3, generator=generator, dtype=F64), dim=-1)
    phases = 6.28 * torch.rand(joints, 1, generator=generator, dtype=F64)

    def position(t):
        angle = 2 * math.pi * frequency * t + phases
        return torch.stack(
            [1.2 * t + 0.1 * angle.sin(), 0.9 + 0.05 * (2 * angle).cos(), 0.1 * angle.cos()], -1
        )

    def rotation(t):
        angle = swing * (2 * math.pi * frequency * t + phases).sin()
        tilt = torch.tensor([0.3, 0.1, -0.2], dtype=F64)
        return SO3.compose(SO3.exp(angle[..., None] * axes[:, None]), SO3.exp(0.5 * angle[..., None] * tilt))

    along = lambda f: lambda t: torch.func.jvp(f, (t,), (torch.ones_like(t),))[1]  # noqa: E731
    q = rotation(t)
    rate = along(lambda s: SO3.log(SO3.between(q, rotation(s))))(t)
    fall = along(along(position))(t) - torch.tensor(DOWN, dtype=F64)
    return torch.cat([position(t), q], -1), rate, SO3.act(SO3.inverse(q), fall)


def test_a_spline_of_the_same_knots_comes_back():
    generator = torch.Generator().manual_seed(0)
    first = SE3.random(4, 1, generator=generator, dtype=F64)
    steps = SE3.exp(0.25 * torch.randn(4, 24, 6, generator=generator, dtype=F64))
    points = [first]
    for step in steps.unbind(1):
        points.append(SE3.compose(points[-1], step[:, None]))
    truth = SplitBSpline(torch.cat(points, 1), dt=1 / 30, order=6, learnable=False)
    t = torch.arange(0.0, 20 / 30 + 1e-9, 1 / 120, dtype=F64)
    body = fit_body(t, truth(t), bandwidth=10.0)
    assert body.control_points.shape == (4, 25, 7)
    error = (body(t) - truth(t)).abs()
    assert error[..., :3].max() < 1e-6
    assert error[..., 3:].max() < 5e-3  # ends are held near their neighbours
    assert error[:, 16:-16, 3:].max() < 2e-4


@pytest.mark.parametrize("rate", [60.0, 120.0])
def test_readings_at_any_rate_against_the_exact_ones(rate):
    t = torch.arange(0.0, 4.0, 1 / rate, dtype=F64)
    body = fit_body(t, walking(t)[0], bandwidth=12.0)
    times = torch.linspace(0.5, 3.4, 2001, dtype=F64)
    _, gyroscope, accelerometer = walking(times)
    reading = imu.measure(body, times, gravity=DOWN)
    assert reading.gyroscope.shape == (3, 2001, 3)
    assert (reading.gyroscope - gyroscope).abs().max() < 2e-3 * gyroscope.abs().max()
    assert (reading.accelerometer - accelerometer).abs().max() < 2e-3 * accelerometer.abs().max()


def test_shape_of_one_joint_and_irregular_times():
    generator = torch.Generator().manual_seed(0)
    t = (
        torch.arange(0.0, 4.0, 1 / 100, dtype=F64) + 0.003 * torch.rand(400, generator=generator, dtype=F64)
    ) + 50.0
    poses, *_ = walking(t - 50.0)
    many, one = fit_body(t, poses, bandwidth=10.0), fit_body(t, poses[1], bandwidth=10.0)
    torch.testing.assert_close(one.control_points, many.control_points[1])
    flipped = poses.clone()
    flipped[..., ::3, 3:] *= -2.0  # signs and lengths of quaternions do not matter
    turned = SO3.between(fit_body(t, flipped, bandwidth=10.0)(t)[..., 3:], many(t)[..., 3:])
    assert SO3.log(turned).abs().max() < 1e-9
    assert many.domain[0] == t[0]
    assert abs(many.domain[1] - float(t[-1])) < 1e-9


def test_missing_poses_are_named_before_memory_is_taken():
    t = torch.arange(200, dtype=F64) / 60
    t[100:] += 1e9
    with pytest.raises(ValueError, match=r"t: expected at least .* for as many control points, got 200; cut"):
        fit_body(t, walking(t)[0], bandwidth=5.0)
    with pytest.raises(ValueError, match=r"frequencies: expected at least 4.8e-05 Hz at 60 Hz, got 1e-09"):
        response(torch.tensor([1e-9], dtype=F64), 60.0, bandwidth=5.0)


def test_response_is_what_a_fit_does():
    """A sine of 10 Hz along x: its acceleration in the fitted spline against `response`, and that keeps it."""
    frequencies = torch.tensor([1.0, 5.0, 10.0, 20.0, 25.0], dtype=F64)
    expected = response(frequencies, 60.0, bandwidth=10.0)
    assert (expected.gain[:3] > 0.999).all()
    assert (expected.distortion[:2] < 0.01).all()
    assert expected.distortion[2] < 0.1
    assert (expected.gain[3:] < 1e-3).all()
    t = torch.arange(0.0, 10.0 + 1e-9, 1 / 60, dtype=F64)
    times = torch.linspace(2.0, 8.0, 4001, dtype=F64)
    for f, gain in zip(frequencies.tolist(), expected.gain.tolist(), strict=True):
        poses = SE3.identity(len(t), dtype=F64)
        poses[:, 0] = torch.sin(2 * math.pi * f * t)
        made = fit_body(t, poses, bandwidth=10.0).kinematics(times).acceleration[:, 0].detach()
        exact = -((2 * math.pi * f) ** 2) * torch.sin(2 * math.pi * f * times)
        assert abs(float(made @ exact / (exact @ exact)) - gain) < 2e-3
    noisy = 1e-3 * torch.randn(40, len(t), 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    poses = torch.cat([noisy, SO3.identity(40, len(t), dtype=F64)], -1)
    made = fit_body(t, poses, bandwidth=10.0).kinematics(times).acceleration.detach()
    assert abs(float(made.square().mean().sqrt()) / (1e-3 * expected.noise) - 1.0) < 0.05


def test_the_usual_recipe_keeps_a_sixth_at_10_hz():
    """Second differences over 4 frames on each side [DIP, TransPose], on a sine, and in closed form: 17 % [issue]."""
    rate, n, f = 60.0, 4, 10.0
    t = torch.arange(0.0, 5.0, 1 / rate, dtype=F64)
    x = torch.sin(2 * math.pi * f * t + 0.3)
    recipe = (x[2 * n :] + x[: -2 * n] - 2 * x[n:-n]) * (rate / n) ** 2
    exact = -((2 * math.pi * f) ** 2) * x[n:-n]
    kept = float(recipe @ exact / (exact @ exact))
    assert abs(kept - float(torch.sinc(torch.tensor(f * n / rate))) ** 2) < 1e-6
    assert round(100 * kept) == 17
    assert float(response(torch.tensor([f], dtype=F64), rate, bandwidth=15.0).gain) > 0.999


@pytest.mark.realdata
def test_real_walk(shared_data):
    """Every second frame of 120 Hz gives what all frames give, up to the bandwidth that both show."""
    skeleton = read_bvh(shared_data / "mocap_bvh" / "walk.bvh.gz")
    t, poses = skeleton.time, skeleton.poses()
    times = torch.linspace(0.3, 3.6, 1000, dtype=F64)
    full, half = (
        imu.measure(fit_body(t[::k], poses[:, ::k], bandwidth=10.0), times, gravity=DOWN) for k in (1, 2)
    )
    moving = (full.accelerometer - full.accelerometer.mean(1, keepdim=True)).square().mean().sqrt()
    assert (full.accelerometer - half.accelerometer).square().mean().sqrt() < 0.35 * moving
    assert 9.0 < full.accelerometer[0].mean(0).norm() < 10.5  # hips carry the body against gravity
    assert (
        full.gyroscope - half.gyroscope
    ).square().mean().sqrt() < 0.25 * full.gyroscope.square().mean().sqrt()
