"""Moving bodies from motion capture: splines through all joints at once, for IMUs on any of them at any rate."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchspline import checks
from torchspline.fit.poses.knots import Knots
from torchspline.groups.group import R3, SE3, SO3, product
from torchspline.splines.bspline import SplitBSpline, bspline
from torchspline.splines.keyframes import consistent_signs

#: Knots a period of the bandwidth: at two thirds of what knots can follow, the fit keeps what is there.
_KNOTS_PER_PERIOD = 3.0
#: Samples a knot interval that determine a spline, with some to spare.
_LEAST_SAMPLES = 1.2
#: Weights of squared second differences of control points, in poses, of positions and rotations. Poses say little of
#: the first and last control points: in R^3 it does not matter where these are, on SO(3) they must stay near their
#: neighbours. Repeated fits of what is left make up for it everywhere else.
_SMOOTHNESS, _TURN_SMOOTHNESS = 1e-9, 1e-4
#: Samples of a sine that `response` fits.
_MOST_SAMPLES = 1e7
#: Linear fits of what is left of rotations; the first leaves a percent to the second.
_STEPS = 3


class Response(NamedTuple):
    """What a fit makes of accelerations, at each frequency."""

    #: (F,): share of the acceleration that is kept, and RMS of what is added to it at other frequencies, as a share.
    gain: Tensor
    distortion: Tensor
    #: RMS acceleration that white noise of poses becomes, times 1/s^2.
    noise: float


def fit_body(t: Tensor, poses: Tensor, *, bandwidth: float, order: int = 6) -> SplitBSpline:
    """Least-squares splines through the poses of many joints, batched.

    Knots are `1 / (3 bandwidth)` apart: motion up to the bandwidth is kept, accelerations included (`response` says
    how well), and what is above 1.5 times the bandwidth is not. One banded factorisation for all joints: positions by
    a linear fit, rotations by a few of them.

    Args:
        t: (N,) s, increasing; uniform or not.
        poses: `(J, N, 7)` or (N, 7), body to world, as `Skeleton.poses` gives them.
        bandwidth: highest frequency of the motion that matters, Hz: 10 to 15 for walking, more for impacts; up to
            about a quarter of the rate of the poses.
        order: of the spline, 4 or more.
    Returns:
        SplitBSpline: control points `(J, M, 7)` or (M, 7), float64. `imu.measure(body, t, gravity)` reads an IMU on
        every joint; the world of BVH files has y up, gravity (0, -9.80665, 0).
    Raises:
        TypeError, ValueError: a wrong type, shape or value, or a bandwidth that the poses cannot show.
    """
    checks.is_floating_tensor("t", t)
    checks.is_floating_tensor("poses", poses)
    if t.ndim != 1 or poses.ndim not in (2, 3) or poses.shape[-2:] != (len(t), 7) or poses.shape[0] == 0:
        raise ValueError(
            f"t, poses: expected shapes (N,) and (J, N, 7) or (N, 7), got {tuple(t.shape)} and {tuple(poses.shape)}"
        )
    checks.whole("order", order, least=4)
    checks.positive("bandwidth", bandwidth)
    checks.finite("t", t)
    checks.finite("poses", poses)
    checks.quaternions("poses", poses, SE3.arithmetic.unit_blocks)
    times = t.detach().to("cpu", torch.float64)
    if len(times) < order + 1 or not bool((times.diff() > 0).all()):
        raise ValueError(f"t: expected at least {order + 1} increasing times, got {len(times)}")
    spacing, span = _spacing(bandwidth, float(times.diff().median())), float(times[-1] - times[0])
    # The last knot on the last pose: a control point with next to no poses would be anywhere.
    spacing = span / math.ceil(span / spacing - 1e-6)
    count = round(span / spacing) + order - 1
    if count > len(times):
        raise ValueError(
            f"t: expected at least {count} times over {span:g} s for as many control points, got {len(times)}; "
            "cut the motion where poses are missing"
        )
    knots = Knots(times, spacing, order)
    single = poses.ndim == 2
    measured = consistent_signs(poses.detach().to("cpu", torch.float64).reshape(-1, len(times), 7), _SPLIT)
    positions = _linear(knots, times, measured[..., :3], _SMOOTHNESS)
    solved = torch.cat([positions, _rotations(knots, times, measured[..., 3:], order)], -1)
    return SplitBSpline(solved[0] if single else solved, order=order, dt=spacing, t0=float(times[0]))


def _linear(knots: Knots, times: Tensor, values: Tensor, smoothness: float) -> Tensor:
    """Control points (J, M, C) of the least-squares splines through values (J, N, C), of all by one factorisation."""
    J, N, C = values.shape
    columns = values.transpose(0, 1).reshape(N, J * C).numpy()
    return torch.from_numpy(knots.linear_fit(times, columns, smoothness)).reshape(-1, J, C).transpose(0, 1)


def _rotations(knots: Knots, times: Tensor, measured: Tensor, order: int) -> Tensor:
    """Control points (J, M, 4) whose misses (rotation vectors, world) have next to no share in any basis function.

    All control points turned by one rotation turn the curve by it, so that a linear fit of the misses is nearly the
    step to take. Least squares asks the same, up to the curvature of SO(3) over the few knots of a basis function.
    """
    numbers = _linear(knots, times, measured, _TURN_SMOOTHNESS)
    # Where a body turns far between knots its numbers can cancel to nothing.
    vanished = numbers.norm(dim=-1, keepdim=True) < 1e-3
    points = SO3.normalize(torch.where(vanished, SO3.identity(dtype=torch.float64), numbers))
    best, least = points, torch.full((len(points),), torch.inf, dtype=torch.float64)
    with torch.no_grad():
        for step in range(_STEPS + 1):
            curve = bspline(
                points, times, group=SO3, order=order, derivatives=0, **knots.options(), validate=False
            ).value
            misses = SO3.log(SO3.compose(measured, SO3.inverse(curve)))
            cost = misses.square().sum((-1, -2))
            best = torch.where((cost < least)[:, None, None], points, best)
            least = torch.minimum(cost, least)
            if step < _STEPS:
                move = _linear(knots, times, misses, _TURN_SMOOTHNESS)
                points = SO3.compose(SO3.exp(move), points)
    return best


def response(frequencies: Tensor, rate: float, *, bandwidth: float, order: int = 6) -> Response:
    """What `fit_body` makes of accelerations of the given frequencies, by fitting sines.

    Args:
        frequencies: (F,) Hz. rate: of the poses, Hz. bandwidth, order: as for `fit_body`.
    Raises:
        TypeError, ValueError: a wrong type, shape or value, or a bandwidth that the poses cannot show.
    """
    checks.is_floating_tensor("frequencies", frequencies)
    if frequencies.ndim != 1:
        raise ValueError(f"frequencies: expected shape (F,), got {tuple(frequencies.shape)}")
    checks.finite("frequencies", frequencies)
    if not bool((frequencies > 0).all()):
        raise ValueError(f"frequencies: expected Hz above zero, got {frequencies.min().item():g}")
    checks.positive("rate", rate)
    checks.positive("bandwidth", bandwidth)
    checks.whole("order", order, least=4)
    spacing = _spacing(bandwidth, 1.0 / rate)
    w = 2.0 * math.pi * frequencies.detach().to("cpu", torch.float64).numpy()
    # Long enough to be alike in the middle, wherever knots and samples stand to each other.
    duration = max(100.0 * spacing, 8.0 * 2.0 * math.pi / float(w.min()) if len(w) else 0.0)
    if duration * rate > _MOST_SAMPLES:
        raise ValueError(
            f"frequencies: expected at least {8.0 * rate / _MOST_SAMPLES:.2g} Hz at {rate:g} Hz, "
            f"got {frequencies.min().item():g}"
        )
    t = torch.arange(0.0, duration, 1.0 / rate, dtype=torch.float64)
    knots = Knots(t, spacing, order)
    phase = t.numpy()[:, None] * w
    points = knots.linear_fit(t, np.concatenate([np.cos(phase), np.sin(phase)], 1), _SMOOTHNESS)
    middle = torch.linspace(0.25 * duration, 0.75 * duration, 20 * knots.segments, dtype=torch.float64)
    found = knots.evaluate(points, middle, derivative=2)
    # As a share of the true acceleration: its mean is the gain, its spread comes at other frequencies.
    share = (found[:, : len(w)] + 1j * found[:, len(w) :]) / (
        -(w**2) * np.exp(1j * middle.numpy()[:, None] * w)
    )
    gain = share.mean(0)
    distortion = np.sqrt((np.abs(share - gain) ** 2).mean(0))
    few = torch.arange(0.0, 60.0 * spacing, 1.0 / rate, dtype=torch.float64)
    knots = Knots(few, spacing, order)
    unit = knots.linear_fit(few, np.eye(len(few)), _SMOOTHNESS)
    inner = torch.linspace(25.0 * spacing, 35.0 * spacing, 401, dtype=torch.float64)
    noise = math.sqrt((knots.evaluate(unit, inner, derivative=2) ** 2).sum(1).mean())
    return Response(torch.from_numpy(gain.real.copy()), torch.from_numpy(distortion), noise)


_SPLIT = product(R3, SO3)


def _spacing(bandwidth: float, interval: float) -> float:
    spacing = 1.0 / (_KNOTS_PER_PERIOD * bandwidth)
    if spacing < _LEAST_SAMPLES * interval * (1.0 - 1e-6):
        most = 1.0 / (_KNOTS_PER_PERIOD * _LEAST_SAMPLES * interval)
        raise ValueError(
            f"bandwidth: expected at most {most:.4g} Hz from poses {interval * 1e3:.4g} ms apart, got {bandwidth}"
        )
    return spacing
