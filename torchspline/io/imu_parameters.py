"""Parameters of IMUs in YAML files: Kalibr's `imu.yaml` and `*-imu.yaml`, EuRoC's `sensor.yaml`."""

import importlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchspline import checks
from torchspline.groups.convert import from_rotation_matrix, from_transform_matrix, to_transform_matrix
from torchspline.groups.group import SE3, SO3
from torchspline.imu.parameters import ImuNoise
from torchspline.io.archive import write_bytes
from torchspline.io.yaml import read_yaml, short

_DENSITIES = (
    "accelerometer_noise_density",
    "accelerometer_random_walk",
    "gyroscope_noise_density",
    "gyroscope_random_walk",
)
_UNITS = dict(
    zip(_DENSITIES, ("m/s^2/sqrt(Hz)", "m/s^3/sqrt(Hz)", "rad/s/sqrt(Hz)", "rad/s^2/sqrt(Hz)"), strict=True)
)
FORMATS = ("kalibr", "euroc")
# Files are written by hand and by several tools; rotations in them may be rounded to this.
_ROUNDED = 1e-4


@dataclass(frozen=True, eq=False)
class ImuParameters:
    """What parameter files say of an IMU; `Imu(noise=p.noise, rate=p.rate, T_body_imu=p.T_body_imu, **p.calibration)`.

    Attributes:
        noise: its densities. rate: samples per second, Hz.
        T_body_imu: SE3 pose (7,) of the IMU in the body; None where the file has none.
        topic: Kalibr's `rostopic`; None where the file has none.
        calibration: scales, misalignments, rotation and g-sensitivity of a Kalibr result, by the names `Imu` has.
    """

    noise: ImuNoise
    rate: float
    T_body_imu: Tensor | None = None
    topic: str | None = None
    calibration: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        checks.instance("noise", self.noise, ImuNoise, "a torchspline.imu.ImuNoise")
        checks.positive("rate", self.rate)
        if self.T_body_imu is not None:
            checks.point("T_body_imu", self.T_body_imu, SE3, "an SE3 pose")
            if self.T_body_imu.ndim != 1:
                raise ValueError(f"T_body_imu: expected shape (7,), got {tuple(self.T_body_imu.shape)}")
        if self.topic is not None:
            checks.instance("topic", self.topic, str, "text")
        checks.instance("calibration", self.calibration, Mapping, "a mapping")


def read_imu_parameters(path: str | PathLike[str], inflation: float = 1.0) -> ImuParameters:
    """Read Kalibr's `imu.yaml`, its result `*-imu.yaml` (the first IMU), or EuRoC's `sensor.yaml`.

    Args:
        path: the file. EuRoC's is known by its key `rate_hz`.
        inflation: by how much the densities in the file were inflated for an estimator; they are divided by it. Many
            files hold ten times what an Allan deviation gives, and readings simulated with those are ten times too
            noisy.
    Raises:
        FileNotFoundError: no such file.
        ValueError: a key that is missing or has no usable value; the message names the file and the key.
    """
    path = _path(path)
    checks.positive("inflation", inflation)
    content: dict[str, Any] = read_yaml(path, f"keys such as {_DENSITIES[0]}")
    if len(content) >= 1 and all(
        isinstance(x, dict) and str(k).startswith("imu") for k, x in content.items()
    ):
        content = next(iter(content.values()))
    if content.get("time_offset") and _finite(path, content, "time_offset") != 0:
        raise ValueError(
            f"{path}: key time_offset: expected 0, as there is no place for another one, got {content['time_offset']}; "
            "set it to 0 here, and give the time offset to Imu"
        )
    rate_key = "rate_hz" if "rate_hz" in content else "update_rate"
    densities = {name: _number(path, content, name, zero_too=True) / inflation for name in _DENSITIES}
    rate = _number(path, content, rate_key)
    pose = None
    if content.get("T_BS") is not None:
        pose = _transform(path, "T_BS", _matrix_of(path, content["T_BS"]))
    elif content.get("T_i_b") is not None:
        pose = SE3.inverse(_transform(path, "T_i_b", _matrix(path, "T_i_b", content["T_i_b"], 4)))
    topic = content.get("rostopic")
    if topic is not None and not isinstance(topic, str):
        raise ValueError(f"{path}: key rostopic: expected text, got {short(repr(topic))}")
    return ImuParameters(ImuNoise(**densities), rate, pose, topic, _calibration(path, content))


