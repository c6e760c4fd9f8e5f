"""Splines of joints from encoder logs: positions, and velocities where there are any, by banded least squares."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline import checks
from torchspline.fit.poses.banded import difference_band, gram_band, solve_band, transpose_apply
from torchspline.fit.poses.knots import Knots
from torchspline.groups.group import Rn
from torchspline.splines.basis import blending_matrix, derivative_matrix
from torchspline.splines.bspline import BSpline
from torchspline.units import SECOND, unit_of

Array = NDArray[np.float64]
#: Spacings that are tried: factor between them, samples a knot interval at least, knot intervals at least.
_RATIO, _LEAST_SAMPLES, _LEAST_INTERVALS = 2**0.5, 1.5, 6
#: Weights of squared second differences of control points, in samples an interval, which bridge gaps: more where
#: rounding asks for it.
_SMOOTHNESS = (1e-13, 1e-10, 1e-7)
#: At most; three are usual.
_DELAY_STEPS = 12


@dataclass(frozen=True)
class JointFit:
    """The spline of the joints and how well it meets the log."""

    #: On R^dof, float64.
    trajectory: BSpline
    #: Measured minus fitted, (N, dof) as given; NaN for what was not used. None without velocities.
    position_residual: Tensor
    velocity_residual: Tensor | None
    #: Standard deviations that positions and velocities were weighed by, (dof,).
    position_sigma: Tensor
    velocity_sigma: Tensor | None
    #: How much later than positions velocities are, (dof,) s; None unless asked for.
    velocity_delay: Tensor | None
    #: Knot spacing, s, and rows that were left out because of NaN.
    spacing: float
    dropped: int
    #: Things a careful user wants to know, in words.
    notes: list[str] = field(default_factory=list)


@dataclass
class _Data:
    """Of one derivative: its number, values (N, dof), what they weigh (dof,), and how late they are (dof,), s."""

    derivative: int
    values: Array
    sigma: Array
    late: Array | None = None


def fit_joints(
    t: Tensor,
    positions: Tensor,
    velocities: Tensor | None = None,
    *,
    dt: float | Literal["auto"],
    order: int = 6,
    position_sigma: Tensor | float | None = None,
    velocity_sigma: Tensor | float | None = None,
    estimate_delay: bool = False,
) -> JointFit:
    """Least-squares B-spline on R^dof through the log of encoders.

    Linear: a banded Cholesky factorisation for each joint, cost linear in samples and control points. Noise that is
    not given is estimated for each joint from positions alone and from velocities alone, as what remains of them
    beside a spline of their own, whose spacing is found as for "auto".

    Args:
        t: (N,) seconds (float64) or int64 nanoseconds, jitter and gaps allowed, in any order.
        positions, velocities: (N, dof), rad or m, and per second; rows with NaN are left out.
        dt: knot spacing, s; "auto" takes the one of least generalised cross-validation [Craven & Wahba 1979], summed
            over joints, which expects noise that is white from sample to sample.
        order: of the spline, 4 or more, so that accelerations are continuous.
        position_sigma, velocity_sigma: standard deviations, a number or (dof,).
        estimate_delay: find for each joint how much later its velocities are than its positions, as filters of drives
            make them; zero for one that is hardly accelerated.
    Returns:
        JointFit, on the CPU in float64; `fit.Problem(result.trajectory)` takes it from there if more is known.
    Raises:
        TypeError, ValueError: a wrong type, shape or value; fewer distinct usable times than knots need.
    """
    _check(t, positions, velocities)
    checks.whole("order", order, least=4)
    if isinstance(dt, str):
        checks.choice("dt", dt, ("auto",))
    else:
        checks.positive("dt", dt)
    dof = positions.shape[1]
    given = [_sigma("position_sigma", position_sigma, dof), _sigma("velocity_sigma", velocity_sigma, dof)]
    for name, asked in (("velocity_sigma", velocity_sigma is not None), ("estimate_delay", estimate_delay)):
        if velocities is None and asked:
            raise ValueError(f"{name}: expected velocities with it, got none")
    columns = [positions] if velocities is None else [positions, velocities]
    usable = ~torch.stack([x.detach().isnan().any(-1) for x in columns]).any(0)
    if t.dtype != torch.int64:
        usable &= ~t.detach().isnan()
        checks.finite("t", t.masked_fill(~usable, 0.0))
    for name, x in zip(("positions", "velocities"), columns, strict=False):
        checks.finite(name, torch.where(usable[:, None], x.detach(), 0.0))
    rows = torch.argsort(t.detach(), stable=True)
    rows = rows[usable[rows]].cpu()
    times = t.detach().cpu()[rows]
    if (distinct := times.unique().numel()) < order + 1:
        raise ValueError(f"t: expected at least {order + 1} distinct times with usable rows, got {distinct}")
    numbers = [x.detach().to("cpu", torch.float64)[rows].numpy() for x in columns]
    notes = []
    data = []
    for r, (values, sigma) in enumerate(zip(numbers, given, strict=False)):
        if sigma is None:
            sigma, spacing = _noise(times, values, order - r, numbers[0])
            what = ("positions", "velocities")[r]
            notes.append(f"noise of {what} from a fit of these alone, knots {spacing * 1e3:.3g} ms apart")
        data.append(_Data(r, values, sigma))
    if isinstance(dt, str):
        dt = _choose(times, data, order)
        notes.append(f"knots {dt * 1e3:.4g} ms apart: the least generalised cross-validation")
    knots = Knots(times, dt, order)
    if (gaps := knots.gaps(times)) and len(gaps) > 0:
        notes.append(f"{len(gaps)} stretches of more than two knot intervals without samples were bridged")
    late = None
    if estimate_delay:
        data[1].late = _delays(knots, times, data)
        late = torch.from_numpy(data[1].late)
    points, _ = _solve(knots, times, data)
    trajectory = BSpline(torch.from_numpy(points), group=Rn(dof), order=order, **knots.options())
    residuals: list[Tensor | None] = [None, None]
    for r, part in enumerate(data):
        rest = torch.full((t.shape[0], dof), torch.nan, dtype=torch.float64)
        rest[rows] = torch.from_numpy(_misses(knots, times, points, part))
        residuals[r] = rest
    sigmas = [torch.from_numpy(part.sigma) for part in data] + [None]
    assert residuals[0] is not None
    assert sigmas[0] is not None
    return JointFit(
        trajectory, residuals[0], residuals[1], sigmas[0], sigmas[1],
        late, knots.seconds, int((~usable).sum()), notes,
    )  # fmt: skip


def _rows(knots: Knots, times: Tensor, derivative: int, late: float = 0.0) -> tuple[NDArray[np.int64], Array]:
    """First control point and weights (N, k) of a derivative per second, zeros where late ones are outside."""
    if late:
        start, stop = knots.t0, knots.t0 + knots.segments * knots.dt
        shifted = times - (round(late * SECOND) if knots.nanoseconds else late)
        inside = ((shifted >= start) & (shifted <= stop)).numpy()
        times = shifted.clamp(start, stop)
    first, u = knots.place(times)
    matrix = np.array(derivative_matrix(blending_matrix(knots.order), derivative), dtype=np.float64)
    weights = u[:, None] ** np.arange(knots.order) @ matrix.T / knots.seconds**derivative
    return first, weights * inside[:, None] if late else weights


def _evaluate(knots: Knots, points: Array, rows: tuple[NDArray[np.int64], Array]) -> Array:
    first, weights = rows
    return np.einsum("nk,nkd->nd", weights, points[first[:, None] + np.arange(knots.order)])


def _misses(knots: Knots, times: Tensor, points: Array, part: _Data) -> Array:
    """Measured minus fitted, (N, dof), NaN where the weights are zero."""
    if part.late is None:
        return part.values - _evaluate(knots, points, _rows(knots, times, part.derivative))
    rest = np.empty_like(part.values)
    for d, late in enumerate(part.late):
        rows = _rows(knots, times, part.derivative, float(late))
        rest[:, d] = part.values[:, d] - _evaluate(knots, points[:, d : d + 1], rows)[:, 0]
        rest[~rows[1].any(1), d] = np.nan
    return rest


def _solve(knots: Knots, times: Tensor, data: Sequence[_Data]) -> tuple[Array, Array]:
    """Control points (M, dof) and, for each joint, the weighted sum of squares that remains."""
    shared = [
        _equations(knots, times, part, 0.0, part.values) if part.late is None else None for part in data
    ]
    difference = min(2, knots.count - 1)
    bends = difference_band(knots.count, difference, max(knots.order, difference + 1))
    dof = data[0].values.shape[1]
    points, left = np.empty((knots.count, dof)), np.zeros(dof)
    for d in range(dof):
        # In units of the noise of the first: numbers of the matrix are counts of samples.
        band, right = np.zeros((len(bends), knots.count)), np.zeros((knots.count, 1))
        for part, known in zip(data, shared, strict=True):
            scale = (data[0].sigma[d] / part.sigma[d]) ** 2
            if known is not None:
                gram, side = known[0], known[1][:, d : d + 1]
            else:
                assert part.late is not None
                gram, side = _equations(knots, times, part, float(part.late[d]), part.values[:, d : d + 1])
            band[: knots.order] += scale * gram
            right += scale * side
        points[:, d] = _solve_bending(band, bends * len(times) / knots.segments, right)
    for part in data:
        left += np.nansum(_misses(knots, times, points, part) ** 2, axis=0) / part.sigma**2
    return points, left


def _equations(knots: Knots, times: Tensor, part: _Data, late: float, values: Array) -> tuple[Array, Array]:
    first, weights = _rows(knots, times, part.derivative, late)
    return gram_band(weights, first, knots.count), transpose_apply(weights, first, knots.count, values)


def _delays(knots: Knots, times: Tensor, data: list[_Data]) -> Array:
    """How late velocities are, (dof,) s, by Gauss-Newton steps between solutions for the control points.

    What a delay of s leaves of them is -s times the acceleration.
    """
    positions, velocities = data
    late = np.zeros(positions.values.shape[1])
    for _ in range(_DELAY_STEPS):
        velocities.late = late
        points, _ = _solve(knots, times, data)
        rest = _misses(knots, times, points, velocities)
        pull = _evaluate(knots, points, _rows(knots, times, 2))
        there = ~np.isnan(rest)
        power = np.where(there, pull**2, 0.0).sum(0)
        # A joint that is hardly accelerated, so that its delay is not known to a knot interval, says nothing.
        told = power > (velocities.sigma / knots.seconds) ** 2
        step = -np.where(there, pull * rest, 0.0).sum(0) / np.where(told, power, np.inf)
        late = np.clip(late + step, -2.0 * knots.seconds, 2.0 * knots.seconds)
        if np.abs(step).max() < 1e-8:
            break
    return late


def _solve_bending(band: Array, bends: Array, right: Array) -> Array:
    """With as little smoothing as makes the matrix definite: what samples hold does not feel it."""
    for smoothness in _SMOOTHNESS[:-1]:
        try:
            return solve_band(band + smoothness * bends, right)[:, 0]
        except np.linalg.LinAlgError:
            pass
    return solve_band(band + _SMOOTHNESS[-1] * bends, right)[:, 0]


def _choose(times: Tensor, data: Sequence[_Data], order: int) -> float:
    """The spacing of least generalised cross-validation: `sum over joints of log(rest / (1 - p / n)^2)`."""
    unit = unit_of(times)
    steps = times.diff().to(torch.float64)
    steps = steps[steps > 0] * unit
    spacing = _LEAST_SAMPLES * float(steps.median())
    widest = max(float(steps.sum()) / _LEAST_INTERVALS, spacing)
    best, least, since = spacing, math.inf, 0
    samples = len(times) * len(data)
    while spacing <= widest * (1 + 1e-9) and since < 6:
        knots = Knots(times, spacing, order)
        if knots.count < samples:
            _, left = _solve(knots, times, data)
            score = float(np.log(np.maximum(left, 1e-300)).mean()) - 2.0 * math.log(
                1.0 - knots.count / samples
            )
            since += 1
            if score < least:
                best, least, since = spacing, score, 0
        spacing *= _RATIO
    return best


def _noise(times: Tensor, values: Array, order: int, positions: Array) -> tuple[Array, float]:
    """Standard deviation of each column about a spline of its own, (dof,), and that spline's spacing."""
    data = [_Data(0, values, np.ones(values.shape[1]))]
    spacing = _choose(times, data, order)
    knots = Knots(times, spacing, order)
    _, left = _solve(knots, times, data)
    free = max(len(times) - knots.count, 1)
    # A column that is constant has no noise to see; it must not count for everything.
    # Velocities that are all zero are seen beside the positions of the same log.
    least = 1e-9 * max(float(np.abs(values).max()), 1e-3 * float(np.abs(positions).max()), 1e-9)
    return np.sqrt(left / free).clip(least), spacing


