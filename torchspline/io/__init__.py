"""Reading and writing recordings: `read_poses`, `read_imu`, `read_bvh`, `write_poses`, `write_imu`; and what
calibration finds: `read_imu_parameters`, `read_camchain` and their writers.

Trajectories: `save_trajectory`, `load_trajectory`. Cameras of nerfstudio: `read_nerfstudio`, `write_nerfstudio`.
Bags of ROS: `read_poses` and `read_imu` with `topic`, `write_rosbag`. The viewer of rerun: `write_rerun`. To add a
format, write one module that ends with its `FORMAT` and name the module in `_FORMATS` below.
"""

from os import PathLike
from pathlib import Path

import torch

from torchspline.io import euroc, kitti, ros, tum
from torchspline.io.bvh import Skeleton, read_bvh
from torchspline.io.camchain import CamChain, read_camchain, write_camchain
from torchspline.io.camera import Camera
from torchspline.io.imu_parameters import ImuParameters, read_imu_parameters, write_imu_parameters
from torchspline.io.nerfstudio import read_nerfstudio, write_nerfstudio
from torchspline.io.records import ImuRecord, PoseRecord
from torchspline.io.registry import Format
from torchspline.io.rerun import write_rerun
from torchspline.io.ros import write_rosbag
from torchspline.io.text import Table, read_table
from torchspline.io.trajectory import load_trajectory, save_trajectory

__all__ = [
    "CamChain",
    "Camera",
    "ImuParameters",
    "ImuRecord",
    "PoseRecord",
    "Skeleton",
    "load_trajectory",
    "read_bvh",
    "read_camchain",
    "read_imu",
    "read_imu_parameters",
    "read_nerfstudio",
    "read_poses",
    "save_trajectory",
    "write_camchain",
    "write_imu",
    "write_imu_parameters",
    "write_nerfstudio",
    "write_poses",
    "write_rerun",
    "write_rosbag",
]

_FORMATS: dict[str, Format] = {module.FORMAT.name: module.FORMAT for module in (euroc, kitti, tum)}


def read_poses(
    path: str | PathLike[str],
    format: str | None = None,
    times: str | PathLike[str] | None = None,
    topic: str | None = None,
    child: str | None = None,
) -> PoseRecord:
    """Read stamped poses, body to world: metres, quaternions [w, x, y, z], exact nanoseconds.

    Args:
        path: a file, plain or gzipped, or an EuRoC folder (the one of `data.csv`, or of the whole sequence,
            where `state_groundtruth_estimate0` goes before `mocap0`), or a ROS bag (.bag, .mcap, .db3, or the folder of
            a bag).
        format: "euroc", "kitti", "ros" or "tum"; found from the content when not given.
        times: the file of stamps, for KITTI only; looked for beside the poses when not given.
        topic: of a ROS bag, with PoseStamped, PoseWithCovarianceStamped, TransformStamped, Odometry or TFMessage
            messages; the only one there is when not given, where TFMessages count if there is nothing else. Messages
            are stamped by their headers.
        child: of a topic with transforms of several frames, the one whose poses are read.
    Returns:
        PoseRecord: the rows as they are in the file, also where they are unsorted, repeated or NaN.
    Raises:
        FileNotFoundError: no such file, or no file of stamps.
        ValueError: content that cannot be read as this format; the message names the file and the line.
    """
    if _is_bag(path, format, topic=topic, child=child):
        return ros.read_poses(_path(path), topic, child)
    table, chosen = _open(_path(path), format, "read_poses", "pose_files")
    assert chosen.read_poses
    if times is not None and not chosen.separate_times:
        raise ValueError(f"{path}: {chosen.name} files hold their own stamps; leave out times={str(times)!r}")
    return chosen.read_poses(table, None if times is None else _path(times, "times"))


def read_imu(path: str | PathLike[str], format: str | None = None, topic: str | None = None) -> ImuRecord:
    """Read stamped IMU samples: rad/s, specific force in m/s^2, exact nanoseconds.

    Args:
        path: a file, plain or gzipped, an EuRoC folder (the one of `data.csv`, or of the whole sequence), or a ROS bag.
        format: "euroc" or "ros"; found from the content when not given.
        topic: of a ROS bag, with sensor_msgs/Imu messages; the only one there is when not given.
    Returns:
        ImuRecord: the rows as they are in the file, also where they are unsorted, repeated or NaN.
    Raises:
        FileNotFoundError: no such file.
        ValueError: content that cannot be read as this format; the message names the file and the line.
    """
    if _is_bag(path, format, topic=topic):
        return ros.read_imu(_path(path), topic)
    table, chosen = _open(_path(path), format, "read_imu", "imu_files")
    assert chosen.read_imu
    return chosen.read_imu(table)


