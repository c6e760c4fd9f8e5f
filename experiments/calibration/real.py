"""What the real recording tells: time, reprojection errors, and whether parts of it agree."""

from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchspline.calibrate import Camera, Recording, board_poses, find_start, read_recording
from torchspline.calibrate.estimate import Calibration, calibrate
from torchspline.groups import SE3, SO3

FILES = "config.yaml", ("cam0_corners.npz", "cam1_corners.npz"), ("imu0.csv.gz",)
DEGREES = 180.0 / torch.pi


def read(folder: Path, seconds: float | None) -> Recording:
    config, corners, imus = FILES
    recording = read_recording(folder / config, [folder / x for x in corners], [folder / x for x in imus])
    return recording if seconds is None else recording.between(0.0, seconds)


def cold(recording: Recording, repeats: int, **options: Any) -> tuple[Calibration, dict[str, float]]:
    """From the recording alone to its calibration: the last one, and phases of the fastest after a first."""
    best: dict[str, float] = {}
    for i in range(repeats + 1):
        begin = perf_counter()
        found = calibrate(recording, **options)
        seconds = perf_counter() - begin
        if i == 0 or seconds < best["total"]:
            best = {**found.seconds, "total": seconds}
    return found, best


def medians(found: Calibration) -> list[float]:
    """Median reprojection error of each camera, px."""
    return [camera.residuals.median_length for camera in found.cameras]


def independent(recording: Recording) -> list[float]:
    """The same of a pose of its own for every image."""
    pairs = zip(recording.cameras, recording.corners, strict=True)
    return [board_poses(camera, corners).median_error() for camera, corners in pairs]


def fisheye(camera: Camera) -> Camera:
    """The equidistant model nearest to a pinhole with radial distortion, over the angles at which that grows."""
    k1, k2 = camera.coefficients[:2]
    angle = np.linspace(0.01, 0.85, 300)
    r2 = np.tan(angle) ** 2
    radius = np.tan(angle) * (1 + k1 * r2 + k2 * r2 * r2)
    grows = np.gradient(radius, angle) > 0.1
    powers = np.stack([angle**n for n in (3, 5, 7, 9)], axis=1)
    coefficients = np.linalg.lstsq(powers[grows], (radius - angle)[grows], rcond=None)[0]
    return replace(camera, distortion="equidistant", coefficients=tuple(coefficients.tolist()))


def with_intrinsics(recording: Recording, found: Calibration) -> Recording:
    """The recording with the intrinsics that were estimated."""
    cameras = tuple(
        replace(c, intrinsics=tuple(x.intrinsics[:4].tolist()), coefficients=tuple(x.intrinsics[4:].tolist()))
        for c, x in zip(recording.cameras, found.cameras, strict=True)
    )
    return replace(recording, cameras=cameras)


def one_by_one(recording: Recording, joint: Calibration, **options: Any) -> dict[str, float]:
    """How far the transform between two cameras, each calibrated without the other, is from the joint one."""
    single = [calibrate(recording.only(i), **options).cameras[0].T_imu_cam for i in (0, 1)]
    between = SE3.compose(SE3.inverse(single[0]), single[1])
    position, rotation = apart(between, joint.T_cam_cam(0, 1))
    return {"mm": 1e3 * position, "degrees": rotation}


def apart(a: Tensor, b: Tensor) -> tuple[float, float]:
    """m and degrees."""
    difference = SE3.between(a, b)
    return float(difference[:3].norm()), float(SO3.log(difference[3:]).norm() * DEGREES)


