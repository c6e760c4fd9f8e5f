"""ROS bags, of ROS 1 and 2 (MCAP and SQLite), through the package rosbags: no ROS needed."""

import io
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchspline import checks
from torchspline.io.archive import check_folder
from torchspline.io.records import ImuRecord, PoseRecord
from torchspline.units import SECOND

NAME = "ros"
_SUFFIXES = (".bag", ".mcap", ".db3")
_IMU = ("sensor_msgs/msg/Imu",)
#: Messages with one stamped pose, and where it is in them.
_POSES = {
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "geometry_msgs/msg/TransformStamped": "transform",
    "nav_msgs/msg/Odometry": "pose.pose",
}
#: What messages are made of.
_MADE_OF = (
    "builtin_interfaces/msg/Time",
    "std_msgs/msg/Header",
    "sensor_msgs/msg/Imu",
    *(f"geometry_msgs/msg/{name}" for name in ("PoseStamped", "Pose", "Point", "Quaternion", "Vector3")),
)
#: Who the poses of a bag that is written belong to, and its IMUs.
_WORLD, _SENSOR = "world", "imu"


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag: by its name, or as a folder with metadata."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix in _SUFFIXES


def read_poses(path: Path, topic: str | None) -> PoseRecord:
    """The poses of one topic, child frame to `header.frame_id`, stamped as their headers say."""
    rows = []
    with _messages(path, topic, tuple(_POSES), "poses") as messages:
        for kind, message in messages:
            pose = message
            for name in _POSES[kind].split("."):
                pose = getattr(pose, name)
            p = pose.translation if hasattr(pose, "translation") else pose.position
            q = pose.rotation if hasattr(pose, "rotation") else pose.orientation
            rows.append((_stamp(message), (p.x, p.y, p.z, q.w, q.x, q.y, q.z)))
    stamps, values = _columns(rows, 7)
    return PoseRecord(stamps, values[:, :3].contiguous(), values[:, 3:].contiguous(), str(path))


def read_imu(path: Path, topic: str | None) -> ImuRecord:
    """The IMU samples of one topic, stamped as their headers say."""
    rows = []
    with _messages(path, topic, _IMU, "IMU samples") as messages:
        for _, message in messages:
            w, a = message.angular_velocity, message.linear_acceleration
            rows.append((_stamp(message), (w.x, w.y, w.z, a.x, a.y, a.z)))
    stamps, values = _columns(rows, 6)
    return ImuRecord(stamps, values[:, :3].contiguous(), values[:, 3:].contiguous(), str(path))


