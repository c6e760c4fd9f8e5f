"""Many small least-squares problems of one kind at once, such as windows of a second: every step one call for all.

Trajectories are laid end to end in time. Their normal equations are one band of independent blocks; the variables of
each are its own border, so that the borders of all fit into as many columns as one has.
"""

import copy
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline import checks
from torchspline.fit.problem import Problem
from torchspline.fit.residual import Residual
from torchspline.fit.solving.model import Model, Spline, State, with_points
from torchspline.fit.solving.priors import Prior, steps_of
from torchspline.fit.solving.solver import LEAST_DIAGONAL, MOST_DAMPING, Options
from torchspline.fit.solving.system import Rows
from torchspline.fit.solving.terms import Term
from torchspline.fit.variables import Variable
from torchspline.kernels.assemble import add_to_band
from torchspline.splines.bspline import BSpline

Array = NDArray[Any]
#: What a system has of each trajectory.
_BLOCKS = ("band", "border", "corner", "cost", "inner", "outer")


class BatchProblem:
    """As `Problem`, for each trajectory of a batch: they share nothing, and each stops when it is done.

    Args:
        trajectories: a `BSpline` with control points `(B, M, P)`, on the CPU. Solving moves them in place.
    Raises:
        TypeError, ValueError: no such spline.
    """

    def __init__(self, trajectories: BSpline):
        checks.instance("trajectories", trajectories, BSpline, "a BSpline")
        points = trajectories.control_points
        if points.ndim != 3 or points.shape[0] == 0:
            raise ValueError(
                f"trajectories: expected control points of shape (B, M, P), got {tuple(points.shape)}; for a single "
                "one use Problem"
            )
        if points.device.type != "cpu":
            raise ValueError(
                f"trajectories: expected them on the CPU, got {points.device}; move them with .to('cpu')"
            )
        self.trajectories = trajectories
        self._residuals: list[tuple[Residual, Array]] = []
        # One trajectory stands for all where arguments are checked.
        self._first = Problem(with_points(trajectories, points.detach()[0]))

    def add(self, residual: Residual, trajectory: Tensor) -> Residual:
        """Add measurements; returns the residual.

        Args:
            residual: its unknowns are variables with a value `(B, n)`, a row for each trajectory. Known arguments and
                the domain of the times are those of all.
            trajectory: which one each measurement is of, (N,) int64.
        Raises:
            TypeError, ValueError: it does not fit the trajectories, or has an unknown clock or splines as arguments.
        """
        checks.instance("residual", residual, Residual, "a residual such as torchspline.fit.Gyroscope")
        B = self.trajectories.control_points.shape[0]
        which = _which("trajectory", trajectory, len(residual), B)
        index = {}
        for slot, x in residual.arguments.items():
            if isinstance(x, BSpline):
                raise ValueError(f"{slot}: expected a Variable or a tensor in a batch, got a BSpline")
            if isinstance(x, Variable):
                if x.value.ndim != 2 or len(x.value) != B:
                    raise ValueError(
                        f"{slot}: expected a Variable with a row for each of {B} trajectories, got {x!r}"
                    )
                index[slot] = trajectory
        if residual.clock.unknowns:
            raise ValueError(
                f"clock: expected a known one in a batch, got {residual.name} with unknowns of time"
            )
        self._first.add(residual, **index)
        self._residuals.append((residual, which))
        return residual

    def add_prior(
        self,
        variable: Variable,
        *,
        sigma: Tensor | float | None = None,
        covariance: Tensor | None = None,
        information: Tensor | None = None,
    ) -> None:
        """As `Problem.add_prior`, for each trajectory's row of a variable."""
        checks.instance("variable", variable, Variable, "a torchspline.fit.Variable")
        B = self.trajectories.control_points.shape[0]
        if variable.value.ndim != 2 or len(variable.value) != B:
            raise ValueError(f"variable: expected a row for each of {B} trajectories, got {variable!r}")
        self._first.add_prior(variable, sigma=sigma, covariance=covariance, information=information)

    @property
    def variables(self) -> dict[str, Variable]:
        """Unknowns besides the trajectories, by name."""
        return self._first.variables

    def solve(
        self,
        *,
        max_iterations: int = 50,
        cost_tolerance: float = 1e-9,
        gradient_tolerance: float = 1e-8,
        damping: float = 1e-5,
    ) -> "BatchResult":
        """Move the unknowns of each trajectory to where its own sum of squares is least, by Levenberg-Marquardt.

        Args:
            max_iterations, cost_tolerance, gradient_tolerance, damping: as for `Problem.solve`.
        Returns:
            BatchResult. Control points and the `value` of variables are replaced in place; those of a trajectory that
            fails stay at the best that was found.
        Raises:
            ValueError: nothing to solve, or a wrong option.
        """
        options = Options.checked(max_iterations, cost_tolerance, gradient_tolerance, damping)
        if not self._residuals:
            raise ValueError("solve: the problem has no residuals; add some with problem.add(...)")
        # Numbers of a trajectory may overflow; it then takes no further part.
        with torch.no_grad(), np.errstate(over="ignore", invalid="ignore"):
            linearizer = _Linearizer(self)
            state, result = _minimise(linearizer, options)
            linearizer.store(state)
        return result


