"""What a file format has to say about itself; each format module ends with one `FORMAT`."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from torchspline.io.records import ImuRecord, PoseRecord
from torchspline.io.text import Table


@dataclass(frozen=True)
class Format:
    """One file format: how to know it, and what it can read and write (None: it cannot).

    Attributes:
        name: what callers pass as `format`.
        recognises: whether a table looks like this format.
        read_poses: from a table and the path of the stamps (None unless `separate_times`).
        read_imu: from a table.
        write_poses: to a path, and stamps to the other (None unless `separate_times`).
        write_imu: to a path.
        pose_files: where poses lie in a folder of this format, first match first; each also gzipped.
        imu_files: the same for IMU samples.
        separate_times: whether stamps are in a file of their own.
    """

    name: str
    recognises: Callable[[Table], bool]
    read_poses: Callable[[Table, Path | None], PoseRecord] | None = None
    read_imu: Callable[[Table], ImuRecord] | None = None
    write_poses: Callable[[Path, PoseRecord, Path | None], None] | None = None
    write_imu: Callable[[Path, ImuRecord], None] | None = None
    pose_files: tuple[str, ...] = ()
    imu_files: tuple[str, ...] = ()
    separate_times: bool = False
