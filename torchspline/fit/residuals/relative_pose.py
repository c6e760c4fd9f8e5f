"""A measured motion between two times: visual or lidar odometry, loop closures."""

from collections.abc import Sequence
from typing import ClassVar

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.motion import MOTIONS, Motion
from torchspline.arithmetic.registry import arithmetic
from torchspline.arithmetic.so3 import conjugate, multiply, rotate, unit, unrotate
from torchspline.arithmetic.vector import Vector, add, cross, negate
from torchspline.fit.residual import POSE_IN_BODY, Cotangents, Given, Moment, Residual


class RelativePose(Residual):
    """`[p - p_measured, Log(R_measured^-1 R)]`, m in the frame of the sensor at the first time, and rad.

    (p, R) is the pose of the sensor at the second time as seen from the sensor at the first. `t` is (2, N), first and
    second times; `measured` is (N, 7) [x, y, z, qw, qx, qy, qz].

    Arguments:
        T_body_sensor: pose of the sensor in the body, SE3.
    """

    rows, measured_size, derivatives, moments = 6, 7, 0, 2
    measured_signs = ((3, 7),)
    slots: ClassVar = {"T_body_sensor": POSE_IN_BODY}

    def _between(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Given
    ) -> tuple[list[Motion], Vector]:
        """Motion of the body at both times, and the pose of the second sensor in the first."""
        motions, poses = [MOTIONS[group.name].motion(x.value, ()) for x in at], arithmetic("SE3")
        first, second = (poses.compose((*m.p, *m.q), given["T_body_sensor"]) for m in motions)
        return motions, poses.between(first, second)

    def evaluate(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Given, measured: Vector
    ) -> Vector:
        _, between = self._between(group, at, given)
        error = multiply(conjugate(unit(measured[3:])), between[3:])
        return (*add(between[:3], negate(measured[:3])), *arithmetic("SO3").log(error))

    def reverse(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Given, measured: Vector, g: Vector
    ) -> tuple[list[Moment], Cotangents]:
        motions, between = self._between(group, at, given)
        p, q, T = between[:3], between[3:], given["T_body_sensor"]
        error = self.evaluate(group, at, given, measured)[3:]
        turn_g = arithmetic("SO3").right_jacobian_inverse_transpose(error, g[3:], short=True)
        # The second sensor moves (p, q) on its right; the first on its left, Exp(-x) (p, q).
        second = (*unrotate(q, g[:3]), *turn_g)
        first = negate((*g[:3], *add(cross(p, g[:3]), rotate(q, turn_g))))
        moments = []
        for x, motion, sensor_g in zip(at, motions, (first, second), strict=True):
            # T_body Exp(x) T = T_body T Exp(Ad_T^-1 x)
            body_g = arithmetic("SE3").coadjoint_inverse(T, sensor_g)
            motion_g = Motion(q=body_g[3:], p=rotate(motion.q, body_g[:3]))
            moments.append(Moment(MOTIONS[group.name].reverse(x.value, (), motion, motion_g)[0], ()))
        return moments, {"T_body_sensor": add(first, second)}
