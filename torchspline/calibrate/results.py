"""What a calibration found, as files: `result.json`, Kalibr's `camchain-imucam.yaml` and a report to look at."""

import json
import math
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchspline import checks
from torchspline.calibrate.coverage import Coverage, coverage
from torchspline.calibrate.estimate import CalibratedImu, Calibration, SensorResiduals
from torchspline.calibrate.report import CONVENTIONS, page, sensors
from torchspline.groups.group import SE3
from torchspline.io.archive import write_bytes
from torchspline.io.camchain import CamChain, write_camchain
from torchspline.units import NANOSECOND

#: The files that `write_calibration` writes.
FILES = ("result.json", "camchain-imucam.yaml", "report.html")


def write_calibration(folder: str | PathLike[str], calibration: Calibration) -> list[str]:
    """Write `result.json`, `camchain-imucam.yaml` and `report.html` into a folder; files of these names are replaced.

    `result.json` holds every estimate with its standard deviation; `camchain-imucam.yaml` is what Kalibr writes;
    `report.html` has all of it with figures in one file.

    Args:
        folder: made if it is not there.
    Returns:
        What to be wary of, in words, as the report has it: directions in which there was little motion, parts of the
        images without corners, residuals larger than the noise that was stated, a board, gravity or accelerometer whose
        size does not fit the rest. None is good.
    Raises:
        TypeError: no path, or no Calibration.
        ValueError: the folder is a file.
    """
    if not isinstance(folder, (str, PathLike)):
        raise TypeError(f"folder: expected a path, got {type(folder).__name__}")
    checks.instance("calibration", calibration, Calibration, "a Calibration, as calibrate returns it")
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"folder: expected a folder, got the file {folder}")
    folder.mkdir(parents=True, exist_ok=True)
    found = coverage(calibration)
    content = json.dumps(_plain(results(calibration, found)), indent=2, allow_nan=False)
    write_bytes(folder / FILES[0], (content + "\n").encode())
    write_camchain(folder / FILES[1], camchain(calibration))
    write_bytes(folder / FILES[2], page(calibration, found).encode())
    return found.warnings


def camchain(calibration: Calibration) -> CamChain:
    """The cameras as Kalibr knows them."""
    cameras = [
        replace(
            camera,
            intrinsics=tuple(found.intrinsics[:4].tolist()),
            coefficients=tuple(found.intrinsics[4:].tolist()),
        )
        for camera, found in zip(calibration.recording.cameras, calibration.cameras, strict=True)
    ]
    offsets = torch.tensor([found.time_offset for found in calibration.cameras], dtype=torch.float64)
    return CamChain(tuple(cameras), torch.stack([found.T_imu_cam for found in calibration.cameras]), offsets)


# ---------------------------------------------------------------------- result.json


def results(calibration: Calibration, found: Coverage) -> dict[str, Any]:
    """Every estimate and its standard deviation, residual statistics, and what to be wary of, as numbers and words.

    A standard deviation of null stands for what was not estimated.
    """
    content: dict[str, Any] = {"conventions": CONVENTIONS}
    for i, camera in enumerate(calibration.cameras):
        content |= {
            f"T_imu_cam{i}": _pose(camera.T_imu_cam, camera.T_imu_cam_sigma),
            f"time_offset_cam{i}": _value(camera.time_offset, camera.time_offset_sigma),
            f"intrinsics_cam{i}": _value(camera.intrinsics, camera.intrinsics_sigma),
        }
        if camera.line_delay is not None:
            content[f"line_delay_cam{i}"] = _value(camera.line_delay, camera.line_delay_sigma)
        if i:
            content[f"T_cam{i}_cam{i - 1}"] = _pose(calibration.T_cam_cam(i, i - 1), None)
    content["gravity"] = _value(calibration.gravity, calibration.gravity_sigma)
    for j, imu in enumerate(calibration.imus):
        content[f"imu{j}"] = _imu(imu, first=j == 0)
    options = calibration.trajectory
    return content | {
        "residuals": {x.name: _statistics(x) for x in sensors(calibration)},
        "coverage": {
            "duration_s": found.duration,
            "angular_velocity_rms_rad_s": found.angular_velocity,
            "acceleration_rms_m_s2": found.acceleration,
            "cameras": {
                x.name: {"covered": x.covered, "distance_m": x.distance, "tilt_rad": x.tilt}
                for x in found.cameras
            },
        },
        "trajectory": {
            "group": str(options.group),
            "order": options.order,
            "spacing_s": None if options.dt_ns is None else options.dt_ns * NANOSECOND,
            "control_points": options.control_points.shape[-2],
        },
        "solver": {
            "converged": calibration.result.converged,
            "stopped": calibration.result.reason,
            "iterations": len(calibration.result.cost) - 1,
        },
        "seconds": calibration.seconds,
        "notes": calibration.notes,
        "warnings": found.warnings,
    }


def _pose(pose: Tensor, sigma: Tensor | None) -> dict[str, Any]:
    return {
        "matrix": SE3.to_matrix(pose),
        "translation": pose[:3],
        "quaternion": pose[3:],
        "translation_sigma": None if sigma is None else sigma[:3],
        "rotation_sigma": None if sigma is None else sigma[3:],
    }


def _value(value: Tensor | float, sigma: Tensor | float | None) -> dict[str, Any]:
    return {"value": value, "sigma": sigma}


def _imu(imu: CalibratedImu, first: bool) -> dict[str, Any]:
    content = {
        "gyro_bias": _value(imu.gyro_bias, imu.gyro_bias_sigma),
        "accel_bias": _value(imu.accel_bias, imu.accel_bias_sigma),
    }
    for name in ("gyro_scaling", "accel_scaling"):
        if (scaling := getattr(imu, name)) is not None:
            content[name] = _value(scaling, getattr(imu, f"{name}_sigma"))
    for name in ("gyro_bias_spline", "accel_bias_spline"):
        if (spline := getattr(imu, name)) is not None:
            content[name] = {"order": spline.order, "start_ns": spline.domain[0], "spacing_ns": spline.dt_ns}
    if not first:
        content["T_imu0_imu"] = _pose(imu.T_imu0_imu, imu.T_imu0_imu_sigma)
        content["time_offset"] = _value(imu.time_offset, imu.time_offset_sigma)
    return content


def _statistics(residuals: SensorResiduals) -> dict[str, Any]:
    return {
        "unit": residuals.unit,
        "count": len(residuals.values),
        "unused": int((~residuals.used).sum()),
        "mean": residuals.mean,
        "rms": residuals.rms,
        "median_length": residuals.median_length,
        "largest_length": float(residuals.values.norm(dim=1).max()),
        "sigma": residuals.sigma,
        "stated_sigma": residuals.stated,
    }


def _plain(x: Any) -> Any:
    """As JSON has it: lists for tensors and tuples, null for what is not finite."""
    if isinstance(x, Tensor):
        x = x.tolist()
    if isinstance(x, dict):
        return {str(key): _plain(value) for key, value in x.items()}
    if isinstance(x, (list, tuple)):
        return [_plain(value) for value in x]
    return None if isinstance(x, float) and not math.isfinite(x) else x
