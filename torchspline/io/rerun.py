"""Recordings for the viewer of rerun (.rrd), through the package rerun-sdk."""

from collections.abc import Mapping
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline import checks
from torchspline.io.archive import check_folder, replacing
from torchspline.io.records import ImuRecord, PoseRecord
from torchspline.io.trajectory import even_times
from torchspline.splines import Trajectory
from torchspline.units import SECOND

#: The one clock of a recording.
TIMELINE = "time"
#: Stamps from here on (ns, the year 1973) are dates, earlier ones times since some start.
_DATES = 100_000_000 * SECOND


def write_rerun(
    path: str | PathLike[str], records: Mapping[str, PoseRecord | ImuRecord | Trajectory], rate: float = 100.0
) -> None:
    """Write a recording that `rerun FILE` shows: moving frames, their paths, velocities and IMU readings over time.

    For each name: `world/NAME` is the frame as it moves, `paths/NAME` where it goes; `velocity/NAME` (m/s, in the
    world) and `angular_velocity/NAME` (rad/s, in the body) are there for trajectories, `gyroscope/NAME` (rad/s) and
    `accelerometer/NAME` (m/s^2) for IMU readings. Stamps are exact, series float64; the viewer has poses in float32.
    Poses that are not finite are left out. An existing file is replaced, whole or not at all.

    Args:
        path: the file; .rrd is usual.
        records: by name, such as `{"body": trajectory, "imu0": samples}`, on one clock.
        rate: at which trajectories are sampled, Hz.
    Raises:
        FileNotFoundError: the folder of `path` does not exist.
        ImportError: the package rerun-sdk is not installed.
        ValueError: no records, an empty one, or a trajectory without positions.
    """
    if not isinstance(path, (str, PathLike)):
        raise TypeError(f"path: expected a path, got {type(path).__name__}")
    checks.positive("rate", rate)
    series = {name: _series(name, x, rate) for name, x in _checked(records).items()}
    check_folder(Path(path))
    rr = _library()
    first = min(int(stamps.min()) for stamps, _ in series.values())
    # In memory, since the library's own writing to files neither says nor notices that a disk is full.
    with rr.RecordingStream("torchspline") as stream:
        memory = stream.memory_recording()
        for name, (stamps, columns) in series.items():
            _log(rr, stream, name, _clock(rr, stamps, dates=first >= _DATES), columns)
        content = memory.drain_as_bytes()
    with replacing(Path(path)) as part:
        part.write_bytes(content)


def _checked(records: Any) -> Mapping[str, Any]:
    if not isinstance(records, Mapping):
        raise TypeError(f"records: expected a mapping of names to records, got {type(records).__name__}")
    if not records:
        raise ValueError("records: expected at least one record, got none")
    for name, record in records.items():
        checks.instance("records", name, str, "names that are words")
        if not isinstance(record, (PoseRecord, ImuRecord, Trajectory)):
            got = type(record).__name__
            raise TypeError(
                f"records[{name!r}]: expected a PoseRecord, an ImuRecord or a trajectory, got {got}"
            )
        if not isinstance(record, Trajectory) and len(record) == 0:
            raise ValueError(f"records[{name!r}]: expected rows to write, got an empty record")
    return records


def _series(
    name: str, record: PoseRecord | ImuRecord | Trajectory, rate: float
) -> tuple[Tensor, dict[str, Tensor]]:
    """Stamps, and what there is at them."""
    if isinstance(record, ImuRecord):
        return record.time_ns, {"gyroscope": record.gyroscope, "accelerometer": record.accelerometer}
    if isinstance(record, PoseRecord):
        finite = record.position.isfinite().all(-1) & record.rotation.isfinite().all(-1)
        if not bool(finite.any()):
            raise ValueError(f"records[{name!r}]: expected poses that are finite, got none")
        rows = record.position[finite], record.rotation[finite]
        return record.time_ns[finite], {"position": rows[0], "rotation": rows[1]}
    t, stamps = even_times(record, rate)
    with torch.no_grad():
        motion = record.kinematics(t)
    found = {key: x for key, x in motion._asdict().items() if x is not None and "acceleration" not in key}
    if "position" not in found or found["position"].ndim != 2:
        batch = found.get("position", stamps).ndim > 2
        got = "a batch of them" if batch else f"one of {record.group}"
        raise ValueError(f"records[{name!r}]: expected one trajectory with positions, got {got}")
    return stamps, found


def _log(rr: Any, stream: Any, name: str, clock: Any, columns: dict[str, Tensor]) -> None:
    def at(kind: str) -> str:
        return str(rr.new_entity_path([kind, *filter(None, name.split("/"))]))

    numbers: dict[str, NDArray[np.float64]] = {
        key: x.detach().to("cpu", torch.float64).numpy() for key, x in columns.items()
    }
    position, rotation = numbers.pop("position", None), numbers.pop("rotation", None)
    if position is not None:
        pose = {"translation": position}
        if rotation is not None:
            pose["quaternion"] = rotation[:, [1, 2, 3, 0]] / np.linalg.norm(rotation, axis=1, keepdims=True)
        extent = float(np.ptp(position, axis=0).max()) or 1.0
        stream.log(at("world"), rr.TransformAxes3D(extent / 20), static=True)
        stream.send_columns(at("world"), [clock], rr.Transform3D.columns(**pose))
        stream.log(at("paths"), rr.LineStrips3D([position.astype(np.float32)]), static=True)
    for key, x in numbers.items():
        stream.log(at(key), rr.SeriesLines(names=["x", "y", "z"]), static=True)
        scalars = rr.Scalars.columns(scalars=x.reshape(-1)).partition(np.full(len(x), x.shape[1]))
        stream.send_columns(at(key), [clock], scalars)


def _clock(rr: Any, stamps: Tensor, dates: bool) -> Any:
    t = stamps.cpu().numpy()
    if dates:
        return rr.TimeColumn(TIMELINE, timestamp=t.astype("datetime64[ns]"))
    return rr.TimeColumn(TIMELINE, duration=t.astype("timedelta64[ns]"))


def _library() -> Any:
    try:
        return import_module("rerun")
    except ImportError as reason:
        raise ImportError(
            f"recordings for rerun need the package rerun-sdk: pip install 'torchspline[rerun]' ({reason})"
        ) from None