def write_imu_parameters(
    path: str | PathLike[str], parameters: ImuParameters, format: str = "kalibr", inflation: float = 1.0
) -> None:
    """Write Kalibr's `imu.yaml` or EuRoC's `sensor.yaml`; reading it back gives the same float64 numbers.

    An existing file is replaced.

    Args:
        inflation: factor on the densities that are written, for estimators that need to be told more noise than an
            Allan deviation shows: ten to twenty is common.
    Raises:
        FileNotFoundError: the folder of `path` does not exist.
        ValueError: an unknown format, or noise or calibration that such a file cannot hold.
    """
    path = _path(path)
    checks.instance("parameters", parameters, ImuParameters, "a torchspline.io.ImuParameters")
    checks.choice("format", format, FORMATS)
    checks.positive("inflation", inflation)
    noise = parameters.noise
    for sensor in ("gyroscope", "accelerometer"):
        for name in ("bias_sigma", "bias_instability"):
            if torch.as_tensor(getattr(noise, f"{sensor}_{name}")).any():
                raise ValueError(
                    f"parameters: {sensor}_{name} has no place in such a file, which holds densities and walks"
                )
    if parameters.calibration:
        raise ValueError(
            f"parameters: expected no calibration, which has no place in such a file, got "
            f"{', '.join(parameters.calibration)}"
        )
    lines = [] if format == "kalibr" else ["sensor_type: imu", "comment: torchspline"]
    pose = parameters.T_body_imu
    if pose is not None and format == "kalibr":
        raise ValueError("parameters: expected no T_body_imu, which has no place in a kalibr file; got one")
    if format == "euroc":
        identity = SE3.identity(dtype=torch.float64) if pose is None else pose
        rows = to_transform_matrix(identity.detach().to("cpu", torch.float64)).tolist()
        data = ",\n         ".join(", ".join(map(repr, row)) for row in rows)
        lines += [
            "T_BS:",
            "  cols: 4",
            "  rows: 4",
            f"  data: [{data}]",
            f"rate_hz: {float(parameters.rate)!r}",
        ]
    for name in _DENSITIES:
        x = torch.as_tensor(getattr(noise, name), dtype=torch.float64).detach()
        if x.numel() == 0 or not (x == x.flatten()[0]).all():
            raise ValueError(f"parameters: such a file holds one {name} for all axes, got {x.tolist()}")
        lines.append(f"{name}: {_float(float(x.flatten()[0]) * inflation)}  # {_UNITS[name]}")
    if format == "kalibr":
        if parameters.topic is not None:
            lines.append(f"rostopic: {_text(parameters.topic)}")
        lines.append(f"update_rate: {float(parameters.rate)!r}  # Hz")
    if path.is_dir():
        raise ValueError(f"{path}: expected a file, got a folder")
    write_bytes(path, ("\n".join(lines) + "\n").encode())


def _float(x: float) -> str:
    """So that YAML 1.1 takes it for a number: 1e-05 lacks the point it wants."""
    text = repr(x)
    return text if "." in text or "e" not in text else text.replace("e", ".0e")


def _text(x: str) -> str:
    # In quotes, where what would break the line is escaped.
    text: str = importlib.import_module("yaml").safe_dump(x, default_style='"', width=math.inf)
    return text.rstrip("\n")


def _path(path: str | PathLike[str]) -> Path:
    if not isinstance(path, (str, PathLike)):
        raise TypeError(f"path: expected a path, got {type(path).__name__}")
    return Path(path)


def _finite(path: Path, content: Mapping[str, Any], key: str) -> float:
    if key not in content:
        raise ValueError(
            f"{path}: key {key} is missing; expected a number; there are {short(', '.join(map(str, content)))}"
        )
    x = content[key]
    try:
        if isinstance(x, bool):
            raise TypeError
        value = float(x)  # YAML 1.1 takes 1e-3 for text
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{path}: key {key}: expected a number, got {short(repr(x))}") from None
    if not math.isfinite(value):
        raise ValueError(f"{path}: key {key}: expected a finite number, got {value}")
    return value


