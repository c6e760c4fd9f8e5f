"""The IMU with all that is wrong with it: noise, clocks, jitter and samples that are lost."""

import math

import pytest
import torch
from batteries import generator
from sensor_cases import F32, F64, SPLIT, spline, stamps

from torchspline import SE3, BSpline, SplitBSpline, imu


def noisy(**more):
    noise = imu.ImuNoise(0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 5.0, 6.0)
    return imu.Imu(noise=noise, jitter=1e-3, drop_probability=0.2, rate=100.0, **more)


def test_an_item_is_the_same_in_any_batch():
    trajectory, t, sensor = spline(4), stamps(), noisy()
    whole = sensor(trajectory, t, generator=[imu.item_generator(7, i) for i in range(4)])
    part = BSpline(trajectory.control_points[2:], group=SPLIT, order=5, dt=0.1, t0=-0.2)
    again = sensor(part, t, generator=[imu.item_generator(7, i) for i in (2, 3)])
    for a, b in zip(whole, again, strict=True):
        assert torch.equal(a if a is t else a[2:], b)
    assert not torch.equal(whole.gyroscope[0], whole.gyroscope[1])
    repeat = sensor(trajectory, t, generator=[imu.item_generator(8, i) for i in range(4)])
    assert not torch.equal(whole.gyroscope, repeat.gyroscope)


def test_one_motion_and_a_generator_for_each_item():
    out = noisy()(spline(), stamps(), generator=[imu.item_generator(0, i) for i in range(3)])
    assert out.gyroscope.shape == (3, 21, 3)
    assert out.valid.shape == out.instants.shape == (3, 21)
    assert out.gyroscope_bias.shape == (3, 21, 3)


def test_noise_has_its_densities():
    still = SplitBSpline(SE3.identity(6, dtype=F64), dt=1.0, learnable=False)
    t = torch.linspace(0.0, 3.0, 3001, dtype=F64)
    density = torch.tensor([0.01, 0.02, 0.03], dtype=F64)
    white = imu.Imu(noise=imu.ImuNoise(density, 0.1))(still, t, generator=generator(0))
    ideal = imu.Imu()(still, t)
    count = 3 * len(t)
    # The mean interval is a millisecond, and a standard deviation of n numbers is known to 1 / sqrt(2 n).
    assert torch.allclose(white.gyroscope.std(0), density * math.sqrt(1000), rtol=5 / math.sqrt(2 * len(t)))
    deviation = (white.accelerometer - ideal.accelerometer).std()
    assert abs(deviation / (0.1 * math.sqrt(1000)) - 1) < 5 / math.sqrt(2 * count)
    assert white.gyroscope_bias.abs().max() == 0.0
    walk = imu.Imu(noise=imu.ImuNoise(0.0, 0.0, 0.5))(still, t, generator=generator(0))
    steps = walk.gyroscope_bias.diff(dim=0)
    assert abs(steps.std() / (0.5 * math.sqrt(1e-3)) - 1) < 5 / math.sqrt(2 * count)
    assert torch.equal(walk.gyroscope, walk.gyroscope_bias)
    slow = imu.Imu(noise=imu.ImuNoise(0.0, 0.0, gyroscope_bias_instability=0.5))(
        still, t, generator=generator(0)
    )
    assert slow.gyroscope_bias.std() > 0.1
    assert slow.accelerometer_bias.abs().max() == 0.0


def test_densities_of_a_batch_and_single_precision():
    noise = imu.ImuNoise(torch.tensor([[0.0] * 3, [1.0] * 3]), 0.1)
    out = imu.Imu(noise=noise, dtype=F32)(spline(2), stamps(), generator=generator(0))
    assert out.gyroscope.dtype == out.accelerometer_bias.dtype == F32
    ideal = imu.Imu(dtype=F32)(spline(2), stamps())
    assert torch.equal(out.gyroscope[0], ideal.gyroscope[0])
    assert (out.gyroscope[1] - ideal.gyroscope[1]).abs().max() > 1.0


# ---------------------------------------------------------------------- sampling


def test_clocks_of_a_batch_in_seconds_and_nanoseconds():
    offset = torch.tensor([0.01, -0.02], dtype=F64)
    trajectory, t = spline(), stamps()
    out = imu.Imu(time_offset=offset, time_skew=1e-3)(trajectory, t)
    start, stop = trajectory.domain
    mid = 0.5 * (start + stop)
    again = out.instants + offset[:, None] + 1e-3 * (out.instants - mid)
    assert torch.allclose(again, t.expand(2, -1), rtol=0, atol=1e-15)
    whole = BSpline(
        trajectory.control_points.detach(),
        group=SPLIT,
        order=5,
        dt_ns=10**8,
        t0_ns=-2 * 10**8,
        learnable=False,
    )
    t_ns = (t * 1e9).round().to(torch.int64)
    exact = imu.Imu(time_offset=offset, time_skew=1e-3)(whole, t_ns)
    assert exact.instants.dtype == torch.int64
    assert (exact.instants - out.instants * 1e9).abs().max() <= 1.0
    assert torch.allclose(exact.accelerometer, out.accelerometer, atol=1e-5)


def test_jitter_stays_inside_and_drops_are_marked():
    trajectory = spline()
    start, stop = trajectory.domain
    t = torch.linspace(start, stop, 4001, dtype=F64)
    out = imu.Imu(jitter=1e-3, drop_probability=0.25)(trajectory, t, generator=generator(0))
    late = out.instants - t
    assert abs(late[10:-10].std() / 1e-3 - 1) < 5 / math.sqrt(8000)
    assert start <= out.instants.min() <= out.instants.max() <= stop
    share = out.valid.to(F64).mean()
    assert abs(share - 0.75) < 5 * math.sqrt(0.25 * 0.75 / 4001)
    there = imu.Imu()(trajectory, out.instants)
    assert torch.allclose(out.gyroscope[out.valid], there.gyroscope[out.valid], atol=1e-12)
    assert (out.gyroscope[~out.valid] == 0.0).all()
    with pytest.raises(ValueError, match="outside the domain"):
        imu.Imu(jitter=1e-3)(trajectory, t + 0.01)


def test_a_single_stamp():
    trajectory, t = spline(2), stamps()
    sensor = imu.Imu(noise=imu.ImuNoise(0.1), rate=100.0, averaging=2, gyroscope_filter=imu.LowPass(10.0))
    one = sensor(trajectory, t[3], generator=generator(0))
    assert one.gyroscope.shape == one.accelerometer_bias.shape == (2, 3)
    assert one.valid.shape == (2,)
    assert one.instants.shape == ()
