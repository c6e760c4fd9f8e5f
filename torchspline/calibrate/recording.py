"""What a calibration starts from: corners of a board seen by cameras, readings of IMUs, and how noisy those are."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchspline import checks
from torchspline.imu.parameters import ImuNoise
from torchspline.io.camera import Camera
from torchspline.io.records import ImuRecord
from torchspline.units import SECOND

#: Corners may lie as far outside of the image (px) as sub-pixel refinement may put them.
_BEYOND = 2.0
#: The board lies in its plane z = 0 up to this (m).
_FLAT = 1e-6


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of a flat board in the images of one camera, image after image.

    Attributes:
        t_ns: stamps of the images on the camera's clock, nanoseconds, (F,) int64, ascending. Images without any corner
            may be among them.
        frame: (C,) int64, the image of each corner as an index into `t_ns`, ascending.
        uv: (C, 2) float64, where it was seen, pixels.
        xyz: (C, 3) float64, where it is on the board, m; the board lies in its plane z = 0.
        tag_id, corner: (C,) int64, which tag of the board and which corner of the tag it is, for messages.
        source: where the corners come from, for messages and titles.
    Raises:
        TypeError: a column that is no tensor or has another dtype.
        ValueError: a column of another shape, numbers that are not finite, stamps or images out of order, images that
        are not there, points that do not lie in the plane of the board.
    """

    t_ns: Tensor
    frame: Tensor
    uv: Tensor
    xyz: Tensor
    tag_id: Tensor
    corner: Tensor
    source: str = ""

    def __post_init__(self) -> None:
        if isinstance(self.frame, Tensor) and self.frame.ndim != 1:
            raise ValueError(f"frame: expected shape (C,), got {tuple(self.frame.shape)}")
        count = len(self.frame) if isinstance(self.frame, Tensor) else 0
        _column("t_ns", self.t_ns, torch.int64, ("F",))
        for name in ("frame", "tag_id", "corner"):
            _column(name, getattr(self, name), torch.int64, (count,))
        _column("uv", self.uv, torch.float64, (count, 2))
        _column("xyz", self.xyz, torch.float64, (count, 3))
        _ascending("t_ns", self.t_ns, strictly=True)
        _ascending("frame", self.frame, strictly=False)
        if count and not 0 <= int(self.frame[0]) <= int(self.frame[-1]) < len(self.t_ns):
            bad = self.frame[0] if self.frame[0] < 0 else self.frame[-1]
            raise ValueError(
                f"frame: expected indices of the {len(self.t_ns)} images of t_ns, 0 to {len(self.t_ns) - 1}, "
                f"got {int(bad)}"
            )
        checks.finite("uv", self.uv)
        checks.finite("xyz", self.xyz)
        off = self.xyz[:, 2].abs()
        if count and float(off.max()) > _FLAT:
            row = int(off.argmax())
            raise ValueError(
                f"xyz: expected a flat board in its plane z = 0, got z = {float(self.xyz[row, 2]):g} m at row {row} "
                f"(tag {int(self.tag_id[row])}, corner {int(self.corner[row])})"
            )

    def __len__(self) -> int:
        """How many corners there are."""
        return len(self.frame)

    @property
    def first(self) -> Tensor:
        """(F + 1,) int64: the corners of image f are the rows `first[f]` to `first[f + 1] - 1`."""
        return torch.searchsorted(self.frame, torch.arange(len(self.t_ns) + 1))

    def select(self, images: Tensor) -> "Corners":
        """The images where `images` (F,) is true, numbered anew.

        Raises:
            TypeError, ValueError: not truth values, not one an image.
        """
        _column("images", images, torch.bool, (len(self.t_ns),))
        # NumPy's indexing: PyTorch would spread these short copies over threads and wait for them.
        kept, frame = images.numpy(), self.frame.numpy()
        rows = np.flatnonzero(kept[frame])
        numbers = np.cumsum(kept) - 1
        columns = {name: getattr(self, name).numpy()[rows] for name in ("uv", "xyz", "tag_id", "corner")}
        columns |= {"t_ns": self.t_ns.numpy()[kept], "frame": numbers[frame[rows]]}
        return Corners(**{name: torch.from_numpy(x) for name, x in columns.items()}, source=self.source)


