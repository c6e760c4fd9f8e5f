"""`torchspline info`."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchspline.cli.files import PoseFormat, is_trajectory, open_record
from torchspline.cli.report import Report
from torchspline.io import ImuRecord, PoseRecord, load_trajectory
from torchspline.splines import Trajectory
from torchspline.units import SECOND

EXAMPLES = """
torchspline info poses.txt
torchspline info V1_02_medium/imu0/data.csv --json
torchspline info motion.npz
gunzip -c poses.txt.gz | torchspline info -
torchspline info drive.bag --topic /imu/data
"""


def info(
    file: Path,
    format: PoseFormat | None = None,
    times: Path | None = None,
    topic: str | None = None,
    child: str | None = None,
) -> Report:
    """What is in a file: kind, rows, rate, gaps, duration, range of the numbers and their units.

    Args:
        file: poses (TUM, EuRoC, KITTI, nerfstudio, the root of BVH), IMU readings (EuRoC), a ROS bag, or a saved
            trajectory; - is standard input.
        format: by default recognised from the content.
        times: file of times that goes with KITTI poses.
        topic: of a ROS bag; needed where it has several.
        child: frame of the transforms in that topic; needed where it has several.
    """
    if is_trajectory(file):
        values, rows = _of_trajectory(load_trajectory(file))
        return Report(str(file), {"kind": "trajectory", **values}, [("kind", "trajectory", ""), *rows])
    record = open_record(file, format, times, topic, child)
    kind = "poses" if isinstance(record, PoseRecord) else "IMU readings"
    values, rows, notes = _of_record(record)
    return Report(str(file), {"kind": kind, **values}, [("kind", kind, ""), *rows], notes)


def _of_record(
    record: PoseRecord | ImuRecord,
) -> tuple[dict[str, Any], list[tuple[str, str, str]], list[str]]:
    stamps = record.time_ns
    bad = torch.zeros(len(stamps), dtype=torch.bool)
    if isinstance(record, PoseRecord):
        columns = {"position": (record.position, "m")}
        bad |= ~record.rotation.isfinite().all(-1)
    else:
        columns = {
            "gyroscope": (record.gyroscope, "rad/s"),
            "accelerometer": (record.accelerometer, "m/s²"),
        }
    for x, _ in columns.values():
        bad |= ~x.isfinite().all(-1)
    distinct = stamps.unique()
    steps = distinct.diff().double() / SECOND
    interval = float(steps.median()) if len(steps) else float("nan")
    gaps = steps[steps > 3 * interval]
    span = (int(distinct[-1]) - int(distinct[0])) / SECOND if len(distinct) else 0.0
    values: dict[str, Any] = {
        "rows": len(stamps),
        "first_ns": int(distinct[0]) if len(distinct) else None,
        "last_ns": int(distinct[-1]) if len(distinct) else None,
        "duration_s": span,
        "rate_hz": 1.0 / interval,
        "gaps": len(gaps),
        "longest_gap_s": float(gaps.max()) if len(gaps) else 0.0,
        "rows_with_nan": int(bad.sum()),
        "repeated_stamps": len(stamps) - len(distinct),
        "in_order": bool((stamps.diff() >= 0).all()),
    }
    rows = [
        ("rows", f"{len(stamps)}", ""),
        ("first stamp", f"{values['first_ns']}", "ns"),
        ("duration", f"{span:.6g}", "s"),
        ("rate (median)", f"{values['rate_hz']:.6g}", "Hz"),
        ("gaps (over 3 intervals)", f"{len(gaps)}, the longest {values['longest_gap_s']:.3g}", "s"),
    ]
    for name, (x, unit) in columns.items():
        good = x[~bad]
        low, high = (_row(good.amin(0)), _row(good.amax(0))) if len(good) else ("none", "none")
        rows += [(f"{name}, smallest", low, unit), (f"{name}, largest", high, unit)]
        values |= (
            {f"{name}_min": good.amin(0).tolist(), f"{name}_max": good.amax(0).tolist()} if len(good) else {}
        )
    if isinstance(record, PoseRecord):
        ordered = record.position[torch.argsort(stamps, stable=True)]
        ordered = ordered[ordered.isfinite().all(-1)]
        values["path_length_m"] = float(ordered.diff(dim=0).norm(dim=-1).sum())
        rows.append(("length of the path", f"{values['path_length_m']:.6g}", "m"))
    notes = []
    if values["rows_with_nan"]:
        notes.append(f"{values['rows_with_nan']} rows have numbers that are not finite")
    if values["repeated_stamps"]:
        notes.append(f"{values['repeated_stamps']} rows share their stamp with another")
    if not values["in_order"]:
        notes.append("the stamps are not in order")
    return values, rows, notes


def _of_trajectory(trajectory: Trajectory) -> tuple[dict[str, Any], list[tuple[str, str, str]]]:
    first, last = trajectory.domain
    nanoseconds = isinstance(first, int)
    unit = "ns" if nanoseconds else "s"
    span = (last - first) / (SECOND if nanoseconds else 1)
    tensors = [*trajectory.named_parameters(), *trajectory.named_buffers()]
    values: dict[str, Any] = {
        "family": type(trajectory).__name__,
        "group": trajectory.group.name,
        "domain": [first, last],
        "time_unit": unit,
        "duration_s": span,
        "tensors": {name: list(x.shape) for name, x in tensors},
    }
    rows = [
        ("family", values["family"], ""),
        ("group", values["group"], ""),
        ("domain", f"{first} to {last}", unit),
        ("duration", f"{span:.6g}", "s"),
    ]
    order = getattr(trajectory, "order", None)
    if order is not None:
        values["order"] = order
        rows.append(("order", str(order), ""))
    rows += [(name, "x".join(map(str, shape)) or "1", "numbers") for name, shape in values["tensors"].items()]
    return values, rows


def _row(x: Tensor) -> str:
    return " ".join(f"{v:.6g}" for v in x.tolist())
