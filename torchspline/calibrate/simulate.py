"""Recordings of cameras and an IMU in front of a board, made from a trajectory and extrinsics that are known."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchspline import checks
from torchspline.calibrate.images import PROJECTIONS
from torchspline.calibrate.recording import Corners, Recording
from torchspline.fit.solving.kernel import kernel_of
from torchspline.groups import SE3, Group
from torchspline.groups.convert import from_scipy
from torchspline.imu import ImuNoise, measure
from torchspline.io.camera import Camera
from torchspline.io.records import ImuRecord
from torchspline.splines.bspline import BSpline
from torchspline.units import SECOND

GROUPS = {"split": "R3xSO3", "joint": "SE3"}
#: The board: 6 x 6 tags of 88 mm, 26.4 mm apart, four corners each.
_TAGS, _TAG, _GAP = 6, 0.088, 0.0264


@dataclass(frozen=True, eq=False)
class Simulation:
    """A recording and what it was made from.

    Attributes:
        recording: as a calibration takes it.
        trajectory: the IMU in the frame of the board, by int64 nanoseconds of the IMU's clock.
        T_imu_cam: (cameras, 7), camera to IMU. time_offset: (cameras,) s, `t_imu = t_cam + time_offset`.
        gravity: (3,) acceleration in the frame of the board. gyro_bias, accel_bias: (3,).
        pixel_sigma: standard deviation of the corners, px.
    """

    recording: Recording
    trajectory: BSpline
    T_imu_cam: Tensor
    time_offset: Tensor
    gravity: Tensor
    gyro_bias: Tensor
    accel_bias: Tensor
    pixel_sigma: float


def simulate(
    *,
    seconds: float = 51.8,
    images: int = 1036,
    samples: int = 10336,
    corners: int | None = None,
    cameras: int = 2,
    order: int = 5,
    spacing: float = 0.01,
    representation: str = "split",
    distortion: str = "radtan",
    pixel_sigma: float = 0.5,
    noise: ImuNoise | None = None,
    seed: int = 0,
) -> Simulation:
    """Waves of several periods in all six degrees of freedom, half a metre before an April grid; noise is white.

    The motion, extrinsics and biases are always the same: only noise, and which corners are missed, follow the seed.
    The trajectory is a spline, so that one of the same order, spacing and group meets it exactly.

    Args:
        images: of each camera. samples: of the IMU. corners: seen in all images together; None for all that are in
            sight.
        order, spacing [s], representation ("split" or "joint"): of the trajectory.
        distortion: of the cameras, "radtan" or "equidistant".
        noise: of the IMU; by default that of an ADIS16448.
    Raises:
        TypeError, ValueError: a wrong type or value; more corners wanted than are in sight.
    """
    checks.positive("seconds", seconds)
    for name, x in (("images", images), ("samples", samples), ("cameras", cameras)):
        checks.whole(name, x, least=1)
    checks.whole("order", order, least=4)
    checks.whole("seed", seed, least=0)
    checks.choice("representation", representation, tuple(GROUPS))
    checks.choice("distortion", distortion, tuple(PROJECTIONS))
    checks.positive("spacing", spacing)
    if checks.finite_number("pixel_sigma", pixel_sigma) < 0:
        raise ValueError(f"pixel_sigma: expected a number that is not negative, got {pixel_sigma:g}")
    noise = noise or ImuNoise(1.6968e-4, 2.0e-3, 1.9393e-5, 3.0e-3)
    checks.instance("noise", noise, ImuNoise, "an ImuNoise")
    generator = torch.Generator().manual_seed(seed)

    T_imu_cam, offsets = _mounting(cameras)
    gravity = _vector(0.0, -9.80665, 0.0)
    biases = _vector(-0.002, 0.02, 0.078), _vector(0.05, -0.12, 0.08)
    start, dt = 1_000 * SECOND, round(spacing * SECOND)
    trajectory = _trajectory(seconds, order, dt, start, representation, T_imu_cam[0])

    span = trajectory.domain[1] - start
    stamps = start + torch.linspace(0, 1, samples, dtype=torch.float64).mul(span).round().long()
    clean = measure(trajectory, stamps, gravity, *biases)
    rate = np.sqrt((samples - 1) / (span / SECOND)) if samples > 1 else 1.0

    def noisy(x: Tensor, sigma: float) -> Tensor:
        return x + sigma * torch.randn(x.shape, generator=generator, dtype=torch.float64)

    imu = ImuRecord(
        stamps,
        noisy(clean.gyroscope, float(noise.gyroscope_noise_density) * rate),
        noisy(clean.accelerometer, float(noise.accelerometer_noise_density) * rate),
        source="simulated",
    )
    # Images keep away from the ends by more than the offsets, so that none of them leaves the trajectory.
    edge = 0.02 * SECOND
    times = (
        start + (edge + torch.linspace(0, 1, images, dtype=torch.float64) * (span - 2 * edge)).round().long()
    )
    camera = [_camera(f"cam{i}", distortion) for i in range(cameras)]
    seen = [_sights(trajectory, times, T_imu_cam[i], float(offsets[i]), camera[i]) for i in range(cameras)]
    keep = _chosen([len(x) for x in seen], corners, generator)
    seen = [_kept(x, k) for x, k in zip(seen, keep, strict=True)]
    seen = [replace(x, uv=noisy(x.uv, pixel_sigma)) for x in seen]
    recording = Recording(tuple(camera), tuple(seen), (imu,), (noise,), gravity=9.80665)
    return Simulation(recording, trajectory, T_imu_cam, offsets, gravity, *biases, pixel_sigma)


def _vector(*x: float) -> Tensor:
    return torch.tensor(x, dtype=torch.float64)


def _mounting(cameras: int) -> tuple[Tensor, Tensor]:
    """Extrinsics and time offsets: the first camera turned against the IMU, the others a hand's breadth apart."""
    turn = Rotation.from_euler("zyx", [89.0, 1.5, -0.8], degrees=True)
    poses = []
    for i in range(cameras):
        rotation = turn * Rotation.from_rotvec([0.002 * i, 0.01 * i, -0.004 * i])
        position = turn.apply([0.11 * i, 0.0005 * i, -0.001 * i]) + np.array([-0.0216, -0.0647, 0.0098])
        poses.append([*position, *from_scipy(rotation).tolist()])
    return torch.tensor(poses, dtype=torch.float64), torch.linspace(0.0041, 0.0046, cameras).double()


