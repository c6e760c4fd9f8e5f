"""Opening what the commands are given: files of poses and saved trajectories."""

import zipfile
from pathlib import Path
from typing import Literal

import torch

from torchspline.cli.common import longest_stretch
from torchspline.fit import PoseFit, fit_poses
from torchspline.io import PoseRecord, read_nerfstudio, read_poses
from torchspline.splines import Trajectory
from torchspline.units import SECOND

PoseFormat = Literal["tum", "euroc", "kitti", "ros", "nerfstudio"]


def is_trajectory(path: Path) -> bool:
    """Whether it may be a file of `torchspline.io.save_trajectory`."""
    return path.suffix == ".npz" or (path.is_file() and zipfile.is_zipfile(path))


def named_after(path: Path, suffix: str) -> Path:
    """The default name of what is made of a file: in the working folder, since that of data may not be ours."""
    return Path(path.resolve().name.removesuffix(".gz").rsplit(".", 1)[0] + suffix)


def open_poses(
    path: Path, format: PoseFormat | None = None, times: Path | None = None, topic: str | None = None
) -> PoseRecord:
    """Poses from a file of any format that has them."""
    if format == "nerfstudio" or (format is None and path.suffix == ".json"):
        return read_nerfstudio(path)
    return read_poses(path, format, times, topic)


def fitted(
    record: PoseRecord,
    spacing: float | Literal["auto"] = "auto",
    order: int = 6,
    representation: Literal["split", "joint"] = "split",
    gap: float | None = None,
    start: float = 0.0,
    duration: float = float("inf"),
) -> tuple[PoseRecord, PoseFit]:
    """The poses used and the spline through them; see the command `fit` for the arguments."""
    used = longest_stretch(record, gap, start, duration)
    poses = torch.cat([used.position, used.rotation], -1)
    dt: float | Literal["auto"] = "auto"
    if not isinstance(spacing, str):
        if not 0 < spacing < float("inf"):
            raise ValueError(f"spacing: expected a finite number above zero (ms) or auto, got {spacing}")
        dt = spacing * 1e-3
    return used, fit_poses(used.time_ns, poses, dt=dt, order=order, representation=representation)


def sampled(trajectory: Trajectory, rate: float, source: str) -> PoseRecord:
    """Poses of a trajectory, `rate` a second, on nanosecond stamps."""
    if not 0 < rate < float("inf"):
        raise ValueError(f"rate: expected a finite number above zero (Hz), got {rate}")
    first, last = trajectory.domain
    nanoseconds = isinstance(first, int)
    span = (last - first) / (SECOND if nanoseconds else 1)
    if span * rate > 1e8:
        raise ValueError(f"rate: {rate:g} Hz over {span:g} s makes more than 1e8 poses")
    steps = torch.arange(int(span * rate + 1e-9) + 1, dtype=torch.float64) / rate
    stamps = (steps * SECOND).round().to(torch.int64)
    t = first + stamps.clamp(max=last - first) if nanoseconds else (first + steps).clamp(first, last)
    with torch.no_grad():
        motion = trajectory.kinematics(t)
    if motion.position is None or motion.position.ndim != 2:
        raise ValueError(f"{source}: expected one trajectory with positions, got {trajectory.group}")
    rotation = motion.rotation
    if rotation is None:
        rotation = torch.zeros(len(t), 4, dtype=torch.float64)
        rotation[:, 0] = 1.0
    if not nanoseconds:
        stamps = round(first * SECOND) + stamps
    return PoseRecord(t if nanoseconds else stamps, motion.position.double(), rotation.double(), source)
