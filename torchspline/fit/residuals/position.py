"""A measured position of a point of the body: motion capture markers, satellite navigation."""

from typing import ClassVar

from torchspline.arithmetic.motion import Motion, attached, attached_reverse
from torchspline.arithmetic.vector import Vector, add, negate
from torchspline.fit.residual import LEVER_ARM, Cotangents, Given
from torchspline.fit.residuals.motion import MotionResidual


class Position(MotionResidual):
    """`p + R_body l - measured`, m, in the world.

    Arguments:
        lever_arm: l, position of the antenna or marker in the body, m; in R3, where nothing turns, along the axes of
            the world.
    """

    rows, measured_size, derivatives = 3, 3, 0
    rotates = False
    slots: ClassVar = {"lever_arm": LEVER_ARM}

    def error(self, motion: Motion, given: Given, measured: Vector) -> Vector:
        return add(attached(motion, given["lever_arm"]).p, negate(measured))

    def error_reverse(
        self, motion: Motion, given: Given, measured: Vector, g: Vector
    ) -> tuple[Motion, Cotangents]:
        motion_g, arm_g = attached_reverse(motion, given["lever_arm"], Motion(p=g))
        return motion_g, {"lever_arm": arm_g}
