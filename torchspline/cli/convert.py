"""`torchspline convert`."""

from pathlib import Path
from typing import Literal

from torchspline.cli.files import PoseFormat, is_trajectory, open_poses, sampled
from torchspline.cli.report import Report
from torchspline.io import PoseRecord, load_trajectory, write_nerfstudio, write_poses, write_rosbag

EXAMPLES = """
torchspline convert data.csv poses.txt                   # EuRoC to TUM
torchspline convert 00.txt 00_euroc.csv --times times.txt  # KITTI to EuRoC
torchspline convert motion.npz poses.txt --rate 100      # a saved trajectory, sampled
"""
Target = Literal["tum", "euroc", "nerfstudio", "ros"]
_BY_SUFFIX: dict[str, Target] = {".txt": "tum", ".tum": "tum", ".csv": "euroc", ".json": "nerfstudio"}


def convert(
    source: Path,
    target: Path,
    to: Target | None = None,
    format: PoseFormat | None = None,
    times: Path | None = None,
    topic: str | None = None,
    rate: float = 100.0,
) -> Report:
    """Poses from one file format to another, exact to the last digit of stamps and numbers.

    Args:
        source: TUM, EuRoC, KITTI or nerfstudio file, ROS bag, or saved trajectory.
        target: the file to write; an existing one is replaced, gzipped if the name ends with .gz.
        to: tum, euroc, nerfstudio, or ros for the folder of a bag; by default as the name of the target says
            (.txt .csv .json).
        format: of the source; by default recognised from its content.
        times: file of times that goes with KITTI poses.
        topic: of a ROS bag, read or written.
        rate: of the poses sampled from a saved trajectory, Hz.
    """
    suffix = Path(target.name.removesuffix(".gz")).suffix
    to = to or _BY_SUFFIX.get(suffix)
    if to is None:
        raise ValueError(
            f"to: expected tum, euroc, nerfstudio or ros, or a target named {' '.join(_BY_SUFFIX)}, "
            f"got {target.name}"
        )
    if source.resolve() == target.resolve():
        raise ValueError(f"target: expected another file than the source, got {target}")
    if is_trajectory(source):
        record = sampled(load_trajectory(source), rate, source.name)
    else:
        record = open_poses(source, format, times, topic)
    _write(target, record, to, topic)
    rows = [("poses", str(len(record)), ""), ("written as", to, "")]
    return Report(
        f"{source.name} to {target.name}", {"rows": len(record), "format": to}, rows, files=[target]
    )


def _write(target: Path, record: PoseRecord, to: Target, topic: str | None) -> None:
    if to == "nerfstudio":
        write_nerfstudio(target, record)
    elif to == "ros":
        write_rosbag(target, {topic or "/poses": record})
    else:
        write_poses(target, record, to)
