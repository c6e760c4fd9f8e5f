"""What an IMU integrates from sample to sample: delta-angles and delta-velocities, with coning and sculling."""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchspline import checks
from torchspline.groups.group import SO3
from torchspline.imu import stamps
from torchspline.imu.synthesis import STANDARD_GRAVITY, ImuReading, no_rigid_body, vector_argument
from torchspline.splines.trajectory import MECHANICS, Kinematics, Mounted, Trajectory

#: Points of Gauss-Legendre quadrature within an interval.
NODES = 4


class Increments(NamedTuple):
    """Over the intervals between N + 1 times: `angle` (*batch, N, 3) rad and `velocity` (*batch, N, 3) m/s.

    Compensated ones are the rotation vector from the frame at the start of the interval to that at its end, and the
    integral of specific force in the frame at the start. Others are plain integrals of what gyroscope and accelerometer
    read in their turning frame.
    """

    angle: Tensor
    velocity: Tensor


def increments(
    trajectory: Trajectory,
    t: Tensor,
    gravity: Tensor | Sequence[float] = STANDARD_GRAVITY,
    T_body_imu: Tensor | None = None,
    earth_rate: Tensor | Sequence[float] | None = None,
    compensated: bool = True,
) -> Increments:
    """Increments of a perfect IMU on the moving body between neighbouring times.

    Compensated ones are differences of rotation and velocity, exact whatever the intervals. Plain integrals are taken
    by quadrature with 4 points in each interval: exact to rounding for short ones, but for those with a knot inside.

    Args:
        trajectory: of a rigid body with rotation and position: SE3 or R3xSO3.
        t: increasing times as the trajectory takes them, (N + 1,) or (*batch, N + 1).
        gravity: acceleration in the world, (3,) m/s^2; on the turning earth including the centrifugal one.
        T_body_imu: SE3 pose (7,) of the IMU in the body. None: the body frame is the IMU's.
        earth_rate: angular velocity of the world (a frame fixed to the earth) in its own axes, (3,) rad/s, as
            `earth.earth_rate` gives it: the gyroscope feels it, and the accelerometer Coriolis acceleration.
        compensated: for coning and sculling. False: plain integrals, as an IMU without a processor puts them out.
    Differentiable in control points, times, gravity, T_body_imu and earth_rate.
    Raises:
        TypeError, ValueError: a wrong type, shape or value, or a trajectory without rotation or position.
    """
    checks.instance("trajectory", trajectory, Trajectory, "a Trajectory")
    if not isinstance(compensated, bool):
        raise ValueError(f"compensated: expected True or False, got {compensated!r}")
    if trajectory.group.name not in MECHANICS:
        raise no_rigid_body(trajectory)
    if T_body_imu is not None:
        trajectory = Mounted(trajectory, T_body_imu, name="T_body_imu")
    motion = trajectory.kinematics(t)
    q, v = motion.rotation, motion.velocity
    if q is None or v is None:
        raise no_rigid_body(trajectory)
    if t.ndim == 0:
        raise ValueError("t: expected shape (N,) or (*batch, N), times in a row, got ()")
    h = stamps.intervals(t, v.shape[:-1], v.dtype, device=v.device)[..., None]
    g = world_vector("gravity", gravity, v)
    rate = None if earth_rate is None else world_vector("earth_rate", earth_rate, v)
    start, end = q[..., :-1, :], q[..., 1:, :]
    if compensated and rate is None:
        return Increments(_log(_between(start, end)), _unturn(start, v.diff(dim=-2) - g * h))

    nodes, weights = (torch.tensor(x, dtype=v.dtype, device=v.device) for x in _gauss_legendre(NODES))
    inside = trajectory.kinematics(_times_inside(t, nodes))
    if not compensated:
        read = [x.unflatten(-2, (-1, NODES)) for x in _readings(inside, g, rate)]
        angle, velocity = ((weights[:, None] * x).sum(-2) * h for x in read)
        return Increments(angle, velocity)
    # In axes that do not turn but are the world's at the start of the interval, with E = Exp(rate s), specific force is
    # E (a + 2 rate x v - g), and d(E v)/ds = E (a + rate x v).
    assert rate is not None
    assert inside.velocity is not None
    turn = rotation_by(rate * h)
    moving = inside.velocity.unflatten(-2, (-1, NODES))
    coriolis = torch.linalg.cross(rate[..., None, :].expand_as(moving), moving)
    at_nodes = rotation_by(rate[..., None, :] * (h[..., None] * nodes[:, None]))
    pulled = (weights[:, None] * rotate(at_nodes, coriolis)).sum(-2) * h
    gained = rotate(turn, v[..., 1:, :]) - v[..., :-1, :] + pulled - mean_turn(rate * h, g * h)
    return Increments(_log(_between(start, SO3.compose(turn, end, validate=False))), _unturn(start, gained))