def write_rosbag(path: str | PathLike[str], records: Mapping[str, PoseRecord | ImuRecord]) -> None:
    """Write a bag of ROS 2 (MCAP); reading it back gives the same stamps and float64 numbers.

    Poses become `geometry_msgs/PoseStamped` in the frame `world`, IMU samples `sensor_msgs/Imu` in `imu`, without
    orientation.

    Args:
        path: the folder of the bag, which must not exist.
        records: by topic, such as `{"/imu": samples, "/pose": poses}`.
    Raises:
        FileExistsError: there is something at `path`. FileNotFoundError: the folder it is to stand in is not there.
        ImportError: the package rosbags is not installed.
        ValueError: no records, an empty one, or stamps that such messages cannot hold (before 1970, after 2038).
    """
    if not isinstance(path, (str, PathLike)):
        raise TypeError(f"path: expected a path, got {type(path).__name__}")
    path = Path(path)
    _check_records(records)
    if path.exists():
        raise FileExistsError(
            f"{path}: expected a folder that does not exist yet; remove it or choose another name"
        )
    check_folder(path)
    rosbag2, typesys = _library("rosbag2"), _library("typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    make = {name.split("/")[-1]: store.types[name] for name in _MADE_OF}
    writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
    with writer:
        for topic, record in records.items():
            kind = "sensor_msgs/msg/Imu" if isinstance(record, ImuRecord) else "geometry_msgs/msg/PoseStamped"
            connection = writer.add_connection(topic, kind, typestore=store)
            for time_ns, message in _written(record, make):
                writer.write(connection, time_ns, store.serialize_cdr(message, kind))


def _written(record: PoseRecord | ImuRecord, make: Mapping[str, Any]) -> Iterator[tuple[int, Any]]:
    vector, quaternion, unknown = make["Vector3"], make["Quaternion"], np.zeros(9)
    if isinstance(record, ImuRecord):
        imu, columns = True, (record.gyroscope, record.accelerometer)
    else:
        imu, columns = False, (record.position, record.rotation)
    for time_ns, first, second in zip(record.time_ns.tolist(), *(x.tolist() for x in columns), strict=True):
        stamp = make["Time"](*divmod(time_ns, SECOND))
        if imu:
            header = make["Header"](stamp, _SENSOR)
            nowhere = quaternion(0.0, 0.0, 0.0, 1.0)
            no_orientation = np.array([-1.0, *unknown[1:]])
            yield (
                time_ns,
                make["Imu"](
                    header, nowhere, no_orientation, vector(*first), unknown, vector(*second), unknown
                ),
            )
        else:
            w, x, y, z = second
            pose = make["Pose"](make["Point"](*first), quaternion(x, y, z, w))
            yield time_ns, make["PoseStamped"](make["Header"](stamp, _WORLD), pose)


def _check_records(records: Mapping[str, PoseRecord | ImuRecord]) -> None:
    if not isinstance(records, Mapping):
        raise TypeError(f"records: expected a mapping of topics to records, got {type(records).__name__}")
    if not records:
        raise ValueError("records: expected at least one record, got none")
    for topic, record in records.items():
        checks.instance("records", topic, str, "topics that are words")
        if not isinstance(record, (PoseRecord, ImuRecord)):
            got = type(record).__name__
            raise TypeError(f"records[{topic!r}]: expected a PoseRecord or an ImuRecord, got {got}")
        if len(record) == 0:
            raise ValueError(f"records[{topic!r}]: expected rows to write, got an empty record")
        outside = (record.time_ns < 0) | (record.time_ns >= 2**31 * SECOND)
        if bool(outside.any()):
            raise ValueError(
                f"records[{topic!r}]: expected stamps between 1970 and 2038, as messages of ROS hold them, got "
                f"{int(record.time_ns[outside][0])} ns"
            )


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    return stamp.sec * SECOND + stamp.nanosec


def _columns(rows: Sequence[tuple[int, tuple[float, ...]]], width: int) -> tuple[Tensor, Tensor]:
    stamps = torch.tensor([t for t, _ in rows], dtype=torch.int64)
    return stamps, torch.tensor([x for _, x in rows], dtype=torch.float64).reshape(-1, width)


class _BoundedReader(io.BufferedReader):
    """Reads no more than there is: lengths in damaged files would reserve memory of their size."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > io.DEFAULT_BUFFER_SIZE:
            size = min(size, max(os.fstat(self.fileno()).st_size - self.tell(), 0))
        return super().read(size)


class _BoundedPath(type(Path())):  # type: ignore[misc]
    """A path whose files are opened for bounded reading."""

    def open(self, mode: str = "r", *arguments: Any, **options: Any) -> Any:
        if mode == "rb" and not arguments and not options:
            return _BoundedReader(io.FileIO(str(self)))
        return super().open(mode, *arguments, **options)


@contextmanager
def _messages(path: Path, topic: str | None, kinds: tuple[str, ...], what: str) -> Iterator[Any]:
    """Iterates over the messages of the chosen topic, with their kind."""
    if topic is not None and not isinstance(topic, str):
        raise TypeError(f"topic: expected the name of a topic, got {type(topic).__name__}")
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    highlevel, typesys = _library("highlevel"), _library("typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    chosen = ""
    try:
        with highlevel.AnyReader([_BoundedPath(path)], default_typestore=store) as reader:
            topics = {c.topic: c.msgtype for c in reader.connections}
            fitting = [name for name, kind in topics.items() if kind in kinds and topic in (None, name)]
            if len(fitting) == 1:
                chosen = fitting[0]
                connections = [c for c in reader.connections if c.topic == chosen and c.msgtype in kinds]
                yield (
                    (c.msgtype, reader.deserialize(raw, c.msgtype))
                    for c, _, raw in reader.messages(connections)
                )
    except (MemoryError, ImportError, GeneratorExit):
        raise
    except Exception as reason:  # the library meets damage with whatever comes up
        text = " ".join(f"{type(reason).__name__}: {reason}".split())[:200]
        raise ValueError(f"{path}: expected a ROS bag, got damaged data ({text})") from None
    if not chosen:
        there = ", ".join(f"{name} ({kind})" for name, kind in topics.items())[:500] or "none"
        wanted = f"the topic {topic!r} with {what}" if topic else f"one topic with {what}"
        more = "; pass topic=" if fitting else ""
        raise ValueError(f"{path}: expected {wanted} ({', '.join(kinds)}), got {there}{more}")


def _library(name: str) -> Any:
    try:
        return import_module(f"rosbags.{name}")
    except ImportError as reason:
        raise ImportError(
            f"ROS bags need the package rosbags: pip install 'torchspline[ros]' ({reason})"
        ) from None
