"""Magnetometer and barometer: against rotations and pressures one by one."""

import math

import numpy as np
import pytest
import torch
from batteries import generator, tangents
from scipy.spatial.transform import Rotation
from spline_cases import chain

from torchspline import R3, SE3, SO3, BSpline, SplitBSpline, imu, product
from torchspline.imu import Barometer, LowPass, Magnetometer, earth

F32, F64 = torch.float32, torch.float64
FIELD = earth.dipole_field(math.radians(47.0), math.radians(8.0))


def normal(*shape, scale=1.0, seed=0):
    return scale * torch.randn(shape, generator=generator(seed), dtype=F64)


def spline(*batch, seed=0):
    total = 11 * int(torch.Size(batch).numel())
    steps = 0.4 * tangents(SE3, [1.0], each=total, seed=seed).reshape(*batch, 11, 6)
    points = chain(product(R3, SO3), steps, seed)
    return SplitBSpline(points, dt=0.1, learnable=False)


T = torch.linspace(0.0, 0.8, 9, dtype=F64)


def test_magnetometer_sample_by_sample():
    trajectory = spline(2)
    mount, iron, offset = (
        normal(2, 4),
        torch.eye(3, dtype=F64) + normal(2, 3, 3, scale=0.1),
        normal(2, 3, scale=5.0),
    )
    out = Magnetometer(FIELD, rotation=mount, soft_iron=iron, bias=offset)(trajectory, T)
    for item in range(2):
        poses = trajectory(T)[item].numpy()
        sensor = Rotation.from_quat(np.roll(mount[item].numpy(), -1))
        for pose, value in zip(poses, out.value[item].numpy(), strict=True):
            seen = (Rotation.from_quat(np.roll(pose[3:], -1)) * sensor).inv().apply(FIELD.numpy())
            np.testing.assert_allclose(value, iron[item].numpy() @ seen + offset[item].numpy(), atol=1e-11)
    assert torch.equal(out.bias, offset[:, None].expand(2, 9, 3))
    plain = Magnetometer(FIELD)(trajectory, T).value
    assert torch.allclose(plain.norm(dim=-1), FIELD.norm().expand(2, 9))
    turning = BSpline(trajectory.control_points[..., 3:], group=SO3, dt=0.1)
    assert torch.allclose(Magnetometer(FIELD)(turning, T).value, plain)


def test_barometer_sample_by_sample():
    trajectory, arm = spline(), normal(3)
    up = torch.tensor([0.0, 0.6, -0.8], dtype=F64)
    out = Barometer(ground_height=420.0, up=up, lever_arm=arm, bias=torch.tensor(30.0))(trajectory, T)
    assert out.value.shape == out.bias.shape == out.valid.shape == (9,)
    for pose, value in zip(trajectory(T).numpy(), out.value.tolist(), strict=True):
        place = pose[:3] + Rotation.from_quat(np.roll(pose[3:], -1)).apply(arm.numpy())
        assert abs(value - 30.0 - float(earth.standard_pressure(420.0 + float(place @ up.numpy())))) < 1e-8
    points = BSpline(trajectory.control_points[..., :3], group=R3, dt=0.1)
    low, high = (Barometer(ground_height=h)(points, T).value for h in (0.0, 1.0))
    assert torch.allclose(high - low, torch.tensor(-12.0, dtype=F64).expand(9), atol=0.1)  # 12 Pa a metre
    each = Barometer(ground_height=torch.tensor([0.0, 1.0], dtype=F64))(points, T).value
    assert torch.allclose(each, torch.stack([low, high]))


def test_gradients():
    trajectory = spline()
    given = {"rotation": normal(4), "soft_iron": torch.eye(3, dtype=F64) + normal(3, 3), "bias": normal(3)}

    def magnetic(field, time_offset, *rest):
        parts = dict(zip(given, rest, strict=True))
        return Magnetometer(field, time_offset=time_offset, low_pass=LowPass(5.0), **parts)(
            trajectory, T[1:4]
        ).value

    def pressure(height, arm, bias, time_offset):
        sensor = Barometer(ground_height=height, lever_arm=arm, bias=bias, time_offset=time_offset)
        return sensor(trajectory, T[1:4]).value

    zero = torch.zeros((), dtype=F64)
    inputs = [x.clone().requires_grad_() for x in (FIELD, zero, *given.values())]
    assert torch.autograd.gradcheck(magnetic, inputs, fast_mode=True, check_forward_ad=True)
    inputs = [x.clone().requires_grad_() for x in (zero, normal(3), zero, zero)]
    assert torch.autograd.gradcheck(
        pressure, inputs, eps=1e-4, atol=1e-4, fast_mode=True, check_forward_ad=True
    )


def test_noise_walk_converter_and_losses():
    still = SplitBSpline(SE3.identity(6, dtype=F64), dt=1.0, learnable=False)
    t = torch.linspace(0.0, 3.0, 3001, dtype=F64)
    sensor = Barometer(noise_density=0.1, random_walk=0.5, drop_probability=0.2, dtype=F64)
    out = sensor(still, t, generator=generator(0))
    assert abs(out.bias.diff().std() / (0.5 * math.sqrt(1e-3)) - 1) < 5 / math.sqrt(6000)
    white = (out.value - out.bias)[out.valid] - float(earth.standard_pressure(0.0))
    assert abs(white.std() / (0.1 * math.sqrt(1000)) - 1) < 5 / math.sqrt(4800)
    assert (out.value[~out.valid] == 0.0).all()
    assert abs(out.valid.to(F64).mean() - 0.8) < 5 * math.sqrt(0.16 / 3001)
    rough = Magnetometer(FIELD, range=30.0, resolution=0.5, noise_density=0.1, dtype=F32)
    value = rough(still, t, generator=generator(0)).value
    assert value.dtype == F32
    assert torch.equal(value / 0.5, (value / 0.5).round())
    assert value.abs().max() == 30.0
    items = [imu.item_generator(0, i) for i in range(2)]
    assert Magnetometer(FIELD, noise_density=1.0)(still, t, generator=items).value.shape == (2, 3001, 3)
    one = Magnetometer(FIELD, noise_density=1.0, rate=10.0)(still, t[5], generator=generator(0))
    assert one.value.shape == (3,)
    assert Barometer()(still, t[5]).value.shape == ()


@pytest.mark.parametrize(
    ("sensor", "group", "expected"),
    [
        (Magnetometer(FIELD), R3, "with rotation"),
        (Barometer(), SO3, "with position"),
        (Barometer(lever_arm=(1.0, 0.0, 0.0)), R3, "with rotation"),
    ],
)
def test_trajectories_that_lack_what_is_sensed(sensor, group, expected):
    pose = spline().control_points
    points = pose[..., :3] if group == R3 else pose[..., 3:]
    with pytest.raises(ValueError, match=f"trajectory: expected one {expected}"):
        sensor(BSpline(points, group=group, dt=0.1), T)
