"""A trajectory through timed poses, by least squares on the control points."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from torchspline import checks
from torchspline.fit.banded import (
    BandedCholesky,
    FloatArray,
    NormalEquations,
    difference_band,
    gram_band,
    transpose_apply,
)
from torchspline.groups.components import join, split
from torchspline.groups.group import R3, SE3, SO3, Group, product
from torchspline.splines.basis import blending_matrix
from torchspline.splines.bspline import BSpline, SplitBSpline, bspline
from torchspline.splines.clock import locate
from torchspline.splines.keyframes import consistent_signs

Representation = Literal["split", "joint"]
_NANOSECONDS = 1_000_000_000
#: Rows of the Jacobian that are held at a time.
_ROWS = 20_000


@dataclass(frozen=True)
class PoseFit:
    """The trajectory and how well it meets the poses."""

    #: `SplitBSpline` or `BSpline` on SE3, float64.
    trajectory: BSpline
    #: Per pose as given (N, 3): measured minus fitted position in the world, m. NaN for poses not used.
    position_residual: Tensor
    #: Per pose as given (N, 3): `Log(R_fitted^T R_measured)`, rad. NaN for poses not used.
    rotation_residual: Tensor
    #: Poses left out because a number was NaN, and poses beyond the first at the same time.
    dropped: int
    duplicates: int
    #: Stretches (start, end), in the unit of the times, of more than two knot intervals without a pose.
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
    smoothness: float = 1e-9,
    max_iterations: int = 60,
    tolerance: float = 1e-9,
    progress: bool = True,
) -> PoseFit:
    """Least-squares B-spline through timed poses: `sum |Log(X(t_i)^-1 X_i)|^2_sigma` plus a little smoothness.

    A banded linear fit of the stored numbers (exact for positions) starts Levenberg-Marquardt with exact Jacobians
    from the spline's reverse sweep and a banded Cholesky factorisation. Cost is linear in poses and control points.

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
    checks.quaternions("poses", filled, SE3.arithmetic.unit_blocks)
    order_of_time = torch.argsort(t, stable=True)
    rows = order_of_time[usable[order_of_time]]
    times, measured = t.detach()[rows].cpu(), poses.detach()[rows].to("cpu", torch.float64)
    distinct = torch.unique(times).numel()
    if distinct < 2:
        raise ValueError(f"t: expected at least two distinct times with usable poses, got {distinct}")

    knots = _Knots(times, dt, order)
    # Whatever mode the caller is in, gradients are needed here.
    with torch.inference_mode(False), torch.enable_grad(), _bar(progress, max_iterations) as advance:
        times, measured = times.clone(), consistent_signs(measured.clone(), group)
        problem = _Problem(group, knots, times, measured, (position_sigma, rotation_sigma), smoothness)
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
    notes = _notes(rows, dropped, duplicates, gaps, len(times), knots)
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