def _number(path: Path, content: Mapping[str, Any], key: str, zero_too: bool = False) -> float:
    value = _finite(path, content, key)
    if value < 0 or (value == 0 and not zero_too):
        least = "of at least zero" if zero_too else "above zero"
        raise ValueError(f"{path}: key {key}: expected a finite number {least}, got {value}")
    return value


def _matrix_of(path: Path, x: Any) -> Tensor:
    """OpenCV's way: {cols, rows, data}."""
    if not isinstance(x, dict) or "data" not in x:
        raise ValueError(f"{path}: key T_BS: expected cols, rows and data, got {short(repr(x))}")
    data = x["data"]
    if isinstance(data, list) and len(data) == 16 and not any(isinstance(y, list) for y in data):
        data = [data[i : i + 4] for i in range(0, 16, 4)]
    return _matrix(path, "T_BS", data, 4)


def _matrix(path: Path, key: str, x: Any, size: int) -> Tensor:
    try:
        rows = [[float(y) for y in row] for row in x]
    except (TypeError, ValueError, OverflowError):
        rows = []
    if len(rows) != size or any(len(row) != size for row in rows):
        raise ValueError(f"{path}: key {key}: expected {size} x {size} numbers, got {short(repr(x))}")
    matrix = torch.tensor(rows, dtype=torch.float64)
    if not matrix.isfinite().all():
        raise ValueError(f"{path}: key {key}: expected finite numbers, got {rows}")
    return matrix


def _transform(path: Path, key: str, matrix: Tensor) -> Tensor:
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    if not torch.equal(matrix[3], bottom):
        raise ValueError(f"{path}: key {key}: expected a last row 0 0 0 1, got {matrix[3].tolist()}")
    matrix = matrix.clone()
    matrix[:3, :3] = _rotation(path, key, matrix[:3, :3])
    return from_transform_matrix(matrix)


def _rotation(path: Path, key: str, matrix: Tensor) -> Tensor:
    """The nearest rotation of one that was rounded when it was written."""
    u, _, vh = torch.linalg.svd(matrix)
    nearest = u @ vh
    if torch.linalg.det(nearest) < 0 or (nearest - matrix).abs().max() > _ROUNDED:
        raise ValueError(f"{path}: key {key}: expected a rotation, got {matrix.tolist()}")
    return nearest


def _calibration(path: Path, content: Mapping[str, Any]) -> dict[str, Tensor]:
    """Of Kalibr's results: M of both sensors (lower triangular), A and C_gyro_i of the gyroscopes."""
    found: dict[str, Tensor] = {}
    for sensor in ("gyroscope", "accelerometer"):
        given = content.get(f"{sensor}s")
        if given is None:
            continue
        if not isinstance(given, dict):
            raise ValueError(f"{path}: key {sensor}s: expected matrices by name, got {short(repr(given))}")
        for name, x in given.items():
            key = f"{sensor}s.{name}"
            if name == "M":
                matrix = _matrix(path, key, x, 3)
                if matrix.triu(1).any():
                    raise ValueError(f"{path}: key {key}: expected a lower triangular matrix, got {x}")
                found[f"{sensor}_scale"] = matrix.diagonal().clone()
                found[f"{sensor}_misalignment"] = torch.stack([matrix[1, 0], matrix[2, 0], matrix[2, 1]])
            elif name == "A" and sensor == "gyroscope":
                found["g_sensitivity"] = _matrix(path, key, x, 3)
            elif name == "C_gyro_i" and sensor == "gyroscope":
                turn = _rotation(path, key, _matrix(path, key, x, 3))
                found["gyroscope_rotation"] = SO3.inverse(from_rotation_matrix(turn))
            else:
                raise ValueError(
                    f"{path}: key {key}: expected M, A or C_gyro_i, got a model that is not supported"
                )
    return found
