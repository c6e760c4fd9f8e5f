"""Least squares the obvious way: one function of all unknowns, its Jacobian by forward mode, dense matrices."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchspline import BSpline
from torchspline.fit import Problem, Residual, Variable
from torchspline.fit.solving.kernel import kernel_of
from torchspline.fit.solving.linearizer import Linearizer
from torchspline.functional import bspline

F64 = torch.float64


class Dense(NamedTuple):
    """`J^T J`, `J^T r`, cost, and the weighted residuals and their Jacobian."""

    matrix: Tensor
    right: Tensor
    cost: float
    residuals: Tensor
    jacobian: Tensor


def of_system(linearizer: Linearizer) -> tuple[np.ndarray, np.ndarray, float]:
    """What the library assembles, as a dense matrix."""
    system = linearizer(linearizer.model.state())
    total = linearizer.model.total
    matrix = np.stack([system.multiply(e) for e in np.eye(total)], axis=-1)
    np.testing.assert_array_equal(np.diagonal(matrix), system.diagonal())
    return matrix, system.right, system.cost


class Oracle:
    """All residuals of a problem as one function of a step of all unknowns, in the columns of the problem's model."""

    def __init__(self, problem: Problem, indices: dict[str, dict[str, Tensor]] | None = None):
        self.problem, self.indices = problem, indices or {}
        self.linearizer = problem.prepare()
        self.columns = self.linearizer.model.columns
        self.total = self.linearizer.model.total

    def _tangent(self, unknown: BSpline | Variable, step: Tensor) -> Tensor | None:
        columns = self.columns.get(id(unknown))
        if columns is None:
            return None
        padded = torch.cat([step, step.new_zeros(1)])
        return padded[torch.from_numpy(columns)]

    def value(self, unknown: BSpline | Variable, step: Tensor) -> Tensor:
        """Control points, or the value of a variable, after the step."""
        tangent = self._tangent(unknown, step)
        if isinstance(unknown, BSpline):
            points = unknown.group.normalize(unknown.control_points.detach().to(F64))
            return unknown.group.retract(points, tangent, side="right", validate=False)
        value = unknown.value
        if tangent is None:
            return value if unknown.group is None else unknown.group.normalize(value)
        tangent = tangent.reshape(*value.shape[:-1], -1)
        if unknown.group is not None:
            value = unknown.group.normalize(value)
            return unknown.group.retract(value, tangent, side="right", validate=False)
        if unknown.sphere:
            # A rotation of the vector: no numbers in common with the library's way but the directions of its basis.
            across = (unknown.basis(value).reshape(*value.shape, 2) @ tangent.unsqueeze(-1)).squeeze(-1)
            angle = torch.linalg.cross(value, across) / value.square().sum(-1, keepdim=True)
            return value + torch.linalg.cross(angle, value)
        return value + tangent

    def _on_spline(self, spline: BSpline, points: Tensor, t: Tensor, derivatives: int) -> list[Tensor]:
        """At times in seconds from the start of the trajectory."""
        origin = self.problem.trajectory.domain[0]
        if spline.dt_ns is None:
            start, dt = spline.domain[0] - origin, float(spline.dt)
        else:
            start, dt = (spline.domain[0] - origin) * 1e-9, spline.dt_ns * 1e-9
        state = bspline(
            points, t, group=spline.group, order=spline.order, dt=dt, t0=start, derivatives=derivatives,
            extrapolate="clamp", validate=False,
        )  # fmt: skip
        return list(state[: derivatives + 1])

    def seconds(self, residual: Residual, step: Tensor) -> tuple[Tensor, Tensor]:
        """Stamps, and the times of the trajectory they stand for."""
        trajectory = self.problem.trajectory
        start, end = trajectory.domain
        unit = 1.0 if trajectory.dt_ns is None else 1e-9
        t = (residual.t - start).to(F64) * unit
        clock = residual.clock
        offset, skew, delay = (
            0.0 if v is None else self.value(v, step)[0] for v in (clock.offset, clock.skew, clock.delay)
        )
        mid = 0.5 * (end - start) if clock.mid is None else clock.mid - start
        late = 0.0 if clock.late is None else delay * clock.late
        return t, mid * unit + (t - mid * unit - offset - late) / (1.0 + skew)

    def residual(self, residual: Residual, step: Tensor) -> tuple[Tensor, Tensor]:
        """`(N, R)`, not weighted, and which measurements lie on the trajectory."""
        trajectory, kind = self.problem.trajectory, type(residual)
        stamps, times = self.seconds(residual, step)
        points = self.value(trajectory, step)
        states: list[Tensor] = []
        for t in times.reshape(kind.moments, -1):
            states += self._on_spline(trajectory, points, t, kind.derivatives)
        index = self.indices.get(residual.name, {})
        given = {}
        for slot, x in residual.arguments.items():
            if isinstance(x, BSpline):
                given[slot] = self._on_spline(x, self.value(x, step), stamps.reshape(kind.moments, -1)[0], 0)[
                    0
                ]
            elif isinstance(x, Variable):
                value = self.value(x, step)
                given[slot] = value[index[slot]] if slot in index else value
            else:
                given[slot] = x
        own = tuple((slot, given[slot].ndim == 2) for slot in given)
        kernel = kernel_of(kind, trajectory.group.name, own)
        result = kernel.on_tensors(
            *states, residual.measured.to(F64), *(given[slot].to(F64) for slot in kernel.order)
        )
        start, end = trajectory.domain
        length = (end - start) * (1.0 if trajectory.dt_ns is None else 1e-9)
        inside = ((times > -1e-9) & (times < length + 1e-9)).reshape(kind.moments, -1).all(0)
        return result, inside.detach()

    def weighted(self, residual: Residual, step: Tensor) -> Tensor:
        """`W r`: half its square is the cost without a robust loss."""
        r, inside = self.residual(residual, step)
        kind, x = residual.weighting
        if x is not None:
            x = x.detach().to(F64)
            if kind == "sigma":
                r = r / x
            else:  # any W with W^T W = information; here by eigenvectors, in the library by Cholesky factors
                information = x if kind == "information" else torch.linalg.inv(x)
                values, vectors = torch.linalg.eigh(information)
                r = ((values.sqrt().unsqueeze(-1) * vectors.mT) @ r.unsqueeze(-1)).squeeze(-1)
        return r * inside.to(F64).unsqueeze(-1)

    def dense(self) -> Dense:
        """Of all residuals, each weighted by rho' of its loss."""
        zero = torch.zeros(self.total, dtype=F64)
        cost, rows, jacobians = 0.0, [], []
        for residual in self.problem.residuals:
            r = self.weighted(residual, zero).detach()
            J = torch.func.jacfwd(lambda step, residual=residual: self.weighted(residual, step))(zero)
            squared = r.square().sum(-1)
            if residual.loss is not None:
                cost += 0.5 * float(residual.loss.rho(squared).sum())
                root = residual.loss.weight(squared).sqrt()
                r, J = r * root[:, None], J * root[:, None, None]
            else:
                cost += 0.5 * float(squared.sum())
            rows.append(r.reshape(-1))
            jacobians.append(J.detach().reshape(-1, self.total))
        r, J = torch.cat(rows), torch.cat(jacobians)
        return Dense(J.mT @ J, J.mT @ r, cost, r, J)


def check_assembly(problem: Problem, indices: dict | None = None, tolerance: float = 1e-10) -> Dense:
    """The library's normal equations are those of the oracle."""
    oracle = Oracle(problem, indices)
    expected = oracle.dense()
    matrix, right, cost = of_system(oracle.linearizer)
    assert abs(cost - expected.cost) <= 1e-12 * max(expected.cost, 1.0)
    scale = float(expected.matrix.abs().max())
    assert np.abs(matrix - expected.matrix.numpy()).max() <= tolerance * scale
    assert np.abs(right - expected.right.numpy()).max() <= tolerance * max(
        float(expected.right.abs().max()), 1.0
    )
    return expected
