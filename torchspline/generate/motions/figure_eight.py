"""Figure-eights, the usual motion for calibrating an IMU by hand or a vehicle on a track."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from torchspline.generate.distributions import LogUniform, Parameter, Uniform
from torchspline.generate.motions.motion import STANDARD_GRAVITY, Motion, differences, facing, uniform
from torchspline.groups import SO3


class FigureEight(Motion):
    """A lemniscate of Gerono in a tilted plane, x = a sin(w t), y = a sin(w t) cos(w t), facing where it goes."""

    name = "figure_eight"
    parameters = {
        "size": Parameter("m", LogUniform(0.3, 2.0), least=1e-3, most=1e4, meaning="half its length, a"),
        "period": Parameter("s", Uniform(4.0, 10.0), least=0.1, meaning="of a whole eight"),
        "tilt": Parameter("rad", Uniform(0.0, 0.5), most=0.5 * math.pi, meaning="of its plane"),
        "banking": Parameter(
            "", Uniform(0.0, 1.0), most=1.0, meaning="share of a coordinated turn, 0: level with the plane"
        ),
    }

    def poses(
        self, tau: Tensor, spacing: float, drawn: Mapping[str, Tensor], generator: torch.Generator
    ) -> Tensor:
        phase, heading = uniform(generator, len(tau), 1), uniform(generator, len(tau))
        angle = 2 * math.pi * tau / drawn["period"][:, None] + phase
        flat = torch.stack([angle.sin(), 0.5 * (2 * angle).sin(), torch.zeros_like(angle)], dim=-1)
        # Of the curve rather than of the motion, which has no direction while it rests.
        along = torch.stack([angle.cos(), (2 * angle).cos(), torch.zeros_like(angle)], dim=-1)
        zero = torch.zeros_like(heading)
        plane = SO3.compose(
            SO3.exp(torch.stack([zero, zero, heading], dim=-1)),
            SO3.exp(torch.stack([drawn["tilt"], zero, zero], dim=-1)),
        )[:, None]
        position = SO3.act(plane, drawn["size"][:, None, None] * flat, validate=False)
        normal = SO3.act(plane, flat.new_tensor([0.0, 0.0, 1.0]), validate=False)
        _, acceleration = differences(position, spacing)
        vertical = flat.new_tensor([0.0, 0.0, STANDARD_GRAVITY])
        thrust = torch.nn.functional.normalize(acceleration + vertical, dim=-1)
        up = normal + drawn["banking"][:, None, None] * (thrust - normal)
        return torch.cat([position, facing(SO3.act(plane, along, validate=False), up)], dim=-1)

    def highest_frequency(self, drawn: Mapping[str, Tensor]) -> Tensor:
        # y turns twice as fast as x, and the heading has overtones of that.
        return 4.0 / drawn["period"]
