"""EuRoC csv files: integer nanoseconds first, then IMU samples or poses with the quaternion w first.

TUM VI, the camera-IMU calibration tools and many data sets since share the layout.
"""

import re
from pathlib import Path

import numpy as np
import torch

from torchspline.io.records import ImuRecord, PoseRecord
from torchspline.io.registry import Format
from torchspline.io.text import Table, parse_nanoseconds, write_table

_POSE_COLUMNS = ("t[ns]", "x", "y", "z", "qw", "qx", "qy", "qz")
_IMU_COLUMNS = ("t[ns]", "wx", "wy", "wz", "ax", "ay", "az")
_POSE_HEAD = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
_IMU_HEAD = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)


def recognises(table: Table) -> bool:
    """Seven columns or more that start with nanoseconds, and no header that puts the quaternion's w last."""
    w_last = re.search(r"q\w*x.*q\w*w", table.head)
    return table.columns >= len(_IMU_COLUMNS) and table.unit_of_time == "ns" and not w_last


def read_poses(table: Table, times: Path | None = None) -> PoseRecord:
    """The poses of an EuRoC table; columns after the quaternion (velocity, biases) are not read.

    Raises:
        ValueError: too few columns, a field that is no number, a stamp that is no integer, a zero quaternion.
    """
    table.check_columns(_POSE_COLUMNS, more=True)
    return PoseRecord(
        time_ns=torch.from_numpy(table.stamps(parse_nanoseconds)),
        position=torch.from_numpy(table.values(1, 4)),
        rotation=torch.from_numpy(table.quaternions(4, "wxyz")),
        source=str(table.path),
    )


def read_imu(table: Table) -> ImuRecord:
    """The IMU samples of an EuRoC table, rad/s and m/s^2.

    Raises:
        ValueError: not seven columns, a field that is no number, a stamp that is no integer.
    """
    table.check_columns(_IMU_COLUMNS)
    return ImuRecord(
        time_ns=torch.from_numpy(table.stamps(parse_nanoseconds)),
        gyroscope=torch.from_numpy(table.values(1, 4)),
        accelerometer=torch.from_numpy(table.values(4, 7)),
        source=str(table.path),
    )


def write_poses(path: Path, record: PoseRecord, times: Path | None = None) -> None:
    """Write an EuRoC pose csv, gzipped when the name ends with .gz."""
    _write(path, _POSE_HEAD, record.time_ns, record.position, record.rotation)


def write_imu(path: Path, record: ImuRecord) -> None:
    """Write an EuRoC IMU csv, gzipped when the name ends with .gz."""
    _write(path, _IMU_HEAD, record.time_ns, record.gyroscope, record.accelerometer)


def _write(path: Path, head: str, time_ns: torch.Tensor, *columns: torch.Tensor) -> None:
    values = np.hstack([column.detach().cpu().numpy() for column in columns])
    write_table(path, head, map(str, time_ns.tolist()), values, ",")


_ROOTS = ("", "mav0/")

FORMAT = Format(
    "euroc",
    recognises,
    read_poses=read_poses,
    read_imu=read_imu,
    write_poses=write_poses,
    write_imu=write_imu,
    pose_files=(
        "data.csv",
        *(
            f"{root}{folder}/data.csv"
            for root in _ROOTS
            for folder in ("state_groundtruth_estimate0", "mocap0")
        ),
    ),
    imu_files=("data.csv", *(f"{root}imu0/data.csv" for root in _ROOTS)),
)