@dataclass(frozen=True, eq=False)
class Recording:
    """All that was measured while cameras and IMUs, rigidly mounted, moved in front of a board that stood still.

    Stamps of different sensors need not agree: `t_imu = t_cam + time_offset` is a result of the calibration.

    Attributes:
        cameras: what is known of each; estimated where `calibrate` is told to.
        corners: of each camera.
        imus: readings of each IMU, stamps ascending, numbers finite. May be empty.
        noise: of each IMU, numbers for all three axes; densities above zero.
        gravity: magnitude of the gravitational acceleration, m/s^2.
        time_offset: of each camera what is known of it beforehand, s, or None; where a calibration starts, and where it
            stays if it is not to estimate offsets.
    Raises:
        TypeError, ValueError: a wrong type, no camera, numbers of cameras and corners or of IMUs and noises that
        differ, corners outside of the image, readings that are not in order of time or not finite.
    """

    cameras: tuple[Camera, ...]
    corners: tuple[Corners, ...]
    imus: tuple[ImuRecord, ...]
    noise: tuple[ImuNoise, ...]
    gravity: float = 9.80665
    time_offset: tuple[float | None, ...] | None = None

    def __post_init__(self) -> None:
        for name, kind in (
            ("cameras", Camera),
            ("corners", Corners),
            ("imus", ImuRecord),
            ("noise", ImuNoise),
        ):
            object.__setattr__(self, name, _all(name, getattr(self, name), kind))
        if not self.cameras:
            raise ValueError("cameras: expected at least one, got none")
        for a, b in (("cameras", "corners"), ("imus", "noise")):
            first, second = len(getattr(self, a)), len(getattr(self, b))
            if first != second:
                raise ValueError(f"{b}: expected one for each of the {first} {a}, got {second}")
        checks.positive("gravity", self.gravity)
        if self.time_offset is not None:
            _check_offsets(self.time_offset, len(self.cameras))
            object.__setattr__(self, "time_offset", tuple(self.time_offset))
        for i, noise in enumerate(self.noise):
            for sensor in ("gyroscope", "accelerometer"):
                density, walk = f"{sensor}_noise_density", f"{sensor}_random_walk"
                checks.positive(f"noise[{i}].{density}", getattr(noise, density))
                checks.finite_number(f"noise[{i}].{walk}", getattr(noise, walk))
        for camera, corners in zip(self.cameras, self.corners, strict=True):
            _check_inside(camera, corners)
        for i, imu in enumerate(self.imus):
            name = imu.source or f"imus[{i}]"
            _ascending(f"{name}: time_ns", imu.time_ns, strictly=True)
            checks.finite(f"{name}: gyroscope", imu.gyroscope)
            checks.finite(f"{name}: accelerometer", imu.accelerometer)

    @property
    def start_ns(self) -> int:
        """The first stamp of any image, or of any IMU where there are no images."""
        stamps = [c.t_ns[0] for c in self.corners if len(c.t_ns)] or [
            x.time_ns[0] for x in self.imus if len(x)
        ]
        if not stamps:
            raise ValueError("corners: expected images or readings, got none at all")
        return int(min(stamps))

    def between(self, start: float, end: float) -> "Recording":
        """What was stamped from `start` to `end`, seconds since `start_ns`, both included, whatever the clock.

        Of IMUs from known time offsets earlier to later.

        Raises:
            TypeError, ValueError: no finite numbers, an end before the start.
        """
        checks.finite_number("start", start)
        if checks.finite_number("end", end) < start:
            raise ValueError(f"end: expected a time after start = {start:g} s, got {end:g}")
        low, high = self.start_ns + round(start * SECOND), self.start_ns + round(end * SECOND)
        corners = tuple(c.select((c.t_ns >= low) & (c.t_ns <= high)) for c in self.corners)
        known = [round(x * SECOND) for x in self.time_offset or () if x is not None] or [0]
        imus = tuple(x.window(low + min(known), high + max(known)) for x in self.imus)
        return replace(self, corners=corners, imus=imus)

    def only(self, *cameras: int) -> "Recording":
        """The same with these cameras, numbered from 0, in this order.

        Raises:
            ValueError: none, one that is not there, or one twice.
        """
        for i in cameras:
            checks.whole("cameras", i, least=0)
            if i >= len(self.cameras):
                raise ValueError(f"cameras: expected numbers from 0 to {len(self.cameras) - 1}, got {i}")
        if len(set(cameras)) != len(cameras) or not cameras:
            raise ValueError(f"cameras: expected at least one, each once, got {cameras}")
        return replace(
            self,
            cameras=tuple(self.cameras[i] for i in cameras),
            corners=tuple(self.corners[i] for i in cameras),
            time_offset=None if self.time_offset is None else tuple(self.time_offset[i] for i in cameras),
        )


