"""What an accelerometer on the body reads."""

from typing import ClassVar

from torchspline.arithmetic.motion import Motion, attached, attached_reverse
from torchspline.arithmetic.so3 import rotate, unrotate
from torchspline.arithmetic.vector import Vector, add, cross, negate
from torchspline.fit.residual import LEVER_ARM, Cotangents, Given, Slot
from torchspline.fit.residuals.motion import MotionResidual
from torchspline.fit.residuals.triad import TRIAD, reading, reading_reverse
from torchspline.imu.synthesis import STANDARD_GRAVITY


class Accelerometer(MotionResidual):
    """Specific force `S R^T (a_arm - R_body^T gravity) + b - measured`, m/s^2, [S20] (70) with an error model.

    Arguments:
        bias: b, m/s^2. gravity: acceleration vector in the world, m/s^2; a `Variable` with `sphere=True` where
            only its direction is unknown. rotation: R, SO3, sensor to body. lever_arm: position of the sensor in
            the body, m; `a_arm` is the acceleration there. scaling: S as in `Gyroscope`.
    """

    rows, measured_size, derivatives = 3, 3, 2
    slots: ClassVar = {
        **TRIAD,
        "gravity": Slot(3, None, STANDARD_GRAVITY),
        "lever_arm": LEVER_ARM,
    }

    def _force(self, motion: Motion, given: Given) -> tuple[Vector, Vector]:
        """Gravity and the specific force at the sensor, in the body frame."""
        fall = unrotate(motion.q, given["gravity"])
        return fall, add(attached(motion, given["lever_arm"]).a, negate(fall))

    def error(self, motion: Motion, given: Given, measured: Vector) -> Vector:
        _, force = self._force(motion, given)
        return add(reading(given, force), negate(measured))

    def error_reverse(
        self, motion: Motion, given: Given, measured: Vector, g: Vector
    ) -> tuple[Motion, Cotangents]:
        fall, force = self._force(motion, given)
        force_g, cotangents = reading_reverse(given, force, g)
        motion_g, cotangents["lever_arm"] = attached_reverse(motion, given["lever_arm"], Motion(a=force_g))
        cotangents["gravity"] = negate(rotate(motion.q, force_g))
        # A body tangent x of q changes R^T gravity by (R^T gravity) x x.
        return motion_g._replace(q=add(motion_g.q, negate(cross(force_g, fall)))), cotangents