@dataclass(frozen=True)
class BatchResult:
    """Of `BatchProblem.solve`, for each of B trajectories."""

    #: Half the (robust) weighted sum of squares at the start and at the end, (B,).
    initial_cost: Tensor
    cost: Tensor
    #: Whether it stopped because it converged, (B,) bool; `reason` says why it stopped.
    converged: Tensor
    #: Steps that were tried, (B,).
    iterations: Tensor
    reason: list[str]
    _covariances: dict[int, Tensor]

    def covariance(self, variable: Variable) -> Tensor:
        """Of each trajectory's step of a variable, `(B, dimension, dimension)`; NaN where the data leave it open.

        Raises:
            ValueError: the variable is not among the unknowns.
        """
        checks.instance("variable", variable, Variable, "a torchspline.fit.Variable")
        if id(variable) not in self._covariances:
            raise ValueError(f"variable: {variable.name} is not among the unknowns that were solved for")
        return self._covariances[id(variable)]


class _EndToEnd(Spline):
    """All trajectories of a batch as one spline: trajectory b begins b M knots after the first."""

    def __init__(self, trajectories: BSpline):
        super().__init__(trajectories, trajectories.domain[0])
        self.points, self.batch = self.count, trajectories.control_points.shape[0]
        self.count *= self.batch  # `local` keeps the number of one: no logarithms from one to the next

    def place(self, tau: Array) -> tuple[Array, Array, Array]:
        stride = self.points * self.spacing
        # Domains end at least a knot before the next one begins, half of which is for rounding.
        b = np.floor((tau + 0.5 * self.spacing) / stride)
        base, u, outside = super().place(tau - b * stride)
        return base + b.astype(np.int64) * self.points, u, outside


