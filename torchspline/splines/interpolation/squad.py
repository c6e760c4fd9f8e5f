"""Spherical cubic spline quadrangles, [H18] (15), on any group; R^n makes them its bilinear interpolation of
positions."""

import torch
from torch import Tensor

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.jet import Jet
from torchspline.arithmetic.vector import Vector, scale
from torchspline.groups.group import Group
from torchspline.splines.interpolation.geodesic import steps_between
from torchspline.splines.interpolation.scheme import CurveScheme, Properties
from torchspline.splines.segments import durations


class Squad(CurveScheme):
    """A geodesic between keys and one between inner points, and between these a geodesic at 2 u (1 - u).

    Inner points as in (16) make the velocity continuous; for key times that are not uniform the two logarithms are
    weighted by the durations on the other side, which keeps it so. At the ends the inner point is the key.
    """

    properties = Properties(interpolates=True, continuity=1, reach=1)
    least = 3

    def table(self, group: Group, keys: Tensor, times: Tensor, **options: str) -> Tensor:
        h = durations(times).to(keys.dtype).unsqueeze(-1)
        steps = steps_between(group, keys)
        backward, forward = (
            steps[..., :-1, :],
            steps[..., 1:, :],
        )  # of an inner key: minus Log to the one before
        mean = (h[1:] * backward - h[:-1] * forward) / (2.0 * (h[1:] + h[:-1]))
        middle = group.compose(keys[..., 1:-1, :], group.exp(mean, validate=False), validate=False)
        inner = torch.cat([keys[..., :1, :], middle, keys[..., -1:, :]], dim=-2)
        return torch.cat([keys[..., :-1, :], steps, inner[..., :-1, :], steps_between(group, inner)], dim=-1)

    def point(self, group: GroupArithmetic, row: Vector, u: Jet) -> Vector:
        size, half = group.point_size, len(row) // 2

        def along(start: Vector, step: Vector, s: Jet) -> Vector:
            return group.compose(start, group.exp(scale(s, step)))

        a, b = (along(row[i : i + size], row[i + size : i + half], u) for i in (0, half))
        return along(a, group.log(group.between(a, b)), 2.0 * (u * (1.0 - u)))
