"""The least-squares problem of a calibration: its unknowns, where they start, and the measurements of each sensor."""

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import RotationSpline
from torch import Tensor

from torchspline.calibrate.images import PROJECTIONS, ImageBlock
from torchspline.calibrate.recording import Recording
from torchspline.calibrate.start import Start
from torchspline.fit.losses import Loss
from torchspline.fit.problem import Problem
from torchspline.fit.residual import Clock, Residual
from torchspline.fit.residuals import Accelerometer, Gyroscope
from torchspline.fit.variables import Variable
from torchspline.groups import R3, SE3, SO3, Group
from torchspline.groups.convert import from_scipy, to_scipy
from torchspline.io.records import ImuRecord
from torchspline.splines.bspline import BSpline
from torchspline.units import SECOND

#: Trajectories by representation.
GROUPS = {"split": "R3xSO3", "joint": "SE3"}
#: What may be estimated besides trajectory, extrinsics, gravity and biases.
CHOICES = ("time_offset", "intrinsics", "line_delay", "imu_scaling")
#: How long before the first and after the last image the trajectory goes on, where the IMU does, s.
_PAD = 0.1
#: Off-diagonal numbers of an accelerometer's scaling that would turn the frame of its IMU, and what they may be.
_ABOVE_DIAGONAL, _FIXED, _FREE = (1, 2, 5), 1e-9, 1.0
_UNIT = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class Options(NamedTuple):
    """What `calibrate` was asked for; see there."""

    order: int
    spacing: float
    representation: str
    estimate: frozenset[str]
    bias_spacing: float | None
    pixel_sigma: float
    loss: Loss | None
    imu_loss: Loss | None


@dataclass
class CameraUnknowns:
    extrinsics: Variable
    #: Minus the time offset, s: what the camera's clock is ahead of the IMU's.
    ahead: Variable
    intrinsics: Variable
    line_delay: Variable | None
    residual: Residual
    #: Which images and corners take part.
    images: Tensor
    corners: Tensor


@dataclass
class ImuUnknowns:
    gyro_bias: Variable | BSpline
    accel_bias: Variable | BSpline
    gyroscope: Residual
    accelerometer: Residual
    #: Which samples take part.
    samples: Tensor
    rotation: Variable | None = None
    lever_arm: Variable | None = None
    ahead: Variable | None = None
    gyro_scaling: Variable | None = None
    accel_scaling: Variable | None = None


@dataclass
class Layout:
    """The problem and what its unknowns mean."""

    problem: Problem
    trajectory: BSpline
    gravity: Variable
    cameras: list[CameraUnknowns] = field(default_factory=list)
    imus: list[ImuUnknowns] = field(default_factory=list)
    #: What is known beforehand.
    frozen: list[Variable] = field(default_factory=list)

    @property
    def residuals(self) -> list[Residual]:
        """Of all sensors."""
        return [x for u in self.imus for x in (u.gyroscope, u.accelerometer)] + [
            u.residual for u in self.cameras
        ]


def build(recording: Recording, start: Start, options: Options) -> Layout:
    """All sensors on one trajectory of the first IMU, on its clock.

    Raises:
        ValueError: sensors that share no stretch of time, gaps in the readings of the IMU.
    """
    trajectory = _trajectory(recording, start, options)
    gravity = Variable("gravity", start.gravity * (recording.gravity / start.gravity.norm()), sphere=True)
    layout = Layout(Problem(trajectory), trajectory, gravity)
    for i in range(len(recording.imus)):
        _add_imu(layout, recording, i, start, options)
    for i in range(len(recording.cameras)):
        _add_camera(layout, recording, i, start, options)
    return layout


# ---------------------------------------------------------------------- the trajectory


def span(recording: Recording, start: Start) -> tuple[int, int]:
    """First and last nanosecond, on the clock of the first IMU, at which it and a camera measured."""
    imu, pad = recording.imus[0], round(_PAD * SECOND)
    stamps = [
        (int(c.t_ns[0]) + round(offset * SECOND), int(c.t_ns[-1]) + round(offset * SECOND))
        for c, offset in zip(recording.corners, start.time_offset.tolist(), strict=True)
        if len(c.t_ns)
    ]
    if not stamps or not len(imu):
        raise ValueError("recording: expected images and readings of an IMU, got none of one kind")
    first = max(min(a for a, _ in stamps) - pad, int(imu.time_ns[0]))
    last = min(max(b for _, b in stamps) + pad, int(imu.time_ns[-1]))
    if last <= first:
        raise ValueError(
            "recording: expected images while the IMU measured; got images from "
            f"{min(a for a, _ in stamps)} to {max(b for _, b in stamps)} ns on its clock and readings from "
            f"{int(imu.time_ns[0])} to {int(imu.time_ns[-1])} ns; are the clocks synchronised, or the offsets right?"
        )
    return first, last


