"""A vector of the world seen from the body: the magnetic field, the sun, the vertical."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.motion import MOTIONS, Motion
from torchspline.arithmetic.so3 import rotate, unrotate
from torchspline.arithmetic.vector import Vector, add, cross, negate
from torchspline.fit.residual import Moment, Residual, Slot, needs
from torchspline.fit.residuals.triad import TRIAD, reading, reading_reverse
from torchspline.groups.group import Group


class Direction(Residual):
    """`S R^T R_body^T d + b - measured`, in the unit of what is measured.

    Arguments:
        direction: d, the vector in the world; a `Variable` where it is unknown, with `sphere=True` where its length is
            known. bias: b, for a magnetometer its hard iron. rotation: R, SO3, sensor to body. scaling: S, nine numbers
            row by row; soft iron, scale and misalignment.
    """

    rows, measured_size, derivatives = 3, 3, 0
    slots: ClassVar = {"direction": Slot(3, None, None), **TRIAD}

    @classmethod
    def check_group(cls, group: Group) -> None:
        needs(cls.__name__, group, rotates=True)

    def evaluate(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Mapping[str, Vector], measured: Vector
    ) -> Vector:
        motion = MOTIONS[group.name].motion(at[0].value, ())
        return add(reading(given, unrotate(motion.q, given["direction"])), negate(measured))

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
        inside = unrotate(motion.q, given["direction"])
        inside_g, cotangents = reading_reverse(given, inside, g)
        cotangents["direction"] = rotate(motion.q, inside_g)
        # A body tangent x of q changes R^T d by (R^T d) x x.
        motion_g = Motion(q=cross(inside_g, inside))
        value_g, _ = mechanics.reverse(at[0].value, (), motion, motion_g)
        return [Moment(value_g, ())], cotangents
