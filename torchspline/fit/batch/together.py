"""Many small least-squares problems of one kind at once, such as windows of a second: every step one call for all."""

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline import checks
from torchspline.fit.batch.end_to_end import BatchLinearizer, Part
from torchspline.fit.problem import Problem, include_unknowns
from torchspline.fit.residual import Argument, Clock, Residual
from torchspline.fit.solving.model import State, Unknown, with_points
from torchspline.fit.solving.solver import LEAST_DIAGONAL, MOST_DAMPING, ROUNDING, Options
from torchspline.fit.variables import Variable
from torchspline.splines.bspline import BSpline

Array = NDArray[Any]


class BatchProblem:
    """As `Problem`, for each trajectory of a batch: they share nothing, and each stops when it is done.

    Args:
        trajectories: a `BSpline` with control points `(B, M, P)`, on the CPU. Solving moves them in place.
    Raises:
        TypeError, ValueError: no such spline.
    """

    def __init__(self, trajectories: BSpline):
        points = _check_batch("trajectories", trajectories)
        if points.ndim != 3 or points.shape[0] == 0:
            raise ValueError(
                f"trajectories: expected control points of shape (B, M, P), got {tuple(points.shape)}; for a single "
                "one use Problem"
            )
        self.trajectories = trajectories
        self._parts: list[Part] = []
        self._splines: list[BSpline] = [trajectories]
        self._frozen: dict[Unknown, Array] = {}
        # One trajectory stands for all where arguments are checked.
        self._single = with_points(trajectories, points.detach()[0])
        self._named = Problem(self._single)

    @property
    def _batch(self) -> int:
        return len(self.trajectories.control_points)

    def add(self, residual: Residual, trajectory: Tensor) -> Residual:
        """Add measurements; returns the residual.

        Args:
            residual: its unknowns, those of its clock included, are variables with a value `(B, n)`, a row for each
                trajectory, and splines with control points `(B, M, n)`. Known arguments and the domain of the times are
                those of all.
            trajectory: which one each measurement is of, (N,) int64.
        Raises:
            TypeError, ValueError: it does not fit the trajectories.
        """
        checks.instance("residual", residual, Residual, "a residual such as torchspline.fit.Gyroscope")
        which = _which("trajectory", trajectory, len(residual), self._batch)
        arguments: dict[str, Argument] = {}
        for slot, x in residual.arguments.items():
            arguments[slot] = x
            if isinstance(x, BSpline):
                points = _check_batch(slot, x)
                if points.ndim != 3 or points.shape[0] != self._batch:
                    raise ValueError(
                        f"{slot}: expected a spline for each of {self._batch} trajectories, control points "
                        f"({self._batch}, M, {points.shape[-1]}), got {tuple(points.shape)}"
                    )
                arguments[slot] = with_points(x, points.detach()[0])
            elif isinstance(x, Variable):
                arguments[slot] = self._first_of(slot, x)
        clock = residual.clock
        parts = {name: getattr(clock, name) for name in ("offset", "skew", "delay")}
        firsts = {name: x and self._first_of("clock", x) for name, x in parts.items()}
        # With the unknowns of the first trajectory it has to fit the first trajectory.
        one = copy.copy(residual)
        one.arguments, one.clock = arguments, Clock(mid=clock.mid, late=clock.late, **firsts)
        Problem(self._single).add(one)
        variables = [x for x in (*residual.arguments.values(), *parts.values()) if isinstance(x, Variable)]
        include_unknowns(self._named, variables)
        for x in residual.arguments.values():
            if isinstance(x, BSpline) and not any(x is y for y in self._splines):
                self._splines.append(x)
        self._parts.append(Part(residual, which))
        return residual

    def _first_of(self, name: str, variable: Variable) -> Variable:
        """The variable of the first trajectory."""
        if variable.value.ndim != 2 or len(variable.value) != self._batch:
            raise ValueError(
                f"{name}: expected a Variable with a row for each of {self._batch} trajectories, got {variable!r}"
            )
        return Variable(variable.name, variable.value[0], group=variable.group, sphere=variable.sphere)

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
        self._first_of("variable", variable)
        self._named.add_prior(variable, sigma=sigma, covariance=covariance, information=information)

    def freeze(self, unknown: Unknown, points: Tensor | None = None) -> None:
        """Keep an unknown as it is: a `Variable`, or control points of the trajectories or of splines of a residual.

        Args:
            points: which control points stay, (M,) bool for all trajectories or (B, M); of a variable which rows,
                (B,); None for all.
        """
        shape = self._shape_of(unknown)
        if points is None:
            points = torch.ones(shape, dtype=torch.bool)
        checks.instance("points", points, Tensor, "a bool tensor")
        if points.dtype != torch.bool:
            raise TypeError(f"points: expected dtype torch.bool, got {points.dtype}")
        if points.shape not in (shape, shape[-1:]):
            either = f"{tuple(shape[-1:])} or {tuple(shape)}" if len(shape) > 1 else f"{tuple(shape)}"
            raise ValueError(f"points: expected shape {either}, got {tuple(points.shape)}")
        self._frozen[unknown] = points.cpu().expand(shape).numpy()

    def release(self, unknown: Unknown) -> None:
        """Undo `freeze`."""
        self._shape_of(unknown)
        self._frozen.pop(unknown, None)

    def _shape_of(self, unknown: Unknown) -> torch.Size:
        """Of its control points or rows."""
        known: list[Unknown] = [*self._splines, *self.variables.values()]
        if not any(x is unknown for x in known):
            raise ValueError(
                "unknown: expected the trajectories or an unknown of a residual that was added, got "
                f"{unknown!r}"
            )
        return (unknown.value if isinstance(unknown, Variable) else unknown.control_points).shape[:-1]

    @property
    def variables(self) -> dict[str, Variable]:
        """Unknowns besides splines, by name."""
        return self._named.variables

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
        if not self._parts:
            raise ValueError("solve: the problem has no residuals; add some with problem.add(...)")
        for x in self._splines:
            _check_batch("trajectories" if x is self.trajectories else "spline", x)
        # Numbers of a trajectory may overflow; it then takes no further part.
        with torch.no_grad(), np.errstate(over="ignore", invalid="ignore"):
            frozen = {id(x): stays for x, stays in self._frozen.items()}
            linearizer = BatchLinearizer(
                self._splines, list(self.variables.values()), self._parts, self._named.priors, frozen
            )
            if linearizer.held.all():
                raise ValueError("solve: everything is frozen")
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
        """Of each trajectory's step of a variable, `(B, dimension, dimension)`.

        NaN where the data leave it open, 0 of rows that were frozen.

        Raises:
            ValueError: the variable is not among the unknowns.
        """
        checks.instance("variable", variable, Variable, "a torchspline.fit.Variable")
        if id(variable) not in self._covariances:
            raise ValueError(f"variable: {variable.name} is not among the unknowns that were solved for")
        return self._covariances[id(variable)]


