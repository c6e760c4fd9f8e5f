"""How much a recording tells: motion in all directions, corners all over the images; warnings where it does not."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchspline.calibrate.estimate import CalibratedCamera, CalibratedImu, Calibration, SensorResiduals
from torchspline.calibrate.recording import Corners
from torchspline.groups.group import SO3
from torchspline.io.camera import Camera
from torchspline.units import NANOSECOND

#: Cells of an image, columns and rows, and the share of a camera's corners that a covered cell has at least.
CELLS, _FEW = (8, 5), 0.001
#: Root mean square motion about or along an axis below which it tells little, rad/s and m/s^2.
_SLOW, _SOFT = 0.1, 0.3
#: Tilts (rad): gravity in the IMU against its mean, the board against the image plane.
_TILT, _BOARD_TILT = math.radians(10.0), math.radians(15.0)
#: Least share of cells that are covered, and of images that take part.
_COVERED, _TAKEN = 0.7, 0.9
#: Standard deviations of extrinsics beyond which a calibration is of little use, m and rad.
_UNSURE = (0.01, math.radians(0.5))
#: Residuals may differ from what was stated by this factor.
_FACTOR = 3.0
_MOST_TIMES = 10_000
#: By how much motion and gravity may miss what the accelerometer says of their size, as shares, and in deviations.
_MOTION_OFF, _GRAVITY_OFF, _SIGNIFICANT = 0.01, 0.003, 10.0


@dataclass(frozen=True, eq=False)
class ImageCoverage:
    """Of one camera.

    Attributes:
        counts: (rows, columns) corners that took part, cell by cell of the image, top left first.
        distance: (5 %, 95 %) quantiles of the distance of the board along the optical axis, m.
        tilt: 95 % quantile of the angle between board and image plane, rad.
    """

    name: str
    counts: Tensor
    distance: tuple[float, float]
    tilt: float

    @property
    def covered(self) -> float:
        """Share of the cells with corners."""
        return float((self.counts > _FEW * self.counts.sum()).double().mean())


@dataclass(frozen=True, eq=False)
class Coverage:
    """What was seen and moved.

    Attributes:
        duration: of the readings used, s.
        angular_velocity: (3,) root mean square about the axes of the first IMU, rad/s.
        acceleration: (3,) the same of its motion along them, without gravity, m/s^2.
        tilt: largest angle between the direction of gravity in the first IMU and its mean, rad.
        cameras: one by one.
        warnings: in words; none is good.
    """

    duration: float
    angular_velocity: Tensor
    acceleration: Tensor
    tilt: float
    cameras: tuple[ImageCoverage, ...]
    warnings: list[str]


def coverage(calibration: Calibration) -> Coverage:
    """How much the recording of a calibration tells."""
    used = calibration.imus[0].gyroscope.used
    t = calibration.recording.imus[0].time_ns[used]
    duration = float(t[-1] - t[0]) * NANOSECOND
    step = max(1, len(t) // _MOST_TIMES)
    with torch.no_grad():
        motion = calibration.trajectory.kinematics(t[::step])
    assert motion.acceleration is not None
    assert motion.angular_velocity is not None
    assert motion.rotation is not None
    inverse = SO3.inverse(motion.rotation)
    w, a = motion.angular_velocity, SO3.act(inverse, motion.acceleration)
    down = SO3.act(inverse, calibration.gravity.expand(len(a), 3))
    mean = down.mean(0)
    tilt = float(torch.linalg.cross(down, mean.expand_as(down)).norm(dim=1).atan2(down @ mean).max())
    cameras = tuple(_images(calibration, i) for i in range(len(calibration.cameras)))
    warnings = [
        *_quiet(w, _SLOW, "rotation about", "rad/s", "rotations of cameras and their positions across it"),
        *_quiet(a, _SOFT, "motion along", "m/s²", "what the accelerometer adds along it"),
    ]
    if tilt < _TILT:
        warnings.append(
            f"the IMU tilted by {math.degrees(tilt):.1f} degrees at most: accelerometer biases and the direction of "
            "gravity are told apart by tilting only"
        )
    for found, image in zip(calibration.cameras, cameras, strict=True):
        warnings += _of_camera(found, image)
    for imu in calibration.imus:
        warnings += _of_imu(imu)
    if calibration.imus[0].accel_scaling is None:
        warnings += _of_sizes(calibration.imus[0].accelerometer, step, a, -down)
    warnings += [f"unknowns are left open: {direction}" for direction in calibration.observability]
    return Coverage(duration, _rms(w), _rms(a), tilt, cameras, warnings)


def _of_sizes(residuals: SensorResiduals, step: int, motion: Tensor, weight: Tensor) -> list[str]:
    """Whether residuals of the accelerometer go along with the motion, with gravity, or with both.

    A wrong size of the board scales the motion, and biases take up a part of a wrong gravity: nothing else shows them.
    A regression on both tells less than is wrong, as the trajectory gives way.

    Args:
        residuals: of which every `step`-th is looked at. motion, weight: (N, 3) what it should have read of each.
    """
    x = torch.stack([(y - y.mean(0)).reshape(-1) for y in (motion, weight)], dim=1)
    y = residuals.values[::step]
    matrix = x.mT @ x
    if not float(torch.linalg.cond(matrix)) < 1e8:
        return []
    inverse = torch.linalg.inv(matrix)
    off = inverse @ (x.mT @ (y - y.mean(0)).reshape(-1))
    sure = off.abs() > _SIGNIFICANT * residuals.sigma * inverse.diagonal().sqrt()
    moved, weighed = (sure & (off.abs() > torch.tensor([_MOTION_OFF, _GRAVITY_OFF]))).tolist()
    size, gravity = off.tolist()
    if moved and weighed and 0.5 < size / gravity < 2.0:
        return [
            f"{residuals.name}: it reads motion and gravity at least {abs(size):.1%} too "
            f"{'small' if size > 0 else 'large'}: is its scale right?"
        ]
    found = []
    if moved:
        found.append(
            f"{residuals.name}: the motion in the images is at least {abs(size):.1%} too "
            f"{'large' if size > 0 else 'small'} for it: are the size of the board and the focal lengths right?"
        )
    if weighed:
        found.append(
            f"{residuals.name}: gravity is at least {abs(gravity):.1%} too {'large' if gravity > 0 else 'small'} for "
            "it: is its magnitude right?"
        )
    return found


def cells(camera: Camera, uv: Tensor) -> Tensor:
    """(N,) the cell of an image that each pixel lies in, row by row."""
    columns, rows = CELLS
    width, height = camera.resolution
    column = (uv[:, 0] / width * columns).long().clamp(0, columns - 1)
    row = (uv[:, 1] / height * rows).long().clamp(0, rows - 1)
    return row * columns + column


def _rms(x: Tensor) -> Tensor:
    return x.square().mean(0).sqrt()


def _images(calibration: Calibration, i: int) -> ImageCoverage:
    recording, found, board = calibration.recording, calibration.cameras[i], calibration.start.boards[i]
    corners: Corners = recording.corners[i]
    where = cells(recording.cameras[i], corners.uv[found.residuals.used])
    counts = torch.bincount(where, minlength=CELLS[0] * CELLS[1]).reshape(CELLS[1], CELLS[0])
    poses = board.T_cam_board[board.good]
    z = poses[:, 2].numpy()
    up = torch.tensor([0.0, 0.0, 1.0], dtype=poses.dtype).expand(len(poses), 3)
    tilt = SO3.act(poses[:, 3:], up)[:, 2].abs().clamp(max=1.0).acos().numpy()
    near, far = np.quantile(z, (0.05, 0.95))
    return ImageCoverage(found.name, counts, (float(near), float(far)), float(np.quantile(tilt, 0.95)))


def _quiet(x: Tensor, limit: float, what: str, unit: str, unsure: str) -> list[str]:
    """A warning for each direction of the first IMU in which there was little."""
    values, axes = torch.linalg.eigh(x.mT @ x / len(x))
    values = values.clamp_min(0.0).sqrt()
    quiet = axes[:, values < limit]
    # Which of several quiet directions an eigenvector takes is chance: axes that lie among them have names.
    plain = torch.nonzero(quiet.square().sum(dim=1) > 0.9).flatten().tolist()
    if len(plain) == quiet.shape[1]:
        there = [("xyz"[i], float(x[:, i].square().mean().sqrt())) for i in plain]
    else:
        there = [
            (f"[{', '.join(f'{y:.2f}' for y in axis.tolist())}]", float((x @ axis).square().mean().sqrt()))
            for axis in quiet.mT
        ]
    return [
        f"{what} {name} of the first IMU was hardly excited ({value:.2g} {unit} RMS): {unsure} stay unsure"
        for name, value in there
    ]


def _of_camera(found: CalibratedCamera, image: ImageCoverage) -> list[str]:
    warnings = []
    estimated = found.intrinsics_sigma is not None
    share = float(found.images.double().mean())
    if share < _TAKEN:
        warnings.append(f"{found.name}: only {share:.0%} of its images take part")
    if image.covered < _COVERED:
        edges = _empty_edges(image.counts)
        bare = f", none at the {' and '.join(edges)}" if edges else ""
        matter = (
            "intrinsics are extrapolated there" if estimated else "errors of the intrinsics show there last"
        )
        warnings.append(f"{found.name}: corners cover {image.covered:.0%} of the image only{bare}: {matter}")
    if estimated and image.tilt < _BOARD_TILT:
        warnings.append(
            f"{found.name}: the board is tilted by {math.degrees(image.tilt):.0f} degrees at most: focal length and "
            "distance are hardly told apart"
        )
    for values, limit, unit, what in (
        (found.T_imu_cam_sigma[:3], _UNSURE[0], "m", "position"),
        (found.T_imu_cam_sigma[3:], _UNSURE[1], "rad", "rotation"),
    ):
        worst = float(values.max())
        if not worst <= limit:
            warnings.append(
                f"{found.name}: its {what} is known to {worst:.2g} {unit} only (standard deviation)"
            )
    return warnings + _of_sensor(
        found.residuals, "wrong intrinsics, moving boards, blurred or rolling images"
    )


def _of_imu(imu: CalibratedImu) -> list[str]:
    causes = "vibration, knots too far apart for the motion, scale or misalignment"
    return _of_sensor(imu.gyroscope, causes) + _of_sensor(imu.accelerometer, causes)


def _of_sensor(residuals: SensorResiduals, causes: str) -> list[str]:
    ratio = float(_rms(residuals.values).square().mean().sqrt()) / residuals.stated
    if ratio > _FACTOR:
        return [
            f"{residuals.name}: residuals are {ratio:.1f} times as large as the noise that was stated "
            f"({residuals.stated:.2g} {residuals.unit}): {causes}?"
        ]
    if ratio < 1.0 / _FACTOR:
        return [
            f"{residuals.name}: residuals are {ratio:.2f} of the noise that was stated ({residuals.stated:.2g} "
            f"{residuals.unit}): it was stated too large, or the spline follows the noise"
        ]
    return []


def _empty_edges(counts: Tensor) -> list[str]:
    few = _FEW * float(counts.sum())
    edges = {"left": counts[:, 0], "right": counts[:, -1], "top": counts[0], "bottom": counts[-1]}
    return [name for name, x in edges.items() if bool((x <= few).all())]
