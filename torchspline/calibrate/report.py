"""A calibration's report to look at: one HTML file, figures included."""

import base64
import html
import math
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchspline.calibrate import figures
from torchspline.calibrate.coverage import Coverage
from torchspline.calibrate.estimate import CalibratedCamera, Calibration, SensorResiduals
from torchspline.groups.group import SO3

#: What the numbers of a calibration mean.
CONVENTIONS = {
    "T_a_b": "maps points of frame b into frame a; quaternions are [w, x, y, z]; translations are in m",
    "standard deviations": "of T_imu_cam: of a translation (m) and a rotation vector (rad), both in the frame of the "
    "camera; of T_imu0_imu: of the position in the first IMU (m) and of a rotation vector in the IMU itself (rad)",
    "time_offset": "s, t_imu = t_cam + time_offset, with the clock of the first IMU; between IMUs t_imu = t_imu0 + "
    "time_offset",
    "intrinsics": "fu, fv, pu, pv in pixels, then four coefficients of the distortion",
    "gravity": "acceleration vector in the frame of the board, m/s^2; its deviations are of two angles, rad",
    "residuals": "predicted minus measured",
}
_AXES = "xyz"
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 1120px; margin: 2em auto; padding: 0 1em; color: #222; }
h1 { font-size: 1.6em; } h2 { font-size: 1.2em; margin-top: 2em; border-bottom: 1px solid #ccc; }
table { border-collapse: collapse; margin: 0.8em 0; } img { max-width: 100%; }
th, td { padding: 0.2em 0.8em; border-bottom: 1px solid #e4e4e4; text-align: right; }
td { font-variant-numeric: tabular-nums; }
th:first-child, td:first-child { text-align: left; } th { background: #f5f5f5; }
.warnings { background: #fff4e0; border-left: 4px solid #e69f00; padding: 0.3em 1em; }
.fine { background: #e9f6ec; border-left: 4px solid #2a9d4a; padding: 0.3em 1em; }
.small { color: #666; font-size: 0.9em; }
"""


def page(calibration: Calibration, found: Coverage) -> str:
    """The text of an HTML file with everything in it, figures, too."""
    parts = [
        "<h1>Camera-IMU calibration</h1>",
        _summary(calibration, found),
        _remarks(calibration, found),
        "<h2>Cameras</h2>",
        *(_camera_table(camera, i) for i, camera in enumerate(calibration.cameras)),
        _between(calibration),
        "<h2>IMUs and gravity</h2>",
        _imu_table(calibration),
        "<h2>Residuals</h2>",
        "<p class=small>Predicted minus measured. σ is what a number was weighted with; where it differs from what was "
        "stated, it was estimated from the residuals.</p>",
        _residual_table(sensors(calibration)),
        _image(figures.residuals_over_time(calibration), "residuals over time"),
        _image(figures.residuals_over_image(calibration), "residuals over the image"),
        _image(figures.distributions(calibration), "distributions of residuals"),
        "<h2>Readings and trajectory</h2>",
        *(
            _image(figures.readings(calibration, j), f"readings of {imu.name}")
            for j, imu in enumerate(calibration.imus)
        ),
        _image(figures.motion(calibration), "motion"),
        _coverage_table(found),
        "<h2>Conventions</h2>",
        _table(["", ""], CONVENTIONS.items()),
        f"<p class=small>{_escape(_provenance(calibration))}</p>",
    ]
    body = "\n".join(part for part in parts if part)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>Camera-IMU calibration</title>'
        f"<style>{_STYLE}</style></head>\n<body>\n{body}\n</body></html>\n"
    )


def _summary(calibration: Calibration, found: Coverage) -> str:
    spline, result = calibration.trajectory, calibration.result
    spacing = "" if spline.dt_ns is None else f", knots {spline.dt_ns * 1e-6:g} ms apart"
    images = ", ".join(
        f"{int(camera.images.sum())} images and {len(camera.residuals.values)} corners of {camera.name}"
        for camera in calibration.cameras
    )
    imus = ", ".join(f"{len(imu.gyroscope.values)} readings of {imu.name}" for imu in calibration.imus)
    return (
        f"<p>{_escape(images)}; {_escape(imus)}; {found.duration:.1f} s. Trajectory: {_escape(spline.group)} spline of "
        f"order {spline.order}{spacing}, {spline.control_points.shape[-2]} control points. "
        f"{'Converged' if result.converged else '<b>Not converged</b>'} after {len(result.cost) - 1} iterations "
        f"({_escape(result.reason)}), {calibration.seconds['total']:.2f} s in all.</p>"
    )


def _remarks(calibration: Calibration, found: Coverage) -> str:
    parts = []
    if found.warnings:
        items = "".join(f"<li>{_escape(warning)}</li>" for warning in found.warnings)
        parts.append(f"<div class=warnings><p><b>Warnings</b></p><ul>{items}</ul></div>")
    else:
        parts.append(
            "<div class=fine><p>Motion and images cover what they have to; nothing is left open.</p></div>"
        )
    if calibration.notes:
        items = "".join(f"<li>{_escape(note)}</li>" for note in calibration.notes)
        parts.append(f"<p>Notes</p><ul>{items}</ul>")
    return "\n".join(parts)


def _camera_table(camera: CalibratedCamera, i: int) -> str:
    rotation = SO3.log(camera.T_imu_cam[3:])
    sigma = camera.T_imu_cam_sigma
    rows: list[tuple[str, float | None, float | None]] = [
        (f"T_imu_cam{i} position {a} [m]", x, None)
        for a, x in zip(_AXES, camera.T_imu_cam[:3].tolist(), strict=True)
    ]
    rows += [
        (f"T_imu_cam{i} rotation vector {a} [deg]", math.degrees(x), None)
        for a, x in zip(_AXES, rotation.tolist(), strict=True)
    ]
    rows += [
        (f"position error along the camera's {a} [m]", None, x)
        for a, x in zip(_AXES, sigma[:3].tolist(), strict=True)
    ]
    rows += [
        (f"rotation error about the camera's {a} [deg]", None, math.degrees(x))
        for a, x in zip(_AXES, sigma[3:].tolist(), strict=True)
    ]
    rows.append(("time offset [ms]", 1e3 * camera.time_offset, _times(camera.time_offset_sigma, 1e3)))
    if camera.line_delay is not None:
        rows.append(("line delay [µs]", 1e6 * camera.line_delay, _times(camera.line_delay_sigma, 1e6)))
    names = (
        "fu [px]",
        "fv [px]",
        "pu [px]",
        "pv [px]",
        "distortion 1",
        "distortion 2",
        "distortion 3",
        "distortion 4",
    )
    deviations = [None] * 8 if camera.intrinsics_sigma is None else camera.intrinsics_sigma.tolist()
    rows += list(zip(names, camera.intrinsics.tolist(), deviations, strict=True))
    return f"<h3>{_escape(camera.name)}</h3>" + _estimates(rows)


def _between(calibration: Calibration) -> str:
    rows: list[Sequence[Any]] = []
    for i in range(1, len(calibration.cameras)):
        pose = calibration.T_cam_cam(i, i - 1)
        angle = SO3.log(pose[3:])
        degrees = [f"{math.degrees(x):.4f}" for x in angle.tolist()]
        rows.append((f"T_cam{i}_cam{i - 1}", *(f"{x:.5f}" for x in pose[:3].tolist()), *degrees))
    header = ["", *(f"{a} [m]" for a in _AXES), *(f"rotation {a} [deg]" for a in _AXES)]
    return f"<h3>From camera to camera</h3>{_table(header, rows)}" if rows else ""


def _imu_table(calibration: Calibration) -> str:
    rows: list[tuple[str, float | None, float | None]] = []
    for j, imu in enumerate(calibration.imus):
        for what, unit, value, sigma in (
            ("gyroscope bias", "rad/s", imu.gyro_bias, imu.gyro_bias_sigma),
            ("accelerometer bias", "m/s²", imu.accel_bias, imu.accel_bias_sigma),
        ):
            varies = value.ndim > 1
            # Control points of a spline: those at its ends know least.
            value, sigma = (x[len(x) // 2] if varies else x for x in (value, sigma))
            label = f"{imu.name} {what}{', in the middle of the recording' if varies else ''}"
            rows += [
                (f"{label} {a} [{unit}]", x, y)
                for a, x, y in zip(_AXES, value.tolist(), sigma.tolist(), strict=True)
            ]
        for name in ("gyro_scaling", "accel_scaling"):
            if (scaling := getattr(imu, name)) is not None:
                sigmas = getattr(imu, f"{name}_sigma").reshape(-1).tolist()
                rows += [
                    (f"{imu.name} {name} {_AXES[k // 3]}{_AXES[k % 3]}", x, sigmas[k])
                    for k, x in enumerate(scaling.reshape(-1).tolist())
                ]
        if j:
            deviation = [None] * 6 if imu.T_imu0_imu_sigma is None else imu.T_imu0_imu_sigma.tolist()
            turn = SO3.log(imu.T_imu0_imu[3:])
            for k, a in enumerate(_AXES):
                rows.append((f"{imu.name} position {a} in imu0 [m]", float(imu.T_imu0_imu[k]), deviation[k]))
            for k, a in enumerate(_AXES):
                rows.append((f"{imu.name} rotation vector {a} [deg]", math.degrees(float(turn[k])),
                             _times(deviation[3 + k], math.degrees(1.0))))  # fmt: skip
            rows.append(
                (f"{imu.name} time offset [ms]", 1e3 * imu.time_offset, _times(imu.time_offset_sigma, 1e3))
            )
    rows += [
        (f"gravity {a} on the board [m/s²]", x, None)
        for a, x in zip(_AXES, calibration.gravity.tolist(), strict=True)
    ]
    worst = math.degrees(float(calibration.gravity_sigma.max()))
    rows.append(("direction of gravity [deg]", None, worst))
    return _estimates(rows)


def _residual_table(found: Sequence[SensorResiduals]) -> str:
    rows = []
    for x in found:
        rows.append(
            (
                x.name, x.unit, str(len(x.values)), str(int((~x.used).sum())),
                " ".join(f"{y:+.2g}" for y in x.mean.tolist()), " ".join(f"{y:.3g}" for y in x.rms.tolist()),
                f"{x.median_length:.3g}", f"{float(x.values.norm(dim=1).max()):.3g}", f"{x.sigma:.3g}",
                f"{x.stated:.3g}",
            )
        )  # fmt: skip
    header = ["", "unit", "used", "unused", "mean", "RMS", "median length", "largest", "σ", "σ stated"]
    return _table(header, rows)


def _coverage_table(found: Coverage) -> str:
    rows = [
        ("angular velocity, RMS about x y z of the first IMU [rad/s]", _three(found.angular_velocity)),
        ("acceleration, RMS along x y z of the first IMU [m/s²]", _three(found.acceleration)),
        ("largest tilt of the IMU against gravity [deg]", f"{math.degrees(found.tilt):.0f}"),
    ]
    for image in found.cameras:
        near, far = image.distance
        rows += [
            (f"{image.name}: share of the image with corners", f"{image.covered:.0%}"),
            (f"{image.name}: distance of the board [m]", f"{near:.2f} to {far:.2f}"),
            (f"{image.name}: tilt of the board [deg]", f"up to {math.degrees(image.tilt):.0f}"),
        ]
    return _table(["coverage", ""], rows)


def _provenance(calibration: Calibration) -> str:
    import platform

    recording = calibration.recording
    sources = [x.source for x in recording.corners] + [x.source for x in recording.imus]
    phases = ", ".join(f"{name} {value:.2f} s" for name, value in calibration.seconds.items())
    return (
        f"From {', '.join(filter(None, sources)) or 'memory'}. {phases}. PyTorch {torch.__version__}, "
        f"Python {platform.python_version()}."
    )


def _estimates(rows: Iterable[tuple[str, float | None, float | None]]) -> str:
    def cells(value: float | None, sigma: float | None) -> tuple[str, str]:
        if sigma is None or not math.isfinite(sigma) or sigma <= 0:
            return ("" if value is None else f"{value:.7g}"), "" if sigma is None else f"{sigma:.2g}"
        # As many digits of the value as its deviation makes sense of, and one more.
        digits = max(0, 2 - math.floor(math.log10(sigma)))
        return ("" if value is None else f"{value:.{min(digits, 12)}f}"), f"{sigma:.2g}"

    return _table(["", "estimate", "standard deviation"], [(name, *cells(x, s)) for name, x, s in rows])


def _times(x: float | None, factor: float) -> float | None:
    return None if x is None else factor * x


def _three(x: Tensor) -> str:
    return " ".join(f"{y:.3g}" for y in x.tolist())


def _table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    head = "".join(f"<th>{_escape(x)}</th>" for x in header)
    body = "\n".join("<tr>" + "".join(f"<td>{_escape(x)}</td>" for x in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>\n{body}</table>"


def _image(png: bytes, title: str) -> str:
    return f'<p><img alt="{_escape(title)}" src="data:image/png;base64,{base64.b64encode(png).decode()}"></p>'


def _escape(x: Any) -> str:
    return html.escape(str(x))


def sensors(calibration: Calibration) -> list[SensorResiduals]:
    """Residuals of all cameras, gyroscopes and accelerometers."""
    found = [camera.residuals for camera in calibration.cameras]
    for imu in calibration.imus:
        found += [imu.gyroscope, imu.accelerometer]
    return found