def sampled_increments(reading: ImuReading, t: Tensor) -> Increments:
    """Compensated increments between samples of angular rate and specific force, which change evenly in between.

    With rates w and forces f at both ends, `angle = h (w0 + w1) / 2 + h^2 / 12 w0 x w1` (coning) and
    `velocity = J(angle) h (f0 + f1) / 2 + h^2 / 12 (w0 x f1 + f0 x w1)` (sculling), J the left Jacobian. The error of
    what is integrated from them is of second order in h, that of the trapezoidal rule.

    Args:
        reading: (*batch, N + 1, 3) rad/s and m/s^2.
        t: increasing times, seconds (float) or nanoseconds (int64), (N + 1,) or what broadcasts to (*batch, N + 1).
    Returns:
        Increments: (*batch, N, 3).
    Differentiable in readings and t.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """
    checks.instance("reading", reading, ImuReading, "an ImuReading")
    w, f = reading
    check_pair(reading, ("gyroscope", "accelerometer"), 1)
    h = stamps.intervals(t, w.shape[:-1], w.dtype, device=w.device)[..., None]
    angle = rotation_between_samples(w, h)
    cross, (w0, w1), (f0, f1) = torch.linalg.cross, _ends(w), _ends(f)
    sculling = h.square() / 12.0 * (cross(w0, f1) + cross(f0, w1))
    return Increments(angle, mean_turn(angle, 0.5 * h * (f0 + f1)) + sculling)


def compensate(integrals: Increments, t: Tensor) -> Increments:
    """Coning and sculling put into plain integrals of angular rate and specific force, from their neighbours.

    For equal intervals `angle = a + (a_before x a + a x a_after) / 24` and `velocity = J(angle) v + (a_before x v +
    v_before x a + a x v_after + v x a_after) / 24`, with the left Jacobian J; the outermost intervals have one
    neighbour, which counts twice. The orientation integrated from them is of fourth order in the interval, the velocity
    of third; without, the orientation is of second, the velocity of first.

    Args:
        integrals: of `increments(..., compensated=False)` or of an IMU that does not compensate itself, (*batch, N, 3).
        t: increasing times at their ends, seconds (float) or nanoseconds (int64), (N + 1,) or what broadcasts to
            (*batch, N + 1).
    Returns:
        Increments: compensated ones.
    Differentiable in integrals and t.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """
    checks.instance("integrals", integrals, Increments, "Increments")
    a, v = integrals
    check_pair(integrals, ("angle", "velocity"), 0)
    count = a.shape[-2]
    h = stamps.intervals(t, (*a.shape[:-2], count + 1), a.dtype, device=a.device)[..., None]
    if count < 2:
        return Increments(a, mean_turn(a, v))
    # Of rates that change evenly, a x a_after = h h_after (h + h_after)/2 (w x w'), while coning is h^3/12 (w x w').
    h0, h1 = h[..., :-1, :], h[..., 1:, :]
    (a0, a1), (v0, v1), cross = _ends(a), _ends(v), torch.linalg.cross
    coning, sculling = cross(a0, a1), cross(a0, v1) + cross(v0, a1)

    def of_neighbours(product: Tensor) -> Tensor:
        product = product / (6.0 * (h0 + h1))
        by_next, by_last = product * (h0.square() / h1), product * (h1.square() / h0)
        edges = by_next[..., :1, :], by_last[..., -1:, :]
        return torch.cat([edges[0], 0.5 * (by_next[..., 1:, :] + by_last[..., :-1, :]), edges[1]], -2)

    angle = a + of_neighbours(coning)
    return Increments(angle, mean_turn(angle, v) + of_neighbours(sculling))


