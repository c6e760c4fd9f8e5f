"""Where cameras see what stands before them: the models of their lenses, each with its hand-derived reverse.

Points (x, y, z) are in the frame of the camera, z along the optical axis; the image plane is that at focal length one,
in front of any focal lengths and principal point. Coefficients `k` are four, as Kalibr and OpenCV order them.
"""

from abc import ABC, abstractmethod

from torchspline.arithmetic.scalar import Scalar, sqrt, where
from torchspline.arithmetic.series import arctan_factor
from torchspline.arithmetic.vector import Vector, add, dot, scale, times

#: (tan 89.94 degrees)^-2: a pinhole sees nothing that lies so far aside.
_ASIDE = 1e-6
#: (cos 170 degrees)^2: nor does a fisheye what lies so far behind.
_BEHIND = 0.97


class CameraModel(ABC):
    """A lens with four coefficients of distortion."""

    @staticmethod
    @abstractmethod
    def visible(point: Vector) -> tuple[Vector, Scalar]:
        """The point, another one in its place where it cannot be seen, and 1, or 0 where it cannot."""

    @staticmethod
    @abstractmethod
    def distort(point: Vector, k: Vector) -> Vector:
        """From a point (x, y, z) in the frame of the camera to the image plane at focal length one."""

    @staticmethod
    @abstractmethod
    def distort_reverse(point: Vector, k: Vector, g: Vector) -> tuple[Vector, Vector]:
        """Cotangents of the point and of the coefficients."""


class Radtan(CameraModel):
    """A pinhole with radial and tangential distortion, "plumb bob" of OpenCV, ROS and Kalibr: k1, k2, p1, p2.

    With a = x/z, b = y/z, r^2 = a^2 + b^2 and c = 1 + k1 r^2 + k2 r^4: `c a + 2 p1 a b + p2 (r^2 + 2 a^2)` and
    `c b + p1 (r^2 + 2 b^2) + 2 p2 a b`.
    """

    @staticmethod
    def visible(point: Vector) -> tuple[Vector, Scalar]:
        x, y, z = point
        behind = (z < 1e-12) | (z * z < _ASIDE * dot((x, y), (x, y)))
        return (x, y, where(behind, 1.0, z)), where(behind, z - z, 1.0)

    @staticmethod
    def distort(point: Vector, k: Vector) -> Vector:
        a, b, k1, k2, p1, p2 = point[0] / point[2], point[1] / point[2], *k
        r2, ab = a * a + b * b, 2.0 * (a * b)
        c = 1.0 + r2 * (k1 + r2 * k2)
        return (
            c * a + p1 * ab + p2 * (r2 + 2.0 * (a * a)),
            c * b + p1 * (r2 + 2.0 * (b * b)) + p2 * ab,
        )

    @staticmethod
    def distort_reverse(point: Vector, k: Vector, g: Vector) -> tuple[Vector, Vector]:
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


class Equidistant(CameraModel):
    """A fisheye after Kannala and Brandt, "fisheye" in OpenCV and "equidistant" in Kalibr: k1 to k4.

    With theta the angle to the optical axis and r^2 = x^2 + y^2: (x, y) times
    `theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) / r`, beyond 90 degrees as well.
    """

    @staticmethod
    def visible(point: Vector) -> tuple[Vector, Scalar]:
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
    def distort(point: Vector, k: Vector) -> Vector:
        ratio, angle2, _ = Equidistant._angle(point)
        k1, k2, k3, k4 = k
        stretch = 1.0 + angle2 * (k1 + angle2 * (k2 + angle2 * (k3 + angle2 * k4)))
        return scale(ratio * stretch, point[:2])

    @staticmethod
    def distort_reverse(point: Vector, k: Vector, g: Vector) -> tuple[Vector, Vector]:
        x, y, z = point
        ratio, angle2, distance2 = Equidistant._angle(point)
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


#: By the name that Kalibr gives the distortion. A new one is a class above and a line here.
CAMERA_MODELS: dict[str, CameraModel] = {"radtan": Radtan(), "equidistant": Equidistant()}
