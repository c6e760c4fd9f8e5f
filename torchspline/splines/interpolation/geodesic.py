"""Piecewise geodesics: LERP (1), SLERP (14), SPLIT (25), SE3Up (26) and ScLERP of [H18], by group."""

import torch
from torch import Tensor

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.recurrence import forward
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector
from torchspline.groups.components import join, split
from torchspline.groups.group import Group
from torchspline.groups.operations import geodesics
from torchspline.splines.interpolation.scheme import Properties, Scheme
from torchspline.splines.sweep import first, second


def steps_between(group: Group, keys: Tensor) -> Tensor:
    """Logarithm from each key to the next, `(*batch, M - 1, D)`, the way their signs say."""
    algebra, unit = group.arithmetic, split(keys)
    return join(algebra.signed_log(algebra.between(first(unit), second(unit))), keys[..., 1:, :])


class Geodesic(Scheme):
    """`X_i Exp(u Log(X_i^-1 X_(i+1)))`: constant velocity from key to key."""

    properties = Properties(interpolates=True, continuity=0, reach=0)

    def table(self, group: Group, keys: Tensor, times: Tensor, **options: str) -> Tensor:
        return torch.cat([keys[..., :-1, :], steps_between(group, keys)], dim=-1)

    def fields(self, group: Group, rows: Tensor, u: Tensor, derivatives: int) -> tuple[Tensor, ...]:
        start, step = rows.split([group.point_size, group.tangent_size], dim=-1)
        rates = u.new_tensor([1.0, 0.0, 0.0][:derivatives]).expand(*u.shape, derivatives)
        weights = torch.cat([u.unsqueeze(-1), rates], dim=-1)
        return geodesics(group.name, start, step.unsqueeze(-2), weights.unsqueeze(-1))

    def components(self, group: GroupArithmetic, row: Vector, u: Scalar, derivatives: int) -> list[Vector]:
        start, step = row[: group.point_size], row[group.point_size :]
        weights: list[list[Scalar]] = [[u], [1.0], [0.0], [0.0]]
        value, trace = forward(group, start, [step], weights[: derivatives + 1], derivatives)
        return [value, *trace[-1].rates]
