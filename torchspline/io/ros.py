"""ROS bags, of ROS 1 and 2 (MCAP and SQLite), through the package rosbags: no ROS needed."""

import errno
import io
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

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
#: Messages with a list of transforms, of many frames as a rule.
_TREES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
#: What poses can be written as.
MESSAGES = ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "Odometry", "TFMessage")
#: Who the readings of IMUs that are written belong to.
_SENSOR = "imu"


class _Row(NamedTuple):
    """A stamp and its numbers; for poses the frames, of which messages without a child leave that empty."""

    time_ns: int
    numbers: tuple[float, ...]
    parent: str = ""
    child: str = ""


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag: by its name, or as a folder with metadata."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix in _SUFFIXES


def read_poses(path: Path, topic: str | None, child: str | None) -> PoseRecord:
    """The poses of one topic, child frame to `header.frame_id`, stamped as their headers say."""
    if child is not None and not isinstance(child, str):
        raise TypeError(f"child: expected the name of a frame, got {type(child).__name__}")
    kinds = (*_POSES, *_TREES)
    topic, rows = _rows(path, topic, kinds, _TREES, "poses", _poses_in)
    where = f"{path}, topic {topic!r}"
    there = sorted({(row.parent, row.child) for row in rows})
    listed = ", ".join(f"{row[1] or '(unnamed)'} in {row[0] or '(unnamed)'}" for row in there)[:500]
    fitting = [x for x in there if child in (None, x[1])]
    if len(fitting) != 1:
        wanted = "poses of one frame in one other" if child is None else f"the frame {child!r} in one other"
        more = "; pass child=" if child is None and len({x[1] for x in there}) == len(there) else ""
        raise ValueError(f"{where}: expected {wanted}, got {listed}{more}")
    if len(there) > 1:
        rows = [row for row in rows if row.child == child]
    stamps, values = _columns(rows, 7)
    zero = (values[:, 3:] == 0).all(-1)
    if bool(zero.any()):
        raise ValueError(
            f"{where}: expected quaternions that are not zero, got one in pose {int(zero.nonzero()[0])}"
        )
    source = f"{where}, {listed}" if len(there) == 1 and there[0][1] else where
    return PoseRecord(stamps, values[:, :3].contiguous(), values[:, 3:].contiguous(), source)


def read_imu(path: Path, topic: str | None) -> ImuRecord:
    """The IMU samples of one topic, stamped as their headers say."""
    topic, rows = _rows(path, topic, _IMU, (), "IMU samples", _readings_in)
    stamps, values = _columns(rows, 6)
    source = f"{path}, topic {topic!r}"
    return ImuRecord(stamps, values[:, :3].contiguous(), values[:, 3:].contiguous(), source)


def write_rosbag(
    path: str | PathLike[str],
    records: Mapping[str, PoseRecord | ImuRecord],
    message: str = "PoseStamped",
    parent: str = "world",
    child: str = "body",
) -> None:
    """Write a bag of ROS; reading it back gives the same stamps and float64 numbers.

    IMU samples become `sensor_msgs/Imu` in the frame `imu`, without orientation.

    Args:
        path: what must not exist. A name that ends with .bag is one of ROS 1, with .mcap or .db3 (SQLite) a file of
            ROS 2, and any other name the folder of a bag of ROS 2 (MCAP).
        records: by topic, such as `{"/imu": samples, "/pose": poses}`.
        message: what poses become: "PoseStamped", "PoseWithCovarianceStamped" (covariance zero), "TransformStamped",
            "Odometry" (twist zero, its covariance starts with -1: unknown) or "TFMessage" with one transform each.
        parent: the frame that poses are in.
        child: the frame whose poses they are; messages of the first two kinds have no place for it.
    Raises:
        FileExistsError: there is something at `path`. FileNotFoundError: the folder it is to stand in is not there.
        ImportError: the package rosbags is not installed. OSError: it cannot be written, for want of room say.
        ValueError: no records, an empty one, or stamps that such messages cannot hold (before 1970, after 2038).
    """
    if not isinstance(path, (str, PathLike)):
        raise TypeError(f"path: expected a path, got {type(path).__name__}")
    path = Path(path)
    _check_records(records)
    checks.choice("message", message, MESSAGES)
    for name, frame in (("parent", parent), ("child", child)):
        checks.instance(name, frame, str, "the name of a frame")
    if path.exists():
        raise FileExistsError(
            f"{path}: expected a name that nothing has yet; remove what is there or choose another"
        )
    check_folder(path)
    first = path.suffix == ".bag"
    typesys = _library("typesys")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if first else typesys.Stores.ROS2_HUMBLE)
    if _TREES[0] not in store.types:
        store.register(typesys.get_types_from_msg("geometry_msgs/TransformStamped[] transforms", _TREES[0]))
    with _scratch(path) as scratch:
        bag = scratch / path.name
        if first:
            writer = _library("rosbag1").Writer(bag)
        else:
            rosbag2 = _library("rosbag2")
            plugin = rosbag2.StoragePlugin.SQLITE3 if path.suffix == ".db3" else rosbag2.StoragePlugin.MCAP
            writer = rosbag2.Writer(bag, version=9, storage_plugin=plugin)
        with writer:
            for topic, record in records.items():
                make = _Maker(store, message, parent, child, first)
                kind = _IMU[0] if isinstance(record, ImuRecord) else make.kind
                connection = writer.add_connection(topic, kind, typestore=store)
                serialize = store.serialize_ros1 if first else store.serialize_cdr
                for time_ns, x in make.messages(record):
                    writer.write(connection, time_ns, serialize(x, kind))
        if path.suffix in (".mcap", ".db3"):
            (bag,) = bag.glob(f"*{path.suffix}")
        bag.rename(path)


