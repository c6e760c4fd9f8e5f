"""Shaking: noise of a flat spectrum between two frequencies."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from torchspline.generate.distributions import LogUniform, Parameter, Uniform
from torchspline.generate.motions.motion import Motion, turned, uniform
from torchspline.groups import SO3

#: How many sines an axis is made of: enough for its values to be nearly normal.
SINES = 24


class BandLimited(Motion):
    """Acceleration and body rate are sums of sines of random frequencies in the band, and nothing outside."""

    name = "band_limited"
    parameters = {
        "low": Parameter("Hz", Uniform(0.2, 0.8), least=0.01, meaning="lower end of the band"),
        "bandwidth": Parameter("Hz", LogUniform(0.3, 3.0), meaning="width of the band"),
        "acceleration": Parameter("m/s^2", LogUniform(0.3, 5.0), most=100.0, meaning="RMS in each axis"),
        "angular_velocity": Parameter("rad/s", LogUniform(0.1, 2.0), most=50.0, meaning="RMS in each axis"),
    }

    def poses(
        self, tau: Tensor, spacing: float, drawn: Mapping[str, Tensor], generator: torch.Generator
    ) -> Tensor:
        count = len(tau)
        start = SO3.random(count, generator=generator)
        # Six axes; frequencies one in each of SINES equal parts of the band.
        part = torch.arange(SINES, dtype=torch.float64) + torch.rand(
            count, 6, SINES, generator=generator, dtype=torch.float64
        )
        frequency = drawn["low"][:, None, None] + drawn["bandwidth"][:, None, None] * part / SINES
        omega, phase = 2 * math.pi * frequency, uniform(generator, count, 6, SINES)
        amplitude = torch.cat([omega[:, :3].pow(-2), torch.ones_like(omega[:, 3:])], dim=1)
        amplitude = amplitude * math.sqrt(2.0 / SINES)
        curve = torch.zeros(count, tau.shape[1], 6, dtype=torch.float64)
        for k in range(SINES):  # one at a time: all at once would take SINES times the memory
            angle = omega[:, None, :, k] * tau[..., None] + phase[:, None, :, k]
            curve += amplitude[:, None, :, k] * angle.sin()
        rotation = turned(curve[..., 3:] * drawn["angular_velocity"][:, None, None], tau, start)
        return torch.cat([curve[..., :3] * drawn["acceleration"][:, None, None], rotation], dim=-1)

    def highest_frequency(self, drawn: Mapping[str, Tensor]) -> Tensor:
        return drawn["low"] + drawn["bandwidth"]
