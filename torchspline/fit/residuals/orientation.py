"""A measured orientation of the body, or of a sensor on it."""

from typing import ClassVar

from torchspline.arithmetic.motion import Motion
from torchspline.arithmetic.registry import arithmetic
from torchspline.arithmetic.so3 import conjugate, multiply, rotate, unit
from torchspline.arithmetic.vector import Vector
from torchspline.fit.residual import ROTATION_IN_BODY, Cotangents, Given
from torchspline.fit.residuals.motion import MotionResidual


class Orientation(MotionResidual):
    """`Log(R_measured^-1 R_body R)`, rad, in the frame of the sensor.

    `measured` is (N, 4) [qw, qx, qy, qz], sensor to world.

    Arguments:
        rotation: R, SO3, sensor to body.
    """

    rows, measured_size, derivatives = 3, 4, 0
    moves = False
    measured_signs = ((0, 4),)
    slots: ClassVar = {"rotation": ROTATION_IN_BODY}

    def error(self, motion: Motion, given: Given, measured: Vector) -> Vector:
        missed = multiply(conjugate(unit(measured)), multiply(motion.q, given["rotation"]))
        return arithmetic("SO3").log(missed)

    def error_reverse(
        self, motion: Motion, given: Given, measured: Vector, g: Vector
    ) -> tuple[Motion, Cotangents]:
        error = self.error(motion, given, measured)
        turn_g = arithmetic("SO3").right_jacobian_inverse_transpose(error, g, short=True)
        # q_body Exp(x) q_sensor = q_body q_sensor Exp(R_sensor^T x)
        return Motion(q=rotate(given["rotation"], turn_g)), {"rotation": turn_g}