@contextmanager
def _scratch(path: Path) -> Iterator[Path]:
    """A folder beside `path` to make it in: whoever is interrupted leaves no half of a bag."""
    scratch = None
    try:
        scratch = Path(tempfile.mkdtemp(prefix=".", dir=path.parent))
        yield scratch
    except sqlite3.Error as reason:  # a full disk, to a database
        raise OSError(errno.EIO, f"{reason}; make room or choose another place", str(path)) from None
    except OSError as reason:
        if reason.errno is None:
            raise
        raise OSError(reason.errno, reason.strerror, str(path)) from None
    finally:
        if scratch is not None:
            shutil.rmtree(scratch, ignore_errors=True)


class _Maker:
    """Makes messages of a type store."""

    def __init__(self, store: Any, message: str, parent: str, child: str, first: bool) -> None:
        self.kind = next(x for x in (*_POSES, *_TREES) if x.endswith(f"/{message}"))
        self.types, self.parent, self.child, self.first = store.types, parent, child, first

    def messages(self, record: PoseRecord | ImuRecord) -> Iterator[tuple[int, Any]]:
        """With the stamps that the bag has for them."""
        if isinstance(record, ImuRecord):
            columns = record.gyroscope.tolist(), record.accelerometer.tolist()
        else:
            columns = record.position.tolist(), record.rotation.tolist()
        make = self.imu if isinstance(record, ImuRecord) else self.pose
        for t, a, b in zip(record.time_ns.tolist(), *columns, strict=True):
            yield t, make(t, a, b)

    def header(self, time_ns: int, frame: str) -> Any:
        stamp = self.types["builtin_interfaces/msg/Time"](*divmod(time_ns, SECOND))
        return self.types["std_msgs/msg/Header"](*([0] if self.first else []), stamp, frame)

    def imu(self, time_ns: int, w: Sequence[float], a: Sequence[float]) -> Any:
        vector, unknown = self.geometry("Vector3"), np.zeros(9)
        nowhere, no_orientation = self.geometry("Quaternion")(0.0, 0.0, 0.0, 1.0), _unknown(9)
        header = self.header(time_ns, _SENSOR)
        return self.types[_IMU[0]](header, nowhere, no_orientation, vector(*w), unknown, vector(*a), unknown)

    def pose(self, time_ns: int, p: Sequence[float], q: Sequence[float]) -> Any:
        make, header = self.types[self.kind], self.header(time_ns, self.parent)
        rotation = self.geometry("Quaternion")(*q[1:], q[0])
        if self.kind.endswith(("/TransformStamped", "/TFMessage")):
            transform = self.geometry("Transform")(self.geometry("Vector3")(*p), rotation)
            stamped = self.geometry("TransformStamped")(header, self.child, transform)
            return make([stamped]) if self.kind in _TREES else stamped
        pose = self.geometry("Pose")(self.geometry("Point")(*p), rotation)
        if self.kind.endswith("/PoseStamped"):
            return make(header, pose)
        pose = self.geometry("PoseWithCovariance")(pose, np.zeros(36))
        if self.kind.endswith("/PoseWithCovarianceStamped"):
            return make(header, pose)
        still = self.geometry("Vector3")(0.0, 0.0, 0.0)
        twist = self.geometry("TwistWithCovariance")(self.geometry("Twist")(still, still), _unknown(36))
        return make(header, self.child, pose, twist)

    def geometry(self, name: str) -> Any:
        return self.types[f"geometry_msgs/msg/{name}"]


