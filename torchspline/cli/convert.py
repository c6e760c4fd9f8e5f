"""`torchspline convert`."""

import sys
import tempfile
from pathlib import Path
from typing import Literal

from torchspline.cli.files import PIPE, PoseFormat, is_trajectory, open_record, sampled
from torchspline.cli.report import Report
from torchspline.io import (
    ImuRecord,
    PoseRecord,
    load_trajectory,
    write_imu,
    write_nerfstudio,
    write_poses,
    write_rerun,
    write_rosbag,
)
from torchspline.io.kitti import times_beside
from torchspline.splines import Trajectory

EXAMPLES = """
torchspline convert data.csv poses.txt                   # EuRoC to TUM
torchspline convert 00.txt 00_euroc.csv --times times.txt  # KITTI to EuRoC
torchspline convert data.csv 07_gt.txt --to kitti        # to KITTI, with 07_times.txt
torchspline convert motion.npz poses.txt --rate 100      # a saved trajectory, sampled
torchspline convert walk.bvh head.csv --joint Head       # motion capture
torchspline convert drive.bag odometry.txt --topic /odom  # a bag of ROS
torchspline convert motion.npz motion.rrd                # for the viewer of rerun
gunzip -c poses.txt.gz | torchspline convert - - --to euroc > data.csv
"""
Target = Literal["tum", "euroc", "kitti", "nerfstudio", "ros", "rerun"]
Message = Literal["PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "Odometry", "TFMessage"]
_BY_SUFFIX: dict[str, Target] = {
    ".txt": "tum",
    ".tum": "tum",
    ".csv": "euroc",
    ".json": "nerfstudio",
    ".bag": "ros",
    ".mcap": "ros",
    ".db3": "ros",
    ".rrd": "rerun",
}
_OF_IMUS: tuple[Target, ...] = ("euroc", "ros", "rerun")
_TEXT: tuple[Target, ...] = ("tum", "euroc", "nerfstudio")


def convert(
    source: Path,
    target: Path,
    to: Target | None = None,
    format: PoseFormat | None = None,
    times: Path | None = None,
    topic: str | None = None,
    child: str | None = None,
    message: Message = "PoseStamped",
    joint: str | None = None,
    unit: float = 0.01,
    fps: float | None = None,
    rate: float = 100.0,
) -> Report:
    """Poses or IMU readings from one file format to another, exact to the last digit where the format allows it.

    Args:
        source: TUM, EuRoC, KITTI, nerfstudio or BVH file, ROS bag, or saved trajectory; - is standard input.
        target: the file to write, - for standard output; an existing one is replaced, bags excepted, and text is
            gzipped if the name ends with .gz. Stamps of KITTI go beside it: times.txt for poses.txt, else
            NAME_times.txt. A camera path of nerfstudio, unless the file is called transforms.json. Bags are ROS 1
            if called .bag, a file of ROS 2 if .mcap or .db3 and a folder otherwise.
        to: by default as the name of the target says: .txt .csv .json .bag .mcap .db3 .rrd.
        format: of the source; by default recognised from its content, or its name: .json .bvh .bag .mcap .db3.
        times: file of times that goes with KITTI poses.
        topic: of a ROS bag, read or written.
        child: frame of the transforms in a topic: the one read where there are several, and the one written.
        message: what poses become in a ROS bag.
        joint: of motion capture; its root by default.
        unit: of the lengths in motion capture, m.
        fps: frames per second of a nerfstudio file without times.
        rate: of the poses sampled from a saved trajectory, Hz.
    """
    to = to or _named(target)
    if target == PIPE and to not in _TEXT:
        raise ValueError(f"target: expected the name of a file for {to}; - takes {', '.join(_TEXT)}")
    files = [target, times_beside(target)] if to == "kitti" else [target]
    if source != PIPE and source.resolve() in [file.resolve() for file in files]:
        raise ValueError(f"target: expected another file than the source, got {target}")
    record: PoseRecord | ImuRecord | Trajectory
    if is_trajectory(source):
        record = load_trajectory(source)
        if to != "rerun":
            record = sampled(record, rate, source.name)
    else:
        record = open_record(source, format, times, topic, child, joint=joint, unit=unit, fps=fps)
    if to == "rerun":
        write_rerun(target, {topic or "body": record}, rate=rate)
    else:
        assert not isinstance(record, Trajectory)
        _write(target, record, to, topic, child or "body", message)
    what = "a trajectory" if isinstance(record, Trajectory) else str(len(record))
    kind = "IMU readings" if isinstance(record, ImuRecord) else "poses"
    rows = [(kind, what, ""), ("written as", to, "")]
    values = {"rows": None if isinstance(record, Trajectory) else len(record), "kind": kind, "format": to}
    return Report(f"{source.name} to {target.name}", values, rows, files=files, aside=target == PIPE)


def _named(target: Path) -> Target:
    suffix = Path(target.name.removesuffix(".gz")).suffix
    if suffix == ".npz":
        raise ValueError(
            f"to: a trajectory goes through poses, it has to be fitted: torchspline fit --out {target}"
        )
    if suffix not in _BY_SUFFIX:
        raise ValueError(
            f"to: expected tum, euroc, kitti, nerfstudio, ros or rerun, or a target named {' '.join(_BY_SUFFIX)}, "
            f"got {target.name}"
        )
    return _BY_SUFFIX[suffix]


def _write(
    target: Path, record: PoseRecord | ImuRecord, to: Target, topic: str | None, child: str, message: Message
) -> None:
    if target == PIPE:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder, "stdout")
            _write(file, record, to, topic, child, message)
            sys.stdout.write(file.read_text(encoding="utf-8"))
    elif to == "ros":
        write_rosbag(target, {topic or _topic(record): record}, message, child=child)
    elif isinstance(record, ImuRecord):
        if to not in _OF_IMUS:
            raise ValueError(
                f"to: expected one of {', '.join(_OF_IMUS)} for IMU readings, which {record.source} has, got {to}"
            )
        write_imu(target, record)
    elif to == "nerfstudio":
        data_set = target.name.removesuffix(".gz") == "transforms.json"
        try:
            write_nerfstudio(target, record, "transforms" if data_set else "camera_path")
        except ValueError as reason:
            raise ValueError(
                str(reason).replace("write kind='transforms'", "write transforms.json")
            ) from None
    else:
        write_poses(target, record, to)


def _topic(record: PoseRecord | ImuRecord) -> str:
    return "/imu" if isinstance(record, ImuRecord) else "/poses"
