"""Motions and IMUs to simulate: every effect of `Imu` on, each item with parameters and random numbers of its own."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchspline import SE3, SplitBSpline, imu

F64 = torch.float64
#: What is left out, by name, to see what it costs.
EFFECTS: dict[str, tuple[str, ...]] = {
    "extrinsics": ("T_body_imu",),
    "size effect": ("accelerometer_arms",),
    "earth rotation": ("earth_rate",),
    "averaging": ("averaging",),
    "low-pass filters": ("gyroscope_filter", "accelerometer_filter"),
    "calibration": (
        "gyroscope_scale", "accelerometer_scale", "gyroscope_misalignment", "accelerometer_misalignment",
        "gyroscope_rotation", "g_sensitivity",
    ),
    "constant bias": ("gyroscope_bias", "accelerometer_bias"),
    "clock": ("time_offset", "time_skew"),
    "jitter and losses": ("jitter", "drop_probability"),
    "range": ("gyroscope_range", "accelerometer_range"),
    "resolution": ("gyroscope_resolution", "accelerometer_resolution"),
}  # fmt: skip
#: Parts of the noise, likewise.
NOISES: dict[str, tuple[str, ...]] = {
    "white noise": ("noise_density",),
    "random walk": ("random_walk",),
    "Gauss-Markov bias": ("bias_sigma",),
}


@dataclass
class Load:
    """A batch of items to simulate."""

    trajectory: SplitBSpline
    sensor: imu.Imu
    t: Tensor
    items: list[int]
    seed: int

    @property
    def samples(self) -> int:
        return len(self.items) * len(self.t)

    def simulate(self) -> imu.Readings:
        """Readings of all items; generators are made anew, as for items of a data set."""
        with torch.no_grad():
            generators = [imu.item_generator(self.seed, i) for i in self.items]
            return self.sensor(self.trajectory, self.t, generator=generators)


def make_load(
    items: list[int],
    samples: int,
    rate: float,
    seed: int,
    without: str | None = None,
    flicker: bool = False,
    single: bool = True,
) -> Load:
    """Items of `samples` samples at `rate` Hz; item i is the same in every load of this seed.

    Args:
        without: a name in `EFFECTS` or `NOISES` to leave out; "everything" for an ideal IMU.
        flicker: also bias instability. single: whether readings are float32.
    """
    duration, dt = samples / rate, 0.1
    count = math.ceil((duration + 0.2) / dt) + 4
    points, drawn = [], []
    for i in items:  # a generator for each item, so that items do not depend on who else is in the load
        generator = torch.Generator().manual_seed(10**6 * (seed + 1) + i)
        steps = 0.15 * torch.randn(count, 6, generator=generator, dtype=F64)
        points.append(SE3.exp(torch.cat([steps[:, :3], steps[:, 3:].cumsum(0) * 0.3], dim=-1)))
        drawn.append(torch.randn(52, generator=generator, dtype=F64))
    trajectory = SplitBSpline(torch.stack(points), dt=dt, t0=-0.1, learnable=False)
    given = _parameters(torch.stack(drawn))
    noise: dict[str, Any] = {
        "gyroscope_noise_density": 1.7e-3,
        "accelerometer_noise_density": 2e-2,
        "gyroscope_random_walk": 2e-5,
        "accelerometer_random_walk": 3e-3,
        "gyroscope_bias_sigma": 1e-3,
        "accelerometer_bias_sigma": 1e-2,
    }
    if flicker:
        noise |= {"gyroscope_bias_instability": 1e-4, "accelerometer_bias_instability": 1e-3}
    if without == "everything":
        given, noise = {}, {}
    for name in EFFECTS.get(without or "", ()):
        del given[name]
    for name in NOISES.get(without or "", ()):
        noise = {key: x for key, x in noise.items() if not key.endswith(name)}
    sensor = imu.Imu(
        noise=imu.ImuNoise(**noise) if noise else None,
        rate=rate,
        dtype=torch.float32 if single else torch.float64,
        **given,
    )
    return Load(trajectory, sensor, torch.arange(samples, dtype=F64) / rate, items, seed)


def _parameters(z: Tensor) -> dict[str, Any]:
    """All that `Imu` takes, from normal numbers (B, 52)."""
    column = iter(z.split([3, 4] + [3] * 7 + [4, 9, 9, 1, 1], dim=-1))
    eye = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=F64)
    mount = torch.cat([0.1 * next(column), eye + 0.1 * next(column)], dim=-1)
    return {
        "gyroscope_bias": 1e-2 * next(column),
        "accelerometer_bias": 1e-1 * next(column),
        "gyroscope_scale": 1.0 + 1e-2 * next(column),
        "accelerometer_scale": 1.0 + 1e-2 * next(column),
        "gyroscope_misalignment": 1e-2 * next(column),
        "accelerometer_misalignment": 1e-2 * next(column),
        "gravity": torch.tensor([0.0, 0.0, -9.81], dtype=F64) + 1e-2 * next(column),
        "earth_rate": imu.earth.earth_rate(0.8) ,
        "T_body_imu": mount,
        "gyroscope_range": 35.0,
        "gyroscope_rotation": eye + 1e-2 * next(column),
        "g_sensitivity": 1e-4 * next(column).unflatten(-1, (3, 3)),
        "accelerometer_arms": 1e-2 * next(column).unflatten(-1, (3, 3)),
        "time_offset": 1e-3 * next(column)[:, 0].tanh(),
        "time_skew": 1e-5 * next(column)[:, 0],
        "accelerometer_range": 160.0,
        "gyroscope_resolution": 1e-3,
        "accelerometer_resolution": 5e-3,
        "averaging": 2,
        "gyroscope_filter": imu.LowPass(80.0, 2),
        "accelerometer_filter": imu.LowPass(60.0, 1),
        "jitter": 2e-5,
        "drop_probability": 0.01,
    }  # fmt: skip
