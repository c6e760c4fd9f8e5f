"""What a gyroscope on the body reads."""

from collections.abc import Mapping, Sequence

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.motion import MOTIONS, Motion
from torchspline.arithmetic.vector import Vector, add, negate
from torchspline.fit.residual import Moment, Residual, needs
from torchspline.fit.residuals.triad import TRIAD, reading, reading_reverse
from torchspline.groups.group import Group


class Gyroscope(Residual):
    """`S R^T w + b - measured`, rad/s, [S20] (69) with an error model.

    Arguments:
        bias: b, rad/s. rotation: R, SO3, sensor to body. scaling: S, nine numbers row by row, the scale and
            misalignment of the axes.
    """

    rows, measured_size, derivatives = 3, 3, 1
    slots = TRIAD

    @classmethod
    def check_group(cls, group: Group) -> None:
        needs(cls.__name__, group, rotates=True)

    def evaluate(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Mapping[str, Vector], measured: Vector
    ) -> Vector:
        motion = MOTIONS[group.name].motion(at[0].value, at[0].rates)
        return add(reading(given, motion.w), negate(measured))

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
        w_g, cotangents = reading_reverse(given, motion.w, g)
        value_g, rates_g = mechanics.reverse(at[0].value, at[0].rates, motion, Motion(w=w_g))
        return [Moment(value_g, tuple(rates_g))], cotangents
