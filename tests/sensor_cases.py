"""Motions, stamps and every error of an IMU, for the tests of the sensor."""

import torch
from batteries import generator, tangents
from spline_cases import chain

from torchspline import R3, SO3, BSpline, product

F32, F64 = torch.float32, torch.float64
SPLIT = product(R3, SO3)
GRAVITY = (0.3, -0.2, -9.7)
BATCH = 2


def normal(*shape, scale=1.0, seed=0):
    return scale * torch.randn(shape, generator=generator(seed), dtype=F64)


def spline(*batch, group=SPLIT, order=5, count=14, dt=0.1, seed=0, **options):
    """Neighbours about 0.3 rad and 0.3 m apart; the domain starts at -0.2 s."""
    total = (count - 1) * int(torch.Size(batch).numel())
    steps = 0.3 * tangents(group, [1.0], each=total, seed=seed).reshape(*batch, count - 1, 6)
    points = chain(group, steps, seed)
    return BSpline(points, group=group, order=order, dt=dt, t0=-0.2, learnable=False, **options)


def stamps(count=21):
    return torch.linspace(0.0, 0.6, count, dtype=F64)


def parameters(*batch):
    """Every deterministic effect, large enough to be seen."""
    return {
        "gyroscope_bias": normal(*batch, 3, scale=0.1, seed=1),
        "accelerometer_bias": normal(*batch, 3, scale=0.5, seed=2),
        "gyroscope_scale": 1.0 + normal(*batch, 3, scale=0.1, seed=3),
        "accelerometer_scale": 1.0 + normal(*batch, 3, scale=0.1, seed=4),
        "gyroscope_misalignment": normal(*batch, 3, scale=0.1, seed=5),
        "accelerometer_misalignment": normal(*batch, 3, scale=0.1, seed=6),
        "gyroscope_rotation": normal(*batch, 4, seed=7),
        "g_sensitivity": normal(*batch, 3, 3, scale=0.01, seed=8),
        "T_body_imu": torch.cat([normal(*batch, 3, scale=0.3, seed=9), normal(*batch, 4, seed=10)], -1),
        "accelerometer_arms": normal(*batch, 3, 3, scale=0.2, seed=11),
        "gravity": torch.tensor(GRAVITY, dtype=F64).expand(*batch, 3).clone(),
        "earth_rate": normal(*batch, 3, scale=0.2, seed=12),
        "time_offset": normal(*batch, scale=0.01, seed=13),
        "time_skew": normal(*batch, scale=0.01, seed=14),
    }
