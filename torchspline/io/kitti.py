"""KITTI odometry poses: a 3x4 matrix row by row on each line, stamps in seconds in a file of their own."""

import re
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from torchspline.groups.group import SO3
from torchspline.io.archive import replacing, write_bytes
from torchspline.io.records import PoseRecord
from torchspline.io.registry import Format
from torchspline.io.text import Table, format_seconds, parse_seconds, read_table, write_table

_COLUMNS = tuple(f"{name}{row}" for row in "123" for name in ("r1", "r2", "r3", "t"))
_TOLERANCE = 1e-4  # entries are printed with 7 digits


def recognises(table: Table) -> bool:
    """Twelve columns that do not start with nanoseconds."""
    return table.columns == len(_COLUMNS) and table.unit_of_time != "ns"


def read_poses(table: Table, times: Path | None = None) -> PoseRecord:
    """The poses of a KITTI table with the stamps of `times`, or of the times file found beside it.

    Rotation matrices become unit quaternions; rows with NaN stay NaN.

    Raises:
        FileNotFoundError: no times file given and none found.
        ValueError: a wrong number of columns or stamps, a field that is no number, a matrix that reflects
            or whose `R R^T` departs from the identity by more than 1e-4.
    """
    table.check_columns(_COLUMNS)
    matrices = table.values(0, 12).reshape(-1, 3, 4)
    stamps = read_table(times or find_times(table.path))
    stamps.check_columns(("t",))
    time_ns = stamps.stamps(parse_seconds)
    if len(time_ns) != len(matrices):
        raise ValueError(
            f"{stamps.path}: expected {len(matrices)} stamps as there are poses in {table.path}, "
            f"got {len(time_ns)}"
        )
    return PoseRecord(
        time_ns=torch.from_numpy(time_ns),
        position=torch.from_numpy(matrices[:, :, 3].copy()),
        rotation=torch.from_numpy(_quaternions(table, matrices[:, :, :3])),
        source=str(table.path),
    )


def find_times(path: Path) -> Path:
    """The times file that belongs to a file of poses.

    Tried in this order, each also gzipped: that of `times_beside`, `times.txt` in the same folder,
    `../sequences/NAME/times.txt` as in the KITTI archive.

    Raises:
        FileNotFoundError: none of them exists.
    """
    name = path.name.removesuffix(".gz")
    beside = times_beside(path)
    archive = path.parent.parent / "sequences" / Path(name).stem
    plain = beside.with_name(beside.name.removesuffix(".gz"))
    candidates = [plain, path.with_name("times.txt"), archive / "times.txt"]
    for candidate in candidates:
        # What was written together is packed alike.
        both = (candidate, candidate.with_name(candidate.name + ".gz"))
        for found in both if plain == beside else both[::-1]:
            if found.is_file():
                return found
    raise FileNotFoundError(
        f"{path}: KITTI poses need a file of stamps; pass times=PATH or provide one of "
        + ", ".join(map(str, candidates))
    )


def times_beside(path: Path) -> Path:
    """Where the stamps of a file of poses are written: `times` for `gt` or `poses` in its name, or behind it.

    `poses.txt` goes with `times.txt`, `00_gt.txt` with `00_times.txt`, and `00.txt` with `00_times.txt` as well.
    """
    name, packed = path.name.removesuffix(".gz"), ".gz" if path.suffix == ".gz" else ""
    renamed = re.sub(r"(?<![A-Za-z])(gt|poses)(?![A-Za-z])", "times", name)
    if renamed == name:
        renamed = f"{Path(name).stem}_times{Path(name).suffix}"
    return path.with_name(renamed + packed)


def write_poses(path: Path, record: PoseRecord, times: Path | None = None) -> None:
    """Write a 3x4 matrix a line, row by row, and a line of decimal seconds for each into the file of stamps.

    Both are gzipped where their names end with .gz. Rotations come back to rounding, as unit quaternions of either
    sign; positions and stamps exactly.

    Both are written or neither.

    Raises:
        ValueError: stamps are to go into the file of the poses, or beside what is no file.
    """
    if times is None and path.exists() and not (path.is_file() or path.is_dir()):
        raise ValueError(f"path: expected the name of a file, beside which its stamps can go, got {path}")
    stamps = times or times_beside(path)
    if stamps.resolve() == path.resolve():
        raise ValueError(f"times: expected another file than that of the poses, got {stamps}")
    matrices = torch.cat([_matrices(record.rotation), record.position[..., None]], -1).reshape(-1, 12)
    with replacing(path) as part, replacing(stamps) as part_of_stamps:
        write_table(part, "", (), matrices.detach().cpu().numpy(), " ")
        write_bytes(
            part_of_stamps, "".join(f"{format_seconds(t)}\n" for t in record.time_ns.tolist()).encode()
        )


def _matrices(rotation: torch.Tensor) -> torch.Tensor:
    """NaN where quaternions are not finite."""
    finite = rotation.isfinite().all(-1)
    found = rotation.new_full((len(rotation), 3, 3), float("nan"))
    found[finite] = SO3.to_matrix(rotation[finite])
    return found


def _quaternions(table: Table, rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.spatial.transform import Rotation

    finite = np.isfinite(rotations).all(axis=(1, 2))
    matrices = rotations[finite]
    result = np.full((len(rotations), 4), np.nan)
    if not len(matrices):
        return result
    error = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = (error > _TOLERANCE) | (np.linalg.det(matrices) < 0)
    if wrong.any():
        at = int(wrong.argmax())
        got = "a reflection" if error[at] <= _TOLERANCE else f"one that is off by {error[at]:.2g}"
        row = int(np.flatnonzero(finite)[at])
        raise table.error(row, got, f"a rotation matrix, orthonormal within {_TOLERANCE:g}")
    result[finite] = np.roll(Rotation.from_matrix(matrices).as_quat(), 1, axis=1)
    return result


FORMAT = Format("kitti", recognises, read_poses=read_poses, write_poses=write_poses, separate_times=True)
