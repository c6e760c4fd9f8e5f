"""Strapdown integration: from what an IMU reads back to orientation, velocity and position."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchspline import checks
from torchspline.groups.group import SO3
from torchspline.imu import stamps
from torchspline.imu.increments import (
    Increments,
    check_pair,
    mean_turn,
    rotate,
    rotation_between_samples,
    rotation_by,
    world_vector,
)
from torchspline.imu.scan import rotation_products
from torchspline.imu.synthesis import STANDARD_GRAVITY


class Navigation(NamedTuple):
    """`rotation` (..., 4) quaternion [w, x, y, z], body to world; `velocity` (..., 3) m/s and `position` (..., 3) m."""

    rotation: Tensor
    velocity: Tensor
    position: Tensor


def integrate_gyroscope(gyroscope: Tensor, t: Tensor, start: Tensor | None = None) -> Tensor:
    """Orientations at the times of samples of angular rate, of second order in the interval.

    Between samples the rate is taken to change evenly, as in `sampled_increments`. The products of their rotations are
    one compiled loop on the CPU, with a reverse of sums along time (where no loop can run, products of pairs).

    Args:
        gyroscope: rad/s in the body frame, (*batch, N, 3).
        t: increasing times, seconds (float) or nanoseconds (int64), (N,) or what broadcasts to (*batch, N).
        start: orientation at the first time, body to world, (4,) or (*batch, 4); None: the identity.
    Returns:
        (*batch, N, 4) unit quaternions [w, x, y, z], continuous in sign.
    Differentiable in everything, to any order.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """
    checks.is_floating_tensor("gyroscope", gyroscope)
    checks.has_last("gyroscope", gyroscope, 3, "x, y, z")
    if gyroscope.ndim < 2 or gyroscope.shape[-2] < 1:
        raise ValueError(
            f"gyroscope: expected shape (*batch, N, 3), N at least 1, got {tuple(gyroscope.shape)}"
        )
    checks.finite("gyroscope", gyroscope)
    h = stamps.intervals(t, gyroscope.shape[:-1], gyroscope.dtype, device=gyroscope.device)[..., None]
    if start is not None:
        start = _start("start", start, gyroscope, "gyroscope")
    return _rotations(rotation_between_samples(gyroscope, h), start)


def strapdown(
    increments: Increments,
    t: Tensor,
    start: Navigation,
    gravity: Tensor | Sequence[float] = STANDARD_GRAVITY,
    earth_rate: Tensor | Sequence[float] | None = None,
) -> Navigation:
    """Orientation, velocity and position from compensated increments.

    Orientation and velocity are as exact as the increments (with `earth_rate`, velocity up to `rate h^2 / 12` times the
    change of specific force); position follows from velocities by the trapezoidal rule with end corrections, third
    order in the interval.

    Args:
        increments: compensated for coning and sculling, (*batch, N, 3).
        t: increasing times at their ends, seconds (float) or nanoseconds (int64), (N + 1,) or what broadcasts to
            (*batch, N + 1).
        start: orientation, velocity and position at the first time, (4,), (3,), (3,) or (*batch, 4), ...
        gravity: acceleration in the world, (3,) m/s^2; on the turning earth including the centrifugal one.
        earth_rate: angular velocity of the world in its own axes, (3,) rad/s; None: the world does not turn.
    Returns:
        Navigation: (*batch, N + 1, ...), the start first.
    Differentiable in everything, to any order.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """
    checks.instance("increments", increments, Increments, "Increments")
    checks.instance("start", start, Navigation, "a Navigation")
    check_pair(increments, ("angle", "velocity"), 0)
    angle, gained = increments
    samples = (*angle.shape[:-2], angle.shape[-2] + 1)
    h = stamps.intervals(t, samples, angle.dtype, device=angle.device)[..., None]
    q0, v0, p0 = (
        _start(f"start.{name}", x, angle, "angle", width)
        for name, x, width in zip(Navigation._fields, start, (4, 3, 3), strict=True)
    )
    g = world_vector("gravity", gravity, angle)
    rotation = _rotations(angle, q0)
    if earth_rate is None:
        velocity = _running(v0, rotate(rotation[..., :-1, :], gained) + g * h)
    else:
        rate = world_vector("earth_rate", earth_rate, angle)
        elapsed = _running(torch.zeros_like(v0[..., :1]), h.expand(*angle.shape[:-1], 1))
        # The products so far are in axes that do not turn. Velocity obeys v' + 2 rate x v = force + gravity, of which
        # Exp(2 rate t) v is an integral of the right side alone.
        turned = SO3.inverse(rotation_by(rate * elapsed), validate=False)
        rotation = SO3.compose(turned, rotation, validate=False)
        felt = rotate(rotation_by(0.5 * rate * h), rotate(rotation[..., :-1, :], gained)) + mean_turn(
            2.0 * rate * h, g * h
        )
        twice = rotation_by(2.0 * rate * elapsed)
        velocity = _running(v0, rotate(twice[..., :-1, :], felt))
        velocity = rotate(SO3.inverse(twice, validate=False), velocity)
    return Navigation(rotation, velocity, _running(p0, _travelled(velocity, h)))


# ---------------------------------------------------------------------- parts


def _rotations(angle: Tensor, start: Tensor | None) -> Tensor:
    batch = angle.shape[:-2]
    if start is None:
        start = SO3.identity(*batch, dtype=angle.dtype, device=angle.device)
    else:
        start = SO3.normalize(start, validate=False).expand(*batch, 4)
    return rotation_products(start, rotation_by(angle))


def _running(start: Tensor, steps: Tensor) -> Tensor:
    first = start[..., None, :].expand(*steps.shape[:-2], 1, steps.shape[-1])
    return torch.cat([first, steps], -2).cumsum(-2)


def _travelled(v: Tensor, h: Tensor) -> Tensor:
    """Integral of velocity over each interval: cubic Hermite, with rates from the parabola through three velocities."""
    trapezoid = 0.5 * h * (v[..., :-1, :] + v[..., 1:, :])
    if v.shape[-2] < 3:
        return trapezoid
    slope = v.diff(dim=-2) / h
    h0, h1 = h[..., :-1, :], h[..., 1:, :]
    inner = (h1 * slope[..., :-1, :] + h0 * slope[..., 1:, :]) / (h0 + h1)
    ends = 2.0 * slope[..., :1, :] - inner[..., :1, :], 2.0 * slope[..., -1:, :] - inner[..., -1:, :]
    rates = torch.cat([ends[0], inner, ends[1]], -2)
    return trapezoid - h.square() / 12.0 * rates.diff(dim=-2)


def _start(name: str, x: Tensor, like: Tensor, like_name: str, width: int = 4) -> Tensor:
    """Broadcasts to (*batch, width)."""
    if width == 4:
        checks.point(name, x, SO3, "a quaternion [w, x, y, z]")
    else:
        checks.is_floating_tensor(name, x)
        checks.has_last(name, x, 3, "x, y, z")
        checks.finite(name, x)
    checks.same_kind(**{like_name: like, name: x})
    batch = like.shape[:-2]
    try:
        fits = torch.broadcast_shapes(x.shape[:-1], batch) == batch
    except RuntimeError:
        fits = False
    if not fits:
        raise ValueError(
            f"{name}: expected shape {(*batch, width)} or what broadcasts to it, got {tuple(x.shape)}"
        )
    return x.expand(*batch, width)