class _System:
    """Normal equations of B independent problems with n columns of splines and m of variables each."""

    def __init__(self, model: Model, columns: Array, B: int, width: int):
        from scipy.linalg import lapack  # as long to import as the rest of the library

        self._lapack = lapack
        self.model, self.B, self.n, self.m = model, B, model.band // B, columns.shape[1]
        self.band, self.border = np.zeros((model.band, width)), np.zeros((model.band, self.m))
        self.corner, self.cost = np.zeros((B, self.m, self.m)), np.zeros(B)
        self.inner, self.outer = np.zeros(model.band), np.zeros((B, self.m))
        #: From columns of the model to those of one trajectory's border.
        self.own = np.zeros(model.total - model.band, np.int64)
        self.own[columns.reshape(-1) - model.band] = np.tile(np.arange(self.m), B)

    def add(self, rows: Rows, chain: Array, which: Array) -> None:
        n, columns = self.model.band, rows.columns
        variables = np.flatnonzero((columns >= n).any(axis=0))
        shared = columns.copy()
        shared[:, variables] = n + self.own[columns[:, variables] - n]
        # Sums over all trajectories, of which the part of the splines and the border keep them apart.
        right, corner = np.zeros(n + self.m), np.zeros((self.m, self.m))
        outside = add_to_band(
            self.model.trajectory.local.fused, *rows._replace(columns=shared).arguments(chain),
            self.band, self.border, corner, right,
        )  # fmt: skip
        assert not outside
        self.inner += right[:n]
        if len(variables):
            own = shared[0, variables] - n
            J = np.ascontiguousarray(rows.rows[..., variables])
            products = np.einsum("nra,nrb->nab", J, np.concatenate([J, rows.rows[..., -1:]], axis=-1))
            sums = np.zeros((self.B, *products.shape[1:]))
            begin = np.flatnonzero(np.diff(which, prepend=-1))
            sums[which[begin]] = np.add.reduceat(products, begin)
            self.corner[:, own[:, None], own] += sums[..., :-1]
            self.outer[:, own] += sums[..., -1]

    def isolate(self) -> None:
        """Empty the equations of trajectories whose numbers overflowed: they would spread through the band's factor."""
        blocks = [getattr(self, name).reshape(self.B, -1) for name in _BLOCKS]
        bad = ~np.logical_and.reduce([np.isfinite(block).all(axis=1) for block in blocks])
        for block in blocks:
            block[bad] = 0.0
        self.cost[bad] = math.inf

    @property
    def right(self) -> Array:
        return np.concatenate([self.inner.reshape(self.B, -1), self.outer], axis=1)

    @property
    def diagonal(self) -> Array:
        corner = np.diagonal(self.corner, axis1=1, axis2=2)
        return np.concatenate([self.band[:, 0].reshape(self.B, -1), corner], axis=1)

    def replace(self, other: "_System", where: Array) -> None:
        """Take the equations of some trajectories (B,) bool from another system."""
        for name in _BLOCKS:
            mine, its = (getattr(x, name) for x in (self, other))
            mine.reshape(self.B, -1)[where] = its.reshape(self.B, -1)[where]

    def factor(self, damping: Array) -> tuple[Array, Array, Array, Array]:
        """Of the damped equations: band factor, `A^-1 B`, Schur complements' Cholesky factors, and which failed."""
        B, n = self.B, self.n
        damped = self.band.copy()
        damped[:, 0] += damping[:, :n].reshape(-1)
        failed = np.zeros(B, bool)
        while True:
            chol, info = self._lapack.dpbtrf(damped.T, lower=1)
            if not info:
                break
            bad = (info - 1) // n  # that one is left out, the others go on
            failed[bad] = True
            damped[bad * n : (bad + 1) * n] = np.eye(1, damped.shape[1])
        follow = self._lapack.dpbtrs(chol, self.border, lower=1)[0] if self.m else self.border
        border, apart = self.border.reshape(B, n, self.m), follow.reshape(B, n, self.m)
        complement = self.corner - border.transpose(0, 2, 1) @ apart
        complement[:, np.arange(self.m), np.arange(self.m)] += damping[:, n:]
        factor, info = torch.linalg.cholesky_ex(torch.from_numpy(complement))
        return chol, apart, factor.numpy(), failed | (info.numpy() != 0)

    def step(self, damping: Array) -> tuple[Array, Array]:
        """Steps (B, n + m), and for which trajectories there is none."""
        B, n = self.B, self.n
        chol, apart, corner, failed = self.factor(damping)
        inner = self._lapack.dpbtrs(chol, self.inner, lower=1)[0].reshape(B, n)
        if self.m:
            left = self.outer - np.einsum("bnm,bn->bm", self.border.reshape(B, n, self.m), inner)
            solved = torch.cholesky_solve(torch.from_numpy(left)[..., None], torch.from_numpy(corner))
            outer = solved[..., 0].numpy()
            inner = inner - np.einsum("bnm,bm->bn", apart, outer)
            inner = np.concatenate([inner, outer], axis=1)
        failed |= ~np.isfinite(inner).all(axis=1)
        return np.where(failed[:, None], 0.0, -inner), failed


