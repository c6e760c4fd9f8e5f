"""A measured velocity of a point of the body, against the world: in the world's axes, or in those of the sensor."""

from typing import ClassVar

from torchspline.arithmetic.motion import Motion, attached, attached_reverse, turned, turned_reverse
from torchspline.arithmetic.so3 import rotate, unrotate
from torchspline.arithmetic.vector import Vector, add, cross, negate
from torchspline.fit.residual import LEVER_ARM, ROTATION_IN_BODY, Cotangents, Given
from torchspline.fit.residuals.motion import MotionResidual


class WorldVelocity(MotionResidual):
    """`R_body (v + w x l) - measured`, m/s, in the world: the Doppler velocity of an antenna.

    Arguments:
        lever_arm: l, position of the antenna in the body, m.
    """

    rows, measured_size, derivatives = 3, 3, 1
    rotates = False
    slots: ClassVar = {"lever_arm": LEVER_ARM}

    def error(self, motion: Motion, given: Given, measured: Vector) -> Vector:
        return add(rotate(motion.q, attached(motion, given["lever_arm"]).v), negate(measured))

    def error_reverse(
        self, motion: Motion, given: Given, measured: Vector, g: Vector
    ) -> tuple[Motion, Cotangents]:
        v, v_g = attached(motion, given["lever_arm"]).v, unrotate(motion.q, g)
        motion_g, arm_g = attached_reverse(motion, given["lever_arm"], Motion(v=v_g))
        # R Exp(x) v = R (v + x x v), and g . R (x x v) = x . (v x R^T g)
        return motion_g._replace(q=add(motion_g.q, cross(v, v_g))), {"lever_arm": arm_g}


class BodyVelocity(MotionResidual):
    """`R^T (v + w x l) - measured`, m/s, in the sensor's frame: wheel odometry, a Doppler log, radar.

    Arguments:
        rotation: R, SO3, sensor to body. lever_arm: l, position of the sensor in the body, m.
    """

    rows, measured_size, derivatives = 3, 3, 1
    slots: ClassVar = {"rotation": ROTATION_IN_BODY, "lever_arm": LEVER_ARM}

    def error(self, motion: Motion, given: Given, measured: Vector) -> Vector:
        return add(turned(given["rotation"], attached(motion, given["lever_arm"]).v), negate(measured))

    def error_reverse(
        self, motion: Motion, given: Given, measured: Vector, g: Vector
    ) -> tuple[Motion, Cotangents]:
        seen = turned(given["rotation"], attached(motion, given["lever_arm"]).v)
        rotation_g, v_g = turned_reverse(given["rotation"], seen, g)
        motion_g, arm_g = attached_reverse(motion, given["lever_arm"], Motion(v=v_g))
        return motion_g, {"rotation": rotation_g, "lever_arm": arm_g}
