"""Opening what the commands are given: files of poses and saved trajectories."""

import shutil
import sys
import tempfile
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import torch

from torchspline.cli.common import longest_stretch
from torchspline.fit import PoseFit, fit_poses
from torchspline.io import ImuRecord, PoseRecord, read_bvh, read_imu, read_nerfstudio, read_poses
from torchspline.io.archive import check_folder
from torchspline.io.trajectory import even_times
from torchspline.splines import Trajectory
from torchspline.units import SECOND

PoseFormat = Literal["tum", "euroc", "kitti", "nerfstudio", "bvh", "ros"]
#: The widest spacing of knots, ms: a hundred days. Stamps are 64 bits of nanoseconds.
_WIDEST = 1e10
#: What stands for standard input and output.
PIPE = Path("-")


def is_trajectory(path: Path) -> bool:
    """Whether it may be a file of `torchspline.io.save_trajectory`."""
    return path.suffix == ".npz" or (path.is_file() and zipfile.is_zipfile(path))


def named_after(path: Path, suffix: str) -> Path:
    """The default name of what is made of a file: in the working folder, since that of data may not be ours."""
    if path == PIPE:
        raise ValueError(
            "out: expected a name for the result, since what it is made of comes from standard input"
        )
    return Path(path.resolve().name.removesuffix(".gz").rsplit(".", 1)[0] + suffix)


def check_outputs(sources: Iterable[Path | None], outputs: Iterable[tuple[str, Path | None]]) -> None:
    """Before the work: whether there are folders for files to write, and none is a source or written twice.

    Args:
        sources: what is read.
        outputs: names of arguments, and the files that they say.
    """
    taken = {x.resolve(): "the source" for x in sources if x not in (None, PIPE)}
    for name, file in outputs:
        if file is None or (file.exists() and not file.is_file() and not file.is_dir()):  # devices take all
            continue
        place = file.resolve()
        if place in taken:
            raise ValueError(f"{name}: expected another file than {taken[place]}, got {file}")
        check_folder(file)
        if file.is_dir():
            raise ValueError(f"{name}: expected the name of a file, got the folder {file}")
        taken[place] = f"that of {name}"


@contextmanager
def on_disk(path: Path) -> Iterator[Path]:
    """The path, or a file of what comes on standard input for `-`: readers look more than once."""
    if path != PIPE:
        yield path
        return
    if sys.stdin is None:
        raise ValueError("-: expected something on standard input, which is closed; name a file")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "stdin")
        with file.open("wb") as copy:
            shutil.copyfileobj(sys.stdin.buffer, copy)
        try:
            yield file
        except (ValueError, OSError) as reason:
            raise ValueError(str(reason).replace(str(file), "standard input")) from None


def open_poses(
    path: Path,
    format: PoseFormat | None = None,
    times: Path | None = None,
    topic: str | None = None,
    child: str | None = None,
    joint: str | None = None,
    unit: float = 0.01,
    fps: float | None = None,
) -> PoseRecord:
    """Poses from a file of any format that has them."""
    with on_disk(path) as file:
        suffix = Path(path.name.removesuffix(".gz")).suffix
        is_json, is_bvh = (
            format == name or (format is None and suffix == ending)
            for name, ending in (("nerfstudio", ".json"), ("bvh", ".bvh"))
        )
        _refuse(path, "a camera path or data set of nerfstudio", is_json, fps=fps)
        _refuse(path, "motion capture (BVH)", is_bvh, joint=joint)
        if is_json or is_bvh:
            what = "nerfstudio" if is_json else "BVH"
            _refuse(path, "a ROS bag", False, topic=topic, child=child)
            if times is not None:
                raise ValueError(f"times: expected none, since {path} is {what}, got {times}")
        if is_json:
            return read_nerfstudio(file, fps)
        return _joint(file, joint, unit) if is_bvh else read_poses(file, format, times, topic, child)


def open_record(
    path: Path,
    format: PoseFormat | None = None,
    times: Path | None = None,
    topic: str | None = None,
    child: str | None = None,
    **options: Any,
) -> PoseRecord | ImuRecord:
    """Poses, or IMU readings from a file that has none; options as those of `open_poses`."""
    with on_disk(path) as file:
        try:
            return open_poses(file, format, times, topic, child, **options)
        except ValueError as first:
            no_table = format is None and Path(file.name.removesuffix(".gz")).suffix in (".json", ".bvh")
            if no_table or format not in (None, "euroc", "ros"):
                raise
            try:
                return read_imu(file, format, topic)
            except ValueError as second:
                same = str(first) == str(second)
                raise (
                    first if same else ValueError(f"not poses: {first}; not IMU readings: {second}")
                ) from None


def _refuse(path: Path, kind: str, fits: bool, **options: Any) -> None:
    for name, value in options.items():
        if value is not None and not fits:
            raise ValueError(f"{name}: expected none, since {path} is not {kind}, got {value}")


def _joint(path: Path, name: str | None, unit: float) -> PoseRecord:
    """The poses of one joint of a skeleton."""
    skeleton = read_bvh(path, unit)
    if name is not None and name not in skeleton.names:
        raise ValueError(f"joint: expected one of {', '.join(skeleton.names)[:500]}, got {name!r}")
    poses = skeleton.poses()[0 if name is None else skeleton.names.index(name)]
    stamps = (skeleton.time * SECOND).round().to(torch.int64)
    return PoseRecord(stamps, poses[:, :3].contiguous(), poses[:, 3:].contiguous(), str(path))


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
        dt = seconds_of(spacing)
    return used, fit_poses(used.time_ns, poses, dt=dt, order=order, representation=representation)


def seconds_of(spacing: float) -> float:
    """The knot spacing of a command line, ms, in s."""
    if not 0 < spacing <= _WIDEST:
        raise ValueError(
            f"spacing: expected a number above zero (ms), at most {_WIDEST:g}, or auto, got {spacing}"
        )
    return spacing * 1e-3


def sampled(trajectory: Trajectory, rate: float, source: str) -> PoseRecord:
    """Poses of a trajectory, `rate` a second, on nanosecond stamps."""
    t, stamps = even_times(trajectory, rate)
    with torch.no_grad():
        motion = trajectory.kinematics(t)
    if motion.position is None or motion.position.ndim != 2:
        raise ValueError(f"{source}: expected one trajectory with positions, got {trajectory.group}")
    rotation = motion.rotation
    if rotation is None:
        rotation = torch.zeros(len(t), 4, dtype=torch.float64)
        rotation[:, 0] = 1.0
    return PoseRecord(stamps, motion.position.double(), rotation.double(), source)
