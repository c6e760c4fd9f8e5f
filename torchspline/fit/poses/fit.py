"""A trajectory through timed poses, by least squares on the control points."""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchspline import checks
from torchspline.fit.poses.knots import Knots, Spacing, choose_spacing
from torchspline.fit.problem import Problem
from torchspline.fit.residuals.pose import Pose
from torchspline.fit.solving.bends import Bends
from torchspline.fit.solving.progress import progress_bar
from torchspline.fit.solving.solver import Options, minimise
from torchspline.groups.group import R3, SE3, SO3, Group, product
from torchspline.splines.bspline import BSpline, SplitBSpline
from torchspline.splines.keyframes import consistent_signs
from torchspline.units import NANOSECOND

Representation = Literal["split", "joint"]


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
    #: Half the weighted sum of squares after the linear start and after each iteration; where dt="auto" smooths, of
    #: what is left to the smoothed poses.
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
    dt: float | Literal["auto"],
    order: int = 6,
    representation: Representation = "split",
    position_sigma: float = 0.01,
    rotation_sigma: float = 0.01,
    smoothness: float = 1e-9,
    accuracy: tuple[float, float] | None = None,
    max_iterations: int = 60,
    tolerance: float = 1e-9,
    progress: bool = True,
) -> PoseFit:
    """Least-squares B-spline through timed poses: position and rotation misses, plus a little smoothness.

    Half the sum of squares of `p(t_i) - p_i` and `Log(R_i^-1 R(t_i))`, weighted. A banded linear fit of the stored
    numbers (exact for positions) starts Levenberg-Marquardt with analytic Jacobians and a banded Cholesky
    factorisation. Cost is linear in poses and control points.

    Args:
        t: (N,) seconds (float64) or int64 nanoseconds; in any order, duplicates allowed.
        poses: (N, 7) [x, y, z, qw, qx, qy, qz], body to world; rows with NaN are left out.
        dt: knot spacing, seconds. What it should be depends on the data: a wrong spacing costs more than anything.
            "auto" finds one from the data, see `knots.choose_spacing`, for positions and for rotations, and says why in
            the notes. Knots are then half as far apart, and go through smoothing splines of that bandwidth, which is
            better than knots that far apart; with few poses, or an `accuracy`, these it is.
        order: of the spline, 2 or more; IMU synthesis wants at least 4, better 6.
        representation: "split" (R3 x SO3) or "joint" (SE3).
        position_sigma, rotation_sigma: what a residual of one weighs, m and rad; matters to "joint" only.
        smoothness: weight of squared second differences of neighbouring control points, in poses a knot interval.
            Bridges stretches without data; small enough not to be felt where there are poses.
        accuracy: with dt="auto", how well poses have to be met: root mean square per axis of position [m] and rotation
            [rad]; the widest spacings that do are taken. None: what suits velocities and accelerations best.
        max_iterations, tolerance: stop after so many iterations, or when the cost falls by less than this share.
        progress: show a progress bar on a terminal.
    Returns:
        PoseFit, on the CPU in float64.
    Raises:
        TypeError, ValueError: a wrong type, shape or value; fewer than two distinct usable times.
    Examples:
        >>> import torch
        >>> t = torch.linspace(0, 1, 50, dtype=torch.float64)
        >>> poses = torch.stack([t, t.sin(), 0 * t, 1 + 0 * t, 0 * t, 0 * t, 0 * t], dim=-1)
        >>> fit = fit_poses(t, poses, dt=0.2, progress=False)
        >>> position, rotation = fit.rms()
        >>> position < 1e-6, fit.trajectory.domain[0]
        (True, 0.0)
    """
    group = _group(representation)
    _check(t, poses)
    checks.whole("order", order, least=2)
    checks.whole("max_iterations", max_iterations, least=0)
    if isinstance(dt, str):
        checks.choice("dt", dt, ("auto",))
    else:
        checks.positive("dt", dt)
    _check_accuracy(accuracy, dt)
    for name, x in (
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

    spacing = None
    if isinstance(dt, str):
        signed = consistent_signs(measured, group)
        spacing = choose_spacing(times, signed, order, smoothness, accuracy)
        dt = spacing.knots
    width = float(dt)
    knots = Knots(times, width, order)
    weight = torch.tensor([1 / position_sigma] * 3 + [1 / rotation_sigma] * 3, dtype=torch.float64)
    with (
        torch.inference_mode(False),
        torch.no_grad(),
        progress_bar(progress, max_iterations, "fitting poses") as show,
    ):
        times, measured = times.clone(), consistent_signs(measured.clone(), group)
        if spacing is not None and spacing.smooth:
            at, followed = _smoothed(knots, times, measured, spacing)
        else:
            at, followed = times, measured
        per_interval = len(at) / knots.segments
        control_points = _start(knots, at, followed, group, smoothness * per_interval)
        trajectory = BSpline(control_points, group=group, order=order, **knots.options())
        if group != SE3:
            trajectory = SplitBSpline(control_points, order=order, **knots.options())
        problem = Problem(trajectory)
        problem.add(Pose(at, followed, sigma=1.0 / weight))
        linearizer = problem.prepare()
        linearizer.terms.append(
            Bends(linearizer.model, weight.numpy() * math.sqrt(smoothness * per_interval))
        )
        options = Options(max_iterations, tolerance, 0.0, damping=1e-6)
        state, _, trace = minimise(linearizer.model, linearizer.model.state(), linearizer, options, show)
        linearizer.model.store(state)
        if accuracy is not None and spacing is not None and representation == "split":
            wide = width * int(spacing.position / width + 1e-6)  # a whole multiple is met exactly
            trajectory.control_points[:, :3] = _smoother(knots, times, measured[:, :3], wide, smoothness)
    fitted = trajectory(times).detach()
    residual = torch.full((2, t.shape[0], 3), torch.nan, dtype=torch.float64)
    residual[0, rows.cpu()] = measured[:, :3] - fitted[:, :3]
    residual[1, rows.cpu()] = SO3.log(SO3.between(fitted[:, 3:], measured[:, 3:]))
    gaps = knots.gaps(times)
    dropped, duplicates = int((~usable).sum()), len(times) - distinct
    notes = _notes(rows, dropped, duplicates, gaps, len(times), knots)
    if spacing is not None:
        smoothed = (
            ", in smoothing splines that pass what splines of such knots pass" if spacing.smooth else ""
        )
        notes.insert(0, f"knots {width * 1e3:.4g} ms apart: {spacing.reason}{smoothed}")
    return PoseFit(
        trajectory, residual[0], residual[1], dropped, duplicates, gaps, trace.cost, trace.reason, notes
    )


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


def _start(knots: Knots, times: Tensor, measured: Tensor, group: Group, smoothness: float) -> Tensor:
    """Control points from the linear fit of the stored numbers, quaternions normalised after it."""
    solution = torch.from_numpy(knots.linear_fit(times, measured.numpy(), smoothness))
    # Where rotation runs through more than half a turn between knots the numbers can cancel to nothing.
    vanished = solution[:, 3:].norm(dim=-1) < 1e-3
    solution[vanished, 3:] = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    return group.normalize(solution)


def _smoothed(knots: Knots, times: Tensor, measured: Tensor, spacing: Spacing) -> tuple[Tensor, Tensor]:
    """Poses on a smooth curve through those measured, at times that are dense among the knots; none within gaps."""
    grid = knots.grid(3)
    # Beside gaps at the times measured: poses may be there alone.
    grid = torch.cat([grid[knots.among(grid, times)], times[knots.beside_gaps(times)]]).unique()
    parts = []
    for columns, wide in ((slice(0, 3), spacing.position), (slice(3, 7), spacing.rotation)):
        own = Knots(times, max(wide / 2, knots.seconds), knots.order)
        numbers = measured[:, columns].numpy()
        parts.append(own.evaluate(own.smooth_fit(times, numbers, wide, spacing.step), grid))
    return grid, SE3.normalize(torch.from_numpy(np.concatenate(parts, axis=1)))


def _smoother(knots: Knots, times: Tensor, positions: Tensor, spacing: float, smoothness: float) -> Tensor:
    """Control points of the spline through the positions with knots `spacing` apart, which is not below that of these
    knots: on these it is nearly a spline, too, or exactly if every so many of them are its own."""
    wide = Knots(times, spacing, knots.order)
    points = wide.linear_fit(times, positions.numpy(), smoothness * len(times) / wide.segments)
    within = torch.arange(knots.order + 1, dtype=torch.float64) / knots.order
    s = (torch.arange(knots.segments, dtype=torch.float64)[:, None] + within).reshape(-1)
    return torch.from_numpy(knots.linear_fit_at(s, wide.evaluate_at(points, s * (knots.dt / wide.dt))))


def _check_accuracy(accuracy: tuple[float, float] | None, dt: float | str) -> None:
    if accuracy is None:
        return
    if dt != "auto":
        raise ValueError(f'accuracy: goes with dt="auto", got dt={dt}')
    if not isinstance(accuracy, tuple) or len(accuracy) != 2:
        raise ValueError(
            f"accuracy: expected two numbers, for positions [m] and rotations [rad], got {accuracy!r}"
        )
    for x in accuracy:
        checks.positive("accuracy", x)


def _notes(
    rows: Tensor,
    dropped: int,
    duplicates: int,
    gaps: list[tuple[float, float]],
    used: int,
    knots: Knots,
) -> list[str]:
    notes = []
    if bool((rows.diff() < 0).any()):
        notes.append("times were not in order; poses were sorted")
    if dropped:
        notes.append(f"{dropped} poses with NaN were left out")
    if duplicates:
        notes.append(f"{duplicates} poses share their time with another; all were used")
    if gaps:
        longest = max(b - a for a, b in gaps) * (NANOSECOND if knots.nanoseconds else 1.0)
        notes.append(
            f"{len(gaps)} stretches of more than two knot intervals without poses, up to {longest:.3g} s, "
            "were bridged by smoothness"
        )
    if used < knots.count:
        notes.append(
            f"{used} poses for {knots.count} control points: smoothness decides the rest; use a larger dt"
        )
    return notes
