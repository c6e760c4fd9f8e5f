"""A measured orientation of the body, or of a sensor on it."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.motion import MOTIONS, Motion
from torchspline.arithmetic.registry import arithmetic
from torchspline.arithmetic.so3 import conjugate, multiply, rotate, unit
from torchspline.arithmetic.vector import Vector
from torchspline.fit.residual import ROTATION_IN_BODY, Moment, Residual, needs
from torchspline.groups.group import Group


class Orientation(Residual):
    """`Log(R_measured^-1 R_body R)`, rad, in the frame of the sensor.

    `measured` is (N, 4) [qw, qx, qy, qz], sensor to world.

    Arguments:
        rotation: R, SO3, sensor to body.
    """

    rows, measured_size, derivatives = 3, 4, 0
    measured_signs = ((0, 4),)
    slots: ClassVar = {"rotation": ROTATION_IN_BODY}

    @classmethod
    def check_group(cls, group: Group) -> None:
        needs(cls.__name__, group, rotates=True)

    def evaluate(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Mapping[str, Vector], measured: Vector
    ) -> Vector:
        motion = MOTIONS[group.name].motion(at[0].value, ())
        error = multiply(conjugate(unit(measured)), multiply(motion.q, given["rotation"]))
        return arithmetic("SO3").log(error)

    def reverse(
        self,
        group: GroupArithmetic,
        at: Sequence[Moment],
        given: Mapping[str, Vector],
        measured: Vector,
        g: Vector,
    ) -> tuple[list[Moment], dict[str, Vector]]:
        mechanics = MOTIONS[group.name]
        motion = mechanics.motion(at[0].value, ())
        error = self.evaluate(group, at, given, measured)
        turn_g = arithmetic("SO3").right_jacobian_inverse_transpose(error, g, short=True)
        # q_body Exp(x) q_sensor = q_body q_sensor Exp(R_sensor^T x)
        motion_g = Motion(q=rotate(given["rotation"], turn_g))
        value_g, _ = mechanics.reverse(at[0].value, (), motion, motion_g)
        return [Moment(value_g, ())], {"rotation": turn_g}