class _Linearizer:
    """From numbers of the unknowns to the normal equations of all trajectories."""

    def __init__(self, problem: BatchProblem):
        trajectories = problem.trajectories
        self.module, spline = trajectories, _EndToEnd(trajectories)
        self.spline, self.B = spline, spline.batch
        self.variables = list(problem.variables.values())
        self.model = Model([spline], self.variables, {})
        self.priors: list[Prior] = problem._first.priors
        each = [self.model.columns[id(v)] for v in self.variables]
        self.columns = np.concatenate([np.zeros((self.B, 0), np.int64), *each], axis=1)
        self.terms, self.which = [], []
        for residual, which in problem._residuals:
            index = {slot: which for slot, x in residual.arguments.items() if isinstance(x, Variable)}
            term = Term(_shifted(residual, which, trajectories), self.model, trajectories.domain[0], index)
            self.terms.append(term)
            self.which.append(which[term.order])

    def state(self) -> State:
        points = self.module.group.normalize(self.module.control_points.detach().to(torch.float64))
        values = {id(v): v.points(v.value) for v in self.variables}
        flat = np.ascontiguousarray(points.reshape(-1, points.shape[-1]).numpy())
        return self.model.prepared({id(self.module): flat}, values)

    def moved(self, state: State, step: Array) -> State:
        full = np.empty(self.model.total)
        full[: self.model.band] = step[:, : self.model.band // self.B].reshape(-1)
        full[self.columns] = step[:, self.model.band // self.B :]
        return self.model.moved(state, full)

    def mixed(self, state: State, candidate: State, where: Array) -> State:
        """The candidate for some trajectories (B,) bool, the state for the others; without what follows from points."""
        key = id(self.module)
        rows = np.repeat(where, self.spline.points)[:, None]
        points = np.where(rows, candidate.points[key], state.points[key])
        chosen = torch.from_numpy(where)[:, None]
        values = {k: torch.where(chosen, candidate.values[k], x) for k, x in state.values.items()}
        return State({key: points}, values)

    def store(self, state: State) -> None:
        points = torch.from_numpy(state.points[id(self.module)])
        target = self.module.control_points
        target.copy_(points.reshape(target.shape).to(target))
        for variable in self.variables:
            variable.value = state.values[id(variable)].clone()

    def __call__(self, state: State) -> _System:
        assert state.chain is not None
        widths = [1]
        for term in self.terms:
            columns = term.touched(state)
            inner = columns < self.model.band
            low = np.where(inner, columns, self.model.total).min(axis=1, initial=self.model.total)
            widths.append(
                int((np.where(inner, columns, -1).max(axis=1, initial=-1) - low).max(initial=0)) + 1
            )
        system = _System(self.model, self.columns, self.B, max(widths))
        for term, which in zip(self.terms, self.which, strict=True):
            for part, costs, rows, _ in term.chunks(state):
                system.add(rows, state.chain, which[part])
                system.cost += np.bincount(which[part], costs, minlength=self.B)
        for prior in self.priors:
            self._add_prior(prior, system, state)
        system.isolate()
        return system

    def _add_prior(self, prior: Prior, system: _System, state: State) -> None:
        (part,) = prior.parts
        x, J = steps_of(part, state)
        D = x.shape[1]
        H = prior.information[:D, :D]  # the same for each row
        own = system.own[self.model.columns[id(part.unknown)][0] - self.model.band]
        system.cost += 0.5 * np.einsum("bi,ij,bj->b", x, H, x)
        system.corner[:, own[:, None], own] += J.transpose(0, 2, 1) @ H @ J
        system.outer[:, own] += np.einsum("bji,jk,bk->bi", J, H, x)


def _minimise(linearize: _Linearizer, options: Options) -> tuple[State, BatchResult]:
    """`solver.minimise` with a damping, a gain and an end for each trajectory."""
    B, state = linearize.B, linearize.state()
    system = linearize(state)
    initial = system.cost.copy()
    damping, growth = np.full(B, options.damping), np.full(B, 2.0)
    iterations, converged = np.zeros(B, np.int64), np.zeros(B, bool)
    reason = np.full(B, f"reached {options.iterations} iterations", dtype=object)
    active = np.isfinite(initial)
    reason[~active] = "the cost is not finite where the solution starts"

    def stop(where: Any, why: str, good: bool) -> None:
        where = where & active
        reason[where], converged[where] = why, good
        active[where] = False

    for _ in range(options.iterations):
        diagonal, right = system.diagonal, system.right
        far = (np.abs(right) > options.gradient * np.sqrt(np.maximum(diagonal, 0.0))) & (diagonal > 0)
        stop(~far.any(axis=1), "no unknown could come nearer: the gradient is zero", True)
        if not active.any():
            break
        iterations += active
        scale = np.maximum(diagonal, LEAST_DIAGONAL * diagonal.max(axis=1, initial=0.0, keepdims=True))
        scale[~(scale > 0.0)] = 1.0
        shares = damping[:, None] * scale
        step, failed = system.step(shares)
        step[~active] = 0.0
        candidate = linearize.moved(state, step)
        fresh = linearize(candidate)
        expected = 0.5 * (step * (shares * step - right)).sum(axis=1)
        usable = ~failed & np.isfinite(fresh.cost) & (expected > 0)
        gain = np.where(usable, (system.cost - fresh.cost) / np.where(usable, expected, 1.0), -1.0)
        stalled = ~failed & (gain <= 0) & (expected <= options.cost * system.cost)
        stop(stalled, "no step lowers the cost any more", True)
        better = active & (gain > 0)
        fall = (system.cost - fresh.cost) / np.maximum(system.cost, 1e-300)
        state = linearize.mixed(state, candidate, better)
        system.replace(fresh, better)
        lowered = damping * np.maximum(1 / 10, 1 - (2 * np.where(better, gain, 1.0) - 1) ** 3)
        damping = np.where(better, np.maximum(lowered, 1e-15), damping * growth)
        growth = np.where(better, 2.0, 2 * growth)
        stop(better & (fall < options.cost), f"the cost fell by less than {options.cost:g} of itself", True)
        stop(damping > MOST_DAMPING, "no step lowers the cost, however small", False)
    covariances = _covariances(linearize, system)
    before, after, done, tried = map(torch.from_numpy, (initial, system.cost, converged, iterations))
    return state, BatchResult(before, after, done, tried, list(reason), covariances)


def _covariances(linearize: _Linearizer, system: _System) -> dict[int, Tensor]:
    if not system.m:
        return {}
    *_, corner, failed = system.factor(np.zeros((system.B, system.n + system.m)))
    corner[failed] = np.eye(system.m)  # a failed factor may have zeros on its diagonal
    inverse = torch.cholesky_inverse(torch.from_numpy(corner))
    inverse[torch.from_numpy(failed)] = math.nan
    found = {}
    for variable in linearize.variables:
        own = system.own[linearize.model.columns[id(variable)][0] - linearize.model.band]
        found[id(variable)] = inverse[:, own[:, None], own]
    return found


def _shifted(residual: Residual, which: Array, trajectories: BSpline) -> Residual:
    """With times of the trajectories laid end to end."""
    points, b = trajectories.control_points.shape[-2], torch.from_numpy(which)
    new = copy.copy(residual)
    if trajectories.dt_ns is not None:
        new.t = residual.t + b * (points * trajectories.dt_ns)
    else:
        assert trajectories.dt is not None
        new.t = residual.t + b.to(torch.float64) * (points * float(trajectories.dt.detach()))
    return new


def _which(name: str, x: Any, count: int, B: int) -> Array:
    checks.instance(name, x, Tensor, "an int64 tensor")
    if x.dtype != torch.int64 or x.shape != (count,):
        raise ValueError(f"{name}: expected int64 of shape ({count},), got {x.dtype} {tuple(x.shape)}")
    which = x.cpu().numpy()
    if which.size and (which.min() < 0 or which.max() >= B):
        raise ValueError(f"{name}: expected numbers from 0 to {B - 1}, got {which.min()} to {which.max()}")
    return which
