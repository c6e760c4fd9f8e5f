"""Recordings of poses and an IMU, in one form: EuRoC, TUM VI, BROAD, Blackbird, or made up where there are none."""

import math
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchspline import SO3, SplitBSpline, imu
from torchspline.io import ImuRecord, PoseRecord, read_imu, read_poses
from torchspline.units import SECOND

#: Poses farther apart than this leave a gap.
GAP = 30_000_000

#: RMSE of gyroscope [rad/s] and accelerometer [m/s^2] at knot spacings of 20, 40, 80, 160 ms: a SciPy least-squares
#: spline of order 6 through the same poses, from the README of the recordings.
YARDSTICK = {
    "tum_vi/room1": ((0.0746, 0.942), (0.0363, 0.223), (0.0304, 0.142), (0.0675, 0.207)),
    "tum_vi/room4": ((0.0828, 1.149), (0.0392, 0.241), (0.0313, 0.128), (0.0595, 0.175)),
    "euroc/V1_02_medium": ((0.0277, 0.882), (0.0340, 0.886), (0.0407, 0.892), (0.0503, 0.897)),
    "euroc/V1_03_difficult": ((0.0496, 1.217), (0.0556, 1.218), (0.0598, 1.224), (0.0659, 1.229)),
    "broad/02_undisturbed_slow_rotation_B": ((0.0628, 0.581), (0.0529, 0.206), (0.1592, 0.243), (0.1900, 0.313)),
    "broad/07_undisturbed_fast_rotation_B": ((0.0910, 0.826), (0.1650, 0.733), (0.8278, 1.673), (1.8744, 2.528)),
    "broad/16_undisturbed_fast_translation_B": ((0.0614, 0.584), (0.1835, 0.585), (0.4964, 1.986), (0.7380, 4.367)),
    "broad/21_undisturbed_fast_combined": ((0.1011, 0.912), (0.1275, 0.502), (0.4070, 0.970), (0.6304, 1.924)),
    "blackbird/train": ((0.0374, 0.615), (0.0197, 0.190), (0.0316, 0.143), (0.0650, 0.145)),
    "blackbird/val": ((0.0391, 0.592), (0.0203, 0.193), (0.0396, 0.142), (0.0849, 0.149)),
}  # fmt: skip


class Recording(NamedTuple):
    """Poses and readings on their own clocks, in nanoseconds."""

    name: str
    poses: PoseRecord
    samples: ImuRecord

    @property
    def pose(self) -> Tensor:
        """(N, 7)."""
        return torch.cat([self.poses.position, self.poses.rotation], -1)


def load(data: Path, name: str, seed: int) -> Recording:
    """A recording under the folder `data`, or "synthetic"."""
    if name == "synthetic":
        return synthetic(seed)
    if (data / name).is_dir():
        return Recording(name, read_poses(data / name), read_imu(data / name))
    return _arrays(data, name)


def _arrays(data: Path, name: str) -> Recording:
    """BROAD and Blackbird: poses and readings share one column of stamps, in seconds."""
    columns = np.load(data / f"{name}.npz")
    stamps = torch.from_numpy(np.rint((columns["t"] - columns["t"][0]) * SECOND).astype(np.int64))
    xyzw = "quat_xyzw" in columns
    quaternion = columns["quat_xyzw"][:, [3, 0, 1, 2]] if xyzw else columns["quat_wxyz"]
    position, rotation, gyro, accel = (
        torch.from_numpy(x.astype(np.float64))
        for x in (columns["pos"], quaternion, columns["gyro"], columns["acc"])
    )
    return Recording(name, PoseRecord(stamps, position, rotation, name), ImuRecord(stamps, gyro, accel, name))


def synthetic(seed: int, duration: float = 20.0) -> Recording:
    """Noisy poses at 120 Hz and readings at 200 Hz of a random motion, the IMU's clock 5 ms ahead."""
    generator = torch.Generator().manual_seed(seed)
    knot, count = 0.3, math.ceil(duration / 0.3) + 5
    position = 0.3 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    rotation = [SO3.identity()]
    for turn in 0.25 * torch.randn(count - 1, 3, generator=generator, dtype=torch.float64):
        rotation.append(SO3.retract(rotation[-1], turn, side="right"))
    points = torch.cat([position, torch.stack(rotation)], -1)
    motion = SplitBSpline(points, order=6, dt_ns=round(knot * SECOND), t0_ns=0, learnable=False)
    stamps = torch.arange(0, round(duration * SECOND), SECOND // 120)
    exact = motion(stamps)
    noise = torch.randn(len(stamps), 6, generator=generator, dtype=torch.float64)
    q = SO3.retract(exact[:, 3:], 5e-4 * noise[:, 3:], side="right")
    poses = PoseRecord(stamps, exact[:, :3] + 1e-4 * noise[:, :3], q, "synthetic")
    times = torch.arange(0, round(duration * SECOND), SECOND // 200)
    with torch.no_grad():
        reading = imu.measure(motion, times)
    noise = torch.randn(len(times), 6, generator=generator, dtype=torch.float64)
    samples = ImuRecord(
        times + SECOND // 200,
        reading.gyroscope + 0.01 * noise[:, :3],
        reading.accelerometer + 0.05 * noise[:, 3:],
        "synthetic",
    )
    return Recording("synthetic", poses, samples)


def usable(poses: PoseRecord) -> PoseRecord:
    """Without rows of NaN."""
    good = ~(poses.position.isnan().any(-1) | poses.rotation.isnan().any(-1))
    return PoseRecord(poses.time_ns[good], poses.position[good], poses.rotation[good], poses.source)


def longest_stretch(poses: PoseRecord) -> tuple[int, int]:
    """First and last stamp of the longest run of poses without a gap."""
    time = usable(poses).time_ns
    edges = [0, *(torch.nonzero(time.diff() > GAP).flatten() + 1).tolist(), len(time)]
    pieces = ((int(time[a]), int(time[b - 1])) for a, b in pairwise(edges))
    return max(pieces, key=lambda piece: piece[1] - piece[0])


def near_gaps(poses: PoseRecord, stamps: Tensor, margin: int = 3 * SECOND // 10) -> Tensor:
    """Which stamps lie in a gap of the poses or near one."""
    time = usable(poses).time_ns
    wide = torch.nonzero(time.diff() > GAP).flatten()
    start, stop = time[wide] - margin, time[wide + 1] + margin
    return ((stamps[:, None] > start) & (stamps[:, None] < stop)).any(-1)
