"""The unknowns of a problem: splines and variables, their numbers, and where they stand among the columns.

Control points of all splines are sorted by time, so that what measurements tie together lies close: the normal
equations of splines are a band. Variables come after them, as its border.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchspline.fit.variables import Variable
from torchspline.splines.basis import blending_matrix
from torchspline.splines.bspline import BSpline
from torchspline.splines.local import Local, LocalSpline
from torchspline.units import NANOSECOND

Array = NDArray[Any]
Unknown = BSpline | Variable


class Spline:
    """A B-spline as the solver sees it. Times are seconds from the start of the trajectory.

    Args:
        origin: start of the trajectory's domain, in the unit of the spline's times.
    """

    def __init__(self, spline: BSpline, origin: float | int):
        self.module, self.order, self.group = spline, spline.order, spline.group.arithmetic
        self.name, self.start = spline.group.name, seconds(spline.domain[0], origin)
        self.spacing = spacing_of(spline)
        self.count = spline.control_points.shape[-2]
        self.segments = self.count - self.order + 1
        self.size = self.group.tangent_size
        self.local = LocalSpline(self.name, self.order, self.spacing, self.count)
        #: How far outside times may lie, in segments: seconds since an epoch are rounded, the origin included.
        rounding = 0.0 if isinstance(origin, int) else abs(origin) / self.spacing
        self.slack = 1e-9 + 8 * np.finfo(np.float64).eps * (rounding + self.segments)
        self._blending = np.array(blending_matrix(self.order), dtype=np.float64)

    def place(self, tau: Array, which: Array | None = None) -> tuple[Array, Array, Array]:
        """First control point, position in the segment (clamped into the domain), and which times lie outside it.

        Args:
            which: of splines laid end to end, the one that each time is of.
        """
        s = (tau - self.start) / self.spacing
        base = np.clip(np.floor(s), 0, self.segments - 1)
        u = s - base
        outside = (u < -self.slack) | (u > 1.0 + self.slack)
        return base.astype(np.int64), np.clip(u, 0.0, 1.0), outside

    def blending(self, u: Array) -> Array:
        """Weights (N, k) of the control points, for splines in R^n."""
        return (u[:, None] ** np.arange(self.order)) @ self._blending.T

    def times(self) -> Array:
        """The middle of what each control point influences."""
        return self.start + (np.arange(self.count) - 0.5 * (self.order - 2)) * self.spacing


def spacing_of(spline: BSpline) -> float:
    """Knot spacing in seconds."""
    if spline.dt_ns is not None:
        return spline.dt_ns * NANOSECOND
    assert spline.dt is not None
    return float(spline.dt.detach())


def seconds(t: float | int, origin: float | int) -> float:
    """A time, in the unit of the origin, as seconds from it."""
    return (t - origin) * NANOSECOND if isinstance(origin, int) else float(t - origin)


def with_points(spline: BSpline, points: torch.Tensor) -> BSpline:
    """Another spline of the same group, order and clock, whose control points are `points` `(..., M, P)`, no
    Parameter."""
    options: dict[str, Any] = {"dt_ns": spline.dt_ns, "t0_ns": spline.t0_ns}
    if spline.dt is not None:
        assert spline.t0 is not None
        options = {"dt": float(spline.dt.detach()), "t0": float(spline.t0.detach())}
    return BSpline(points, group=spline.group, order=spline.order, learnable=False, **options)


@dataclass
class State:
    """Numbers of all unknowns."""

    #: Control points (M, P) of each spline, by the `id` of its module.
    points: dict[int, Array]
    #: Of each variable, by its `id`.
    values: dict[int, torch.Tensor]
    #: Of the trajectory, computed once from its points: logarithms between neighbours, the local coordinates of rows.
    local: Local | None = None
    #: And how each of them moves with its two control points, by the chain rule: `LocalSpline.pair_jacobians`.
    chain: Array | None = None


class Model:
    """Splines, the trajectory first, and variables of a problem, and which columns are theirs.

    `columns` has them by the `id` of the unknown, one row a control point or element, -1 for what stays. The first
    `band` of the `total` columns are those of splines.

    Args:
        frozen: for splines a mask of control points that stay, for variables whether they stay.
    """

    def __init__(self, splines: list[Spline], variables: list[Variable], frozen: dict[int, Array | bool]):
        self.splines, self.variables = splines, variables
        self.trajectory = splines[0]
        self.columns: dict[int, Array] = {}
        movable, times, owner = [], [], []
        for i, spline in enumerate(splines):
            free = ~np.asarray(frozen.get(id(spline.module), np.zeros(spline.count, bool)))
            index = np.flatnonzero(free)
            movable.append(index)
            times.append(spline.times()[index])
            owner.append(np.full(len(index), i))
            self.columns[id(spline.module)] = np.full((spline.count, spline.size), -1, np.int64)
        all_times, all_owners, index = map(np.concatenate, (times, owner, movable))
        order = np.argsort(all_times, kind="stable")
        sizes = np.array([spline.size for spline in splines])[all_owners[order]]
        first = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        for i, spline in enumerate(splines):
            mine = all_owners[order] == i
            columns = first[:-1][mine, None] + np.arange(spline.size)
            self.columns[id(spline.module)][index[order][mine]] = columns
        #: Columns of splines, and of all unknowns.
        self.band = int(first[-1])
        self.total = self.band
        for variable in variables:
            count = variable.value.shape[:-1].numel() * variable.dimension
            if frozen.get(id(variable)):
                continue
            columns = self.total + np.arange(count, dtype=np.int64)
            self.columns[id(variable)] = columns.reshape(-1, variable.dimension)
            self.total += count

    def columns_of(self, unknown: Unknown) -> Array:
        """Of its control points or its rows (C, D); -1 for those that stay."""
        if id(unknown) in self.columns:
            return self.columns[id(unknown)]
        assert isinstance(unknown, Variable)
        return np.full((unknown.value.shape[:-1].numel(), unknown.dimension), -1, np.int64)

    def state(self) -> State:
        """The numbers as they stand in the modules."""
        points = {
            id(s.module): np.ascontiguousarray(
                s.module.group.normalize(s.module.control_points.detach().to("cpu", torch.float64)).numpy()
            )
            for s in self.splines
        }
        values = {id(v): v.points(v.value) for v in self.variables}
        return self.prepared(points, values)

    def moved(self, state: State, step: Array) -> State:
        """All unknowns moved by a step `(total,)` in their tangent spaces."""
        padded = np.append(step, 0.0)  # column -1: unknowns that stay
        points, values = {}, {}
        for spline in self.splines:
            key = id(spline.module)
            points[key] = spline.local.retract(state.points[key], padded[self.columns[key]])
        for variable in self.variables:
            key = id(variable)
            value = state.values[key]
            if key in self.columns:
                value = variable.retract(value, torch.from_numpy(padded[self.columns[key]]))
            values[key] = value
        return self.prepared(points, values)

    def prepared(self, points: dict[int, Array], values: dict[int, torch.Tensor]) -> State:
        """With what follows from the trajectory's points."""
        local = self.trajectory.local.at(points[id(self.trajectory.module)])
        return State(points, values, local, self.trajectory.local.pair_jacobians(local))

    def store(self, state: State) -> None:
        """Write the numbers of what may move back; the rest keeps its own, quaternions of any length included."""
        for spline in self.splines:
            key = id(spline.module)
            index = torch.from_numpy(np.flatnonzero(self.columns[key][:, 0] >= 0))
            with torch.no_grad():
                target = spline.module.control_points
                target[index] = torch.from_numpy(state.points[key]).to(target)[index]
        for variable in self.variables:
            if id(variable) in self.columns:
                variable.value = state.values[id(variable)].clone()
