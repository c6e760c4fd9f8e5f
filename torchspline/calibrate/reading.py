"""Reading a recording: corners from npz archives, IMU samples from csv files, the rest from one YAML file."""

import math
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchspline import checks
from torchspline.calibrate.recording import Corners, Recording
from torchspline.imu.parameters import ImuNoise
from torchspline.io import read_imu
from torchspline.io.archive import read_arrays
from torchspline.io.camera import camera_from
from torchspline.io.sections import number, numbered, read_sections, section_of
from torchspline.io.yaml import short

#: Columns of an archive: name there, name here, whole numbers, dimensions.
_COLUMNS = (
    ("t_ns", "t_ns", True, 1),
    ("frame", "frame", True, 1),
    ("uv", "uv", False, 2),
    ("xyz_m", "xyz", False, 2),
    ("tag_id", "tag_id", True, 1),
    ("corner", "corner", True, 1),
)
#: Of an IMU in the YAML file: name here, names there.
_NOISE = {
    "gyroscope_noise_density": ("gyroscope_noise_density", "sigma_g_c"),
    "accelerometer_noise_density": ("accelerometer_noise_density", "sigma_a_c"),
    "gyroscope_random_walk": ("gyroscope_random_walk", "sigma_gw_c"),
    "accelerometer_random_walk": ("accelerometer_random_walk", "sigma_aw_c"),
}
_ON_BOARD = 1e-5
#: Rows and columns of tags that a board may have.
_MOST = 10_000

Path_ = str | PathLike[str]


def read_recording(config: Path_, corners: Sequence[Path_], imus: Sequence[Path_]) -> Recording:
    """Read what `calibrate` works on.

    Args:
        config: YAML file with a section `cam0`, `cam1`, ... for each camera (camera_model, intrinsics,
            distortion_model, distortion_coeffs, resolution, as Kalibr writes them, or proj_model, proj_params,
            dist_model, dist_params; timeshift_cam_imu [s], t_imu = t_cam + timeshift_cam_imu, if something is known of
            the clocks), a section `imu0`, ... for each IMU (gyroscope_noise_density and so on, or
            sigma_g_c, sigma_a_c, sigma_gw_c, sigma_aw_c; g, the magnitude of gravity), and, if the corners are to be
            checked against it, `calib_target` (target_type aprilgrid, tag_rows, tag_cols, tag_size, tag_spacing).
        corners: one npz archive for each camera: t_ns (F,), and a row for each corner, `frame tag_id corner` (C,),
            `uv` (C, 2) px and `xyz_m` (C, 3) m in the frame of the board.
        imus: one csv file for each IMU, as `torchspline.io.read_imu` reads them.
    Raises:
        FileNotFoundError: a file that is not there.
        ValueError: files that cannot be read, are damaged or do not go together; the message names file and field.
    """
    corners, imus = _paths("corners", corners), _paths("imus", imus)
    if not isinstance(config, (str, PathLike)):  # named as it is called here
        raise TypeError(f"config: expected a path, got {type(config).__name__}")
    path = Path(config)
    content = read_sections(path)
    cameras = [
        _section(path, content, "cam", i, camera_from) for i in range(_count(path, content, "cam", corners))
    ]
    noises = [_section(path, content, "imu", i, _noise) for i in range(_count(path, content, "imu", imus))]
    given = [content[f"imu{i}"].get("g") for i in range(len(imus))]
    gravities = {checks.positive(f"{path}: g", number(f"{path}: g", g)) for g in given if g is not None}
    if len(gravities) > 1:
        raise ValueError(f"{path}: g: expected the same gravity for every IMU, got {sorted(gravities)}")
    seen = [read_corners(x) for x in corners]
    if "calib_target" in content:
        for found in seen:
            _check_board(path, content["calib_target"], found)
    gravity = {"gravity": gravities.pop()} if gravities else {}
    offsets = tuple(_section(path, content, "cam", i, _time_offset) for i in range(len(corners)))
    return Recording(
        tuple(cameras), tuple(seen), tuple(read_imu(x) for x in imus), tuple(noises),
        time_offset=offsets if any(x is not None for x in offsets) else None, **gravity,
    )  # fmt: skip


def read_corners(path: Path_) -> Corners:
    """The corners that one camera saw, from an npz archive; see `read_recording`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no archive, a damaged one, columns that are missing or wrong; the message names file and field.
    """
    if not isinstance(path, (str, PathLike)):
        raise TypeError(f"path: expected a path, got {type(path).__name__}")
    path = Path(path)
    columns = _archive(path)
    try:
        return Corners(**{name: torch.from_numpy(x) for name, x in columns.items()}, source=str(path))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None


def _archive(path: Path) -> dict[str, NDArray[Any]]:
    arrays, columns = read_arrays(path), {}
    for stored, name, whole, dimensions in _COLUMNS:
        if stored not in arrays:
            raise ValueError(
                f"{path}: {stored}: expected this array in the archive, got only {short(', '.join(arrays))}"
            )
        columns[name] = _converted(path, stored, arrays[stored], whole, dimensions)
    return columns