def _trajectory(recording: Recording, start: Start, options: Options) -> BSpline:
    first, last = span(recording, start)
    dt = max(round(options.spacing * SECOND), 1)
    segments = (last - first) // dt
    if segments < 1:
        raise ValueError(
            f"spacing: expected less than the {(last - first) / SECOND:g} s that sensors share, got {options.spacing:g}"
        )
    _check_gaps(recording.imus[0], first, first + segments * dt, options)
    count = segments + options.order - 1
    t = (np.arange(count) - 0.5 * (options.order - 2)) * (dt / SECOND)
    known = (start.t_ns - first).numpy() / SECOND
    points = _through(known, start.T_board_imu.numpy(), np.clip(t, known[0], known[-1]))
    group = Group(GROUPS[options.representation])
    return BSpline(
        torch.from_numpy(points), group=group, order=options.order, dt_ns=dt, t0_ns=first, learnable=False
    )


def _through(t: np.ndarray, poses: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Poses between others: good enough to start from."""
    if len(t) == 1:
        return np.repeat(poses, len(at), axis=0)
    position = CubicSpline(t, poses[:, :3])(at)
    rotation = RotationSpline(t, to_scipy(torch.from_numpy(poses[:, 3:])))(at)
    return np.concatenate([position, from_scipy(rotation).numpy()], axis=1)


def _check_gaps(imu: ImuRecord, first: int, last: int, options: Options) -> None:
    """Control points that no reading touches would be left open."""
    stamps = imu.window(first, last).time_ns
    rate = (len(stamps) - 1) / max((last - first) / SECOND, 1e-9)
    if rate * options.spacing < 0.999:
        raise ValueError(
            f"spacing: expected at least the {1 / max(rate, 1e-9):.4g} s between readings of the IMU, got "
            f"{options.spacing:g}: every control point needs a reading"
        )
    steps = stamps.diff()
    widest = (options.order - 1) * round(options.spacing * SECOND)
    if len(steps) and int(steps.max()) > widest:
        row = int(steps.argmax())
        raise ValueError(
            f"{imu.source or 'imus[0]'}: expected readings at most {widest / SECOND:g} s apart for a spline of order "
            f"{options.order} with knots every {options.spacing:g} s; got a gap of {int(steps[row]) / SECOND:.3f} s at "
            f"{int(stamps[row])} ns; use a larger spacing, or a part of the recording without the gap"
        )


# ---------------------------------------------------------------------- sensors


def _add_imu(layout: Layout, recording: Recording, i: int, start: Start, options: Options) -> None:
    record, noise = recording.imus[i], recording.noise[i]
    first, last = layout.trajectory.domain
    shift = round(float(start.imu_time_offset[i]) * SECOND)
    inside = (record.time_ns - shift >= first) & (record.time_ns - shift <= last)
    part = record.window(int(first) + shift, int(last) + shift)
    if len(part) < 2:
        raise ValueError(
            f"{record.source or f'imus[{i}]'}: expected readings while cameras saw the board, got none"
        )
    rate = math.sqrt((len(part) - 1) * SECOND / int(part.time_ns[-1] - part.time_ns[0]))
    mount: dict[str, Variable] = {}
    clock = ahead = None
    if i > 0:
        mount["rotation"] = Variable(f"imu{i} rotation", start.T_imu0_imu[i, 3:], group=SO3)
        mount["lever_arm"] = Variable(f"imu{i} lever arm", start.T_imu0_imu[i, :3])
        # `t_imu_i = t_imu0 + offset`, as a `Clock` has it.
        ahead = Variable(f"imu{i} ahead", start.imu_time_offset[i : i + 1])
        clock = Clock(offset=ahead)
    gyro_bias = _bias(f"imu{i} gyro bias", start.gyro_bias[i], layout.trajectory, part.time_ns, options)
    accel_bias = _bias(f"imu{i} accel bias", start.accel_bias[i], layout.trajectory, part.time_ns, options)
    scaling: dict[str, Variable] = {}
    if "imu_scaling" in options.estimate:
        for sensor in ("gyro", "accel"):
            scaling[sensor] = Variable(f"imu{i} {sensor} scaling", torch.tensor(_UNIT, dtype=torch.float64))
    names = f"imu{i} gyroscope", f"imu{i} accelerometer"
    shared: dict[str, Any] = {"loss": options.imu_loss, "clock": clock}
    gyro_given: dict[str, Any] = {"bias": gyro_bias}
    accel_given: dict[str, Any] = {"bias": accel_bias, "gravity": layout.gravity, **mount}
    if i > 0:
        gyro_given["rotation"] = mount["rotation"]
    if scaling:
        gyro_given["scaling"], accel_given["scaling"] = scaling["gyro"], scaling["accel"]
    gyroscope = Gyroscope(
        part.time_ns,
        part.gyroscope,
        sigma=noise.gyroscope_noise_density * rate,
        name=names[0],
        **shared,
        **gyro_given,
    )
    accelerometer = Accelerometer(
        part.time_ns,
        part.accelerometer,
        sigma=noise.accelerometer_noise_density * rate,
        name=names[1],
        **shared,
        **accel_given,
    )
    layout.problem.add(gyroscope)
    layout.problem.add(accelerometer)
    if scaling:
        # The frame of an IMU is that of its accelerometer, x along its first axis, y in the plane of the first two: a
        # rotation of the sensor and two full matrices would say the same thing twice.
        sigma = torch.full((9,), _FREE, dtype=torch.float64)
        sigma[list(_ABOVE_DIAGONAL)] = _FIXED
        layout.problem.add_prior(scaling["accel"], sigma=sigma)
    layout.imus.append(
        ImuUnknowns(
            gyro_bias, accel_bias, gyroscope, accelerometer, inside, mount.get("rotation"), mount.get("lever_arm"),
            ahead, scaling.get("gyro"), scaling.get("accel"),
        )
    )  # fmt: skip


def _bias(
    name: str, value: Tensor, trajectory: BSpline, stamps: Tensor, options: Options
) -> Variable | BSpline:
    """One for all times, or a spline over the trajectory's time and all stamps of the sensor's own clock."""
    if options.bias_spacing is None:
        return Variable(name, value)
    first, last = trajectory.domain
    first, last = min(int(first), int(stamps[0])), max(int(last), int(stamps[-1]))
    # Whole segments: a last one with a few readings only would leave its control point open.
    segments, order = max(1, round((last - first) / (options.bias_spacing * SECOND))), 4
    dt, count = -(-(last - first) // segments), segments + order - 1
    points = value.repeat(count, 1)
    return BSpline(points, group=R3, order=order, dt_ns=dt, t0_ns=first, learnable=False)


def _add_camera(layout: Layout, recording: Recording, i: int, start: Start, options: Options) -> None:
    camera, corners, problem = recording.cameras[i], recording.corners[i], layout.problem
    number, name = f"cam{i}", f"cam{i} corners"
    offset = float(start.time_offset[i])
    first, last = layout.trajectory.domain
    near = corners.t_ns + round(offset * SECOND)
    images = (near >= first) & (near <= last)
    kept = images[corners.frame]
    if not bool(kept.any()):
        raise ValueError(
            f"{corners.source or camera.name}: expected corners while the IMU measured, got none there"
        )
    ahead = Variable(f"{number} ahead", torch.tensor([-offset], dtype=torch.float64))
    extrinsics = Variable(f"{number} extrinsics", SE3.normalize(start.T_imu_cam[i]), group=SE3)
    intrinsics = Variable(f"{number} intrinsics", camera.parameters)
    frame = (torch.cumsum(images, 0) - 1)[corners.frame[kept]]
    uv, xyz, stamps = corners.uv[kept], corners.xyz[kept], corners.t_ns[images]
    sigma = options.pixel_sigma
    delay = None
    shared: dict[str, Any] = {"intrinsics": intrinsics, "T_body_camera": extrinsics}
    if "line_delay" in options.estimate:
        delay = Variable(f"{number} line delay", torch.zeros(1, dtype=torch.float64))
        # A `Clock` takes delays off stamps; lines below the middle are seen after the stamp.
        middle = 0.5 * (camera.resolution[1] - 1)
        residual = PROJECTIONS[camera.distortion](
            stamps[frame], uv, landmark=xyz, sigma=sigma, loss=options.loss, name=name, **shared,
            clock=Clock(offset=ahead, delay=delay, late=middle - uv[:, 1]),
        )  # fmt: skip
    else:
        residual = ImageBlock(
            stamps, image=frame, uv=uv, xyz=xyz, distortion=camera.distortion, sigma=sigma, loss=options.loss,
            name=name, clock=Clock(offset=ahead), **shared,
        )  # fmt: skip
    problem.add(residual)
    for kind, variable in (("intrinsics", intrinsics), ("time_offset", ahead)):
        if kind not in options.estimate:
            problem.freeze(variable)
            layout.frozen.append(variable)
    layout.cameras.append(CameraUnknowns(extrinsics, ahead, intrinsics, delay, residual, images, kept))
