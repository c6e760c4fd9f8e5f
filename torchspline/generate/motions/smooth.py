"""Something in a hand: smooth random translation and turning."""

from collections.abc import Mapping

import torch
from torch import Tensor

from torchspline.generate.distributions import LogUniform, Parameter
from torchspline.generate.motions.motion import Motion, smooth_curve, turned
from torchspline.groups import SO3


class Smooth(Motion):
    """Splines with random control points: acceleration and body rate of a given bandwidth and RMS in each axis."""

    name = "smooth"
    parameters = {
        "bandwidth": Parameter("Hz", LogUniform(0.3, 3.0), least=0.01, meaning="of position and body rate"),
        "acceleration": Parameter("m/s^2", LogUniform(0.3, 5.0), most=100.0, meaning="RMS in each axis"),
        "angular_velocity": Parameter("rad/s", LogUniform(0.1, 2.0), most=50.0, meaning="RMS in each axis"),
    }

    def poses(
        self, tau: Tensor, spacing: float, drawn: Mapping[str, Tensor], generator: torch.Generator
    ) -> Tensor:
        start = SO3.random(len(tau), generator=generator)
        position = smooth_curve(tau, drawn["bandwidth"], generator, rate=2)
        rates = smooth_curve(tau, drawn["bandwidth"], generator, rate=0)
        rotation = turned(rates * drawn["angular_velocity"][:, None, None], tau, start)
        return torch.cat([position * drawn["acceleration"][:, None, None], rotation], dim=-1)

    def highest_frequency(self, drawn: Mapping[str, Tensor]) -> Tensor:
        return drawn["bandwidth"]
