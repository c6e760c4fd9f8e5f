"""A landmark whose place a sensor measures in three dimensions: depth cameras, lidar, beacons."""

from typing import ClassVar

from torchspline.arithmetic.motion import Motion, sighted, sighted_reverse
from torchspline.arithmetic.vector import Vector, add, negate
from torchspline.fit.residual import POSE_IN_BODY, Cotangents, Given, Slot
from torchspline.fit.residuals.motion import MotionResidual


class Point(MotionResidual):
    """`T_body_sensor^-1 T_body^-1 landmark - measured`, m, in the frame of the sensor.

    Arguments:
        landmark: point in the world, m: known, (3,) or (N, 3), or a `Variable`, (3,) or (L, 3) with an index.
        T_body_sensor: pose of the sensor in the body, SE3.
    """

    rows, measured_size, derivatives = 3, 3, 0
    slots: ClassVar = {
        "landmark": Slot(3, None, None),
        "T_body_sensor": POSE_IN_BODY,
    }

    def error(self, motion: Motion, given: Given, measured: Vector) -> Vector:
        return add(sighted(motion, given["T_body_sensor"], given["landmark"]), negate(measured))

    def error_reverse(
        self, motion: Motion, given: Given, measured: Vector, g: Vector
    ) -> tuple[Motion, Cotangents]:
        motion_g, T_g, landmark_g = sighted_reverse(motion, given["T_body_sensor"], given["landmark"], g)
        return motion_g, {"landmark": landmark_g, "T_body_sensor": T_g}