# ---------------------------------------------------------------------- parts


def rotation_between_samples(w: Tensor, h: Tensor) -> Tensor:
    """Rotation vectors over intervals `h` (..., N, 1) in which the rate changes evenly from one sample to the next."""
    w0, w1 = _ends(w)
    return 0.5 * h * (w0 + w1) + h.square() / 12.0 * torch.linalg.cross(w0, w1)


def mean_turn(angle: Tensor, x: Tensor) -> Tensor:
    """Mean of `Exp(s angle) x` over s from 0 to 1: the left Jacobian of SO(3) times x."""
    angle, x = torch.broadcast_tensors(angle, x)
    return (SO3.left_jacobian(angle, validate=False) @ x[..., None])[..., 0]


@cache
def _gauss_legendre(count: int) -> tuple[list[float], list[float]]:
    """Points and weights on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(count)
    return (0.5 + 0.5 * x).tolist(), (0.5 * w).tolist()


def _times_inside(t: Tensor, nodes: Tensor) -> Tensor:
    """(..., N * NODES); whole nanoseconds stay whole."""
    steps = t.diff(dim=-1)[..., None] * nodes.to(torch.float64)
    if t.dtype == torch.int64:
        steps = steps.round().to(torch.int64)
    return (t[..., :-1, None] + steps.to(t.dtype)).flatten(-2)


def _readings(motion: Kinematics, g: Tensor, rate: Tensor | None) -> tuple[Tensor, Tensor]:
    """What gyroscope and accelerometer read on an earth that turns with `rate`."""
    assert motion.rotation is not None
    assert motion.acceleration is not None
    assert motion.angular_velocity is not None
    # Of parameters of each sample there are none: they have one row for all.
    force, w = motion.acceleration - g, motion.angular_velocity
    if rate is not None:
        assert motion.velocity is not None
        force = force + 2.0 * torch.linalg.cross(rate.expand_as(force), motion.velocity)
        w = w + _unturn(motion.rotation, rate.expand_as(w))
    return w, _unturn(motion.rotation, force)


def world_vector(name: str, x: Tensor | Sequence[float], like: Tensor) -> Tensor:
    """A vector (3,), or (*batch, 1, 3): one for all samples of `like` (*batch, N, 3).

    Numbers of samples and of intervals differ, so that (N, 3) would go with one of them and not with the other.
    """
    x = vector_argument(name, x, like)
    if x.ndim > 1 and x.shape[-2] != 1:
        raise ValueError(f"{name}: expected shape (3,), or (*batch, 1, 3), got {tuple(x.shape)}")
    return x


def _ends(x: Tensor) -> tuple[Tensor, Tensor]:
    return x[..., :-1, :], x[..., 1:, :]


def rotate(q: Tensor, x: Tensor) -> Tensor:
    """Vectors turned by rotations."""
    return SO3.act(q, x, validate=False)


def _unturn(q: Tensor, x: Tensor) -> Tensor:
    return SO3.act(SO3.inverse(q, validate=False), x, validate=False)


def _between(start: Tensor, end: Tensor) -> Tensor:
    return SO3.between(start, end, validate=False)


def _log(q: Tensor) -> Tensor:
    return SO3.log(q, validate=False)


def rotation_by(x: Tensor) -> Tensor:
    """Rotations, of rotation vectors."""
    return SO3.exp(x, validate=False)


def check_pair(pair: tuple[Tensor, Tensor], names: tuple[str, str], least: int) -> None:
    """Two tensors (*batch, N, 3) of one shape and kind, with at least `least` rows."""
    for name, x in zip(names, pair, strict=True):
        checks.is_floating_tensor(name, x)
        checks.has_last(name, x, 3, "x, y, z")
        if x.ndim < 2 or x.shape[-2] < least:
            raise ValueError(
                f"{name}: expected shape (*batch, N, 3), N at least {least}, got {tuple(x.shape)}"
            )
        checks.finite(name, x)
    first, second = pair
    if second.shape != first.shape:
        raise ValueError(
            f"{names[1]}: expected shape {tuple(first.shape)} as {names[0]}, got {tuple(second.shape)}"
        )
    checks.same_kind(**dict(zip(names, pair, strict=True)))
