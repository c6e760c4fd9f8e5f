"""Control points of a B-spline over any knots, on any group, from the curve it shall follow."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline.fit.approximation.compare import union, within
from torchspline.fit.approximation.source import Source
from torchspline.fit.poses.banded import gram_band, transpose_apply
from torchspline.groups.components import split
from torchspline.groups.group import Group
from torchspline.splines.keyframes import consistent_signs
from torchspline.splines.nonuniform import basis, local_knots, nonuniform_bspline
from torchspline.splines.segments import locate_between

#: Steps at most; each takes off most of the miss that knots allow to take off, more of it the nearer knots are.
_STEPS = 60
#: So many steps in a row that leave more than this share of the least miss so far end it: that is what knots leave.
_STALLED, _IN_A_ROW = 0.97, 8
#: Steps that are remembered to speed up the next ones.
_REMEMBERED = 12


def greville(knots: Tensor, order: int, start: float | int, end: float | int) -> Tensor:
    """Where each control point acts: the mean of the order - 1 knots it belongs to, within the domain."""
    windows = knots[1:-1].unfold(0, order - 1, 1)
    offset = (windows - knots[0]).to(torch.float64).mean(-1)
    if knots.dtype == torch.int64:
        offset = offset.round().to(torch.int64)
    return (knots[0] + offset).clamp(start, end)


def control_points(source: Source, knots: Tensor, order: int) -> Tensor:
    """Control points `(*batch, M, P)` of the B-spline over `knots` (M + order,) that follows the source.

    On R^n the least-squares spline, by one banded solution. On a group the misses `Log(X(t) S(t)^-1)`, tangents of the
    world's side, are met by the same linear fit, and its coefficients move the control points, `Exp(c_j) X_j`, until
    only what the basis cannot follow is left: as the basis functions sum to one, a miss that is the same everywhere
    is met at once, whatever the group, and the rest as fast as neighbours commute. Cost is linear in knots.

    Factors of a direct product are met each by itself, so that one that the basis cannot follow does not hide what is
    left of another: the rotation of a B-spline in SE3 is one in SO3, its position no B-spline.
    """
    group, count = source.group, len(knots) - order
    domain = knots[order - 1 : count + 1]
    start, end = source.start, min(source.end, domain[-1].item())
    nodes, shares = np.polynomial.legendre.leggauss(order + 1)
    breaks = union(source.pieces.breaks, domain.unique_consecutive(), start, end)
    t = within(breaks, torch.from_numpy((nodes + 1.0) / 2.0))
    place = locate_between(t, domain, "error", False)
    local = local_knots(knots, order)[place.segment]
    weights = np.stack([_numbers(w, t) for w in basis(split(local), place.u)], axis=-1)
    lengths = breaks.diff().to(torch.float64)
    density = torch.outer(lengths / lengths.sum(), torch.from_numpy(shares / 2.0)).flatten().numpy()
    first = place.segment.numpy()
    solve = _Solver(weights, first, density, count)

    goal = source.values(t)
    points = source.values(greville(knots, order, start, end))
    if group.arithmetic.unit_blocks:
        points = consistent_signs(points, group)
    factors = getattr(group.arithmetic, "factors", (group.arithmetic,))
    sizes = [factor.point_size for factor in factors]
    met = [
        _followed(Group(factor.name), x, y, t, knots, order, solve)
        for factor, x, y in zip(factors, goal.split(sizes, -1), points.split(sizes, -1), strict=True)
    ]
    return torch.cat(met, dim=-1)


def _followed(
    group: Group, goal: Tensor, points: Tensor, t: Tensor, knots: Tensor, order: int, solve: "_Solver"
) -> Tensor:
    """Control points, from a first guess, of the B-spline that follows `goal` at times `t`."""
    count, density = points.shape[-2], solve.density[:, 0]
    base, mixing = points, _Mixing()
    moved: NDArray[np.float64] | None = None
    best, least, stalled = points, np.inf, 0
    # On R^n the first step is the solution, others refine its rounding.
    for _ in range(_STEPS if group.arithmetic.unit_blocks else _IN_A_ROW):
        with torch.no_grad():
            value = nonuniform_bspline(
                points, t, group=group, knots=knots, order=order, derivatives=0, validate=False
            ).value
            back = group.inverse(value, validate=False)
            miss = group.log(group.compose(goal, back, validate=False), validate=False)
        rows = miss.movedim(-2, 0).reshape(len(t), -1).numpy()
        size = float(np.sqrt(density @ np.square(rows).sum(1)))
        stalled = 0 if size < _STALLED * least else stalled + 1
        if size < least:
            best, least = points, size
        if stalled == _IN_A_ROW or size == 0.0 or not np.isfinite(size):
            break
        step = torch.from_numpy(solve(rows)).reshape(count, *miss.shape[:-2], -1).movedim(0, -2)
        ahead = group.retract(points, step, validate=False)
        # As tangents at the first guess, so that steps can be combined.
        there = group.log(
            group.compose(ahead, group.inverse(base, validate=False), validate=False), validate=False
        ).numpy()
        moved = np.zeros_like(there) if moved is None else moved
        moved = mixing(moved.ravel(), (there - moved).ravel()).reshape(there.shape)
        points = group.retract(base, torch.from_numpy(moved), validate=False)
    return best


class _Mixing:
    """Anderson acceleration of `x <- x + f(x)`: next comes the fixed point of the affine map through the last ones."""

    def __init__(self) -> None:
        self.places: list[NDArray[np.float64]] = []
        self.steps: list[NDArray[np.float64]] = []

    def __call__(self, place: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        self.places = [*self.places, place][-_REMEMBERED:]
        self.steps = [*self.steps, step][-_REMEMBERED:]
        if len(self.steps) == 1:
            return place + step
        dx = np.diff(np.stack(self.places), axis=0)
        df = np.diff(np.stack(self.steps), axis=0)
        shares = np.linalg.lstsq(df.T, step, rcond=1e-10)[0]
        return place + step - shares @ (dx + df)


def _numbers(x: Any, like: Tensor) -> NDArray[np.float64]:
    return (x if isinstance(x, Tensor) else torch.full(like.shape, float(x), dtype=torch.float64)).numpy()


class _Solver:
    """Weighted least squares with the basis functions, factored once."""

    def __init__(
        self,
        weights: NDArray[np.float64],
        first: NDArray[np.int64],
        density: NDArray[np.float64],
        count: int,
    ):
        from scipy.linalg import cholesky_banded  # as long to import as the rest of the library

        self.weights, self.first, self.count = weights, first, count
        self.density = density[:, None]
        band = gram_band(weights * np.sqrt(self.density), first, count)
        # The outermost functions of a domain that is not clamped hardly reach into it.
        band[0] += 1e-15 * band[0].max()
        self.factor = cholesky_banded(band, lower=True, check_finite=False)

    def __call__(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        from scipy.linalg import cho_solve_banded

        right = transpose_apply(self.weights, self.first, self.count, self.density * rows)
        return cho_solve_banded((self.factor, True), right, check_finite=False)
