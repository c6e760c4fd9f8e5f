"""What an accelerometer on the body reads."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.motion import MOTIONS, Motion, attached, attached_reverse
from torchspline.arithmetic.so3 import rotate, unrotate
from torchspline.arithmetic.vector import Vector, add, cross, negate
from torchspline.fit.residual import LEVER_ARM, Moment, Residual, Slot
from torchspline.fit.residuals.triad import TRIAD, reading, reading_reverse
from torchspline.imu.synthesis import STANDARD_GRAVITY


class Accelerometer(Residual):
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

    def _force(
        self, group: GroupArithmetic, at: Moment, given: Mapping[str, Vector]
    ) -> tuple[Motion, Vector, Vector]:
        """Motion of the body, gravity and the specific force at the sensor, in the body frame."""
        motion = MOTIONS[group.name].motion(at.value, at.rates)
        fall = unrotate(motion.q, given["gravity"])
        return motion, fall, add(attached(motion, given["lever_arm"]).a, negate(fall))

    def evaluate(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Mapping[str, Vector], measured: Vector
    ) -> Vector:
        *_, force = self._force(group, at[0], given)
        return add(reading(given, force), negate(measured))

    def reverse(
        self,
        group: GroupArithmetic,
        at: Sequence[Moment],
        given: Mapping[str, Vector],
        measured: Vector,
        g: Vector,
    ) -> tuple[list[Moment], dict[str, Vector]]:
        motion, fall, force = self._force(group, at[0], given)
        force_g, cotangents = reading_reverse(given, force, g)
        motion_g, cotangents["lever_arm"] = attached_reverse(motion, given["lever_arm"], Motion(a=force_g))
        # A body tangent x of q changes R^T gravity by (R^T gravity) x x.
        motion_g = motion_g._replace(q=add(motion_g.q, negate(cross(force_g, fall))))
        cotangents["gravity"] = negate(rotate(motion.q, force_g))
        value_g, rates_g = MOTIONS[group.name].reverse(at[0].value, at[0].rates, motion, motion_g)
        return [Moment(value_g, tuple(rates_g))], cotangents
