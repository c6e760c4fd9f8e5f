"""Kalibr's `camchain-imucam.yaml`: cameras, their poses on an IMU, and their clocks."""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchspline import checks
from torchspline.groups.group import SE3
from torchspline.io.archive import write_bytes
from torchspline.io.camera import Camera, camera_from
from torchspline.io.sections import number, numbered, read_sections, section_of
from torchspline.io.yaml import short


@dataclass(frozen=True, eq=False)
class CamChain:
    """C cameras on an IMU. Files hold `T_cam_imu`, the inverse of what is here.

    Attributes:
        cameras: with intrinsics and distortion.
        T_imu_cam: (C, 7) float64 SE3, maps points of a camera into the frame of the IMU.
        time_offset: (C,) float64 s, `t_imu = t_cam + time_offset`; Kalibr's `timeshift_cam_imu`.
    Raises:
        TypeError, ValueError: a wrong type or shape, no camera, numbers that are not finite.
    """

    cameras: tuple[Camera, ...]
    T_imu_cam: Tensor
    time_offset: Tensor

    def __post_init__(self) -> None:
        if not isinstance(self.cameras, Sequence):
            raise TypeError(f"cameras: expected a tuple of Camera, got {type(self.cameras).__name__}")
        for i, camera in enumerate(self.cameras):
            checks.instance(f"cameras[{i}]", camera, Camera, "a Camera")
        if not self.cameras:
            raise ValueError("cameras: expected at least one, got none")
        object.__setattr__(self, "cameras", tuple(self.cameras))
        count = len(self.cameras)
        for name, shape in (("T_imu_cam", (count, 7)), ("time_offset", (count,))):
            x = checks.is_floating_tensor(name, getattr(self, name))
            if x.dtype != torch.float64:
                raise TypeError(f"{name}: expected dtype torch.float64, got {x.dtype}")
            if tuple(x.shape) != shape:
                raise ValueError(f"{name}: expected shape {shape}, one row a camera, got {tuple(x.shape)}")
            checks.finite(name, x)
        checks.point("T_imu_cam", self.T_imu_cam, SE3, "poses")


def read_camchain(path: str | PathLike[str]) -> CamChain:
    """Read a `camchain-imucam.yaml`, by Kalibr or by `write_camchain`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no such content; the message names the file and the entry.
    """
    content = read_sections(path)
    path = Path(path)
    names = numbered(content, "cam")
    if not names:
        raise ValueError(
            f"{path}: expected sections cam0, cam1, ..., got only {short(', '.join(map(str, content))) or 'none'}"
        )
    cameras, poses, offsets = [], [], []
    for name in names:
        section = section_of(path, content, name)
        try:
            cameras.append(camera_from(section, name))
            if "T_cam_imu" not in section:
                raise ValueError(
                    "T_cam_imu: expected a 4 x 4 matrix, got none; camchain.yaml knows of cameras only, the file with "
                    "the IMU is camchain-imucam.yaml"
                )
            poses.append(SE3.inverse(SE3.from_matrix(_matrix("T_cam_imu", section["T_cam_imu"]))))
            offsets.append(number("timeshift_cam_imu", section.get("timeshift_cam_imu", 0.0)))
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"{path}: {short(name, 40)}: {short(error, 500)}") from None
    try:
        return CamChain(tuple(cameras), torch.stack(poses), torch.tensor(offsets, dtype=torch.float64))
    except ValueError as error:
        raise ValueError(f"{path}: {short(error, 500)}") from None


def write_camchain(path: str | PathLike[str], chain: CamChain) -> None:
    """Write a `camchain-imucam.yaml` that Kalibr and what builds on it read. An existing file is replaced.

    Raises:
        TypeError: no CamChain.
        FileNotFoundError: the folder of `path` does not exist.
    """
    import yaml

    if not isinstance(path, (str, PathLike)):
        raise TypeError(f"path: expected a path, got {type(path).__name__}")
    checks.instance("chain", chain, CamChain, "a torchspline.io.CamChain")
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: the folder {path.parent} does not exist; make it first")
    with torch.no_grad():
        T_cam_imu = SE3.inverse(chain.T_imu_cam)
        content = {}
        for i, camera in enumerate(chain.cameras):
            section: dict[str, Any] = {"T_cam_imu": SE3.to_matrix(T_cam_imu[i]).tolist()}
            if i:
                step = SE3.compose(T_cam_imu[i], chain.T_imu_cam[i - 1])
                section["T_cn_cnm1"] = SE3.to_matrix(step).tolist()
            section |= {
                "cam_overlaps": [j for j in range(len(chain.cameras)) if j != i],
                "camera_model": camera.model,
                "distortion_coeffs": list(camera.coefficients),
                "distortion_model": camera.distortion,
                "intrinsics": list(camera.intrinsics),
                "resolution": list(camera.resolution),
                "rostopic": f"/{camera.name}/image_raw",
                "timeshift_cam_imu": float(chain.time_offset[i]),
            }
            content[f"cam{i}"] = section
    write_bytes(path, yaml.safe_dump(content, default_flow_style=None, sort_keys=False).encode())


def _matrix(name: str, rows: Any) -> Tensor:
    if (
        not isinstance(rows, list)
        or len(rows) != 4
        or any(not isinstance(r, list) or len(r) != 4 for r in rows)
    ):
        raise ValueError(f"{name}: expected a 4 x 4 matrix, got {str(rows)[:60]!r}")
    matrix = torch.tensor([[number(name, x) for x in row] for row in rows], dtype=torch.float64)
    if bool((matrix[3] != torch.tensor([0.0, 0.0, 0.0, 1.0])).any()):
        raise ValueError(f"{name}: expected a last row of 0 0 0 1, got {rows[3]}")
    return matrix
