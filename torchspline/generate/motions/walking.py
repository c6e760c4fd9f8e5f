"""Somebody who walks and wears the sensor."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from torchspline.generate.distributions import Parameter, Uniform
from torchspline.generate.motions.motion import Motion, around_z, facing, smooth_curve, uniform
from torchspline.groups import SO3

#: Overtones of a step, up to which there is some of a foot's impact.
OVERTONES = 3
#: Hz: how fast the direction of the walk changes.
WANDERING = 0.2


class Walking(Motion):
    """Forward at a steady speed along a wandering path, up and down with every step, to the side with every second."""

    name = "walking"
    parameters = {
        "speed": Parameter("m/s", Uniform(0.5, 1.8), most=10.0),
        "step_frequency": Parameter("Hz", Uniform(1.3, 1.65), least=0.1, most=5.0, meaning="steps a second"),
        "bounce": Parameter("m", Uniform(0.01, 0.04), most=0.5, meaning="amplitude, up and down"),
        "sway": Parameter("m", Uniform(0.01, 0.03), most=0.5, meaning="amplitude, to the side"),
        "wobble": Parameter("rad", Uniform(0.02, 0.12), most=1.0, meaning="amplitude about each axis"),
        "turn_rate": Parameter("rad/s", Uniform(0.05, 0.4), most=5.0, meaning="RMS of the heading's rate"),
        "circling": Parameter(
            "rad/s", Uniform(-0.2, 0.2), least=-5.0, most=5.0, meaning="mean of the heading's rate"
        ),
    }

    def poses(
        self, tau: Tensor, spacing: float, drawn: Mapping[str, Tensor], generator: torch.Generator
    ) -> Tensor:
        count = len(tau)
        heading, phase = uniform(generator, count, 1), uniform(generator, count, 6, OVERTONES)
        slow = torch.full((count,), WANDERING, dtype=torch.float64)
        turning = smooth_curve(tau, slow, generator, rate=0)[..., 0] * drawn["turn_rate"][:, None]
        turning = turning + drawn["circling"][:, None]
        steps = tau.diff(dim=1)
        zero = torch.zeros_like(tau[:, :1])
        heading = heading + torch.cat([zero, (0.5 * (turning[:, 1:] + turning[:, :-1]) * steps).cumsum(1)], 1)
        forward = around_z(heading)
        path = torch.cat(
            [
                torch.zeros_like(forward[:, :1]),
                (0.5 * (forward[:, 1:] + forward[:, :-1]) * steps[..., None]).cumsum(1),
            ],
            1,
        )
        # Axes 0-2: forward, sideways, up; 3-5: roll, pitch, yaw. Sideways, roll and yaw repeat with every second step.
        base = torch.tensor([1.0, 0.5, 1.0, 0.5, 1.0, 0.5], dtype=torch.float64)
        cycle = 2 * math.pi * drawn["step_frequency"][:, None, None] * tau[..., None] * base
        wave = torch.zeros_like(cycle)
        for k in range(OVERTONES):
            wave += ((k + 1) * cycle + phase[:, None, :, k]).sin() / (k + 1) ** 2
        bounce, sway, wobble = (drawn[name][:, None, None] for name in ("bounce", "sway", "wobble"))
        up = wave.new_tensor([0.0, 0.0, 1.0])
        side = torch.linalg.cross(up.expand_as(forward), forward)
        position = drawn["speed"][:, None, None] * path
        position = position + bounce * (0.5 * wave[..., :1] * forward + wave[..., 2:3] * up)
        position = position + sway * wave[..., 1:2] * side
        level = facing(forward, up.expand_as(forward))
        rotation = SO3.compose(level, SO3.exp(wobble * wave[..., 3:], validate=False), validate=False)
        return torch.cat([position, rotation], dim=-1)

    def highest_frequency(self, drawn: Mapping[str, Tensor]) -> Tensor:
        return OVERTONES * drawn["step_frequency"]
