"""A measured angular acceleration."""

from collections.abc import Mapping, Sequence

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.motion import MOTIONS, Motion
from torchspline.arithmetic.vector import Vector, add, negate
from torchspline.fit.residual import Moment, Residual, needs
from torchspline.fit.residuals.triad import TRIAD, reading, reading_reverse
from torchspline.groups.group import Group


class AngularAcceleration(Residual):
    """`S R^T alpha + b - measured`, rad/s^2; alpha is the derivative of the angular velocity in the body frame.

    Arguments:
        bias: b, rad/s^2. rotation: R, SO3, sensor to body. scaling: S as in `Gyroscope`.
    """

    rows, measured_size, derivatives = 3, 3, 2
    slots = TRIAD

    @classmethod
    def check_group(cls, group: Group) -> None:
        needs(cls.__name__, group, rotates=True)

    def evaluate(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Mapping[str, Vector], measured: Vector
    ) -> Vector:
        motion = MOTIONS[group.name].motion(at[0].value, at[0].rates)
        return add(reading(given, motion.alpha), negate(measured))

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
        alpha_g, cotangents = reading_reverse(given, motion.alpha, g)
        value_g, rates_g = mechanics.reverse(at[0].value, at[0].rates, motion, Motion(alpha=alpha_g))
        return [Moment(value_g, tuple(rates_g))], cotangents