def halves(recording: Recording, **options: Any) -> dict[str, Any]:
    """Differences of two halves, each solved from nothing, over their deviations; the largest of each estimate."""
    last = max(int(c.t_ns[-1]) for c in recording.corners)
    middle = 0.5e-9 * (last - recording.start_ns)
    parts = [recording.between(0.0, middle), recording.between(middle, 2 * middle + 1.0)]
    a, b = (calibrate(part, **options) for part in parts)
    found: dict[str, Any] = {}
    for i, (x, y) in enumerate(zip(a.cameras, b.cameras, strict=True)):
        error = SE3.log(SE3.between(x.T_imu_cam, y.T_imu_cam))
        sigma = torch.hypot(x.T_imu_cam_sigma, y.T_imu_cam_sigma)
        found[f"cam{i} translation"] = _worst(error[:3], sigma[:3])
        found[f"cam{i} rotation"] = _worst(error[3:], sigma[3:])
        assert x.time_offset_sigma is not None
        assert y.time_offset_sigma is not None
        found[f"cam{i} time offset"] = abs(x.time_offset - y.time_offset) / float(
            np.hypot(x.time_offset_sigma, y.time_offset_sigma)
        )
    x, y = a.imus[0], b.imus[0]
    for name in ("gyro_bias", "accel_bias"):
        sigma = torch.hypot(getattr(x, f"{name}_sigma"), getattr(y, f"{name}_sigma"))
        found[name.replace("_", " ")] = _worst(getattr(x, name) - getattr(y, name), sigma)
    tilt = torch.linalg.cross(a.gravity, b.gravity).norm() / a.gravity.norm() ** 2
    found["gravity"] = float(tilt / torch.hypot(a.gravity_sigma, b.gravity_sigma).norm())
    return found


def _worst(error: Tensor, sigma: Tensor) -> float:
    return float((error / sigma).abs().max())


def everything(folder: Path, seconds: float | None, repeats: int, options: dict[str, Any]) -> dict[str, Any]:
    """All figures of the real recording."""
    recording = read(folder, seconds)
    given, phases = cold(recording, repeats, **options)
    estimate = ("time_offset", "intrinsics")
    start = find_start(recording)
    free = calibrate(recording, start, estimate=estimate, **options)
    wide = replace(recording, cameras=tuple(map(fisheye, recording.cameras)))
    widely = calibrate(wide, start, estimate=estimate, **options)
    known = with_intrinsics(wide, widely)
    settled = calibrate(known, start, **options)
    figures = {
        "corners": [len(c) for c in recording.corners],
        "seconds": phases,
        "evaluations": given.result.evaluations,
        "median_px": {
            "given intrinsics": {"one pose an image": independent(recording), "calibration": medians(given)},
            "estimated intrinsics": {
                "one pose an image": independent(with_intrinsics(recording, free)), "calibration": medians(free),
            },
            "estimated fisheye": {"one pose an image": independent(known), "calibration": medians(widely)},
        },
        "one_by_one": {
            "given intrinsics": one_by_one(recording, given, **options),
            "fisheye of both": one_by_one(known, settled, **options),
        },
        "halves": {
            "given intrinsics": halves(recording, **options),
            "given intrinsics, independent errors": halves(recording, **{**options, "stretch": None}),
            "fisheye of both": halves(known, **options),
        },
        "estimates": {name: _summary(found) for name, found in (("given", given), ("fisheye", settled))},
    }  # fmt: skip
    return figures


def _summary(found: Calibration) -> dict[str, Any]:
    imu = found.imus[0]
    return {
        **{
            camera.name: {
                "T_imu_cam": camera.T_imu_cam, "sigma": camera.T_imu_cam_sigma,
                "time_offset": camera.time_offset, "time_offset_sigma": camera.time_offset_sigma,
                "intrinsics": camera.intrinsics,
            }
            for camera in found.cameras
        },
        "gravity": found.gravity,
        "gyro_bias": imu.gyro_bias, "accel_bias": imu.accel_bias,
        "noise": {
            x.name: {"rms": x.rms, "found": x.sigma, "stated": x.stated}
            for x in (imu.gyroscope, imu.accelerometer, *(c.residuals for c in found.cameras))
        },
    }  # fmt: skip
