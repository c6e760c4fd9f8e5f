"""Knots for a fit: a uniform grid over the measurements, and how wide it should be."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchspline.fit.poses.banded import FloatArray, difference_band, gram_band, solve_band, transpose_apply
from torchspline.splines.basis import blending_matrix, derivative_matrix
from torchspline.splines.clock import locate
from torchspline.units import NANOSECOND, SECOND, unit_of

#: Spacings that are tried follow each other by this factor; fits two of them apart are compared.
_RATIO = 2**0.25
#: Fewest poses a knot interval that are tried, and knot intervals.
_LEAST_POSES, _LEAST_INTERVALS = 1.5, 6
#: So many times the order of poses close together are a recording by themselves, fewer a burst.
_RUN = 2
#: How often worse than the best so far ends the search.
_GIVE_UP = 5.0
#: A minimum is one if what follows rises by this factor.
_RISE = 1.5
#: The fall of changes is over where it has slowed to this share of its steepest. With noise and missed motion alike, if
#: the latter changes little with the spacing, it would be a half.
_SLOWED = 0.4
#: Spacings from there to the minimum at least, if it is to count for more.
_WELL_BEFORE = 3
#: Changes within this factor of the least count as alike.
_ALIKE = 1.7
#: Weight of the straight line across a gap when smoothing: holds the curve there, and is not felt beside poses.
_BRIDGE = 1e-8


class Knots:
    """Uniform knots over a stretch of time, in the unit of the times."""

    def __init__(self, times: Tensor, dt: float, order: int):
        self.order = order
        self.nanoseconds = times.dtype == torch.int64
        self.t0 = times[0].item()
        self.dt: float | int = round(dt * SECOND) if self.nanoseconds else float(dt)
        if self.dt == 0:
            raise ValueError(f"dt: with int64 times expected at least a nanosecond, got {dt} s")
        span = times[-1].item() - self.t0
        if self.nanoseconds:
            segments = -(-span // self.dt)
        else:  # rounding errors of the times beyond the last knot belong to the domain, see `locate`
            rounding = np.finfo(np.float64).eps * (abs(times[-1].item()) + abs(self.t0) + span) / self.dt
            segments = math.ceil(span / self.dt - min(3.0 * rounding, 1e-3))
        self.segments = max(int(segments), 1)
        self.count = self.segments + order - 1
        if self.count > 1_000_000 and self.count > 1000 * len(times):
            raise ValueError(
                f"dt: {dt} s makes {self.count} control points for {len(times)} poses; use a larger one"
            )

    def options(self) -> dict[str, Any]:
        return {"dt_ns": self.dt, "t0_ns": self.t0} if self.nanoseconds else {"dt": self.dt, "t0": self.t0}

    def place(self, times: Tensor) -> tuple[np.ndarray, np.ndarray]:
        located = locate(times, self.t0, self.dt, self.segments, "error", True)
        return located.segment.numpy(), located.u.numpy()

    def gaps(self, times: Tensor) -> list[tuple[float, float]]:
        """Stretches between neighbouring poses longer than two knot intervals."""
        steps = times.diff()
        wide = torch.nonzero(steps > 2 * self.dt).flatten().tolist()
        return [(times[i].item(), times[i + 1].item()) for i in wide]

    @property
    def seconds(self) -> float:
        """The spacing."""
        return self.dt * (NANOSECOND if self.nanoseconds else 1.0)

    def _basis(self, first: np.ndarray, u: FloatArray, derivative: int) -> FloatArray:
        """Weights (N, k) of the control points, for splines in R^n; derivatives per second."""
        matrix = np.array(derivative_matrix(blending_matrix(self.order), derivative), dtype=np.float64)
        weights = u[:, None] ** np.arange(self.order) @ matrix.T
        return weights / self.seconds**derivative

    def _place_at(self, s: Tensor) -> tuple[np.ndarray, FloatArray]:
        """The same as `place` for times in knot spacings since the start."""
        first = s.floor().clamp(0, self.segments - 1)
        return first.to(torch.int64).numpy(), (s - first).numpy()

    def linear_fit(self, times: Tensor, values: FloatArray, smoothness: float) -> FloatArray:
        """Control points (M, C) of the least-squares spline in R^C through `values` (N, C).

        Args:
            smoothness: weight of squared second differences of control points.
        """
        return self._linear_fit(*self.place(times), values, smoothness)

    def smooth_fit(self, times: Tensor, values: FloatArray, spacing: float, step: float) -> FloatArray:
        """Control points (M, C) of the smoothing spline in R^C that passes what splines of wider knots would pass.

        Minimises the squared misses and the weighted integral of the squared derivative of the highest degree m that
        the spline has, m = order - 1 [Schoenberg 1964, Reinsch 1967]. To uniform samples that is a filter of gain
        `1 / (1 + (omega / omega_half)^(2 m))`. Least squares on knots `spacing` apart halve the same frequency,
        `omega_half = pi / spacing`, but have another gain beside knots than between them.

        Args:
            spacing: above that of these knots, s. step: mean distance of the times but for gaps, s.
        """
        m = self.order - 1
        first, u = self.place(times)
        weights = self._basis(first, u, 0)
        # The m-th derivative is constant between knots: differences of control points give its integral exactly.
        rough = self.seconds / step * (spacing / (math.pi * self.seconds)) ** (2 * m)
        band = rough * difference_band(self.count, m, self.order)
        band += gram_band(weights, first, self.count)
        right_side = transpose_apply(weights, first, self.count, values)
        between, line = self._across_gaps(times, values)
        if len(between):
            first, u = self.place(between)
            weights = self._basis(first, u, 0)
            band += _BRIDGE * gram_band(weights, first, self.count)
            right_side += _BRIDGE * transpose_apply(weights, first, self.count, line)
        return solve_band(band, right_side)

    def grid(self, each: int) -> Tensor:
        """So many evenly spaced times in every knot interval, from the first knot on, in the unit of the times."""
        steps = torch.arange(self.segments * each)
        if self.nanoseconds:
            return self.t0 + steps * self.dt // each
        return self.t0 + steps.to(torch.float64) * (self.dt / each)

    def among(self, grid: Tensor, times: Tensor) -> Tensor:
        """Which times of a grid have measurements around them: not within `gaps`, nor beyond the last."""
        after = torch.searchsorted(times, grid).clamp(1, len(times) - 1)
        return (times[after] - times[after - 1] <= 2 * self.dt) & (grid <= times[-1])

    def beside_gaps(self, times: Tensor) -> Tensor:
        """Which times begin or end one of the `gaps`, or are the last."""
        wide = times.diff() > 2 * self.dt
        edge = torch.ones(1, dtype=torch.bool)
        return torch.cat([wide, edge]) | torch.cat([~edge, wide])

    def _across_gaps(self, times: Tensor, values: FloatArray) -> tuple[Tensor, FloatArray]:
        """Times within gaps, and the straight lines across."""
        grid = self.grid(1)
        grid = grid[~self.among(grid, times) & (grid <= times[-1])]
        since, knots = ((x - self.t0).to(torch.float64).numpy() for x in (grid, times))
        return grid, np.stack([np.interp(since, knots, column) for column in values.T], axis=1)

    def linear_fit_at(self, s: Tensor, values: FloatArray) -> FloatArray:
        """The same without smoothing, times in knot spacings since the start."""
        return self._linear_fit(*self._place_at(s), values, 0.0)

    def _linear_fit(
        self, first: np.ndarray, u: FloatArray, values: FloatArray, smoothness: float
    ) -> FloatArray:
        weights = self._basis(first, u, 0)
        difference = min(2, self.count - 1)
        band = smoothness * difference_band(self.count, difference, max(self.order, difference + 1))
        band[: self.order] += gram_band(weights, first, self.count)
        band[0] += 1e-14 * len(u) / self.segments  # keeps a single knot interval with few poses definite
        return solve_band(band, transpose_apply(weights, first, self.count, values))

    def evaluate(self, control_points: FloatArray, times: Tensor, derivative: int = 0) -> FloatArray:
        """The spline in R^C, or a derivative of it, at times (N, C)."""
        return self._evaluate(control_points, *self.place(times), derivative)

    def evaluate_at(self, control_points: FloatArray, s: Tensor) -> FloatArray:
        """The same, times in knot spacings since the start."""
        return self._evaluate(control_points, *self._place_at(s), 0)

    def _evaluate(
        self, control_points: FloatArray, first: np.ndarray, u: FloatArray, derivative: int
    ) -> FloatArray:
        windows = control_points[first[:, None] + np.arange(self.order)]
        return np.einsum("nk,nkc->nc", self._basis(first, u, derivative), windows)


@dataclass(frozen=True)
class Spacing:
    """Knot spacings, s, and why."""

    rotation: float
    position: float
    reason: str
    #: Mean distance of the times but for gaps, the narrowest spacing they allow, s; whether they are so many that
    #: smoothing is better than wide knots.
    step: float = 0.0
    narrow: float = 0.0
    smooth: bool = False

    @property
    def knots(self) -> float:
        """Spacing of knots for the fit: so narrow that smoothing decides, not they."""
        narrower = min(self.rotation, self.position)
        return max(narrower / 2, min(self.narrow, narrower)) if self.smooth else narrower


def choose_spacing(
    times: Tensor, measured: Tensor, order: int, smoothness: float, accuracy: tuple[float, float] | None
) -> Spacing:
    """Spacings that suit the data, from banded linear fits of the stored numbers at many spacings.

    A spline with knots too near follows the noise, one with knots too far misses motion; both show as a difference
    between the fits at two near spacings, one falling with the spacing and one rising. Where the sum is least, or where
    its fall comes to an end well before, the error of a fit is about least, too [Lepski 1991]. Compared is what an IMU
    would see: rates of rotation, and accelerations. Nothing has to be known about the noise.

    Args:
        times: (N,) in order. measured: (N, 7) of continuous sign.
        accuracy: instead, the root mean square misses in m and rad, per axis, that the widest spacing may have.
    """
    unit = unit_of(times)
    numbers = measured.numpy() * np.array([1.0] * 3 + [2.0] * 4)  # a turn by x moves a quaternion by x / 2
    steps = times.diff().to(torch.float64)
    steps = steps[steps > 0] * unit
    # Poses may come in bursts, and with gaps between them.
    span, (usual, apart) = (times[-1].item() - times[0].item()) * unit, _usual(steps)
    if len(steps) > _RUN * order * len(apart):
        # No bursts, but stretches that are recordings by themselves.
        usual, apart = _usual(steps[steps <= 0.1 * usual])
    narrow = _LEAST_POSES * max(float(apart.median()), usual)
    if span / narrow > 1_000_000 and span / narrow > 1000 * len(times):
        longest = int(times.to(torch.float64).diff().argmax())
        raise ValueError(
            f"t: the {len(times)} usable times are mostly {usual:.3g} s apart, but span {span:.3g} s, from "
            f"{times[longest].item()!r} to {times[longest + 1].item()!r} without any; expected one recording: correct "
            "the times, fit the parts by themselves, or give dt"
        )
    widest = max(span / _LEAST_INTERVALS, narrow)
    tried: list[float] = []
    misses: list[tuple[float, float]] = []
    changes: list[tuple[float, float]] = []
    before: list[tuple[FloatArray, FloatArray]] = []
    spacing = narrow
    # Ends and the surroundings of gaps, where little holds the curve, do not count.
    inside = _well_inside(times, unit, narrow)
    while spacing <= widest * (1 + 1e-9):
        knots = Knots(times, spacing, order)
        points = knots.linear_fit(times, numbers, smoothness * len(times) / knots.segments)
        residual = knots.evaluate(points, times) - numbers
        here = (
            knots.evaluate(points[:, 3:], times[inside], derivative=1),
            knots.evaluate(points[:, :3], times[inside], derivative=2),
        )
        tried.append(spacing)
        misses.append((_per_axis(residual[:, :3]), _per_axis(residual[:, 3:])))
        if len(before) == 2:
            changes.append((_per_axis(here[0] - before[0][0]), _per_axis(here[1] - before[0][1])))
            if accuracy is None and all(
                now > _GIVE_UP * min(c)
                for now, c in zip(changes[-1], zip(*changes, strict=True), strict=True)
            ):
                break
        if accuracy is not None and all(
            now > _GIVE_UP * limit for now, limit in zip(misses[-1], accuracy, strict=True)
        ):
            break
        before, spacing = [*before[-1:], here], spacing * _RATIO
    if accuracy is not None:
        return _widest_within(tried, misses, accuracy)
    if not changes:
        return Spacing(
            tried[0], tried[0], f"too few poses to compare spacings: {tried[0] * 1e3:.3g} ms, the narrowest"
        )
    (rotation, turns), (position, pulls) = (_least(tried, [c[i] for c in changes]) for i in (0, 1))
    reason = (
        f"judged by how fits at near spacings differ, {rotation * 1e3:.3g} ms suit angular velocity (difference "
        f"{turns:.3g} rad/s) and {position * 1e3:.3g} ms acceleration ({pulls:.3g} m/s^2)"
    )
    return Spacing(rotation, position, reason, usual, narrow, smooth=len(apart) > 2 * order)


def _usual(steps: Tensor) -> tuple[float, Tensor]:
    """Mean of steps but for the longest, and the steps but for those within bursts."""
    usual = float(steps.sort().values[: max(math.ceil(0.99 * len(steps)), 1)].mean())
    return usual, steps[steps > 0.1 * usual]


def _per_axis(x: FloatArray) -> float:
    """Root mean square per axis of three."""
    return math.sqrt(np.square(x).sum() / (3 * max(len(x), 1)))


def _well_inside(times: Tensor, unit: float, narrow: float) -> Tensor:
    """Which times are so far from the ends and from gaps that the narrowest knots are held there."""
    seconds = (times - times[0]).to(torch.float64) * unit
    gap = seconds.diff() > 2 * narrow
    edges = torch.cat([seconds[:1], seconds[1:][gap], seconds[:-1][gap], seconds[-1:]]).sort().values
    after = torch.searchsorted(edges, seconds).clamp(1, len(edges) - 1)
    distance = torch.minimum((seconds - edges[after - 1]).abs(), (edges[after] - seconds).abs())
    inside = distance >= 10 * narrow
    return inside if bool(inside.any()) else torch.ones_like(inside)


def _least(tried: list[float], changes: list[float]) -> tuple[float, float]:
    """The spacing of least change, or where the changes stop falling with the noise well before, and that change.

    Args:
        changes: those between the first and third spacing tried, the second and fourth, and so on.
    """
    best, heights = _minimum(changes), np.log(np.maximum(changes, 1e-300))
    at = float(best)
    if best <= 2:
        # Noise that is smooth from pose to pose, as that of interpolated or filtered poses is, hardly changes between
        # narrow spacings: fits agree there without being right. The widest that agrees as well has less of it.
        alike = [c <= _ALIKE * min(changes[:4]) for c in changes]
        at = float(alike.index(False, best) - 1 if False in alike[best:] else best)
    elif (end := _end_of_fall(heights[: best + 1])) is not None:
        at = end
    elif best < len(heights) - 1:
        a, b, c = heights[best - 1 : best + 2]
        at = best + float(np.clip(0.5 * (a - c) / max(a - 2 * b + c, 1e-12), -0.5, 0.5))
    return tried[1] * _RATIO**at, float(np.exp(np.interp(at, np.arange(len(heights)), heights)))


def _minimum(changes: list[float]) -> int:
    """The first minimum that is one: at spacings wider still neighbouring fits may agree on missing the motion."""
    best = 0
    for i, change in enumerate(changes):
        if change < changes[best]:
            best = i
        elif change > _RISE * changes[best]:
            break
    return best


def _end_of_fall(heights: FloatArray) -> float | None:
    """Where the fall to the minimum, at the end of `heights`, has slowed down for good, if that is well before it: from
    there on the changes are motion that is missed."""
    slopes = heights[2:] - heights[:-2]
    for i in range(1, len(slopes) - _WELL_BEFORE + 1):
        slow = _SLOWED * slopes[:i].min()
        if slow < slopes[i - 1]:
            continue
        if (slopes[i : i + _WELL_BEFORE] > slow).all():
            at = i + float((slow - slopes[i - 1]) / (slopes[i] - slopes[i - 1]))
            return at if at <= len(heights) - 1 - _WELL_BEFORE else None
    return None


def _widest_within(
    tried: list[float], misses: list[tuple[float, float]], accuracy: tuple[float, float]
) -> Spacing:
    chosen = []
    for i, limit in enumerate(accuracy):
        fitting = [h for h, miss in zip(tried, misses, strict=True) if miss[i] <= limit]
        chosen.append(max(fitting) if fitting else tried[0])
    reached = misses[tried.index(chosen[0])][0], misses[tried.index(chosen[1])][1]
    reason = (
        f"widest spacings within {accuracy[0]:g} m and {accuracy[1]:g} rad: {chosen[0] * 1e3:.3g} ms for positions "
        f"(misses {reached[0]:.3g} m) and {chosen[1] * 1e3:.3g} ms for rotations (misses {reached[1]:.3g} rad)"
    )
    return Spacing(chosen[1], chosen[0], reason)
