"""Ideal inertial readings of a trajectory, [S20] (69)-(70)."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchspline import checks
from torchspline.groups.group import SO3
from torchspline.splines.trajectory import MECHANICS, Mounted, Trajectory

#: Standard gravity as an acceleration in a world whose z axis points up, m/s^2.
STANDARD_GRAVITY = (0.0, 0.0, -9.80665)


class ImuReading(NamedTuple):
    """`gyroscope` (..., N, 3) rad/s and `accelerometer` (..., N, 3) specific force m/s^2, in the IMU's frame."""

    gyroscope: Tensor
    accelerometer: Tensor


def measure(
    trajectory: Trajectory,
    t: Tensor,
    gravity: Tensor | Sequence[float] = STANDARD_GRAVITY,
    gyroscope_bias: Tensor | Sequence[float] | None = None,
    accelerometer_bias: Tensor | Sequence[float] | None = None,
    T_body_imu: Tensor | None = None,
) -> ImuReading:
    """What a perfect IMU on the moving body reads: `w + b_g` and `R^T (a - g) + b_a`, [S20] (69)-(70).

    Args:
        trajectory: of a rigid body with rotation and position: SE3 or R3xSO3.
        t: times as the trajectory takes them.
        gravity: acceleration in the world, (3,) m/s^2, opposite in sign to the g of [S20] (70). KITTI's y axis points
            down: (0, 9.80665, 0).
        gyroscope_bias, accelerometer_bias: added to the readings, rad/s and m/s^2, (3,) or broadcasting with
            (..., N, 3).
        T_body_imu: SE3 pose (7,) of the IMU in the body; its lever arm enters through angular rates. None: the body
            frame is the IMU's.
    Differentiable in control points, times, gravity, biases and T_body_imu.
    Raises:
        TypeError, ValueError: a wrong type, shape or value, or a trajectory without rotation or position.
    Examples:
        >>> import torch
        >>> from torchspline import SE3, BSpline
        >>> still = BSpline(SE3.identity(4, dtype=torch.float64), group=SE3, dt=1.0)
        >>> measure(still, torch.tensor([0.5], dtype=torch.float64)).accelerometer.tolist()
        [[0.0, 0.0, 9.80665]]
    """
    checks.instance("trajectory", trajectory, Trajectory, "a Trajectory")
    if trajectory.group.name not in MECHANICS:
        raise no_rigid_body(trajectory)
    if T_body_imu is not None:
        trajectory = Mounted(trajectory, T_body_imu, name="T_body_imu")
    motion = trajectory.kinematics(t)
    if motion.rotation is None or motion.acceleration is None or motion.angular_velocity is None:
        raise no_rigid_body(trajectory)
    world = motion.acceleration - vector_argument("gravity", gravity, motion.acceleration)
    accelerometer = SO3.act(SO3.inverse(motion.rotation, validate=False), world, validate=False)
    gyroscope = motion.angular_velocity
    if gyroscope_bias is not None:
        gyroscope = gyroscope + vector_argument("gyroscope_bias", gyroscope_bias, gyroscope)
    if accelerometer_bias is not None:
        accelerometer = accelerometer + vector_argument(
            "accelerometer_bias", accelerometer_bias, accelerometer
        )
    return ImuReading(gyroscope, accelerometer)


def no_rigid_body(trajectory: Trajectory) -> ValueError:
    """What to raise for a trajectory without rotation or position."""
    return ValueError(
        f"trajectory: expected one with rotation and position, such as SE3 or R3xSO3, got {trajectory.group}"
    )


def vector_argument(name: str, x: Tensor | Sequence[float], like: Tensor) -> Tensor:
    """A vector (3,), or what broadcasts with the readings `like` (*batch, N, 3), in their dtype."""
    if isinstance(x, Tensor):
        checks.is_floating_tensor(name, x)
        checks.same_kind(trajectory=like, **{name: x})
    else:
        try:
            x = torch.stack([torch.as_tensor(v, dtype=like.dtype, device=like.device) for v in x])
        except (TypeError, ValueError, RuntimeError):
            raise TypeError(f"{name}: expected a tensor or three numbers, got {x!r}") from None
    checks.has_last(name, x, 3, "x, y, z")
    checks.finite(name, x)
    checks.broadcast(**{name: x.shape, "readings": like.shape})
    return x
