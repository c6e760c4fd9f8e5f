"""Cubic Bezier segments through all keys, joined C2 ([H18] section 3): on quaternions normalised, its RQBez."""

from types import MappingProxyType

import torch
from torch import Tensor

from torchspline import checks
from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.jet import Jet
from torchspline.arithmetic.vector import Vector, add, scale
from torchspline.groups.group import Group
from torchspline.splines.interpolation.bezier import bernstein
from torchspline.splines.interpolation.scheme import CurveScheme, Properties
from torchspline.splines.segments import durations


class CompositeBezier(CurveScheme):
    """The inner points of every segment follow from the rates at keys, and these from a tridiagonal system, so that one
    key moves the whole curve. Solved as a dense one, O(M^3) once, not per query.

    Ends: "natural", no second derivative of the numbers; "clamped", no first one; "periodic", first and last key the
    same and the curve closed with two continuous derivatives.
    """

    properties = Properties(interpolates=True, continuity=2, reach=None)
    least = 3
    options = MappingProxyType({"ends": ("natural", "clamped", "periodic")})

    def table(self, group: Group, keys: Tensor, times: Tensor, **options: str) -> Tensor:
        h = durations(times).to(keys.dtype)
        third = (h / 3.0).unsqueeze(-1)
        rates = rates_at_keys(group, keys, h, options["ends"])
        start, end = keys[..., :-1, :], keys[..., 1:, :]
        inner = [start + third * rates[..., :-1, :], end - third * rates[..., 1:, :]]
        return torch.cat([start, *inner, end], dim=-1)

    def point(self, group: GroupArithmetic, row: Vector, u: Jet) -> Vector:
        size = group.point_size
        points = [row[i : i + size] for i in range(0, 4 * size, size)]
        return add(*(scale(b, p) for b, p in zip(bernstein(3, u), points, strict=True)))


def rates_at_keys(group: Group, keys: Tensor, h: Tensor, ends: str) -> Tensor:
    """First derivatives by time of the keys' numbers that make the second ones continuous, `(*batch, M, P)`."""
    w, slopes = 1.0 / h, keys.diff(dim=-2) / h.unsqueeze(-1)
    count, pulls = len(h) + 1, 3.0 * w.unsqueeze(-1) * slopes
    pad = torch.nn.functional.pad
    right = pad(pulls, (0, 0, 0, 1)) + pad(pulls, (0, 0, 1, 0))
    diagonal = 2.0 * (pad(w, (0, 1)) + pad(w, (1, 0)))
    system = torch.diag(diagonal) + torch.diag(w, 1) + torch.diag(w, -1)
    if ends == "natural":
        return _solve(system, right)
    inner = system[1:-1, 1:-1]
    if ends == "clamped":
        return pad(_solve(inner, right[..., 1:-1, :]), (0, 0, 1, 1))
    # The last rate is the first one, up to the sign in which the keys return; what the ends lack they give each other.
    sign = returning_sign(group, keys)
    right = torch.cat([right[..., :1, :] + sign * right[..., -1:, :], right[..., 1:-1, :]], dim=-2)
    closed = system[:-1, :-1].clone()
    closed[0, 0] = closed[0, 0] + diagonal[-1]
    corner = torch.zeros_like(closed)
    corner[0, count - 2], corner[count - 2, 0] = w[-1], w[-1]
    flipped = _solve(closed - corner, right)
    rates = torch.where(sign > 0, _solve(closed + corner, right), flipped)
    return torch.cat([rates, sign * rates[..., :1, :]], dim=-2)


def _solve(system: Tensor, right: Tensor) -> Tensor:
    """Not by `torch.linalg.solve`, whose forward mode of forward mode is wrong (torch 2.13)."""
    factors, pivots = torch.linalg.lu_factor(system)
    return torch.linalg.lu_solve(
        factors.expand(*right.shape[:-2], -1, -1), pivots.expand(*right.shape[:-2], -1), right
    )


def returning_sign(group: Group, keys: Tensor) -> Tensor:
    """1, or -1 where the last key has the opposite sign of the first: `(*batch, 1, P)`.

    Raises:
        ValueError: they are not the same element.
    """
    first, last = keys[..., :1, :].detach(), keys[..., -1:, :].detach()
    sign = torch.ones_like(first)
    for start, stop in group.arithmetic.sign_blocks:
        opposite = (first[..., start:stop] * last[..., start:stop]).sum(-1, keepdim=True) < 0
        sign[..., start:stop] = torch.where(opposite, -1.0, sign[..., start:stop])
    apart = (first - sign * last).abs().amax()
    if checks.values_visible(keys) and checks.seen_true(apart > 1e-6 * first.abs().amax().clamp_min(1.0)):
        raise ValueError(
            f"keyframes: ends='periodic' expects the first and the last to be the same, got a difference of "
            f"{apart.item():.3g}"
        )
    return sign
