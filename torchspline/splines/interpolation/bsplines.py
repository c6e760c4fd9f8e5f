"""Cubic B-splines over keys, any key times: cumulative on groups (CuBsp (17), SpFus, ScFus of [H18]) and on
numbers (2)."""

import torch
from torch import Tensor

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.jet import Jet
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector, add, scale
from torchspline.groups.group import Group
from torchspline.splines.interpolation.scheme import CurveScheme, Properties, Scheme
from torchspline.splines.nonuniform import basis, local_knots, step_components, step_fields, step_table

_ORDER = 4


def with_phantoms(group: Group, keys: Tensor) -> Tensor:
    """Keys with a neighbour mirrored in either end, in signs that go on: the curve starts and ends at a key."""
    ends = []
    for end, inner in ((keys[..., :1, :], keys[..., 1:2, :]), (keys[..., -1:, :], keys[..., -2:-1, :])):
        back = group.inverse(inner, validate=False)
        ends.append(group.compose(group.compose(end, back, validate=False), end, validate=False))
    return torch.cat([ends[0], keys, ends[1]], dim=-2)


def knots_of(times: Tensor) -> Tensor:
    """Key times, and as many mirrored in the ends as a cubic needs: symmetric there like the points."""
    times = times if times.dtype == torch.int64 else times.to(torch.float64)
    front = [2 * times[0] - times[i] for i in (3, 2, 1)] if len(times) > 3 else _even(times, front=True)
    back = [2 * times[-1] - times[-1 - i] for i in (1, 2, 3)] if len(times) > 3 else _even(times, front=False)
    return torch.cat([torch.stack(front), times, torch.stack(back)])


def _even(times: Tensor, front: bool) -> list[Tensor]:
    """Too few keys to mirror three: those there are, then evenly on."""
    end, step = (times[0], times[0] - times[1]) if front else (times[-1], times[-1] - times[-2])
    made = [2 * end - x for x in (times[1:] if front else times[:-1].flip(0))]
    while len(made) < 3:
        made.append(made[-1] + step)
    return made[::-1] if front else made


class CumulativeBSpline(Scheme):
    """[H18] (17): control points are the keys, mirrored at the ends; C2 also for key times that are not uniform."""

    properties = Properties(interpolates=False, continuity=2, reach=1)

    def table(self, group: Group, keys: Tensor, times: Tensor, **options: str) -> Tensor:
        return step_table(with_phantoms(group, keys), local_knots(knots_of(times), _ORDER), group)

    def fields(self, group: Group, rows: Tensor, u: Tensor, derivatives: int) -> tuple[Tensor, ...]:
        return step_fields(group, rows, u, derivatives, _ORDER - 1)

    def components(self, group: GroupArithmetic, row: Vector, u: Scalar, derivatives: int) -> list[Vector]:
        return step_components(group, row, u, derivatives)


class BlendedBSpline(CurveScheme):
    """The keys' numbers weighted by (2), or by its form for any knots (de Boor), then normalised: on R^n the B-spline,
    on dual quaternions DLFus."""

    properties = Properties(interpolates=False, continuity=2, reach=1)

    def table(self, group: Group, keys: Tensor, times: Tensor, **options: str) -> Tensor:
        points, local = with_phantoms(group, keys), local_knots(knots_of(times), _ORDER).to(keys.dtype)
        windows = points.unfold(-2, _ORDER, 1).movedim(-1, -2).flatten(-2)
        return torch.cat([windows, local.expand(*windows.shape[:-1], -1)], dim=-1)

    def point(self, group: GroupArithmetic, row: Vector, u: Jet) -> Vector:
        size, last = group.point_size, _ORDER * group.point_size
        weights = basis(row[last:], u)
        return add(*(scale(w, row[i * size : (i + 1) * size]) for i, w in enumerate(weights)))