def _check_offsets(offsets: Any, count: int) -> None:
    if isinstance(offsets, (str, Tensor)) or not isinstance(offsets, Sequence):
        raise TypeError(
            f"time_offset: expected a tuple of numbers or None, one a camera, got {type(offsets).__name__}"
        )
    if len(offsets) != count:
        raise ValueError(f"time_offset: expected one for each of the {count} cameras, got {len(offsets)}")
    for i, x in enumerate(offsets):
        if x is not None:
            checks.finite_number(f"time_offset[{i}]", x)


def _all(name: str, x: Any, kind: type) -> tuple:
    if not isinstance(x, Sequence):
        raise TypeError(f"{name}: expected a tuple of {kind.__name__}, got {type(x).__name__}")
    for i, y in enumerate(x):
        checks.instance(f"{name}[{i}]", y, kind, f"a {kind.__name__}")
    return tuple(x)


def _column(name: str, x: Any, dtype: torch.dtype, shape: tuple[int | str, ...]) -> None:
    checks.instance(name, x, Tensor, "a torch.Tensor")
    if x.dtype != dtype:
        raise TypeError(f"{name}: expected {dtype}, got {x.dtype}")
    matches = len(shape) == x.ndim and all(a in ("F", b) for a, b in zip(shape, x.shape, strict=True))
    if not matches:
        wanted = ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "")
        raise ValueError(f"{name}: expected shape ({wanted}), got {tuple(x.shape)}")
    if x.device.type != "cpu":
        raise ValueError(f"{name}: expected a tensor on the CPU, got {x.device}; move it with .to('cpu')")


def _ascending(name: str, x: Tensor, strictly: bool) -> None:
    steps = x.diff()
    wrong = torch.nonzero(steps <= 0 if strictly else steps < 0).flatten()
    if len(wrong):
        row = int(wrong[0]) + 1
        word = "strictly ascending" if strictly else "ascending"
        raise ValueError(
            f"{name}: expected {word} numbers, got {int(x[row])} at row {row} after {int(x[row - 1])}; "
            "sort the rows" + (" and keep one of those that share a stamp" if strictly else "")
        )


def _check_inside(camera: Camera, corners: Corners) -> None:
    size = torch.tensor(camera.resolution, dtype=torch.float64)
    outside = ((corners.uv < -_BEYOND) | (corners.uv > size - 1 + _BEYOND)).any(dim=1)
    if bool(outside.any()):
        row = int(torch.nonzero(outside)[0])
        u, v = corners.uv[row].tolist()
        width, height = camera.resolution
        raise ValueError(
            f"{corners.source or 'corners'}: uv: expected pixels of {camera.name}, {width} x {height}, got "
            f"({u:.1f}, {v:.1f}) at row {row}; are the files in the order of the cameras?"
        )
