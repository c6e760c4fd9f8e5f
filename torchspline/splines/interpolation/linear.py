"""Straight lines between the keys' numbers, then normalised: QLB (9) of [H18], its DLB on dual quaternions,
LERP on R^n."""

import torch
from torch import Tensor

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.jet import Jet
from torchspline.arithmetic.vector import Vector, add, scale
from torchspline.groups.group import Group
from torchspline.splines.interpolation.scheme import CurveScheme, Properties


class Linear(CurveScheme):
    """`normalize((1 - u) X_i + u X_(i+1))`: the path of a geodesic on quaternions, at a speed that is not constant."""

    properties = Properties(interpolates=True, continuity=0, reach=0)

    def table(self, group: Group, keys: Tensor, times: Tensor, **options: str) -> Tensor:
        return torch.cat([keys[..., :-1, :], keys[..., 1:, :]], dim=-1)

    def point(self, group: GroupArithmetic, row: Vector, u: Jet) -> Vector:
        start, end = row[: group.point_size], row[group.point_size :]
        return add(scale(1.0 - u, start), scale(u, end))
