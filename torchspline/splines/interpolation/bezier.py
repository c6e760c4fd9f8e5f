"""One Bezier curve over all keys, [H18] section 3: by de Casteljau on any group, by Bernstein polynomials on
numbers."""

from abc import abstractmethod
from itertools import pairwise
from math import comb

from torch import Tensor

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.jet import Jet
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector, add, scale
from torchspline.groups.group import Group
from torchspline.splines.interpolation.scheme import CurveScheme, Properties


def bernstein(degree: int, u: Scalar) -> list[Scalar]:
    """B_0^n(u) ... B_n^n(u): binomial coefficients times u^i (1 - u)^(n - i)."""
    rise: list[Scalar] = [1.0]
    fall: list[Scalar] = [1.0]
    for _ in range(degree):
        rise.append(u * rise[-1])
        fall.append((1.0 - u) * fall[-1])
    return [float(comb(degree, i)) * (rise[i] * fall[degree - i]) for i in range(degree + 1)]


class _OneSegment(CurveScheme):
    """Only the first and last of the key times matter: the keys between are not passed at any time of their own."""

    properties = Properties(interpolates=False, continuity=None, reach=None)

    def segments(self, times: Tensor) -> Tensor:
        return times[:: len(times) - 1]

    def table(self, group: Group, keys: Tensor, times: Tensor, **options: str) -> Tensor:
        return keys.flatten(-2).unsqueeze(-2)

    def point(self, group: GroupArithmetic, row: Vector, u: Jet) -> Vector:
        size = group.point_size
        return self.between(group, [row[i : i + size] for i in range(0, len(row), size)], u)

    @abstractmethod
    def between(self, group: GroupArithmetic, points: list[Vector], u: Jet) -> Vector:
        """The curve of these points."""


class Casteljau(_OneSegment):
    """Geodesics between geodesics between ... keys, all at the same u."""

    def between(self, group: GroupArithmetic, points: list[Vector], u: Jet) -> Vector:
        while len(points) > 1:
            pairs = pairwise(points)
            points = [
                group.compose(a, group.exp(scale(u, group.signed_log(group.between(a, b))))) for a, b in pairs
            ]
        return points[0]


class Bernstein(_OneSegment):
    """The keys' numbers weighted by Bernstein polynomials, then normalised; on R^n the curve of de Casteljau."""

    def between(self, group: GroupArithmetic, points: list[Vector], u: Jet) -> Vector:
        return add(*(scale(b, p) for b, p in zip(bernstein(len(points) - 1, u), points, strict=True)))
