"""A measured pose of the body, or of a sensor on it."""

from typing import ClassVar

from torchspline.arithmetic.motion import Motion, attached, attached_reverse
from torchspline.arithmetic.registry import arithmetic
from torchspline.arithmetic.so3 import conjugate, multiply, rotate, unit, unrotate
from torchspline.arithmetic.vector import Vector, add, negate
from torchspline.fit.residual import POSE_IN_BODY, Cotangents, Given
from torchspline.fit.residuals.motion import MotionResidual


class Pose(MotionResidual):
    """`[p - p_measured, Log(R_measured^-1 R)]`, m in the world and rad: position and orientation, each by itself.

    `measured` is (N, 7) [x, y, z, qw, qx, qy, qz], sensor to world.

    Arguments:
        T_body_sensor: pose of the sensor in the body, SE3; p and R are those of the sensor.
    """

    rows, measured_size, derivatives = 6, 7, 0
    measured_signs = ((3, 7),)
    slots: ClassVar = {"T_body_sensor": POSE_IN_BODY}

    def error(self, motion: Motion, given: Given, measured: Vector) -> Vector:
        T = given["T_body_sensor"]
        position = attached(motion, T[:3]).p
        missed = multiply(conjugate(unit(measured[3:])), multiply(motion.q, T[3:]))
        return (*add(position, negate(measured[:3])), *arithmetic("SO3").log(missed))

    def error_reverse(
        self, motion: Motion, given: Given, measured: Vector, g: Vector
    ) -> tuple[Motion, Cotangents]:
        T, error = given["T_body_sensor"], self.error(motion, given, measured)[3:]
        turn_g = arithmetic("SO3").right_jacobian_inverse_transpose(error, g[3:], short=True)
        motion_g, arm_g = attached_reverse(motion, T[:3], Motion(p=g[:3]))
        # q_body Exp(x) q_sensor = q_body q_sensor Exp(R_sensor^T x)
        motion_g = motion_g._replace(q=add(motion_g.q, rotate(T[3:], turn_g)))
        return motion_g, {"T_body_sensor": (*unrotate(T[3:], arm_g), *turn_g)}
