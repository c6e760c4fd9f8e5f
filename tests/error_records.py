"""Bad arguments of records of poses and of IMU samples, and of their files."""

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

from error_arguments import (
    ACCEPTED,
    F64,
    FOLDER,
    I64,
    IMU_COLUMNS,
    IMU_FILE,
    POSE_COLUMNS,
    POSES,
    SAMPLES,
    TUM_FILE,
    Case,
    Q,
    accept,
    file,
    refused,
)

import torchspline.io as records

FUNCTIONS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "read_poses": (records.read_poses, {"path": TUM_FILE}),
    "read_imu": (records.read_imu, {"path": IMU_FILE}),
    "write_poses": (records.write_poses, {"path": f"{FOLDER.name}/poses.txt", "record": POSES}),
    "write_imu": (records.write_imu, {"path": f"{FOLDER.name}/imu.csv", "record": SAMPLES}),
    "PoseRecord": (records.PoseRecord, POSE_COLUMNS),
    "ImuRecord": (records.ImuRecord, IMU_COLUMNS),
    "_Record.seconds": (POSES.seconds, {}),
    "_Record.window": (POSES.window, {"start_ns": 0, "end_ns": 3}),
}  # fmt: skip
accept(FUNCTIONS)

_FILES = "read_poses read_imu write_poses write_imu"
_WINDOWS = "_Record.seconds _Record.window"
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE: dict[str, dict[str, str]] = {
    "shape": {"no tensor": _WINDOWS, "a record, whose shape was checked": "write_poses write_imu"},
    "dtype": {"no tensor": f"{_FILES} {_WINDOWS}"},
    "device": {"no two tensors": f"{_FILES} {_WINDOWS}"},
    "nan": {"no numbers": _WINDOWS, "rows with NaN stay as they are": f"{_FILES} PoseRecord ImuRecord"},
    "zero quaternion": {
        "no quaternion goes in": f"read_imu write_imu ImuRecord {_WINDOWS}",
        "rows stay as they are until they are used": "PoseRecord",
    },
    "count": {"any number of rows": _WINDOWS},
    "time": {"any time, also none at all": " ".join(FUNCTIONS)},
}


def cases() -> Iterator[Case]:
    """Here what is wrong with arguments; what may be wrong with the content of files has tests of its own."""
    zero = file("1.5 1 2 3 0 0 0 0\n", "zero.txt")
    for function in _FILES.split():
        for bad in (5, None):
            yield refused(function, "path", "type", bad, f"got {type(bad).__name__}", "path")
        for bad in ("bvh", 5):
            yield refused(
                function, "format", "option", bad, f"got {bad!r}", "expected a format", named=function
            )
    for function in ("read_poses", "read_imu"):
        short = file("1.5,2\n", "short.csv")
        empty = file("", "empty.txt")
        yield refused(function, "path", "shape", short, "got 2 columns", "rows that look like", named=short)
        yield refused(function, "path", "count", empty, "without any", "expected rows", named=empty)
        nowhere = f"{FOLDER.name}/nowhere.txt"
        yield refused(function, "path", "option", nowhere, "no such file", nowhere, named=nowhere)
    yield refused("read_poses", "path", "zero quaternion", zero, "got '1.5", "not zero", named=zero)
    yield refused("read_poses", "times", "option", "x", "times='x'", "hold their own stamps", named=TUM_FILE)
    for function, wrong in (("write_poses", SAMPLES), ("write_imu", POSES)):
        kind = "PoseRecord" if function == "write_poses" else "ImuRecord"
        for bad in (wrong, None, SimpleNamespace()):
            yield refused(function, "record", "type", bad, f"got {type(bad).__name__}", kind)
        empty = (POSES if function == "write_poses" else SAMPLES).window(1, 0)
        path = ACCEPTED[function][1]["path"]
        yield refused(function, "record", "count", empty, "got an empty", "expected rows", named=path)
    still = records.PoseRecord(**{**POSE_COLUMNS, "rotation": 0 * Q[0]})
    yield refused("write_poses", "record", "zero quaternion", still, "got", "quaternion")
    for kind, columns in (("PoseRecord", POSE_COLUMNS), ("ImuRecord", IMU_COLUMNS)):
        for name, x in columns.items():
            named, dtype = f"{kind}.{name}", I64 if name == "time_ns" else F64
            yield refused(kind, name, "type", x.tolist(), "got list", "expected a tensor", named)
            yield refused(kind, name, "dtype", x.float(), "got torch.float32", f"expected {dtype}", named)
            yield refused(kind, name, "shape", x[None], f"got {(1, *x.shape)}", "expected shape (N,", named)
            if name != "time_ns":
                yield refused(kind, name, "count", x[:-1], "got 7", "expected 8 rows", named)
                yield refused(kind, name, "device", x.to("meta"), "meta", "cpu", named)
    yield refused("_Record.seconds", "origin_ns", "type", 1.5, "'float'", "integer", named="origin_ns")
    for name in ("start_ns", "end_ns"):
        yield refused("_Record.window", name, "type", 1.5, "'float'", "integer")
