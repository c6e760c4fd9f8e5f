"""Where an alignment of an IMU with a trajectory starts: correlation of angular speeds, Wahba's problem, linear fits.

Times are seconds from the first reading (`s`) and from the start of the trajectory's domain (`tau`); `s = tau + lag`.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchspline.groups.group import SO3
from torchspline.splines.bspline import BSpline
from torchspline.units import NANOSECOND, nanoseconds

Array = NDArray[Any]
#: Angular speeds are compared at this interval (s), or that of the readings if longer, smoothed over two of them.
STEP = 0.02
#: Lags that stand out most in the correlation of speeds are tried on vectors; they lie this far apart (s).
_CANDIDATES, _APART = 6, 0.1
#: Starting angles where the motion turns about one axis only and leaves the rotation about it open.
_TURNS = 12
_ITERATIONS = 15
#: Of three standard normal components.
MEDIAN_LENGTH = 1.5381722544550522


class Start(NamedTuple):
    """`lag` (s), rotation matrix body to sensor, bias, share of the gyroscope's variance that it explains, how wide
    the rotation is still open (rad, one standard deviation, about the least determined axis) and that axis in the
    sensor, by how much the trajectory's angular speed varies (rad/s), and the next best lag with what it explains."""

    lag: float
    rotation: Array
    bias: Array
    explained: float
    open_angle: float
    open_axis: Array
    turning: float = 0.0
    rival: tuple[float, float] | None = None


class Force(NamedTuple):
    """What specific force says in the body frame: gravity (world), bias, lever arm, scale of the residual (m/s^2)."""

    rotation: Array
    gravity: Array
    bias: Array
    lever_arm: Array
    scale: float


class Motion(NamedTuple):
    """Of the body at some times: rotation matrices to the world, rates in the body, acceleration in the body."""

    rotation: Array
    w: Array
    w_dot: Array
    a: Array


def unit_of(trajectory: BSpline) -> float:
    """Seconds in a unit of the trajectory's times."""
    return 1.0 if trajectory.dt_ns is None else NANOSECOND


def times_of(trajectory: BSpline, tau: Array) -> torch.Tensor:
    """Times as the trajectory takes them, of seconds from the start of its domain."""
    start = trajectory.domain[0]
    x = torch.from_numpy(np.ascontiguousarray(tau))
    return start + nanoseconds(x) if isinstance(start, int) else start + x


def length_of(trajectory: BSpline) -> float:
    """Of the domain, s."""
    start, stop = trajectory.domain
    return (stop - start) * unit_of(trajectory)


def angular_velocity(trajectory: BSpline, tau: Array) -> Array:
    """(N, 3), body frame."""
    with torch.no_grad():
        w = trajectory.kinematics(times_of(trajectory, tau)).angular_velocity
    assert w is not None
    return w.numpy()


def motion(trajectory: BSpline, tau: Array) -> Motion:
    """What a sensor on the body feels of its motion, but gravity."""
    with torch.no_grad():
        m = trajectory.kinematics(times_of(trajectory, tau))
        assert m.rotation is not None
        assert m.acceleration is not None
        assert m.angular_velocity is not None
        assert m.angular_acceleration is not None
        rotation = SO3.to_matrix(m.rotation)
        a = (rotation.mT @ m.acceleration.unsqueeze(-1)).squeeze(-1)
    return Motion(*(x.numpy() for x in (rotation, m.angular_velocity, m.angular_acceleration, a)))


# ---------------------------------------------------------------------- gyroscope: lag, rotation, bias


def start(trajectory: BSpline, s: Array, gyro: Array, lags: tuple[float, float]) -> Start | None:
    """The lag, within `lags`, at which the gyroscope's readings look most like the trajectory; None if they
    never overlap.

    Args:
        s: (N,) ascending. gyro: (N, 3).
    """
    from scipy.ndimage import median_filter

    steps = np.diff(s)
    interval = float(np.median(steps[steps > 0]))
    step = max(STEP, interval)
    # Spikes go before anything is squared: one reading in five may be wrong.
    width = 2 * int(np.clip(0.015 / interval, 2, 7)) + 1
    clean = median_filter(gyro, size=(width, 1), mode="nearest")
    seen, there = _binned(s, clean, step)
    tau = np.arange(math.floor(length_of(trajectory) / step) + 1) * step
    moved, _ = _smooth(angular_velocity(trajectory, tau), np.ones(len(tau)))
    speeds = np.linalg.norm(moved, axis=1), np.linalg.norm(seen, axis=1)
    speeds = tuple(np.minimum(v, 1.5 * np.quantile(v, 0.999)) for v in speeds)
    turning = float(np.std(speeds[0]))
    shorter = min(len(tau), int((there > 0).sum())) * step
    least = min(10.0, 0.5 * shorter)
    shifts, score = _correlation(speeds[0], speeds[1], (there > 0).astype(float), step, least)
    allowed = (shifts * step >= lags[0] - 0.5 * step) & (shifts * step <= lags[1] + 0.5 * step)
    if not (allowed & np.isfinite(score)).any():
        return None
    tried = [
        _matched(lag, tau, moved, np.arange(len(seen)) * step, seen, there)
        for lag in _peaks(shifts, np.where(allowed, score, -np.inf), step, lags)
    ]
    found = sorted((x for x in tried if x is not None), key=lambda x: -x.explained)
    if not found:
        return None
    best, *others = found
    rivals = [(x.lag, x.explained) for x in others if abs(x.lag - best.lag) > 2 * _APART]
    return best._replace(turning=turning, rival=rivals[0] if rivals else None)


