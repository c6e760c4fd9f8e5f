"""`torchspline calibrate camera-imu`."""

import json
import math
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Literal

from torchspline.calibrate.estimate import Calibration, calibrate
from torchspline.calibrate.reading import read_recording
from torchspline.calibrate.results import FILES, write_calibration
from torchspline.calibrate.start import find_start, with_known_offsets
from torchspline.cli.common import MOST_SECONDS
from torchspline.cli.report import Report

EXAMPLES = """
torchspline calibrate camera-imu --imu imu.csv --corners cam0.npz cam1.npz --config config.yaml --out DIR
torchspline calibrate camera-imu --imu a.csv b.csv --corners cam0.npz --config config.yaml --estimate-intrinsics
"""


def camera_imu(
    *,
    imu: list[Path],
    corners: list[Path],
    config: Path,
    out: Path = Path("torchspline-calibration"),
    order: int = 5,
    spacing: float = 20.0,
    representation: Literal["split", "joint"] = "split",
    estimate_intrinsics: bool = False,
    estimate_line_delay: bool = False,
    estimate_imu_scaling: bool = False,
    synchronised: bool = False,
    bias_spacing: float | None = None,
    pixel_sigma: float = 0.5,
    reweigh: bool = True,
    max_offset: float = 10.0,
    start: float = 0.0,
    duration: float = math.inf,
) -> Report:
    """Where cameras sit on an IMU, and how their clocks differ, from a recording of a board: no guess needed.

    Args:
        imu: one csv file for each IMU: nanoseconds, rad/s, m/s²; gzipped or not.
        corners: one npz file for each camera: t_ns, frame, uv, xyz_m, tag_id, corner.
        config: YAML file: a section for each camera (intrinsics) and for each IMU (noise), by Kalibr's names.
        out: folder for report.html, result.json and camchain-imucam.yaml; made if it is not there.
        order: of the spline of the motion, 4 or more.
        spacing: of its knots, ms.
        representation: split (R3 x SO3) or joint (SE3); results are the same.
        estimate_intrinsics: of every camera, along with the rest; otherwise those of the config are kept.
        estimate_line_delay: of rolling shutters.
        estimate_imu_scaling: scale and misalignment of the axes of gyroscopes and accelerometers.
        synchronised: cameras and the first IMU share one clock, or are apart by the timeshift_cam_imu of the config,
            and no time offset is to be estimated.
        bias_spacing: knot spacing of biases that change over time, s; constant by default.
        pixel_sigma: standard deviation of a coordinate of a corner, px.
        reweigh: weight each sensor by what its residuals turn out to be, so that standard deviations are realistic.
        max_offset: how far the clocks may be apart, s, beyond a timeshift_cam_imu of the config.
        start: seconds after the first image at which to begin.
        duration: how much of the recording to use, s.
    """
    if not (math.isfinite(spacing) and spacing > 0):
        raise ValueError(f"spacing: expected a finite number above zero (ms), got {spacing}")
    if not 0 <= start < MOST_SECONDS:
        raise ValueError(f"start: expected seconds, zero or more, got {start}")
    if not duration > 0:
        raise ValueError(f"duration: expected seconds above zero, got {duration}")
    recording = read_recording(config, corners, imu)
    if start > 0 or math.isfinite(duration):
        # Whatever is there: no recording of a calibration lasts a day.
        recording = recording.between(start, start + min(duration, 86400.0))
    chosen = {
        "time_offset": not synchronised,
        "intrinsics": estimate_intrinsics,
        "line_delay": estimate_line_delay,
        "imu_scaling": estimate_imu_scaling,
    }
    if synchronised:
        known = recording.time_offset or (None,) * len(recording.cameras)
        recording = replace(recording, time_offset=tuple(x or 0.0 for x in known))
    begin = perf_counter()
    first = find_start(recording, max_offset=max_offset)
    if synchronised:
        first = with_known_offsets(first, recording)
    found_after = perf_counter() - begin
    found = calibrate(
        recording,
        first,
        order=order,
        spacing=spacing * 1e-3,
        representation=representation,
        estimate=[name for name, wanted in chosen.items() if wanted],
        bias_spacing=bias_spacing,
        pixel_sigma=pixel_sigma,
        reweigh=reweigh,
        progress=True,
    )
    seconds = {**found.seconds, "start": found_after, "total": found_after + found.seconds["total"]}
    found = replace(found, seconds=seconds)
    warnings = write_calibration(out, found)
    notes = [*found.notes, *(f"warning: {warning}" for warning in warnings)]
    values = json.loads((out / "result.json").read_text(encoding="utf-8"))
    files = [out / name for name in FILES]
    columns = ("", "estimate", "standard deviation", "unit")
    return Report("camera-IMU calibration", values, rows(found), notes, files, columns=columns)


def rows(found: Calibration) -> list[tuple[str, ...]]:
    """Estimates with standard deviations, and residuals: rows of the table."""
    made: list[tuple[str, ...]] = []

    def add(name: str, value: list[float], sigma: list[float] | None, unit: str, digits: int) -> None:
        deviations = "" if sigma is None else " ".join(f"{x:.2g}" for x in sigma)
        made.append((name, " ".join(f"{x:+.{digits}f}" for x in value), deviations, unit))

    for i, camera in enumerate(found.cameras):
        pose, sigma = camera.T_imu_cam.tolist(), camera.T_imu_cam_sigma.tolist()
        # Values are in the frame of the IMU, deviations in that of the camera: not in one row.
        add(f"T_imu_cam{i} position x y z", pose[:3], None, "m", 5)
        add(f"T_imu_cam{i} quaternion w x y z", pose[3:], None, "", 6)
        add(f"position of {camera.name}, error along its x y z", [], sigma[:3], "m", 5)
        add(f"rotation of {camera.name}, error about its x y z", [], sigma[3:], "rad", 6)
        deviation = None if camera.time_offset_sigma is None else [1e3 * camera.time_offset_sigma]
        add(f"time offset of {camera.name}", [1e3 * camera.time_offset], deviation, "ms", 4)
        if camera.intrinsics_sigma is not None:
            both = camera.intrinsics.tolist(), camera.intrinsics_sigma.tolist()
            add(f"intrinsics of {camera.name}", both[0][:4], both[1][:4], "px", 3)
            add(f"distortion of {camera.name}", both[0][4:], both[1][4:], "", 6)
        if camera.line_delay is not None:
            deviation = None if camera.line_delay_sigma is None else [1e6 * camera.line_delay_sigma]
            add(f"line delay of {camera.name}", [1e6 * camera.line_delay], deviation, "µs", 4)
    for imu in found.imus:
        for name, value, deviations, unit in (
            ("gyroscope bias", imu.gyro_bias, imu.gyro_bias_sigma, "rad/s"),
            ("accelerometer bias", imu.accel_bias, imu.accel_bias_sigma, "m/s²"),
        ):
            if value.ndim == 1:
                add(f"{name} of {imu.name}", value.tolist(), deviations.tolist(), unit, 5)
    add("gravity on the board", found.gravity.tolist(), None, "m/s²", 4)
    for camera in found.cameras:
        made.append((f"{camera.name}: median error", f"{camera.residuals.median_length:.3f}", "", "px"))
    for imu in found.imus:
        for residuals in (imu.gyroscope, imu.accelerometer):
            rms = float(residuals.values.square().mean().sqrt())
            made.append((f"{residuals.name}: RMS of an axis", f"{rms:.4f}", "", residuals.unit))
    made.append(("time from nothing to result", f"{found.seconds['total']:.2f}", "", "s"))
    return made