def _trajectory(
    seconds: float, order: int, dt: int, start: int, representation: str, T_imu_cam: Tensor
) -> BSpline:
    """Control points on waves of the first camera before the board, which it faces."""
    count = round(seconds * SECOND / dt) + order - 1
    t = (np.arange(count) - 0.5 * (order - 2)) * (dt / SECOND)
    periods = np.array([[1.31, 2.9], [1.07, 3.7], [1.53, 4.3]])
    heights = np.array([[0.055, 0.10], [0.050, 0.09], [0.045, 0.08]])
    turns = np.array([[0.16, 0.22], [0.17, 0.20], [0.22, 0.30]])
    phase = np.arange(3)[:, None] + np.array([0.3, 1.7])
    waves = np.sin(2 * np.pi * t[:, None, None] / periods + phase)
    beats = np.sin(2 * np.pi * t[:, None, None] / (0.83 * periods[::-1]) + 2 * phase)
    middle = 0.5 * (_TAGS * _TAG + (_TAGS - 1) * _GAP)
    position = (heights * waves).sum(-1) + np.array([middle, middle, 0.75])
    # Looking down at the board: x to its right, y down, z away from whoever looks.
    facing = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    rotation = facing * Rotation.from_rotvec((turns * beats).sum(-1))
    camera = torch.cat([torch.from_numpy(position), from_scipy(rotation)], dim=1)
    imu = SE3.compose(camera, SE3.inverse(T_imu_cam))
    group = Group(GROUPS[representation])
    return BSpline(imu, group=group, order=order, dt_ns=dt, t0_ns=start, learnable=False)


def _camera(name: str, distortion: str) -> Camera:
    if distortion == "radtan":
        numbers = (458.654, 457.296, 367.215, 248.375), (-0.28340811, 0.07395907, 0.00019359, 1.76187e-05)
        return Camera(name, *numbers, (752, 480), "radtan")
    numbers = (190.978, 190.973, 254.932, 256.897), (0.0034824, 0.0007150, -0.0020532, 0.0002029)
    return Camera(name, *numbers, (512, 512), "equidistant")


def _sights(trajectory: BSpline, t: Tensor, T: Tensor, offset: float, camera: Camera) -> Corners:
    """Where corners of the board appear, exactly."""
    step = torch.arange(_TAGS, dtype=torch.float64) * (_TAG + _GAP)
    y, x = torch.meshgrid(step, step, indexing="ij")
    size = torch.tensor([[0, 0], [_TAG, 0], [_TAG, _TAG], [0, _TAG]], dtype=torch.float64)
    xy = torch.stack([x.reshape(-1), y.reshape(-1)], -1)[:, None] + size
    board = torch.nn.functional.pad(xy.reshape(-1, 2), (0, 1))
    frame, which = torch.arange(len(t)).repeat_interleave(len(board)), torch.arange(len(board)).repeat(len(t))
    poses = trajectory(t + round(offset * SECOND))
    kernel = kernel_of(
        PROJECTIONS[camera.distortion],
        trajectory.group.name,
        (("landmark", True), ("intrinsics", False), ("T_body_camera", False)),
    )
    xyz = board[which]
    arguments = poses[frame], torch.zeros(len(xyz), 2, dtype=torch.float64), xyz, camera.parameters, T
    uv = kernel.on_tensors(*arguments)
    inner = torch.tensor(camera.resolution, dtype=torch.float64) - 1.0
    inside = ((uv > 3.0) & (uv < inner - 3.0)).all(-1)
    return Corners(
        t, frame[inside], uv[inside], xyz[inside], which[inside] // 4, which[inside] % 4, source="simulated"
    )


def _chosen(counts: list[int], wanted: int | None, generator: torch.Generator) -> list[Tensor]:
    """Which corners are not missed."""
    total = sum(counts)
    keep = torch.ones(total, dtype=torch.bool)
    if wanted is not None:
        checks.whole("corners", wanted, least=1)
        if wanted > total:
            raise ValueError(f"corners: expected at most {total}, as many as are in sight, got {wanted}")
        keep[torch.randperm(total, generator=generator)[wanted:]] = False
    return list(keep.split(counts))


def _kept(corners: Corners, keep: Tensor) -> Corners:
    columns = {name: getattr(corners, name)[keep] for name in ("frame", "uv", "xyz", "tag_id", "corner")}
    return replace(corners, **columns)