def _binned(s: Array, values: Array, step: float) -> tuple[Array, Array]:
    """Means in intervals of `step` around its multiples, smoothed, and how much each rests on."""
    index = np.rint(s / step).astype(np.int64)
    length = int(index[-1]) + 1
    count = np.bincount(index, minlength=length).astype(float)
    total = np.stack([np.bincount(index, v, minlength=length) for v in values.T], axis=-1)
    return _smooth(total / np.maximum(count, 1.0)[:, None], (count > 0).astype(float))


def _smooth(values: Array, weight: Array) -> tuple[Array, Array]:
    """A Gaussian over two steps; zero, and weight zero, where nothing is near."""
    from scipy.ndimage import gaussian_filter1d

    there = gaussian_filter1d(weight, 1.0, mode="constant")
    there[there < 0.2] = 0.0
    sums = gaussian_filter1d(values * weight[:, None], 1.0, axis=0, mode="constant")
    return np.where(there[:, None] > 0, sums / np.maximum(there, 0.2)[:, None], 0.0), there


def _correlation(x: Array, y: Array, there: Array, step: float, least: float) -> tuple[Array, Array]:
    """Shifts k and how much `y[i + k]` looks like `x[i]` over what they share, in standard deviations: Fisher's
    transform of the normalised correlation, which does not favour short overlaps. -inf where less than `least` s is
    shared.

    Sums over each overlap come from transforms of the values, their squares and their masks.
    """
    from scipy.fft import irfft, next_fast_len, rfft

    x, y = x - x.mean(), (y - y[there > 0].mean()) * there
    size = next_fast_len(len(x) + len(y) - 1, real=True)
    spectrum = [rfft(v, size) for v in (x, x * x, np.ones(len(x)), y, y * y, there)]
    fx, fxx, fone, fy, fyy, fthere = spectrum

    def sums(a: Array, b: Array) -> Array:
        full = irfft(np.conj(a) * b, size)
        return np.concatenate([full[size - len(x) + 1 :], full[: len(y)]])

    shifts = np.arange(-(len(x) - 1), len(y))
    n = np.maximum(sums(fone, fthere), 1.0)
    sx, sy, sxx, syy = sums(fx, fthere), sums(fone, fy), sums(fxx, fthere), sums(fone, fyy)
    vx, vy = sxx - sx * sx / n, syy - sy * sy / n
    floor = [1e-9 * max(float(np.sum(v * v)), 1e-30) for v in (x, y)]
    r = (sums(fx, fy) - sx * sy / n) / np.sqrt(np.maximum(vx, floor[0]) * np.maximum(vy, floor[1]))
    score = np.arctanh(np.clip(r, -1.0 + 1e-6, 1.0 - 1e-6)) * np.sqrt(n)
    return shifts, np.where(n * step >= least, score, -np.inf)


def _peaks(shifts: Array, score: Array, step: float, lags: tuple[float, float]) -> list[float]:
    """The highest, each at the top of the parabola through it and its neighbours."""
    left = score.copy()
    found: list[float] = []
    while len(found) < _CANDIDATES:
        i = int(np.argmax(left))
        if not np.isfinite(left[i]):
            break
        shift = float(shifts[i])
        if 0 < i < len(score) - 1 and np.isfinite(score[[i - 1, i + 1]]).all():
            bend = score[i - 1] - 2 * score[i] + score[i + 1]
            if bend < 0:
                shift += float(np.clip(0.5 * (score[i - 1] - score[i + 1]) / bend, -0.5, 0.5))
        found.append(float(np.clip(shift * step, *lags)))
        left[np.abs(shifts - shifts[i]) * step <= _APART] = -np.inf
    return found


