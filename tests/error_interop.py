"""Bad arguments of what reads and writes files of trajectories, cameras and ROS."""

import shutil
from collections.abc import Iterator
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

from error_arguments import (
    FOLDER,
    NAN,
    POSE_COLUMNS,
    POSES,
    SAMPLES,
    SPLINE,
    Case,
    Q,
    accept,
    changed,
    file,
    numbers,
    refused,
)

import torchspline.io
import torchspline.io as records

records.save_trajectory(f"{FOLDER.name}/good.npz", SPLINE)
records.write_nerfstudio(f"{FOLDER.name}/good.json", POSES)


def write_rosbag(path: Any, records: Any, **options: Any) -> None:
    """Into a new folder; where the package is not installed, that is said after the arguments were looked at."""
    if path == f"{FOLDER.name}/bag":
        shutil.rmtree(path, ignore_errors=True)
    with suppress(ImportError):
        torchspline.io.write_rosbag(path, records, **options)


def write_rerun(path: Any, records: Any, rate: Any = 10.0) -> None:
    """Likewise."""
    with suppress(ImportError):
        torchspline.io.write_rerun(path, records, rate)


accept(
    {
        "save_trajectory": (
            records.save_trajectory,
            {"path": f"{FOLDER.name}/saved.npz", "trajectory": SPLINE},
        ),
        "load_trajectory": (records.load_trajectory, {"path": f"{FOLDER.name}/good.npz"}),
        "read_nerfstudio": (records.read_nerfstudio, {"path": f"{FOLDER.name}/good.json"}),
        "write_nerfstudio": (
            records.write_nerfstudio,
            {"path": f"{FOLDER.name}/written.json", "record": POSES, "kind": "transforms"},
        ),
        "write_rosbag": (write_rosbag, {"path": f"{FOLDER.name}/bag", "records": {"/imu": SAMPLES}}),
        "write_rerun": (
            write_rerun,
            {"path": f"{FOLDER.name}/x.rrd", "records": {"imu": SAMPLES, "body": POSES}},
        ),
    }
)

_READ = "load_trajectory read_nerfstudio"
_WRITE = "save_trajectory write_nerfstudio write_rosbag write_rerun"
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE = {
    "shape": {"what is written was checked when it was made": _WRITE, "content has tests of its own": _READ},
    "dtype": {"no tensor goes in, or one that was checked": f"{_READ} {_WRITE}"},
    "device": {"files hold numbers of the CPU": f"{_READ} {_WRITE}"},
    "nan": {"what was checked, and content": f"{_READ} save_trajectory write_rosbag"},
    "zero quaternion": {
        "what was checked, and content ": f"{_READ} save_trajectory write_rosbag write_rerun"
    },
    "count": {"content, which has tests of its own": f"{_READ} save_trajectory"},
    "time": {"any times": f"{_READ} save_trajectory write_rerun"},
}


def cases() -> Iterator[Case]:
    nowhere = f"{FOLDER.name}/nowhere/file"
    for function in f"{_READ} {_WRITE}".split():
        for bad in (5, None):
            yield refused(function, "path", "type", bad, f"got {type(bad).__name__}", "expected a path")
    for function in _READ.split():
        yield refused(function, "path", "option", nowhere, "no such file", nowhere, named=nowhere)
        yield refused(function, "path", "option", FOLDER.name, "got a folder", "expected a file", FOLDER.name)
    for function in _WRITE.split():
        yield refused(function, "path", "option", nowhere, "does not exist", "make it first", named=nowhere)
    text = file("words", "words.npz")
    yield refused(
        "load_trajectory",
        "path",
        "option",
        text,
        "got a damaged or truncated file",
        "an npz archive",
        named=text,
    )
    yield refused("read_nerfstudio", "path", "option", text, "Expecting value", "expected JSON", named=text)
    for bad in ("a", True, 1j):
        yield refused("read_nerfstudio", "fps", "type", bad, f"got {type(bad).__name__}", "expected a number")
    for bad in (NAN, 0.0, -1.0):
        yield refused("read_nerfstudio", "fps", "option", bad, f"got {bad}", "above zero")
    for bad in (None, POSES, SimpleNamespace()):
        yield refused(
            "save_trajectory", "trajectory", "type", bad, f"got {type(bad).__name__}", "one of BSpline"
        )
    yield from of_nerfstudio()
    yield from of_ros()
    yield from of_rerun()


