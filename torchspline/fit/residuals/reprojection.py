"""Where a camera sees a landmark, in pixels."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

from torchspline.arithmetic.motion import Motion, sighted, sighted_reverse
from torchspline.arithmetic.scalar import Scalar, sqrt, where
from torchspline.arithmetic.series import arctan_factor
from torchspline.arithmetic.vector import Vector, add, dot, negate, scale, times
from torchspline.fit.residual import POSE_IN_BODY, Slot
from torchspline.fit.residuals.motion import MotionResidual

#: (tan 89.94 degrees)^-2: a pinhole sees nothing that lies so far aside.
_ASIDE = 1e-6
#: (cos 170 degrees)^2: nor does a fisheye what lies so far behind.
_BEHIND = 0.97


class _Reprojection(MotionResidual):
    rows, measured_size, derivatives = 2, 2, 0
    slots: ClassVar = {
        "landmark": Slot(3, None, None),
        "intrinsics": Slot(8, None, None),
        "T_body_camera": POSE_IN_BODY,
    }

    @staticmethod
    @abstractmethod
    def _visible(point: Vector) -> tuple[Vector, Scalar]:
        """The point, another one in its place where it cannot be seen, and 1, or 0 where it cannot."""

    @staticmethod
    @abstractmethod
    def _distort(point: Vector, k: Vector) -> Vector:
        """From a point (x, y, z) in the frame of the camera to the image plane at focal length one."""

    @staticmethod
    @abstractmethod
    def _distort_reverse(point: Vector, k: Vector, g: Vector) -> tuple[Vector, Vector]:
        """Cotangents of the point and of the coefficients."""

    def error(self, motion: Motion, given: Mapping[str, Vector], measured: Vector) -> Vector:
        camera = given["intrinsics"]
        point, shown = self._visible(sighted(motion, given["T_body_camera"], given["landmark"]))
        x, y = self._distort(point, camera[4:])
        pixel = (times(camera[0], x), times(camera[1], y))
        return scale(shown, add(pixel, camera[2:4], negate(measured)))

    def error_reverse(
        self, motion: Motion, given: Mapping[str, Vector], measured: Vector, g: Vector
    ) -> tuple[Motion, dict[str, Vector]]:
        camera = given["intrinsics"]
        point, shown = self._visible(sighted(motion, given["T_body_camera"], given["landmark"]))
        x, y = self._distort(point, camera[4:])
        gu, gv = scale(shown, g)
        plane_g = (times(camera[0], gu), times(camera[1], gv))
        point_g, k_g = self._distort_reverse(point, camera[4:], plane_g)
        motion_g, T_g, landmark_g = sighted_reverse(
            motion, given["T_body_camera"], given["landmark"], point_g
        )
        intrinsics_g = (times(x, gu), times(y, gv), gu, gv, *k_g)
        return motion_g, {"landmark": landmark_g, "intrinsics": intrinsics_g, "T_body_camera": T_g}


class ReprojectionRadtan(_Reprojection):
    """Pixel where a pinhole camera with radial and tangential distortion sees a landmark, minus `measured` (N, 2).

    With a = x/z, b = y/z, r^2 = a^2 + b^2 and c = 1 + k1 r^2 + k2 r^4, for the landmark at (x, y, z) in the camera, z
    along the optical axis: `u = fx (c a + 2 p1 a b + p2 (r^2 + 2 a^2)) + cx`,
    `v = fy (c b + p1 (r^2 + 2 b^2) + 2 p2 a b) + cy`; the model "plumb bob" of OpenCV, ROS and Kalibr. Landmarks behind
    the camera have residual and derivatives zero: they take no part.

    Arguments:
        landmark: point in the world, m: known, (3,) or (N, 3), or a `Variable`, (3,) or (L, 3) with an index.
        intrinsics: [fx, fy, cx, cy, k1, k2, p1, p2], pixels and plain numbers. T_body_camera: pose of the camera in
            the body, SE3. A rolling shutter is a matter of the `clock`: its `delay` and `late`.
    """

    @staticmethod
    def _visible(point: Vector) -> tuple[Vector, Scalar]:
        x, y, z = point
        behind = (z < 1e-12) | (z * z < _ASIDE * dot((x, y), (x, y)))
        return (x, y, where(behind, 1.0, z)), where(behind, z - z, 1.0)

    @staticmethod
    def _distort(point: Vector, k: Vector) -> Vector:
        a, b, k1, k2, p1, p2 = point[0] / point[2], point[1] / point[2], *k
        r2, ab = a * a + b * b, 2.0 * (a * b)
        c = 1.0 + r2 * (k1 + r2 * k2)
        return (
            c * a + p1 * ab + p2 * (r2 + 2.0 * (a * a)),
            c * b + p1 * (r2 + 2.0 * (b * b)) + p2 * ab,
        )

    @staticmethod
    def _distort_reverse(point: Vector, k: Vector, g: Vector) -> tuple[Vector, Vector]:
        nearness = 1.0 / point[2]
        a, b, k1, k2, p1, p2 = point[0] * nearness, point[1] * nearness, *k
        r2, ab = a * a + b * b, 2.0 * (a * b)
        c = 1.0 + r2 * (k1 + r2 * k2)
        along_a, along_b = r2 + 2.0 * (a * a), r2 + 2.0 * (b * b)
        radial = dot((a, b), g)
        k_g = (
            times(r2, radial),
            times(r2 * r2, radial),
            dot((ab, along_b), g),
            dot((along_a, ab), g),
        )
        slope = times(2.0 * (k1 + 2.0 * (r2 * k2)), radial)
        mixed = 2.0 * (p1 * a + p2 * b)
        a_g = dot((c + 2.0 * (p1 * b) + 6.0 * (p2 * a), mixed), g) + a * slope
        b_g = dot((mixed, c + 6.0 * (p1 * b) + 2.0 * (p2 * a)), g) + b * slope
        return scale(nearness, (a_g, b_g, -(a * a_g + b * b_g))), k_g


class ReprojectionEquidistant(_Reprojection):
    """Pixel where a fisheye camera sees a landmark, minus `measured` (N, 2).

    With theta the angle to the optical axis z and r^2 = x^2 + y^2, for the landmark at (x, y, z) in the camera:
    `d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) / r`, `u = fx d x + cx`, `v = fy d y + cy`; the
    model of Kannala and Brandt, "fisheye" in OpenCV and "equidistant" in Kalibr, and beyond 90 degrees as well.
    Landmarks farther than 170 degrees from the axis have residual and derivatives zero: they take no part.

    Arguments:
        landmark, T_body_camera: as in `ReprojectionRadtan`. intrinsics: [fx, fy, cx, cy, k1, k2, k3, k4].
    """

    @staticmethod
    def _visible(point: Vector) -> tuple[Vector, Scalar]:
        z = point[2]
        squared = dot(point, point)
        behind = (squared < 1e-24) | ((z < 0.0) & (_BEHIND * squared < z * z))
        return (*point[:2], where(behind, 1.0, z)), where(behind, z - z, 1.0)

    @staticmethod
    def _angle(point: Vector) -> tuple[Scalar, Scalar, Scalar]:
        """theta / r, theta^2, and the squared distance.

        Through tan(theta/4), which is smooth in r^2 on the axis, too, and at most one.
        """
        x, y, z = point
        r2 = x * x + y * y
        distance2 = r2 + z * z
        reach = 1.0 / (z + sqrt(distance2))
        half2 = r2 * (reach * reach)
        quarter = 1.0 / (1.0 + sqrt(1.0 + half2))
        ratio = 4.0 * reach * quarter * arctan_factor(half2 * (quarter * quarter))
        return ratio, r2 * (ratio * ratio), distance2

    @staticmethod
    def _distort(point: Vector, k: Vector) -> Vector:
        ratio, angle2, _ = ReprojectionEquidistant._angle(point)
        k1, k2, k3, k4 = k
        stretch = 1.0 + angle2 * (k1 + angle2 * (k2 + angle2 * (k3 + angle2 * k4)))
        return scale(ratio * stretch, point[:2])

    @staticmethod
    def _distort_reverse(point: Vector, k: Vector, g: Vector) -> tuple[Vector, Vector]:
        x, y, z = point
        ratio, angle2, distance2 = ReprojectionEquidistant._angle(point)
        k1, k2, k3, k4 = k
        d = ratio * (1.0 + angle2 * (k1 + angle2 * (k2 + angle2 * (k3 + angle2 * k4))))
        slope = 1.0 + angle2 * (
            3.0 * k1 + angle2 * (5.0 * k2 + angle2 * (7.0 * k3 + angle2 * (9.0 * k4)))
        )  # of d r with theta
        outward = dot((x, y), g)
        k_g, power = [], ratio * angle2
        for _ in k:
            k_g.append(times(power, outward))
            power = power * angle2
        # theta moves with r as z / distance^2 and with z as -r / distance^2. On the axis the direction of r is
        # arbitrary, and its factor zero.
        turn = slope / distance2
        along = times((turn * z - d) / (x * x + y * y + 1e-300), outward)
        point_g = (*add(scale(d, g), scale(along, (x, y))), -times(turn, outward))
        return point_g, tuple(k_g)
