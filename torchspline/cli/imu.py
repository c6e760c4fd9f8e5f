"""`torchspline imu`."""

import math
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from torchspline.cli.common import (
    MOST_SECONDS,
    excerpt,
    fit_report,
    fit_rows,
    longest_stretch,
    rmse,
    save_figure,
    write_report,
    write_results,
)
from torchspline.cli.files import PoseFormat, check_outputs, open_poses, seconds_of
from torchspline.cli.report import Report
from torchspline.fit import fit_poses
from torchspline.imu import STANDARD_GRAVITY, ImuReading, measure
from torchspline.io import ImuRecord, read_imu
from torchspline.io.archive import replacing
from torchspline.plot import imu_comparison
from torchspline.units import SECOND

EXAMPLES = """
torchspline imu poses.txt --rate 200 --out DIR
torchspline imu mocap0 --recorded imu0 --spacing 80
torchspline imu drive.bag --topic /odom --recorded drive.bag --recorded-topic /imu/data
torchspline imu kitti_00.txt --times times.txt --gravity "[0, 9.80665, 0]"
"""


def imu(
    poses: Path,
    recorded: Path | None = None,
    rate: float = 200.0,
    out: Path = Path("torchspline-imu"),
    spacing: float | None = None,
    order: int = 6,
    representation: Literal["split", "joint"] = "split",
    gravity: tuple[float, float, float] = STANDARD_GRAVITY,
    gap: float | None = None,
    start: float = 0.0,
    duration: float = math.inf,
    margin: float = 0.3,
    format: PoseFormat | None = None,
    times: Path | None = None,
    topic: str | None = None,
    child: str | None = None,
    recorded_topic: str | None = None,
) -> Report:
    """IMU readings from a file of poses, compared with a recording if there is one.

    Args:
        poses: TUM, EuRoC, KITTI or nerfstudio file, gzipped or not, or ROS bag: poses of the IMU's frame; - is
            standard input.
        recorded: EuRoC IMU file or ROS bag on the same clock. Constant biases are estimated and removed before
            comparing.
        rate: of the synthesised readings, Hz.
        out: folder for the results; made if it is not there.
        spacing: of the knots, ms; by default five median pose intervals. A wrong one costs accuracy.
        order: of the spline; the curve has order - 2 continuous derivatives.
        representation: split (R3 x SO3) or joint (SE3).
        gravity: acceleration in the world of the poses, m/s²; KITTI's y axis points down: [0, 9.80665, 0].
        gap: the longest stretch without poses that is bridged, ms; by default 30, or three median pose intervals
            if that is more. The longest stretch without a larger gap is used.
        start: offset into that stretch, s.
        duration: how much of it to use, s.
        margin: left out at both ends, where a spline knows least, s.
        format: of the poses; by default recognised from their content.
        times: file of times that goes with KITTI poses.
        topic: of the poses in a ROS bag; needed where it has several.
        child: frame of the transforms in that topic; needed where it has several.
        recorded_topic: of the recording in a ROS bag; needed where it has several.
    """
    if not (math.isfinite(rate) and rate > 0):
        raise ValueError(f"rate: expected a finite number above zero (Hz), got {rate}")
    if not 0 <= margin < MOST_SECONDS:
        raise ValueError(f"margin: expected seconds, zero or more, got {margin}")
    names = ["trajectory.txt", "imu.csv", "imu.png", "report.json"]
    if recorded is not None:
        names.append("comparison.csv")
    files = [out / name for name in names]
    if out.is_dir():
        check_outputs([poses, recorded, times], [("out", file) for file in files])
    elif out.exists():
        raise ValueError(f"out: expected a folder, got the file {out}")
    record = open_poses(poses, format, times, topic, child)
    recording = None if recorded is None else read_imu(recorded, topic=recorded_topic)
    record = longest_stretch(record, gap, start, duration)
    interval = record.time_ns.unique().diff().to(torch.float64).median().item() / SECOND
    dt = 5 * interval if spacing is None else seconds_of(spacing)
    fit = fit_poses(
        record.time_ns,
        torch.cat([record.position, record.rotation], -1),
        dt=dt,
        order=order,
        representation=representation,
    )
    first, last = int(record.time_ns[0]), int(record.time_ns[-1])
    low, high = first + round(margin * SECOND), last - round(margin * SECOND)
    if low >= high:
        raise ValueError(
            f"margin: nothing is left of {(last - first) / SECOND:.3g} s between margins of {margin} s"
        )
    if (high - low) / SECOND * rate > 1e9:
        raise ValueError(f"rate: {rate:g} Hz over {(high - low) / SECOND:g} s makes more than 1e9 readings")
    steps = torch.arange(int((high - low) / SECOND * rate) + 1, dtype=torch.float64)
    stamps = low + (steps * (SECOND / rate)).round().to(torch.int64)
    with torch.no_grad():
        made = measure(fit.trajectory, stamps, gravity)

    rows = [
        ("poses used", f"{len(record)} over {(last - first) / SECOND:.2f} s", ""),
        *fit_rows(fit, dt),
        ("readings synthesised", f"{len(stamps)} at {rate:g} Hz", ""),
    ]
    report: dict = {"fit": fit_report(fit, dt), "window_ns": [first, last]}
    title = f"{poses.name}: {representation} spline of order {order}, knots {dt * 1e3:.4g} ms apart"
    shown = stamps < low + 10 * SECOND
    lines, dots = excerpt(stamps, made, shown, first), None
    compared = None
    if recording is not None:
        within = recording.window(low, high)
        if len(within) == 0:
            raise ValueError(
                f"recorded: {recorded} has no reading between {low} and {high} ns, where the poses are"
            )
        with torch.no_grad():
            here = measure(fit.trajectory, within.time_ns, gravity)
        bias = (
            (within.gyroscope - here.gyroscope).mean(0),
            (within.accelerometer - here.accelerometer).mean(0),
        )
        biased = ImuReading(here.gyroscope + bias[0], here.accelerometer + bias[1])
        errors = rmse(biased, within.gyroscope, within.accelerometer)
        report |= {
            "gyroscope_rmse_rad_s": errors[0],
            "accelerometer_rmse_m_s2": errors[1],
            "gyroscope_bias_rad_s": bias[0].tolist(),
            "accelerometer_bias_m_s2": bias[1].tolist(),
            "readings_compared": len(within),
        }
        rows += [
            ("readings compared", str(len(within)), ""),
            ("gyroscope bias", _three(bias[0]), "rad/s"),
            ("accelerometer bias", _three(bias[1]), "m/s²"),
            ("gyroscope RMSE", f"{errors[0]:.4f}", "rad/s"),
            ("accelerometer RMSE", f"{errors[1]:.4f}", "m/s²"),
        ]
        early = within.time_ns < low + 10 * SECOND
        lines = lines[0], ImuReading(lines[1].gyroscope + bias[0], lines[1].accelerometer + bias[1])
        dots = excerpt(within.time_ns, ImuReading(within.gyroscope, within.accelerometer), early, first)
        compared = within, biased
    out.mkdir(parents=True, exist_ok=True)  # by now nothing can be wrong with what is asked
    if compared is not None:
        _write_comparison(out / "comparison.csv", *compared)
    write_results(out, fit.trajectory, stamps, made)
    save_figure(out / "imu.png", imu_comparison(lines, dots, title))
    write_report(out / "report.json", report)
    return Report(f"IMU from {poses.name}", report, rows, fit.notes, files)


def _write_comparison(path: Path, recorded: ImuRecord, made: ImuReading) -> None:
    """Recorded and synthesised readings side by side."""
    import numpy as np

    names = [
        f"{sensor}_{kind}_{axis}"
        for kind in ("recorded", "synthesised")
        for sensor in ("w", "a")
        for axis in "xyz"
    ]
    columns = torch.cat([recorded.gyroscope, recorded.accelerometer, made.gyroscope, made.accelerometer], -1)
    rows = np.column_stack([recorded.time_ns.numpy().astype(object), columns.numpy()])
    header = ",".join(["timestamp_ns", *names])
    with replacing(path) as part:
        np.savetxt(part, rows, delimiter=",", fmt=["%d", *["%.9g"] * len(names)], header=header, comments="")


def _three(x: Tensor) -> str:
    return " ".join(f"{v:+.4f}" for v in x.tolist())
