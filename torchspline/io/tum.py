"""TUM trajectories: text, `t x y z qx qy qz qw` a line, seconds and metres, body to world."""

from pathlib import Path

import numpy as np
import torch

from torchspline.io.records import PoseRecord
from torchspline.io.registry import Format
from torchspline.io.text import Table, format_seconds, parse_seconds, write_table

_COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")


def recognises(table: Table) -> bool:
    """Eight columns that start with seconds."""
    return table.columns == len(_COLUMNS) and table.unit_of_time == "s"


def read_poses(table: Table, times: Path | None = None) -> PoseRecord:
    """The poses of a TUM table; stamps go from decimal text to nanoseconds exactly.

    Raises:
        ValueError: not eight columns, a field that is no number, a time not finite, a zero quaternion.
    """
    table.check_columns(_COLUMNS)
    return PoseRecord(
        time_ns=torch.from_numpy(table.stamps(parse_seconds)),
        position=torch.from_numpy(table.values(1, 4)),
        rotation=torch.from_numpy(table.quaternions(4, "xyzw")),
        source=str(table.path),
    )


def write_poses(path: Path, record: PoseRecord, times: Path | None = None) -> None:
    """Write a TUM file with nine digits of seconds, gzipped when the name ends with .gz."""
    xyzw = record.rotation[:, [1, 2, 3, 0]]
    values = np.hstack([column.detach().cpu().numpy() for column in (record.position, xyzw)])
    stamps = map(format_seconds, record.time_ns.tolist())
    write_table(path, f"# {' '.join(_COLUMNS)}", stamps, values, " ")


FORMAT = Format("tum", recognises, read_poses=read_poses, write_poses=write_poses)
