"""A vector of the world seen from the body: the magnetic field, the sun, the vertical."""

from typing import ClassVar

from torchspline.arithmetic.motion import Motion
from torchspline.arithmetic.so3 import rotate, unrotate
from torchspline.arithmetic.vector import Vector, add, cross, negate
from torchspline.fit.residual import Cotangents, Given, Slot
from torchspline.fit.residuals.motion import MotionResidual
from torchspline.fit.residuals.triad import TRIAD, reading, reading_reverse


class Direction(MotionResidual):
    """`S R^T R_body^T d + b - measured`, in the unit of what is measured.

    Arguments:
        direction: d, the vector in the world; a `Variable` where it is unknown, with `sphere=True` where its length is
            known. bias: b, for a magnetometer its hard iron. rotation: R, SO3, sensor to body. scaling: S, nine numbers
            row by row; soft iron, scale and misalignment.
    """

    rows, measured_size, derivatives = 3, 3, 0
    moves = False
    slots: ClassVar = {"direction": Slot(3, None, None), **TRIAD}

    def error(self, motion: Motion, given: Given, measured: Vector) -> Vector:
        return add(reading(given, unrotate(motion.q, given["direction"])), negate(measured))

    def error_reverse(
        self, motion: Motion, given: Given, measured: Vector, g: Vector
    ) -> tuple[Motion, Cotangents]:
        inside = unrotate(motion.q, given["direction"])
        inside_g, cotangents = reading_reverse(given, inside, g)
        cotangents["direction"] = rotate(motion.q, inside_g)
        # A body tangent x of q changes R^T d by (R^T d) x x.
        return Motion(q=cross(inside_g, inside)), cotangents