def of_nerfstudio() -> Iterator[Case]:
    function = "write_nerfstudio"
    for bad in (SAMPLES, None):
        yield refused(function, "record", "type", bad, f"got {type(bad).__name__}", "a PoseRecord")
    yield refused(function, "record", "count", POSES.window(1, 0), "got an empty", "expected poses")
    still = records.PoseRecord(**{**POSE_COLUMNS, "rotation": 0 * Q[0]})
    yield refused(function, "record", "zero quaternion", still, "got length 0", "expected quaternions")
    lost = records.PoseRecord(**{**POSE_COLUMNS, "position": changed(POSES.position, (1, 2), NAN)})
    yield refused(function, "record", "nan", lost, "got nan at index (1, 2)", "finite")
    uneven = {**POSE_COLUMNS, "time_ns": POSES.time_ns**2}
    yield refused(
        function,
        "record",
        "time",
        records.PoseRecord(**uneven),
        "off by",
        "evenly spaced",
        kind="camera_path",
    )
    for bad in ("video", None):
        yield refused(function, "kind", "option", bad, f"got {bad!r}", "'camera_path', 'transforms'")
    yield from numbers(function, "field_of_view", 0.0, -1.0)
    yield refused(function, "field_of_view", "option", 180.0, "got 180", "less than 180 degrees")
    for bad in (5, (1, 2, 3), None):
        yield refused(function, "resolution", "option", bad, f"got {bad!r}", "(width, height)")
    for size in (0, -1, 1.0, True):
        yield refused(function, "resolution", "option", (640, size), f"got {size!r}", "at least 1")


def of_ros() -> Iterator[Case]:
    function = "write_rosbag"
    for bad in (None, POSES, [POSES]):
        yield refused(function, "records", "type", bad, f"got {type(bad).__name__}", "a mapping of topics")
    yield refused(function, "records", "type", {5: POSES}, "got int", "topics that are words")
    yield refused(
        function, "records", "type", {"/a": SPLINE}, "got SplitBSpline", "a PoseRecord or", "records"
    )
    yield refused(function, "records", "count", {}, "got none", "at least one record")
    empty = {"/a": POSES.window(1, 0)}
    yield refused(function, "records", "count", empty, "got an empty", "expected rows", "records")
    for stamp in (-1, 2**62):
        early = {"/a": records.PoseRecord(**{**POSE_COLUMNS, "time_ns": POSES.time_ns + stamp})}
        yield refused(function, "records", "time", early, "got ", "between 1970 and 2038", "records")
    for bad in ("Pose", None, "Imu"):
        yield refused(function, "message", "option", bad, f"got {bad!r}", "'PoseStamped'")
    for frame in ("parent", "child"):
        yield refused(function, frame, "type", 5, "got int", "the name of a frame")
    for function in ("read_poses", "read_imu"):
        yield refused(function, "topic", "option", "/a", "got '/a'", "is no ROS bag")
        bag = file("", "x.bag")
        yield refused(function, "topic", "type", 5, "got int", "the name of a topic", path=bag)
    yield refused("read_poses", "child", "option", "base", "got 'base'", "is no ROS bag")
    yield refused("read_poses", "child", "type", 5, "got int", "the name of a frame", path=file("", "x.bag"))
    matrix = file("1 0 0 0 0 1 0 0 0 0 1 0\n", "matrix.txt")
    yield refused("read_poses", "times", "type", 5, "got int", "expected a path", path=matrix)
    yield refused("write_poses", "times", "type", 5, "got int", "expected a path", format="kitti")
    for bad in ("x.txt", 5):
        yield refused("write_poses", "times", "option", bad, f"got {str(bad)!r}", "hold their own stamps")
    here = f"{FOLDER.name}/poses.txt"
    yield refused("write_poses", "times", "option", here, f"got {here}", "another file", format="kitti")
    lost = f"{FOLDER.name}/nowhere/times.txt"
    yield refused("write_poses", "times", "option", lost, "does not exist", "make it", lost, format="kitti")


def of_rerun() -> Iterator[Case]:
    function = "write_rerun"
    for bad in (None, POSES, [POSES]):
        yield refused(function, "records", "type", bad, f"got {type(bad).__name__}", "a mapping of names")
    yield refused(function, "records", "type", {5: POSES}, "got int", "names that are words")
    yield refused(function, "records", "type", {"a": Q[0]}, "got Tensor", "a PoseRecord, an Imu", "records")
    yield refused(function, "records", "count", {}, "got none", "at least one record")
    empty = {"a": POSES.window(1, 0)}
    yield refused(function, "records", "count", empty, "got an empty", "expected rows", "records")
    yield refused(function, "records", "option", {"a": SPLINE}, "got a batch", "one trajectory", "records")
    yield from numbers(function, "rate", 0.0, -1.0)
