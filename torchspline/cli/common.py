"""What several commands do."""

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.figure import Figure
from torch import Tensor

from torchspline.fit import PoseFit
from torchspline.imu import ImuReading
from torchspline.io import ImuRecord, PoseRecord, write_imu, write_poses
from torchspline.io.archive import replacing, write_bytes
from torchspline.splines import Trajectory
from torchspline.units import SECOND

#: Longer than any recording, s: stamps are 64 bits of nanoseconds.
MOST_SECONDS = 9e9


def longest_stretch(record: PoseRecord, gap: float | None, start: float, duration: float) -> PoseRecord:
    """The longest run of usable poses without a larger gap, cut to `start` and `duration`."""
    usable = record.position.isfinite().all(-1) & record.rotation.isfinite().all(-1)
    rows = torch.argsort(record.time_ns, stable=True)
    rows = rows[usable[rows]]
    record = PoseRecord(record.time_ns[rows], record.position[rows], record.rotation[rows], record.source)
    time = record.time_ns.unique()
    if len(time) < 2:
        raise ValueError(
            f"poses: {record.source} has {len(time)} usable poses at distinct times; two are needed"
        )
    steps = time.diff()
    median = steps.to(torch.float64).median().item()
    if gap is not None and not gap > 0:
        raise ValueError(f"gap: expected milliseconds above zero, got {gap}")
    largest = max(0.03 * SECOND, 3 * median) if gap is None else gap * 1e6
    edges = [0, *(torch.nonzero(steps > largest).flatten() + 1).tolist(), len(time)]
    low, high = max(
        ((int(time[a]), int(time[b - 1])) for a, b in pairwise(edges)),
        key=lambda stretch: stretch[1] - stretch[0],
    )
    if not 0 <= start < MOST_SECONDS:
        raise ValueError(f"start: expected seconds, zero or more, got {start}")
    if not duration > 0:
        raise ValueError(f"duration: expected seconds above zero, got {duration}")
    low += round(start * SECOND)
    if duration < MOST_SECONDS:
        high = min(high, low + round(duration * SECOND))
    if low >= high:
        raise ValueError(
            f"start, duration: nothing is left of the longest stretch without a gap ({start=}, {duration=})"
        )
    return record.window(low, high)


def excerpt(stamps: Tensor, reading: ImuReading, shown: Tensor, origin: int) -> tuple[Tensor, ImuReading]:
    """Seconds since `origin` and readings of the samples `shown`."""
    return (stamps[shown] - origin) / SECOND, ImuReading(*(x[shown] for x in reading))


def rmse(made: ImuReading, gyroscope: Tensor, accelerometer: Tensor) -> tuple[float, float]:
    """Pooled over samples and axes."""
    pairs = ((made.gyroscope, gyroscope), (made.accelerometer, accelerometer))
    first, second = (math.sqrt((a - b).square().mean().item()) for a, b in pairs)
    return first, second


def fit_rows(fit: PoseFit, dt: float) -> list[tuple[str, str, str]]:
    """Rows of a report on a fit with knots `dt` seconds apart."""
    position, rotation = fit.rms()
    points = fit.trajectory.control_points.shape[-2]
    return [
        ("knot spacing", f"{dt * 1e3:.4g}", "ms"),
        ("spline", f"{fit.trajectory.group}, order {fit.trajectory.order}, {points} control points", ""),
        ("pose residual, RMS", f"{position * 1e3:.4f} / {rotation * 1e3:.4f}", "mm / mrad"),
    ]


def fit_report(fit: PoseFit, dt: float) -> dict[str, Any]:
    """The same for scripts."""
    position, rotation = fit.rms()
    return {
        "group": str(fit.trajectory.group),
        "order": fit.trajectory.order,
        "knot_spacing_s": dt,
        "control_points": fit.trajectory.control_points.shape[-2],
        "position_residual_rms_m": position,
        "rotation_residual_rms_rad": rotation,
        "iterations": len(fit.cost) - 1,
        "stopped": fit.reason,
        "notes": fit.notes,
    }


def check_figure(name: str, path: Path) -> None:
    """Whether Matplotlib can draw into a file of this name."""
    kinds = FigureCanvasBase.get_supported_filetypes()
    if path.suffix and path.suffix[1:].lower() not in kinds:
        raise ValueError(f"{name}: expected a name that ends with .png, .pdf or .svg, got {path}")


def save_figure(path: Path, figure: Figure, dpi: int = 130) -> None:
    """Draw a figure into a file (png, pdf, svg), whole or not at all."""
    with replacing(path) as part:
        figure.savefig(part, dpi=dpi, format=path.suffix[1:] or "png")


def write_report(path: Path, values: dict[str, Any]) -> None:
    """What scripts read, as JSON."""
    write_bytes(path, (json.dumps(values, indent=2) + "\n").encode())


def write_results(out: Path, trajectory: Trajectory, stamps: Tensor, made: ImuReading) -> None:
    """Poses and readings at `stamps`, into a folder."""
    with torch.no_grad():
        motion = trajectory.kinematics(stamps)
    assert motion.position is not None
    assert motion.rotation is not None
    write_poses(out / "trajectory.txt", PoseRecord(stamps, motion.position, motion.rotation, "torchspline"))
    write_imu(out / "imu.csv", ImuRecord(stamps, made.gyroscope, made.accelerometer, "torchspline"))