def _check(t: Tensor, positions: Tensor, velocities: Tensor | None) -> None:
    if not isinstance(t, Tensor):
        raise TypeError(
            f"t: expected a torch.Tensor, got {type(t).__name__}; convert it with torch.as_tensor"
        )
    if t.dtype not in (torch.float64, torch.int64):
        raise TypeError(f"t: expected float64 seconds or int64 nanoseconds, got {t.dtype}")
    checks.is_floating_tensor("positions", positions)
    if t.ndim != 1 or positions.ndim != 2 or positions.shape[:1] != t.shape or positions.shape[1] == 0:
        raise ValueError(
            f"t, positions: expected shapes (N,) and (N, dof), got {tuple(t.shape)} and {tuple(positions.shape)}"
        )
    if velocities is not None:
        checks.is_floating_tensor("velocities", velocities)
        if velocities.shape != positions.shape:
            raise ValueError(
                f"velocities: expected shape {tuple(positions.shape)}, as positions, got {tuple(velocities.shape)}"
            )


def _sigma(name: str, sigma: Tensor | float | None, dof: int) -> Array | None:
    if sigma is None:
        return None
    if not isinstance(sigma, Tensor):
        return np.full(dof, checks.positive(name, sigma))
    checks.is_floating_tensor(name, sigma)
    if tuple(sigma.shape) not in ((), (dof,)):
        raise ValueError(f"{name}: expected a number or shape ({dof},), got {tuple(sigma.shape)}")
    checks.finite(name, sigma)
    if not bool((sigma.detach() > 0).all()):
        raise ValueError(f"{name}: expected standard deviations above zero, got {sigma.min().item()}")
    return sigma.detach().to("cpu", torch.float64).expand(dof).numpy()