class _Problem:
    """Residuals of all poses and of smoothness, and the normal equations of a step."""

    def __init__(
        self,
        group: Group,
        knots: _Knots,
        times: Tensor,
        measured: Tensor,
        sigmas: tuple[float, float],
        smoothness: float,
    ):
        self.group, self.knots, self.measured = group, knots, measured
        self.weight = torch.tensor([1 / sigmas[0]] * 3 + [1 / sigmas[1]] * 3, dtype=torch.float64)
        first, u = knots.place(times)
        self.first, self.u = torch.from_numpy(first), torch.from_numpy(u)
        per_interval = len(times) / knots.segments
        self.smooth_weight = smoothness * per_interval
        self.tiny = 1e-14 * per_interval  # keeps a single knot interval with few poses definite
        self.difference = min(2, knots.count - 1)

    def start(self) -> Tensor:
        """The linear fit of the stored numbers, quaternions normalised after it."""
        order, count = self.knots.order, self.knots.count
        first, powers = self.first.numpy(), self.u.numpy()[:, None] ** np.arange(order)
        basis: FloatArray = powers @ np.array(blending_matrix(order), dtype=np.float64).T
        width = max(order, self.difference + 1)
        band = self.smooth_weight * difference_band(count, self.difference, width)
        band[:order] += gram_band(basis, first, count)
        band[0] += self.tiny
        right = transpose_apply(basis, first, count, self.measured.numpy())
        solution = torch.from_numpy(BandedCholesky(band).solve(right))
        # Where rotation runs through more than half a turn between knots the numbers can cancel to nothing.
        vanished = solution[:, 3:].norm(dim=-1) < 1e-3
        solution[vanished, 3:] = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
        return self.group.normalize(solution)

    def _parts(self, size: int) -> Iterator[tuple[Tensor, Callable[[Tensor], Tensor], int]]:
        """The rows of the problem in parts of at most `size`: first control point, residuals of windows, their width.

        A window is the control points that a row depends on; residuals are weighted, (rows, 6).
        """
        order = self.knots.order
        for rows in torch.arange(len(self.u)).split(size):
            yield self.first[rows], partial(self._misses, self.u[rows], self.measured[rows]), order
        bends = torch.arange(self.knots.count - self.difference)
        for rows in bends.split(size):
            yield rows, self._bends, self.difference + 1

    def _misses(self, u: Tensor, measured: Tensor, windows: Tensor) -> Tensor:
        fitted = bspline(
            windows,
            u[:, None],
            group=self.group,
            order=self.knots.order,
            dt=1.0,
            derivatives=0,
            validate=False,
        ).value[:, 0]
        miss = self.group.log(self.group.between(fitted, measured, validate=False), validate=False)
        return miss * self.weight

    def _bends(self, windows: Tensor) -> Tensor:
        steps = self.group.log(
            self.group.between(windows[:, :-1], windows[:, 1:], validate=False), validate=False
        )
        bends = steps[:, 1] - steps[:, 0] if self.difference == 2 else steps[:, 0]
        return bends * self.weight * math.sqrt(self.smooth_weight)

    def cost(self, control_points: Tensor) -> float:
        """Half the weighted sum of squares."""
        total = 0.0
        with torch.no_grad():
            for first, residual, width in self._parts(_ROWS):
                total += residual(_windows(control_points, first, width)).square().sum().item()
        return 0.5 * total

    def normal_equations(self, control_points: Tensor) -> tuple[FloatArray, FloatArray]:
        """Lower band of J^T J, and J^T r, for body tangents of the control points."""
        equations = NormalEquations(self.knots.count, max(self.knots.order, self.difference + 1), 6)
        algebra = self.group.arithmetic
        for first, residual, width in self._parts(_ROWS):
            leaf = _windows(control_points, first, width).requires_grad_()
            r = residual(leaf)
            rows = []
            for column in r.unbind(-1):
                (gradient,) = torch.autograd.grad(column.sum(), leaf, retain_graph=True)
                rows.append(join(algebra.pull(split(leaf.detach()), split(gradient)), gradient))
            equations.add(torch.stack(rows, dim=1), r.detach(), first)
        band, right = equations.band(), equations.right_side()
        band[0] += self.tiny * self.weight.square().repeat(self.knots.count).numpy()
        return band, right

    def solve(
        self, max_iterations: int, tolerance: float, advance: Callable[[float], None]
    ) -> tuple[Tensor, list[float], str]:
        """Levenberg-Marquardt with Marquardt's scaling, in body tangents of the control points."""
        points = self.start()
        history = [self.cost(points)]
        damping = 1e-6
        for _ in range(max_iterations):
            band, right = self.normal_equations(points)
            moved = None
            while moved is None:
                moved = self._step(points, band, right, damping, history[-1])
                damping = max(0.1 * damping, 1e-15) if moved is not None else max(10.0 * damping, 1e-12)
                if damping > 1e12:
                    return points, history, "no step lowers the cost any more"
            points, cost = moved
            history.append(cost)
            advance(cost)
            if history[-2] - cost <= tolerance * history[-2]:
                return points, history, f"the cost fell by less than a share of {tolerance:g}"
        return points, history, f"{max_iterations} iterations"

    def _step(
        self, points: Tensor, band: FloatArray, right: FloatArray, damping: float, cost: float
    ) -> tuple[Tensor, float] | None:
        """The moved control points and their cost, None if it is not below `cost`."""
        damped = band.copy()
        damped[0] *= 1.0 + damping
        try:
            step = -BandedCholesky(damped).solve(right)
        except np.linalg.LinAlgError:  # rounding made the matrix indefinite
            return None
        tangents = torch.from_numpy(step.reshape(-1, 6))
        moved = self.group.retract(points, tangents, side="right", validate=False)
        reached = self.cost(moved)
        return (moved, reached) if reached < cost else None


def _windows(control_points: Tensor, first: Tensor, width: int) -> Tensor:
    """(rows, width, P): the control points from `first` on."""
    return control_points.detach()[first[:, None] + torch.arange(width)]


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
    rows: Tensor,
    dropped: int,
    duplicates: int,
    gaps: list[tuple[float, float]],
    used: int,
    knots: _Knots,
) -> list[str]:
    notes = []
    if bool((rows.diff() < 0).any()):
        notes.append("times were not in order; poses were sorted")
    if dropped:
        notes.append(f"{dropped} poses with NaN were left out")
    if duplicates:
        notes.append(f"{duplicates} poses share their time with another; all were used")
    if gaps:
        longest = max(b - a for a, b in gaps) * (1e-9 if knots.nanoseconds else 1.0)
        notes.append(
            f"{len(gaps)} stretches of more than two knot intervals without poses, up to {longest:.3g} s, "
            "were bridged by smoothness"
        )
    if used < knots.count:
        notes.append(
            f"{used} poses for {knots.count} control points: smoothness decides the rest; use a larger dt"
        )
    return notes