def _matched(lag: float, tau: Array, moved: Array, s: Array, seen: Array, there: Array) -> Start | None:
    """Rotation and bias at a lag, and what they explain."""
    inside = (there > 0) & (s - lag >= tau[0]) & (s - lag <= tau[-1])
    if inside.sum() < 10:
        return None
    body = np.stack([np.interp(s[inside] - lag, tau, c) for c in moved.T], axis=-1)
    sensor = seen[inside]
    weight = np.ones(len(body))
    for _ in range(_ITERATIONS):
        rotation, bias = _wahba(body, sensor, weight)
        error = sensor - body @ rotation.T - bias
        weight = _cauchy(error)[0]
    share = weight / weight.sum()
    left = sensor - share @ sensor
    explained = 1.0 - float(share @ (error**2).sum(1)) / max(float(share @ (left**2).sum(1)), 1e-300)
    centred = body - share @ body
    spread, axes = np.linalg.eigh((centred * share[:, None]).T @ centred)
    # Turning about an axis moves what is across it; neighbouring bins share their smoothing, hence the 4.
    variance = 4.0 * float(share @ (error**2).sum(1)) / 3.0
    open_angle = math.sqrt(variance / max(len(body) * float(spread[0] + spread[1]), 1e-300))
    return Start(lag, rotation, bias, explained, open_angle, rotation @ axes[:, 2])


def _wahba(body: Array, sensor: Array, weight: Array) -> tuple[Array, Array]:
    """R and b of least `sum w |sensor - R body - b|^2`: Wahba's problem about the means, by singular values [Markley
    1988]."""
    share = weight / weight.sum()
    mean = share @ body, share @ sensor
    u, _, vt = np.linalg.svd(((sensor - mean[1]) * share[:, None]).T @ (body - mean[0]))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    return rotation, mean[1] - rotation @ mean[0]


def _cauchy(error: Array) -> tuple[Array, float]:
    """Weights of vectors, and the standard deviation of a component, from the median of their lengths."""
    length = np.linalg.norm(error, axis=1)
    scale = float(np.median(length)) / MEDIAN_LENGTH
    return 1.0 / (1.0 + (length / max(3.0 * scale, 1e-12)) ** 2), scale


# ---------------------------------------------------------------------- accelerometer: gravity, bias, lever arm


def force(start: Start, body: Motion, accel: Array, magnitude: float | None) -> Force:
    """Gravity, bias and lever arm, which enter linearly once the rotation is known; where the gyroscope leaves the
    rotation open about an axis, the angle about it that fits best.

    Args:
        body: at the times of the readings `accel` (N, 3), the start's lag taken into account.
    """
    if start.open_angle < 0.03:
        return _linear(start.rotation, body, accel, magnitude)
    turns = np.arange(_TURNS) * (2 * math.pi / _TURNS)
    vectors = torch.from_numpy(turns[:, None] * start.open_axis)
    tried = [
        _linear(R.numpy() @ start.rotation, body, accel, magnitude) for R in SO3.to_matrix(SO3.exp(vectors))
    ]
    return min(tried, key=lambda x: x.scale)


def _linear(rotation: Array, body: Motion, accel: Array, magnitude: float | None) -> Force:
    """`accel = R (a + w' x r + w x (w x r) - Q^T g) + b` for r, g, b, [S20] (70) with a lever arm."""
    N = len(accel)
    w, w_dot, eye = body.w, body.w_dot, np.eye(3)
    outer = w[:, :, None] * w[:, None, :]
    arm = _hat(w_dot) + outer - (w * w).sum(1)[:, None, None] * eye
    columns = np.concatenate(
        [rotation @ arm, -rotation @ body.rotation.transpose(0, 2, 1), np.broadcast_to(eye, (N, 3, 3))],
        axis=2,
    )
    right = accel - body.a @ rotation.T
    weight, scale = np.ones(N), 1.0
    # Priors of 1 m and 1 m/s^2 for arm and bias: only felt where the motion does not tell them from gravity.
    prior = np.diag([1.0, 1, 1, 0, 0, 0, 1, 1, 1])
    for _ in range(_ITERATIONS):
        weighted = columns * weight[:, None, None]
        matrix = np.einsum("nri,nrj->ij", weighted, columns) + (scale**2 + 1e-6) * prior
        x = np.linalg.lstsq(matrix, np.einsum("nri,nr->i", weighted, right), rcond=None)[0]
        weight, scale = _cauchy(right - columns @ x)
    gravity = x[3:6]
    if magnitude is not None:
        gravity = gravity * (magnitude / max(float(np.linalg.norm(gravity)), 1e-9))
    return Force(rotation, gravity, x[6:], x[:3], scale)


def _hat(w: Array) -> Array:
    """(N, 3, 3), of the cross product from the left."""
    zero = np.zeros(len(w))
    x, y, z = w.T
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