def _converted(path: Path, name: str, x: NDArray[Any], whole: bool, dimensions: int) -> NDArray[Any]:
    if x.ndim != dimensions:
        raise ValueError(f"{path}: {name}: expected {dimensions} dimensions, got shape {x.shape}")
    kinds = "iu" if whole else "f"
    if x.dtype.kind not in kinds or (x.dtype == np.uint64 and x.size and int(x.max()) >= 2**63):
        wanted = "whole numbers of at most 63 bits" if whole else "floating-point numbers"
        raise ValueError(f"{path}: {name}: expected {wanted}, got {x.dtype}")
    return np.ascontiguousarray(x, dtype=np.int64 if whole else np.float64)


# ---------------------------------------------------------------------- the YAML file


def _count(path: Path, content: Mapping[str, Any], kind: str, files: Sequence[Path]) -> int:
    """As many as there are files; the sections have to be there, and no others."""
    sections = numbered(content, kind)
    wanted = [f"{kind}{i}" for i in range(len(files))]
    if sections != wanted:
        raise ValueError(
            f"{path}: expected one section for each of the {len(files)} files of {kind}s, "
            f"{', '.join(wanted) or 'none'}, got {', '.join(sections) or 'none'}"
        )
    return len(files)


def _section(path: Path, content: Mapping[str, Any], kind: str, i: int, parse: Any) -> Any:
    name = f"{kind}{i}"
    section = section_of(path, content, name)
    try:
        return parse(section, name)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {name}: {short(error, 500)}") from None


def _time_offset(section: Mapping[str, Any], name: str) -> float | None:
    """What Kalibr found: `t_imu = t_cam + timeshift_cam_imu`, as here."""
    key = "timeshift_cam_imu"
    return checks.finite_number(key, number(key, section[key])) if key in section else None


def _noise(section: Mapping[str, Any], name: str) -> ImuNoise:
    found = {}
    for ours, theirs in _NOISE.items():
        key = next((x for x in theirs if x in section), None)
        if key is None:
            raise ValueError(
                f"{theirs[0]}: expected it in the section, got only {', '.join(map(str, section))}"
            )
        found[ours] = number(key, section[key])
        if ours.endswith("density"):
            checks.positive(ours, found[ours])
    return ImuNoise(**found)


def _check_board(path: Path, target: Any, corners: Corners) -> None:
    """That corners lie where an AprilGrid has them: tags row by row, their corners counter-clockwise."""
    if not isinstance(target, dict) or target.get("target_type") != "aprilgrid":
        return
    names = ("tag_rows", "tag_cols", "tag_size", "tag_spacing")
    missing = [x for x in names if x not in target]
    if missing:
        raise ValueError(f"{path}: calib_target: {missing[0]}: expected a number, got none")
    rows, columns, size, spacing = (number(f"{path}: calib_target: {x}", target[x]) for x in names)
    for name, given in zip(names, (rows, columns, size, spacing), strict=True):
        if not (math.isfinite(given) and (1 <= given <= _MOST if name in names[:2] else given >= 0)):
            raise ValueError(f"{path}: calib_target: {name}: expected the size of a board, got {given:g}")
    if len(corners) == 0:
        return
    stray = (corners.tag_id < 0) | (corners.tag_id >= rows * columns)
    if bool(stray.any()):
        bad = corners.tag_id[stray][0]
        raise ValueError(
            f"{corners.source}: tag_id: expected 0 to {rows * columns - 1:g}, as the board of {path} has, "
            f"got {int(bad)}"
        )
    if bool(((corners.corner < 0) | (corners.corner > 3)).any()):
        raise ValueError(f"{corners.source}: corner: expected 0 to 3, got {int(corners.corner.max())}")
    pitch = size * (1.0 + spacing)
    right = (corners.corner == 1) | (corners.corner == 2)
    up = corners.corner >= 2
    x = (corners.tag_id % int(columns)) * pitch + right * size
    y = torch.div(corners.tag_id, int(columns), rounding_mode="floor") * pitch + up * size
    off = (corners.xyz[:, :2] - torch.stack([x, y], dim=1)).norm(dim=1)
    if float(off.max()) > _ON_BOARD:
        row = int(off.argmax())
        raise ValueError(
            f"{corners.source}: xyz_m: expected the board of {path}, where corner {int(corners.corner[row])} of tag "
            f"{int(corners.tag_id[row])} lies at ({x[row]:.4f}, {y[row]:.4f}) m, got "
            f"({corners.xyz[row, 0]:.4f}, {corners.xyz[row, 1]:.4f}) at row {row}"
        )


def _paths(name: str, x: Any) -> list[Path]:
    if isinstance(x, (str, PathLike)) or not isinstance(x, Sequence):
        raise TypeError(f"{name}: expected a list of paths, got {type(x).__name__}")
    for y in x:
        if not isinstance(y, (str, PathLike)):
            raise TypeError(f"{name}: expected paths, got {type(y).__name__}")
    return [Path(y) for y in x]
