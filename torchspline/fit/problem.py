"""A least-squares problem: a trajectory, what was measured of it, and what else is unknown."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline import checks
from torchspline.fit.residual import Residual, square_root_information, weighting_of
from torchspline.fit.result import Result
from torchspline.fit.solving.implicit import differentiable as of_solution
from torchspline.fit.solving.linearizer import Linearizer
from torchspline.fit.solving.model import Model, Spline, Unknown
from torchspline.fit.solving.priors import Part, Prior
from torchspline.fit.solving.progress import progress_bar
from torchspline.fit.solving.solver import Options, minimise
from torchspline.fit.solving.terms import Term
from torchspline.fit.variables import Variable
from torchspline.splines.bspline import BSpline

Array = NDArray[Any]
#: Names of splines in `Result.observability`.
_RESERVED = re.compile(r"trajectory|spline \d+")


class Problem:
    """Unknown control points of `trajectory`, and unknowns of the residuals that are added.

    Args:
        trajectory: a `BSpline` without a batch, on any group, on the CPU. Solving moves its control points in place.
    Examples:
        >>> import torch
        >>> from torchspline import R3, BSpline
        >>> from torchspline.fit import StateValue
        >>> spline = BSpline(torch.zeros(8, 3, dtype=torch.float64), group=R3, order=4, dt=0.2)
        >>> t = torch.linspace(0, 1, 30, dtype=torch.float64)
        >>> problem = Problem(spline)
        >>> residual = problem.add(StateValue(t, torch.stack([t, t * t, 0 * t], dim=-1), sigma=0.1))
        >>> problem.solve(progress=False).converged
        True
    """

    def __init__(self, trajectory: BSpline):
        _check_spline("trajectory", trajectory)
        self.trajectory = trajectory
        self.residuals: list[Residual] = []
        self._indices: list[dict[str, Array]] = []
        #: By the unknowns themselves, not their `id`: copies and pickles of a problem keep them.
        self._frozen: dict[Unknown, Array | bool] = {}
        self._unknowns: list[Unknown] = [trajectory]
        self.priors: list[Prior] = []

    # ------------------------------------------------------------------ building

    def add(self, residual: Residual, **index: Tensor) -> Residual:
        """Add measurements; returns the residual.

        Args:
            index: for an argument that is a `Variable` of several, such as landmarks, which of them each measurement
                sees, (N,) int64, by the name of the argument.
        Raises:
            TypeError, ValueError: it does not fit the trajectory: group, kind of time, times outside its domain.
        """
        checks.instance("residual", residual, Residual, "a residual such as torchspline.fit.Gyroscope")
        residual.bind(self.trajectory.group)
        if residual.derivatives >= self.trajectory.order:
            raise ValueError(
                f"residual: {residual.name} depends on the derivative number {residual.derivatives}, which is zero on "
                f"a spline of order {self.trajectory.order}; expected order {residual.derivatives + 1} or more"
            )
        indices = {slot: _index(residual, slot, x) for slot, x in index.items()}
        for slot, x in residual.arguments.items():
            if isinstance(x, Variable) and x.value.ndim == 2 and slot not in indices:
                raise ValueError(
                    f"{slot}: {x.name} holds {len(x.value)}; expected {slot}=index, which of them each measurement "
                    "sees, got none"
                )
        for x in residual.clock.unknowns:
            if x.value.ndim != 1:
                raise ValueError(
                    f"clock: expected a Variable of one number, shape (1,), got {x!r}; a row for each of several "
                    "trajectories is for BatchProblem"
                )
        self._check_times(residual)
        unknowns = [
            x
            for x in (*residual.arguments.values(), *residual.clock.unknowns)
            if isinstance(x, (Variable, BSpline))
        ]
        include_unknowns(self, unknowns)
        self.residuals.append(residual)
        self._indices.append(indices)
        return residual

    def _check_times(self, residual: Residual) -> None:
        t, domain = residual.t.detach(), self.trajectory.domain
        if (t.dtype == torch.int64) != (self.trajectory.dt_ns is not None):
            raise TypeError(
                f"t: {residual.name} has {t.dtype} times; expected those of the trajectory, "
                f"{'int64 nanoseconds' if self.trajectory.dt_ns is not None else 'float64 seconds'}"
            )
        for slot, x in residual.arguments.items():
            if isinstance(x, BSpline) and (x.dt_ns is None) != (self.trajectory.dt_ns is None):
                raise TypeError(
                    f"{slot}: expected a spline with the trajectory's kind of time, got seconds and nanoseconds"
                )
            if isinstance(x, BSpline) and (message := _outside(residual, t.reshape(-1), x.domain)):
                raise ValueError(f"{slot}: {message} of its spline; expected one that covers them")
        if residual.clock.unknowns:
            return  # where they lie on the trajectory is unknown; those outside are left out while they are
        if message := _outside(residual, t, domain):
            raise ValueError(f"t: {message} of the trajectory; leave them out or extend the trajectory")

    def add_prior(
        self,
        variable: Variable,
        *,
        sigma: Tensor | float | None = None,
        covariance: Tensor | None = None,
        information: Tensor | None = None,
    ) -> None:
        """Say beforehand how far a variable may be from where it stands now.

        Args:
            variable: any, also one that a residual added later depends on; each of several by itself.
            sigma: standard deviation of its steps (a body tangent, plain numbers, or two angles of a direction, rad):
                a number or (dimension,). covariance, information: instead, (dimension, dimension).
        Raises:
            TypeError, ValueError: a wrong type, shape or value, or none of the three.
        """
        checks.instance("variable", variable, Variable, "a torchspline.fit.Variable")
        if sigma is None and covariance is None and information is None:
            raise ValueError("sigma, covariance, information: expected one of them, got none")
        size, count = variable.dimension, variable.value.shape[:-1].numel()
        kind, x = weighting_of(sigma, covariance, information, size, count)
        if x is not None and x.ndim > (1 if kind == "sigma" else 2):
            raise ValueError(f"{kind}: expected one for all of several unknowns, got shape {tuple(x.shape)}")
        root = square_root_information((kind, x))
        assert root is not None
        root = root.detach().cpu()
        matrix = torch.diag(root.expand(size)) if root.ndim < 2 else root
        include_unknowns(self, [variable])
        reference = variable.points(variable.value).reshape(count, -1)
        H = np.kron(np.eye(count), (matrix.mT @ matrix).numpy())
        self.priors.append(Prior([Part(variable, np.arange(count), reference)], H, np.zeros(len(H))))

    def freeze(self, unknown: Unknown, points: Tensor | None = None) -> None:
        """Keep an unknown as it is: a `Variable`, or control points of a spline.

        Args:
            points: which control points stay, (M,) bool; None for all.
        """
        self._known("unknown", unknown)
        if isinstance(unknown, Variable):
            if points is not None:
                raise ValueError(f"points: only splines have control points, got {unknown!r}; expected None")
            self._frozen[unknown] = True
            return
        count = unknown.control_points.shape[-2]
        if points is None:
            points = torch.ones(count, dtype=torch.bool)
        checks.instance("points", points, Tensor, "a bool tensor")
        if points.dtype != torch.bool:
            raise TypeError(f"points: expected dtype torch.bool, got {points.dtype}")
        if points.shape != (count,):
            raise ValueError(f"points: expected shape ({count},), got {tuple(points.shape)}")
        self._frozen[unknown] = points.cpu().numpy()

    def release(self, unknown: Unknown) -> None:
        """Undo `freeze`."""
        self._known("unknown", unknown)
        self._frozen.pop(unknown, None)

    def _known(self, name: str, unknown: Unknown) -> None:
        if not any(x is unknown for x in self._unknowns):
            raise ValueError(
                f"{name}: expected the trajectory or an unknown of a residual that was added, got {unknown!r}"
            )

    @property
    def variables(self) -> dict[str, Variable]:
        """Unknowns besides splines, by name."""
        return {x.name: x for x in self._unknowns if isinstance(x, Variable)}

    # ------------------------------------------------------------------ solving

    def solve(
        self,
        *,
        max_iterations: int = 50,
        cost_tolerance: float = 1e-9,
        gradient_tolerance: float = 1e-8,
        damping: float = 1e-5,
        differentiable: bool = False,
        progress: bool = False,
    ) -> Result:
        """Move all unknowns to where the sum of squares is least, by Levenberg-Marquardt.

        The first solution with a new kind of residual, group or order compiles its loops, for seconds; later ones, also
        in other processes, find them in the user's cache folder.

        Args:
            max_iterations: steps tried at most.
            cost_tolerance: stop when a step lowers the cost by less than this share.
            gradient_tolerance: stop when every unknown is this near to its optimum, in its standard deviations.
            damping: what to start from, as a share of the diagonal.
            differentiable: let `result.control_points` and `result.values` carry gradients, by the implicit function
                theorem, to every tensor with `requires_grad` among times, measurements, standard deviations,
                covariances and known arguments. Once: not for second derivatives. Gradients are as exact as the
                solution, so ask for small tolerances.
            progress: show a progress bar on a terminal.
        Returns:
            Result. Control points and the `value` of variables are replaced in place.
        Raises:
            ValueError: nothing to solve, a wrong option, a cost that is not finite.
        """
        options = Options.checked(max_iterations, cost_tolerance, gradient_tolerance, damping)
        if not self.residuals:
            raise ValueError("solve: the problem has no residuals; add some with problem.add(...)")
        with torch.no_grad(), progress_bar(progress, max_iterations) as show:
            linearizer = self.prepare()
            model = linearizer.model
            if model.total == 0:
                raise ValueError("solve: everything is frozen")
            state, system, trace = minimise(model, model.state(), linearizer, options, show)
            model.store(state)
        numbers = of_solution(linearizer, state, system) if differentiable else None
        return Result(linearizer, state, system, trace, numbers)

    def prepare(self) -> Linearizer:
        """The problem in arrays."""
        origin = self.trajectory.domain[0]
        for x in self._unknowns:
            if isinstance(x, BSpline):
                _check_spline("trajectory" if x is self.trajectory else "spline", x)
        splines = [Spline(x, origin) for x in self._unknowns if isinstance(x, BSpline)]
        variables = [x for x in self._unknowns if isinstance(x, Variable)]
        model = Model(splines, variables, {id(x): kept for x, kept in self._frozen.items()})
        pairs = zip(self.residuals, self._indices, strict=True)
        terms = [(r.term or Term)(r, model, origin, i) for r, i in pairs]
        return Linearizer(model, [*terms, *(prior.bind(model) for prior in self.priors)])


def include_unknowns(problem: Problem, unknowns: Sequence[Unknown]) -> None:
    """Count these among the unknowns of a problem, all or none of them; those of residuals are without being asked."""
    new: list[Unknown] = []
    for x in unknowns:
        known = [*problem._unknowns, *new]
        if any(y is x for y in known):
            continue
        if isinstance(x, BSpline):
            _check_spline("spline", x)
        elif any(isinstance(y, Variable) and y.name == x.name for y in known):
            raise ValueError(f"variable: expected one unknown of each name, got two called {x.name!r}")
        elif _RESERVED.fullmatch(x.name):
            raise ValueError(f"variable: {x.name!r} is what reports call a spline; expected another name")
        new.append(x)
    problem._unknowns += new


def _check_spline(name: str, spline: BSpline) -> None:
    checks.instance(name, spline, BSpline, "a BSpline")
    points = spline.control_points
    if points.ndim != 2:
        raise ValueError(
            f"{name}: expected one without a batch, got control points of shape {tuple(points.shape)}"
        )
    if points.device.type != "cpu":
        raise ValueError(f"{name}: expected one on the CPU, got {points.device}; move it with .to('cpu')")
    if points.is_inference():
        raise ValueError(
            f"{name}: its control points were made in torch.inference_mode and cannot be moved; make the spline "
            "outside of it, or of their clone()"
        )
    checks.finite(name, points)
    checks.quaternions(name, points, spline.group.arithmetic.sign_blocks)


def _outside(residual: Residual, t: Tensor, domain: tuple[float, float]) -> str:
    """What is wrong with the times of a residual; nothing if they lie in the domain, up to rounding."""
    rounding = 8 * torch.finfo(torch.float64).eps * max(map(abs, domain))
    slack = 0 if t.dtype == torch.int64 else 1e-9 * (domain[1] - domain[0]) + rounding
    outside = (t < domain[0] - slack) | (t > domain[1] + slack)
    if not bool(outside.any()):
        return ""
    return (
        f"{int(outside.sum())} of {outside.numel()} times of {residual.name}, the first {t[outside][0].item()!r}, "
        f"lie outside the domain {list(domain)}"
    )


def _index(residual: Residual, slot: str, x: Any) -> Array:
    variable = residual.arguments.get(slot)
    if not isinstance(variable, Variable) or variable.value.ndim != 2:
        raise ValueError(
            f"{slot}: an index is expected only with a Variable of several, shape (L, n), got {variable!r}"
        )
    checks.instance(slot, x, Tensor, "an int64 index, a torch.Tensor")
    if x.dtype != torch.int64:
        raise TypeError(f"{slot}: expected an index of dtype torch.int64, got {x.dtype}")
    if x.shape != (len(residual),):
        raise ValueError(f"{slot}: expected an index of shape ({len(residual)},), got {tuple(x.shape)}")
    index = x.cpu().numpy()
    count = variable.value.shape[0]
    if index.size and (index.min() < 0 or index.max() >= count):
        raise ValueError(
            f"{slot}: expected indices from 0 to {count - 1}, got {index.min()} to {index.max()}"
        )
    return index