def write_poses(
    path: str | PathLike[str],
    record: PoseRecord,
    format: str = "tum",
    times: str | PathLike[str] | None = None,
) -> None:
    """Write poses as "tum", "euroc" or "kitti"; reading them back gives the same stamps and float64 numbers.

    KITTI has matrices: rotations come back to rounding, as unit quaternions. Gzipped when the name ends with .gz. An
    existing file is replaced, whole or not at all.

    Args:
        times: for KITTI only, the file that the stamps go into; when not given, one beside the poses that
            `read_poses` finds: `times.txt` for `poses.txt`, `00_times.txt` for `00.txt` and `00_gt.txt`.
    Raises:
        FileNotFoundError: the folder of `path` or `times` does not exist.
        ValueError: a format that is unknown or cannot be written, a record without rows, `times` where the format
            holds its own stamps.
    """
    (form,) = _formats("write_poses", format)
    if times is not None and not form.separate_times:
        raise ValueError(
            f"times: expected none, since {format} files hold their own stamps, got {str(times)!r}"
        )
    stamps = None if times is None else _path(times, "times")
    if isinstance(record, PoseRecord):
        zero = torch.nonzero((record.rotation == 0).all(-1)).flatten()
        if len(zero):
            raise ValueError(f"record: expected quaternions that are not zero, got one at row {int(zero[0])}")
    path = _checked(path, record, PoseRecord)
    assert form.write_poses
    form.write_poses(path, record, stamps)


def write_imu(path: str | PathLike[str], record: ImuRecord, format: str = "euroc") -> None:
    """Write IMU samples as an EuRoC csv; reading them back gives the same stamps and float64 numbers.

    Gzipped when the name ends with .gz. An existing file is replaced, whole or not at all.

    Raises:
        FileNotFoundError: the folder of `path` does not exist.
        ValueError: a format that is unknown or cannot be written, a record without rows.
    """
    (form,) = _formats("write_imu", format)
    assert form.write_imu
    form.write_imu(_checked(path, record, ImuRecord), record)


def _is_bag(path: str | PathLike[str], format: str | None, **choices: str | None) -> bool:
    """Whether a ROS bag is meant; topics and frames are for those alone."""
    bag = format == ros.NAME or (format is None and ros.is_bag(_path(path)))
    for name, choice in choices.items():
        if choice is not None and not bag:
            raise ValueError(f"{name}: expected none, since {path} is no ROS bag, got {choice!r}")
    return bag


def _formats(action: str, name: str | None) -> list[Format]:
    """The formats that can do `action`, or just the one of this name."""
    able = {key: form for key, form in _FORMATS.items() if getattr(form, action)}
    if name is None:
        return list(able.values())
    if name not in able:
        raise ValueError(f"{action}: expected a format out of {', '.join(able)}, got {name!r}")
    return [able[name]]


def _open(path: Path, name: str | None, action: str, files: str) -> tuple[Table, Format]:
    """The table at `path` and its format: the named one, else the one that recognises the table."""
    candidates = _formats(action, name)
    if path.is_dir():
        path = _inside(path, [file for form in candidates for file in getattr(form, files)])
    table = read_table(path)
    matches = candidates if name else [form for form in candidates if form.recognises(table)]
    if len(matches) != 1:
        names = " or ".join(form.name for form in matches or candidates)
        raise table.error(
            0,
            f"{table.columns} columns, here {table.excerpt(0)}",
            f"rows that look like {names} (pass format= where the content does not tell which)",
        )
    return table, matches[0]


def _inside(folder: Path, files: list[str]) -> Path:
    for file in files:
        for found in (folder / file, folder / f"{file}.gz"):
            if found.is_file():
                return found
    if not files:
        raise ValueError(f"{folder}: expected a file, got a folder")
    raise FileNotFoundError(f"{folder}: expected a folder that holds {' or '.join(files)}")


def _path(path: str | PathLike[str], name: str = "path") -> Path:
    if not isinstance(path, (str, PathLike)):
        raise TypeError(f"{name}: expected a path, got {type(path).__name__}")
    return Path(path)


def _checked(path: str | PathLike[str], record: PoseRecord | ImuRecord, kind: type) -> Path:
    """The path that a record of this kind goes to."""
    path = _path(path)
    if not isinstance(record, kind):
        raise TypeError(f"record: expected a {kind.__name__}, got {type(record).__name__}")
    if not len(record):
        raise ValueError(f"{path}: expected rows to write, got an empty record")
    return path
