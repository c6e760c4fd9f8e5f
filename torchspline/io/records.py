"""What the readers return: stamped poses and stamped IMU samples, exact in time."""

from dataclasses import dataclass, fields
from operator import index
from typing import ClassVar, Self

import torch
from torch import Tensor

from torchspline.units import SECOND


def _whole(name: str, x: int) -> int:
    try:
        return index(x)
    except TypeError as error:
        raise TypeError(f"{name}: expected whole nanoseconds, {error}") from None


@dataclass(frozen=True, eq=False)
class _Record:
    """Rows that share one column of stamps; the subclasses say which columns there are and how wide."""

    time_ns: Tensor

    _widths: ClassVar[dict[str, int]] = {}

    def __post_init__(self) -> None:
        self._check("time_ns", torch.int64, ())
        for column, width in self._widths.items():
            self._check(column, torch.float64, (width,))

    def _check(self, column: str, dtype: torch.dtype, tail: tuple[int, ...]) -> None:
        name, value = f"{type(self).__name__}.{column}", getattr(self, column)
        if not isinstance(value, Tensor):
            raise TypeError(f"{name}: expected a tensor, got {type(value).__name__}")
        if value.dtype != dtype:
            raise TypeError(f"{name}: expected {dtype}, got {value.dtype}")
        if value.ndim != 1 + len(tail) or tuple(value.shape[1:]) != tail:
            wanted = f"({', '.join(['N', *map(str, tail)])}{'' if tail else ','})"
            raise ValueError(f"{name}: expected shape {wanted}, got {tuple(value.shape)}")
        if value.device != self.time_ns.device:
            raise ValueError(
                f"{name}: expected device {self.time_ns.device} as the stamps, got {value.device}"
            )
        if len(value) != len(self):
            raise ValueError(f"{name}: expected {len(self)} rows as there are stamps, got {len(value)}")

    def __len__(self) -> int:
        return self.time_ns.shape[0]

    def seconds(self, origin_ns: int | None = None) -> Tensor:
        """Seconds since `origin_ns`, (N,) float64, from a difference in int64: epoch stamps lose nothing.

        Args:
            origin_ns: nanoseconds on the clock of the record; the first stamp when not given.
        Raises:
            TypeError: an origin that is not an integer.
        """
        if origin_ns is None:
            if not len(self):
                return self.time_ns.double()
            origin_ns = int(self.time_ns[0])
        return (self.time_ns - _whole("origin_ns", origin_ns)).double() / SECOND

    @property
    def time(self) -> Tensor:
        """Seconds since the first stamp, (N,) float64."""
        return self.seconds()

    def window(self, start_ns: int, end_ns: int) -> Self:
        """The rows with `start_ns <= time_ns <= end_ns`, both ends included, in the order they have here.

        Raises:
            TypeError: ends that are not integers (a float cannot hold an epoch stamp in nanoseconds).
        """
        keep = (self.time_ns >= _whole("start_ns", start_ns)) & (self.time_ns <= _whole("end_ns", end_ns))
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return type(self)(**{k: v[keep] if isinstance(v, Tensor) else v for k, v in values.items()})


@dataclass(frozen=True, eq=False)
class PoseRecord(_Record):
    """Stamped poses that map body to world.

    Rows are those of the file: unsorted, repeated or NaN rows stay, quaternions keep their length and sign.

    Attributes:
        time_ns: nanoseconds, (N,) int64.
        position: metres in the world frame, (N, 3) float64.
        rotation: quaternions [w, x, y, z], body to world, (N, 4) float64.
        source: where the rows come from, for messages and titles.
    Raises:
        TypeError: a column that is no tensor or has another dtype.
        ValueError: a column of another shape.
    """

    position: Tensor
    rotation: Tensor
    source: str = ""

    _widths: ClassVar[dict[str, int]] = {"position": 3, "rotation": 4}


@dataclass(frozen=True, eq=False)
class ImuRecord(_Record):
    """Stamped readings of a gyroscope and an accelerometer, in the frame of the sensor.

    Attributes:
        time_ns: nanoseconds, (N,) int64.
        gyroscope: rad/s, (N, 3) float64.
        accelerometer: specific force in m/s^2, (N, 3) float64.
        source: where the rows come from, for messages and titles.
    Raises:
        TypeError: a column that is no tensor or has another dtype.
        ValueError: a column of another shape.
    """

    gyroscope: Tensor
    accelerometer: Tensor
    source: str = ""

    _widths: ClassVar[dict[str, int]] = {"gyroscope": 3, "accelerometer": 3}
