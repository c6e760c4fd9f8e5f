"""The IMU with all that is wrong with it: gradients, what is learnt, and maps over parameters."""

import pytest
import torch
from batteries import generator
from sensor_cases import BATCH, F64, SPLIT, parameters, spline, stamps
from torch import nn

from torchspline import BSpline, imu


@pytest.mark.parametrize("name", [*parameters(), "control_points", "t"])
def test_gradients_of_every_parameter(name):
    trajectory, t, p = spline(BATCH), stamps(3), parameters(BATCH)
    low_pass = imu.LowPass(3.0, 2)
    points = trajectory.control_points.detach()

    def run(x):
        moved = points + x if name == "control_points" else points
        moved = BSpline(moved, group=SPLIT, order=5, dt=0.1, t0=-0.2, learnable=False)
        given = {**p, **({name: x} if name in p else {})}
        sensor = imu.Imu(
            **given, averaging=2, rate=50.0, gyroscope_filter=low_pass, accelerometer_filter=low_pass
        )
        out = sensor(moved, t + x if name == "t" else t)
        return out.gyroscope, out.accelerometer

    x = {"control_points": torch.zeros_like(points), "t": torch.zeros(3, dtype=F64), **p}[name]
    assert torch.autograd.gradcheck(run, (x.clone().requires_grad_(),), fast_mode=True, check_forward_ad=True)


def test_gradients_of_the_noise():
    trajectory, t = spline(BATCH), stamps(5)
    names = (
        "gyroscope_noise_density",
        "accelerometer_random_walk",
        "gyroscope_bias_sigma",
        "accelerometer_bias_time",
    )
    base = {"gyroscope_bias_time": 2.0, "accelerometer_bias_sigma": 0.2}

    def run(*densities):
        sensor = imu.Imu(noise=imu.ImuNoise(**base, **dict(zip(names, densities, strict=True))), rate=100.0)
        out = sensor(trajectory, t, generator=generator(3))
        return out.gyroscope, out.accelerometer, out.gyroscope_bias

    inputs = [torch.full((3,), 0.5, dtype=F64, requires_grad=True) for _ in names]
    assert torch.autograd.gradcheck(run, inputs, fast_mode=True, check_forward_ad=True)


def test_what_is_learnt_is_among_the_parameters():
    bias, density = nn.Parameter(torch.zeros(3, dtype=F64)), nn.Parameter(torch.full((3,), 0.1, dtype=F64))
    sensor = imu.Imu(
        gyroscope_bias=bias,
        noise=imu.ImuNoise(gyroscope_noise_density=density, accelerometer_random_walk=0.2),
        time_offset=nn.Parameter(torch.tensor(0.0, dtype=F64)),
        accelerometer_filter=imu.LowPass(nn.Parameter(torch.tensor(20.0, dtype=F64))),
    )
    assert {name for name, _ in sensor.named_parameters()} == {
        "gyroscope_bias", "gyroscope_noise_density", "sampling.time_offset", "accelerometer_filter.bandwidth"
    }  # fmt: skip
    assert sensor.noise.gyroscope_noise_density is density
    assert sensor.noise.accelerometer_random_walk == 0.2
    assert imu.Imu().noise is None
    trajectory = spline(extrapolate="linear")
    truth = imu.Imu(gyroscope_bias=(0.1, -0.2, 0.3), time_offset=0.01)(trajectory, stamps())
    learner = imu.Imu(gyroscope_bias=bias, time_offset=sensor.sampling.time_offset)
    optimizer = torch.optim.LBFGS(learner.parameters(), max_iter=40, line_search_fn="strong_wolfe")

    def loss():
        optimizer.zero_grad()
        cost = (learner(trajectory, stamps()).gyroscope - truth.gyroscope).square().sum()
        cost.backward()
        return cost

    optimizer.step(loss)
    assert torch.allclose(bias.detach(), torch.tensor([0.1, -0.2, 0.3], dtype=F64), atol=1e-4)
    assert abs(float(learner.sampling.time_offset.detach()) - 0.01) < 1e-5


def test_gradients_of_the_range():
    trajectory, t = spline(), stamps(5)
    limit = torch.tensor([1.0, 0.5, 2.0], dtype=F64, requires_grad=True)

    def run(x):
        return imu.Imu(gyroscope_range=x)(trajectory, t).gyroscope

    assert (run(limit) == limit).any()
    assert torch.autograd.gradcheck(run, (limit,))


def test_gradients_pass_the_converter_straight_where_it_does_not_clip():
    bias = torch.zeros(3, dtype=F64, requires_grad=True)
    trajectory, t = spline(), stamps()
    out = imu.Imu(gyroscope_bias=bias, gyroscope_range=2.0, gyroscope_resolution=0.3)(trajectory, t)
    out.gyroscope.sum().backward()
    inside = imu.Imu()(trajectory, t).gyroscope.abs() < 2.0
    assert torch.equal(bias.grad, inside.sum(0).to(F64))
    assert not inside.all()

    def run(bias):
        sensor = imu.Imu(gyroscope_bias=bias, gyroscope_range=2.0, gyroscope_resolution=0.3)
        return sensor(trajectory, t).gyroscope.sum(0)

    _, forward = torch.func.jvp(run, (bias.detach(),), (torch.ones(3, dtype=F64),))
    assert torch.equal(forward, inside.sum(0).to(F64))


@pytest.mark.parametrize("name", parameters())
def test_vmap_over_a_parameter_is_a_loop(name):
    trajectory, t, p = spline(), stamps(5), parameters()
    low_pass = imu.LowPass(3.0, 2)

    def run(x):
        sensor = imu.Imu(**{**p, name: x}, averaging=1, gyroscope_filter=low_pass, gyroscope_range=2.0)
        out = sensor(trajectory, t)
        return out.gyroscope, out.accelerometer

    batch = torch.stack([p[name], p[name] + 1e-3])
    for mapped, one, two in zip(torch.func.vmap(run)(batch), run(batch[0]), run(batch[1]), strict=True):
        assert torch.allclose(mapped, torch.stack([one, two]), rtol=0, atol=1e-12)
