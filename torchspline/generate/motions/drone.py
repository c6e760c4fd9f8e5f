"""A multirotor: it can only accelerate along its own z axis, so it leans into every manoeuvre."""

from collections.abc import Mapping

import torch
from torch import Tensor

from torchspline.generate.distributions import LogUniform, Parameter, Uniform
from torchspline.generate.motions.motion import (
    STANDARD_GRAVITY,
    Motion,
    around_z,
    differences,
    facing,
    smooth_curve,
    uniform,
)


class Drone(Motion):
    """A smooth random path; attitude from the thrust that it takes, a - g + drag v, and a smooth random heading."""

    name = "drone"
    parameters = {
        "bandwidth": Parameter("Hz", LogUniform(0.2, 1.5), least=0.01, meaning="of position and heading"),
        "acceleration": Parameter("m/s^2", LogUniform(0.3, 3.0), most=5.0, meaning="RMS in each axis"),
        "yaw_rate": Parameter("rad/s", LogUniform(0.1, 1.0), most=20.0, meaning="RMS"),
        "drag": Parameter("1/s", Uniform(0.0, 0.3), most=5.0, meaning="force per mass and speed"),
    }

    def poses(
        self, tau: Tensor, spacing: float, drawn: Mapping[str, Tensor], generator: torch.Generator
    ) -> Tensor:
        position = smooth_curve(tau, drawn["bandwidth"], generator, rate=2)
        position = position * drawn["acceleration"][:, None, None]
        yaw = smooth_curve(tau, drawn["bandwidth"], generator, rate=1)[..., 0] * drawn["yaw_rate"][:, None]
        yaw = yaw + uniform(generator, len(tau), 1)
        velocity, acceleration = differences(position, spacing)
        thrust = acceleration + drawn["drag"][:, None, None] * velocity
        # Rotors do not pull: a fall faster than free is flown as one with a third of the weight left.
        vertical = (thrust[..., 2:] + STANDARD_GRAVITY).clamp_min(0.3 * STANDARD_GRAVITY)
        up = torch.cat([thrust[..., :2], vertical], dim=-1)
        return torch.cat([position, facing(around_z(yaw), up)], dim=-1)

    def highest_frequency(self, drawn: Mapping[str, Tensor]) -> Tensor:
        return drawn["bandwidth"]
