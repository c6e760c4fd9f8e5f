"""Where a camera sees a landmark, in pixels."""

from typing import ClassVar

from torchspline.arithmetic.camera import CAMERA_MODELS, CameraModel
from torchspline.arithmetic.motion import Motion, sighted, sighted_reverse
from torchspline.arithmetic.vector import Vector, add, negate, scale, times
from torchspline.fit.residual import POSE_IN_BODY, Cotangents, Given, Slot
from torchspline.fit.residuals.motion import MotionResidual


class _Reprojection(MotionResidual):
    """What the models of cameras share; a new one is a class in `arithmetic/camera.py` and one here."""

    rows, measured_size, derivatives = 2, 2, 0
    slots: ClassVar = {
        "landmark": Slot(3, None, None),
        "intrinsics": Slot(8, None, None),
        "T_body_camera": POSE_IN_BODY,
    }
    camera: ClassVar[CameraModel]

    def error(self, motion: Motion, given: Given, measured: Vector) -> Vector:
        intrinsics = given["intrinsics"]
        point, shown = self.camera.visible(sighted(motion, given["T_body_camera"], given["landmark"]))
        x, y = self.camera.distort(point, intrinsics[4:])
        pixel = (times(intrinsics[0], x), times(intrinsics[1], y))
        return scale(shown, add(pixel, intrinsics[2:4], negate(measured)))

    def error_reverse(
        self, motion: Motion, given: Given, measured: Vector, g: Vector
    ) -> tuple[Motion, Cotangents]:
        intrinsics = given["intrinsics"]
        point, shown = self.camera.visible(sighted(motion, given["T_body_camera"], given["landmark"]))
        x, y = self.camera.distort(point, intrinsics[4:])
        gu, gv = scale(shown, g)
        plane_g = (times(intrinsics[0], gu), times(intrinsics[1], gv))
        point_g, k_g = self.camera.distort_reverse(point, intrinsics[4:], plane_g)
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

    camera = CAMERA_MODELS["radtan"]


class ReprojectionEquidistant(_Reprojection):
    """Pixel where a fisheye camera sees a landmark, minus `measured` (N, 2).

    With theta the angle to the optical axis z and r^2 = x^2 + y^2, for the landmark at (x, y, z) in the camera:
    `d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) / r`, `u = fx d x + cx`, `v = fy d y + cy`; the
    model of Kannala and Brandt, "fisheye" in OpenCV and "equidistant" in Kalibr, and beyond 90 degrees as well.
    Landmarks farther than 170 degrees from the axis have residual and derivatives zero: they take no part.

    Arguments:
        landmark, T_body_camera: as in `ReprojectionRadtan`. intrinsics: [fx, fy, cx, cy, k1, k2, k3, k4].
    """

    camera = CAMERA_MODELS["equidistant"]
