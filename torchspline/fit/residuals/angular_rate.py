"""Measured rates of rotation: what a gyroscope on the body reads, and the derivative of that."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.motion import MOTIONS, Motion
from torchspline.arithmetic.vector import Vector, add, negate
from torchspline.fit.residual import Moment, Residual, needs
from torchspline.fit.residuals.triad import TRIAD, reading, reading_reverse
from torchspline.groups.group import Group


class _AngularRate(Residual):
    """`S R^T x + b - measured` for a field x of the body's `Motion`."""

    rows, measured_size = 3, 3
    slots = TRIAD
    #: Name of the field.
    rate: ClassVar[str]

    @classmethod
    def check_group(cls, group: Group) -> None:
        needs(cls.__name__, group, rotates=True)

    def evaluate(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Mapping[str, Vector], measured: Vector
    ) -> Vector:
        motion = MOTIONS[group.name].motion(at[0].value, at[0].rates)
        return add(reading(given, getattr(motion, self.rate)), negate(measured))

    def reverse(
        self,
        group: GroupArithmetic,
        at: Sequence[Moment],
        given: Mapping[str, Vector],
        measured: Vector,
        g: Vector,
    ) -> tuple[list[Moment], dict[str, Vector]]:
        mechanics = MOTIONS[group.name]
        motion = mechanics.motion(at[0].value, at[0].rates)
        rate_g, cotangents = reading_reverse(given, getattr(motion, self.rate), g)
        motion_g = Motion(**{self.rate: rate_g})
        value_g, rates_g = mechanics.reverse(at[0].value, at[0].rates, motion, motion_g)
        return [Moment(value_g, tuple(rates_g))], cotangents


class Gyroscope(_AngularRate):
    """`S R^T w + b - measured`, rad/s, [S20] (69) with an error model.

    Arguments:
        bias: b, rad/s. rotation: R, SO3, sensor to body. scaling: S, nine numbers row by row, the scale and
            misalignment of the axes.
    """

    derivatives, rate = 1, "w"


class AngularAcceleration(_AngularRate):
    """`S R^T alpha + b - measured`, rad/s^2; alpha is the derivative of the angular velocity in the body frame.

    Arguments:
        bias: b, rad/s^2. rotation: R, SO3, sensor to body. scaling: S as in `Gyroscope`.
    """

    derivatives, rate = 2, "alpha"