def _minimise(linearize: BatchLinearizer, options: Options) -> tuple[State, BatchResult]:
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
        # Where the fall is lost in the rounding of the cost, a smaller gradient tells a better place.
        lost = usable & (expected <= ROUNDING * system.cost)
        gain[lost] = np.where(fresh.slope < system.slope, 1.0, -1.0)[lost]
        near = (damping <= 1.0) & (expected <= max(options.cost, ROUNDING) * system.cost)
        stop(~failed & (gain <= 0) & near, "no step lowers the cost any more", True)
        better = active & (gain > 0)
        fall = (system.cost - fresh.cost) / np.maximum(system.cost, 1e-300)
        state = linearize.mixed(state, candidate, better)
        system.replace(fresh, better)
        lowered = damping * np.maximum(1 / 10, 1 - (2 * np.where(better, gain, 1.0) - 1) ** 3)
        damping = np.where(better, np.maximum(lowered, 1e-15), damping * growth)
        growth = np.where(better, 2.0, 2 * growth)
        stop(better & (fall < options.cost), f"the cost fell by less than {options.cost:g} of itself", True)
        stop(damping > MOST_DAMPING, "no step lowers the cost, however small", False)
    before, after, done, tried = map(torch.from_numpy, (initial, system.cost, converged, iterations))
    return state, BatchResult(before, after, done, tried, list(reason), linearize.covariances(system))


def _check_batch(name: str, splines: Any) -> Tensor:
    """Control points of splines of a batch."""
    checks.instance(name, splines, BSpline, "a BSpline")
    points = splines.control_points
    if points.device.type != "cpu":
        raise ValueError(f"{name}: expected them on the CPU, got {points.device}; move them with .to('cpu')")
    checks.finite(name, points)
    checks.quaternions(name, points, splines.group.arithmetic.sign_blocks)
    return points


def _which(name: str, x: Any, count: int, B: int) -> Array:
    checks.instance(name, x, Tensor, "an int64 tensor")
    if x.dtype != torch.int64 or x.shape != (count,):
        raise ValueError(f"{name}: expected int64 of shape ({count},), got {x.dtype} {tuple(x.shape)}")
    which = x.cpu().numpy()
    if which.size and (which.min() < 0 or which.max() >= B):
        raise ValueError(f"{name}: expected numbers from 0 to {B - 1}, got {which.min()} to {which.max()}")
    return which