def _unknown(size: int) -> Any:
    """A covariance that says nothing is known, as sensor_msgs/Imu has it."""
    covariance = np.zeros(size)
    covariance[0] = -1.0
    return covariance


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


def _poses_in(kind: str, message: Any) -> Iterator[_Row]:
    for single in message.transforms if kind in _TREES else (message,):
        pose = single
        for name in ("transform" if kind in _TREES else _POSES[kind]).split("."):
            pose = getattr(pose, name)
        p = pose.translation if hasattr(pose, "translation") else pose.position
        q = pose.rotation if hasattr(pose, "rotation") else pose.orientation
        # ROS 1 also wrote /base where ROS 2 has base.
        parent, child = (str(x).removeprefix("/") for x in (single.header.frame_id, _child(single)))
        yield _Row(_stamp(single), (p.x, p.y, p.z, q.w, q.x, q.y, q.z), parent, child)


def _child(message: Any) -> str:
    return getattr(message, "child_frame_id", "")


def _readings_in(kind: str, message: Any) -> Iterator[_Row]:
    w, a = message.angular_velocity, message.linear_acceleration
    yield _Row(_stamp(message), (w.x, w.y, w.z, a.x, a.y, a.z))


def _columns(rows: Sequence[_Row], width: int) -> tuple[Tensor, Tensor]:
    stamps = torch.tensor([row.time_ns for row in rows], dtype=torch.int64)
    return stamps, torch.tensor([row.numbers for row in rows], dtype=torch.float64).reshape(-1, width)


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


def _rows(
    path: Path,
    topic: str | None,
    kinds: tuple[str, ...],
    second_choice: tuple[str, ...],
    what: str,
    rows_in: Callable[[str, Any], Iterable[_Row]],
) -> tuple[str, list[_Row]]:
    """The chosen topic and what its messages hold; kinds of second choice count where there are no others."""
    if topic is not None and not isinstance(topic, str):
        raise TypeError(f"topic: expected the name of a topic, got {type(topic).__name__}")
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    highlevel, typesys = _library("highlevel"), _library("typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    rows: list[_Row] = []
    chosen = ""
    try:
        with highlevel.AnyReader([_BoundedPath(path)], default_typestore=store) as reader:
            topics = list(dict.fromkeys((c.topic, c.msgtype) for c in reader.connections))
            able = [x for x in topics if x[1] in kinds and topic in (None, x[0])]
            fitting = {name for name, kind in able if kind not in second_choice} or {x[0] for x in able}
            if len(fitting) == 1:
                (chosen,) = fitting
                connections = [c for c in reader.connections if c.topic == chosen and c.msgtype in kinds]
                for c, _, raw in reader.messages(connections):
                    rows += rows_in(c.msgtype, reader.deserialize(raw, c.msgtype))
    except MemoryError:
        raise MemoryError(f"{path}: expected a ROS bag that fits into the memory, got a larger one") from None
    except ImportError:
        raise
    except Exception as reason:  # the library meets damage with whatever comes up
        text = " ".join(f"{type(reason).__name__}: {reason}".split())[:200]
        raise ValueError(f"{path}: expected a ROS bag, got damaged data ({text})") from None
    if not chosen:
        there = ", ".join(f"{name} ({kind})" for name, kind in topics)[:500] or "no topics"
        wanted = f"the topic {topic!r} with {what}" if topic else f"one topic with {what}"
        more = "; pass topic=" if fitting else ""
        raise ValueError(f"{path}: expected {wanted} ({', '.join(kinds)}), got {there}{more}")
    if not rows:
        raise ValueError(f"{path}: expected {what} in the topic {chosen!r}, got none")
    return chosen, rows


def _library(name: str) -> Any:
    try:
        return import_module(f"rosbags.{name}")
    except ImportError as reason:
        raise ImportError(
            f"ROS bags need the package rosbags: pip install 'torchspline[ros]' ({reason})"
        ) from None
