"""A trajectory through timed poses, by least squares on the control points."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from torchspline import checks
from torchspline.fit.banded import BandedCholesky, FloatArray, difference_band, gram_band, transpose_apply
from torchspline.groups.components import join, split
from torchspline.groups.group import R3, SE3, SO3, Group, product
from torchspline.splines.basis import blending_matrix
from torchspline.splines.bspline import BSpline, SplitBSpline, bspline
from torchspline.splines.clock import locate
from torchspline.splines.keyframes import consistent_signs

Representation = Literal["split", "joint"]
_NANOSECONDS = 1_000_000_000
#: Steps the quasi-Newton iteration remembers.
_MEMORY = 10


@dataclass(frozen=True)
class PoseFit:
    """The trajectory and how well it meets the poses."""

    #: `SplitBSpline` or `BSpline` on SE3, float64.
    trajectory: BSpline
    #: Per pose as given (N, 3): measured minus fitted position in the world, m. NaN for poses not used.
    position_residual: Tensor
    #: Per pose as given (N, 3): `Log(R_fitted^T R_measured)`, rad. NaN for poses not used.
    rotation_residual: Tensor
    #: Poses left out because a number was NaN, and how many share their time with another.
    dropped: int
    duplicates: int
    #: Stretches (start, end), in the unit of the times, in which nothing but smoothness holds the trajectory.
    gaps: list[tuple[float, float]]
    #: Half the weighted sum of squares after the linear start and after each iteration.
    cost: list[float]
    #: Why the iteration stopped.
    reason: str
    #: Things a careful user wants to know, in words.
    notes: list[str] = field(default_factory=list)

    def rms(self) -> tuple[float, float]:
        """Root mean square residual per axis of the poses used: position in m, rotation in rad."""
        pair = (self.position_residual, self.rotation_residual)
        position, rotation = (math.sqrt(r[~r.isnan()].square().mean().item()) for r in pair)
        return position, rotation


def fit_poses(
    t: Tensor,
    poses: Tensor,
    *,
    dt: float,
    order: int = 6,
    representation: Representation = "split",
    position_sigma: float = 0.01,
    rotation_sigma: float = 0.01,
    smoothness: float = 1e-6,
    max_iterations: int = 60,
    tolerance: float = 1e-9,
    progress: bool = True,
) -> PoseFit:
    """Least-squares B-spline through timed poses: `sum |Log(X(t_i)^-1 X_i)|^2_sigma` plus a little smoothness.

    A banded linear fit of the stored numbers (exact for positions) starts L-BFGS with exact gradients from the
    spline's reverse sweep, preconditioned by the banded Hessian of the same problem on R^n. Cost is linear in poses
    and control points.

    Args:
        t: (N,) seconds (float64) or int64 nanoseconds; in any order, duplicates allowed.
        poses: (N, 7) [x, y, z, qw, qx, qy, qz], body to world; rows with NaN are left out.
        dt: knot spacing, seconds. What it should be depends on the data: a wrong spacing costs more than anything.
        order: of the spline, 2 or more; IMU synthesis wants at least 4, better 6.
        representation: "split" (R3 x SO3) or "joint" (SE3).
        position_sigma, rotation_sigma: what a residual of one weighs, m and rad; matters to "joint" only.
        smoothness: weight of squared second differences of neighbouring control points, in poses a knot interval.
            Bridges stretches without data; small enough not to be felt where there are poses.
        max_iterations, tolerance: stop after so many iterations, or when the cost falls by less than this share.
        progress: show a progress bar on a terminal.
    Returns:
        PoseFit, on the CPU in float64.
    Raises:
        TypeError, ValueError: a wrong type, shape or value; fewer than two distinct usable times.
    """
    group = _group(representation)
    _check(t, poses)
    checks.whole("order", order, least=2)
    checks.whole("max_iterations", max_iterations, least=0)
    for name, x in (
        ("dt", dt),
        ("position_sigma", position_sigma),
        ("rotation_sigma", rotation_sigma),
        ("smoothness", smoothness),
    ):
        checks.positive(name, x)
    if checks.finite_number("tolerance", tolerance) < 0:
        raise ValueError(f"tolerance: expected a number that is not negative, got {tolerance}")
    usable = ~poses.isnan().any(dim=-1)
    if t.dtype != torch.int64:
        usable &= ~t.isnan()
        checks.finite("t", t.masked_fill(~usable, 0.0))
    # Rows that are left out anyway must not shift the index that an error gives.
    filled = torch.where(
        usable[:, None], poses.detach(), SE3.identity(dtype=poses.dtype, device=poses.device)
    )
    checks.finite("poses", filled)
    checks.quaternions("poses", filled, SE3.arithmetic.sign_blocks)
    order_of_time = torch.argsort(t, stable=True)
    rows = order_of_time[usable[order_of_time]]
    times, measured = t.detach()[rows].cpu(), poses.detach()[rows].to("cpu", torch.float64)
    distinct = torch.unique(times).numel()
    if distinct < 2:
        raise ValueError(f"t: expected at least two distinct times with usable poses, got {distinct}")

    knots = _Knots(times, dt, order)
    measured = consistent_signs(measured, group)
    problem = _Problem(group, knots, times, measured, (position_sigma, rotation_sigma), smoothness)
    with _bar(progress, max_iterations) as advance:
        control_points, cost, reason = problem.solve(max_iterations, tolerance, advance)

    options = knots.options()
    if group == SE3:
        trajectory = BSpline(control_points, group=SE3, order=order, **options)
    else:
        trajectory = SplitBSpline(control_points, order=order, **options)
    fitted = trajectory(times).detach()
    residual = torch.full((2, t.shape[0], 3), torch.nan, dtype=torch.float64)
    residual[0, rows.cpu()] = measured[:, :3] - fitted[:, :3]
    residual[1, rows.cpu()] = SO3.log(SO3.between(fitted[:, 3:], measured[:, 3:]))
    gaps = knots.gaps(times)
    dropped, duplicates = int((~usable).sum()), len(times) - distinct
    notes = _notes(order_of_time, dropped, duplicates, gaps, len(times), knots)
    return PoseFit(trajectory, residual[0], residual[1], dropped, duplicates, gaps, cost, reason, notes)


def _group(representation: str) -> Group:
    checks.choice("representation", representation, ("split", "joint"))
    return product(R3, SO3) if representation == "split" else SE3


def _check(t: Tensor, poses: Tensor) -> None:
    checks.is_floating_tensor("poses", poses)
    if not isinstance(t, Tensor):
        raise TypeError(
            f"t: expected a torch.Tensor, got {type(t).__name__}; convert it with torch.as_tensor"
        )
    if t.dtype not in (torch.float64, torch.int64):
        raise TypeError(f"t: expected float64 seconds or int64 nanoseconds, got {t.dtype}")
    if poses.ndim != 2 or poses.shape[-1] != 7 or t.shape != poses.shape[:1]:
        raise ValueError(
            f"t, poses: expected shapes (N,) and (N, 7), got {tuple(t.shape)} and {tuple(poses.shape)}"
        )
    if poses.device != t.device:
        raise ValueError(
            f"t: on device {t.device}, but poses are on {poses.device}; move one with .to(device)"
        )


class _Knots:
    """Uniform knots over a stretch of time, in the unit of the times."""

    def __init__(self, times: Tensor, dt: float, order: int):
        self.order = order
        self.nanoseconds = times.dtype == torch.int64
        self.t0 = times[0].item()
        self.dt: float | int = round(dt * _NANOSECONDS) if self.nanoseconds else float(dt)
        if self.dt == 0:
            raise ValueError(f"dt: with int64 times expected at least a nanosecond, got {dt} s")
        span = times[-1].item() - self.t0
        segments = -(-span // self.dt) if self.nanoseconds else math.ceil(span / self.dt - 1e-9)
        self.segments = max(int(segments), 1)
        self.count = self.segments + order - 1

    def options(self) -> dict[str, Any]:
        return {"dt_ns": self.dt, "t0_ns": self.t0} if self.nanoseconds else {"dt": self.dt, "t0": self.t0}

    def place(self, times: Tensor) -> tuple[np.ndarray, np.ndarray]:
        located = locate(times, self.t0, self.dt, self.segments, "error", True)
        return located.segment.numpy(), located.u.numpy()

    def gaps(self, times: Tensor) -> list[tuple[float, float]]:
        """Stretches between neighbouring poses in which at least one whole knot interval has no pose."""
        steps = times.diff()
        wide = torch.nonzero(steps > 2 * self.dt).flatten().tolist()
        return [(times[i].item(), times[i + 1].item()) for i in wide]


class _Problem:
    """Residuals of all poses, their gradient, and the banded matrix that turns a gradient into a step."""

    def __init__(
        self,
        group: Group,
        knots: _Knots,
        times: Tensor,
        measured: Tensor,
        sigmas: tuple[float, float],
        smoothness: float,
    ):
        self.group, self.knots, self.times, self.measured = group, knots, times, measured
        self.weight = torch.tensor([1 / sigmas[0]] * 3 + [1 / sigmas[1]] * 3, dtype=torch.float64)
        order = knots.order
        self.first, u = knots.place(times)
        powers = u[:, None] ** np.arange(order)
        self.basis: FloatArray = powers @ np.array(blending_matrix(order), dtype=np.float64).T
        per_interval = len(times) / knots.segments
        self.smooth_weight = smoothness * per_interval
        self.difference = min(2, knots.count - 1)
        band = gram_band(self.basis, self.first, knots.count)
        width = max(order, self.difference + 1)
        band = np.vstack([band, np.zeros((width - order, knots.count))])
        band += self.smooth_weight * difference_band(knots.count, self.difference, width)
        band[0] += 1e-14 * per_interval  # keeps a single knot interval with few poses definite
        self.factor = BandedCholesky(band)

    def start(self) -> Tensor:
        """The linear fit of the stored numbers, quaternions normalised after it."""
        right = transpose_apply(self.basis, self.first, self.knots.count, self.measured.numpy())
        solution = torch.from_numpy(self.factor.solve(right))
        # Where rotation runs through more than half a turn between knots the numbers can cancel to nothing.
        vanished = solution[:, 3:].norm(dim=-1) < 1e-3
        solution[vanished, 3:] = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
        return self.group.normalize(solution)

    def cost(self, control_points: Tensor) -> Tensor:
        fitted = bspline(
            control_points,
            self.times,
            group=self.group,
            order=self.knots.order,
            **self.knots.options(),
            derivatives=0,
            validate=False,
        ).value  # fmt: skip
        residual = self.group.log(self.group.between(fitted, self.measured, validate=False), validate=False)
        total = (residual * self.weight).square().sum()
        steps = self.group.log(
            self.group.between(control_points[:-1], control_points[1:], validate=False), validate=False
        )
        bends = (steps.diff(dim=0) if self.difference == 2 else steps) * self.weight
        return 0.5 * (total + self.smooth_weight * bends.square().sum())

    def body_gradient(self, control_points: Tensor) -> tuple[float, Tensor]:
        """Cost and its gradient as body cotangents (count, 6)."""
        leaf = control_points.requires_grad_()
        cost = self.cost(leaf)
        (gradient,) = torch.autograd.grad(cost, leaf)
        algebra = self.group.arithmetic
        body = join(algebra.pull(split(leaf.detach()), split(gradient)), gradient)
        return cost.item(), body

    def solve(self, max_iterations: int, tolerance: float, advance) -> tuple[Tensor, list[float], str]:
        """L-BFGS on body tangents, started from the banded matrix; steps are halved until the cost falls."""
        points = self.start()
        cost, gradient = self.body_gradient(points)
        history = [cost]
        memory: list[tuple[Tensor, Tensor]] = []
        for _ in range(max_iterations):
            step = -self._inverse_hessian(gradient, memory)
            points, taken = self._line_search(points, step, cost)
            if taken is None:
                return points, history, "no step along the gradient lowers the cost any more"
            before = gradient
            cost, gradient = self.body_gradient(points)
            history.append(cost)
            advance(cost)
            if history[-2] - cost <= tolerance * history[-2]:
                return points, history, f"the cost fell by less than a share of {tolerance:g}"
            change = gradient - before
            if (change * taken).sum() > 0:
                memory = [*memory[1 - _MEMORY :], (taken, change)]
        return points, history, f"{max_iterations} iterations"

    def _inverse_hessian(self, gradient: Tensor, memory: list[tuple[Tensor, Tensor]]) -> Tensor:
        """The two-loop recursion over remembered steps and gradient changes."""
        shares = []
        for step, change in reversed(memory):
            share = (step * gradient).sum() / (step * change).sum()
            gradient = gradient - share * change
            shares.append(share)
        result = torch.from_numpy(self.factor.solve(gradient.numpy())) / self.weight.square()
        for (step, change), share in zip(memory, reversed(shares), strict=True):
            result = result + (share - (change * result).sum() / (step * change).sum()) * step
        return result

    def _line_search(self, points: Tensor, step: Tensor, cost: float) -> tuple[Tensor, Tensor | None]:
        """The moved points and the step taken, None if no share of it lowers the cost."""
        points = points.detach()
        for _ in range(12):
            moved = self.group.retract(points, step, side="right", validate=False)
            with torch.no_grad():
                if self.cost(moved).item() < cost:
                    return moved, step
            step = 0.5 * step
        return points, None


@contextmanager
def _bar(show: bool, total: int) -> Iterator:
    """A progress bar on standard error that shows the cost; silent where that is not a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (TextColumn("fitting poses"), BarColumn(), TextColumn("cost {task.fields[cost]:.6g}"))
    with Progress(
        *columns,
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=not (show and console.is_terminal),
    ) as bar:
        task = bar.add_task("", total=total, cost=math.nan)
        yield lambda cost: bar.update(task, advance=1, cost=cost)


def _notes(
    order_of_time: Tensor,
    dropped: int,
    duplicates: int,
    gaps: list[tuple[float, float]],
    used: int,
    knots: _Knots,
) -> list[str]:
    notes = []
    if bool((order_of_time.diff() < 0).any()):
        notes.append("times were not in order; poses were sorted")
    if dropped:
        notes.append(f"{dropped} poses with NaN were left out")
    if duplicates:
        notes.append(f"{duplicates} poses share their time with another; all were used")
    if gaps:
        longest = max(b - a for a, b in gaps) * (1e-9 if knots.nanoseconds else 1.0)
        notes.append(
            f"{len(gaps)} stretches without poses, up to {longest:.3g} s, were bridged by smoothness alone"
        )
    if used < knots.count:
        notes.append(
            f"{used} poses for {knots.count} control points: smoothness decides the rest; use a larger dt"
        )
    return notes
