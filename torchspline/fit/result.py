"""What a solution says about itself: how it went, how sure it is, and what the data leave open."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline import checks
from torchspline.fit.solving.linearizer import Linearizer
from torchspline.fit.solving.model import State, Unknown, spacing_of
from torchspline.fit.solving.scatter import Scatter
from torchspline.fit.solving.solver import Trace
from torchspline.fit.solving.system import BandSystem, Factor, SingularError, System
from torchspline.fit.variables import Variable
from torchspline.splines.bspline import BSpline

Array = NDArray[Any]
#: Eigenvalues of the normal equations, scaled to a diagonal of ones, below which a direction counts as left open: its
#: standard deviation is 30,000 times what it would be if all else were known.
_OPEN = 1e-9
#: Directions that are looked for.
_DIRECTIONS = 12
#: Of those, named in an error.
_NAMED = 3


@dataclass(frozen=True)
class OpenDirection:
    """A combination of unknowns that the measurements do not determine."""

    #: Eigenvalue of the scaled normal equations: 0 is not at all.
    eigenvalue: float
    #: Which unknowns it moves: share of its squared length, by name ("trajectory", "spline 1", names of variables).
    shares: dict[str, float]
    #: How it moves them: (M, D) for splines, (L, dimension) for variables; the largest number is 1.
    steps: dict[str, Tensor]

    def __str__(self) -> str:
        parts = ", ".join(f"{name} {share:.0%}" for name, share in self.shares.items() if share >= 0.01)
        return f"not determined (eigenvalue {self.eigenvalue:.1e}): {parts}"


class Result:
    """Of `Problem.solve`. Covariances hold at the solution, for the standard deviations that were given."""

    def __init__(
        self,
        linearizer: Linearizer,
        state: State,
        system: System,
        trace: Trace,
        numbers: dict[int, Tensor] | None = None,
    ):
        self._linearizer, self._state, self._system = linearizer, state, system
        model = linearizer.model
        if numbers is None:
            points = {key: torch.from_numpy(x).clone() for key, x in state.points.items()}
            numbers = points | {key: x.clone() for key, x in state.values.items()}
        self._scatter: dict[float, Scatter] = {}
        #: The trajectory's control points, unit, and the variables' values by name; with a graph if so asked.
        self.control_points = numbers[id(model.trajectory.module)]
        self.values = {v.name: numbers[id(v)] for v in model.variables}
        #: Half the (robust) weighted sum of squares at the start and after each accepted step.
        self.cost = list(trace.cost)
        #: Damping along with it.
        self.damping = list(trace.damping)
        #: How often residuals and Jacobians were evaluated.
        self.evaluations = trace.evaluations
        #: Why it stopped, and whether that was convergence.
        self.reason, self.converged = trace.reason, trace.converged
        #: Wall time by phase, s.
        self.seconds = dict(trace.seconds)

    def __repr__(self) -> str:
        return (
            f"Result(cost {self.cost[0]:.6g} -> {self.cost[-1]:.6g} in {self.evaluations} evaluations, "
            f"{'converged' if self.converged else 'not converged'}: {self.reason})"
        )

    # ------------------------------------------------------------------ residuals

    @cached_property
    def residuals(self) -> dict[str, Tensor]:
        """Of every residual added, by name, (N, R) in the order of its measurements, not weighted.

        A second residual of one name gets " 2" after it, and so on.
        """
        found: dict[str, Tensor] = {}
        for term in self._linearizer.measured:
            name, count = term.residual.name, 2
            while name in found:
                name, count = f"{term.residual.name} {count}", count + 1
            found[name] = torch.from_numpy(term.residuals(self._state))
        return found

    @cached_property
    def outside(self) -> int:
        """Measurements that an estimated clock moved out of the trajectory's domain; they had no weight."""
        return sum(int(term.places(self._state).outside.sum()) for term in self._linearizer.measured)

    @property
    def variance_factor(self) -> float:
        """Weighted sum of squares over degrees of freedom: 1 if the standard deviations were right."""
        rows = sum(term.numbers for term in self._linearizer.measured)
        return 2.0 * self.cost[-1] / max(rows - self._linearizer.model.total, 1)

    @cached_property
    def redundancy(self) -> dict[str, float]:
        """How many of the numbers of each residual were left to check the solution, by name as in `residuals`.

        The trace of `I - J (J^T W J)^-1 J^T W`: numbers measured minus those that unknowns went along with. The
        weighted sum of squares of a residual over its redundancy is 1 if its standard deviation was right
        [Foerstner 1979].

        Raises:
            ValueError: the measurements do not determine all unknowns.
        """
        factor, found = self._determined(), {}
        for name, term in zip(self.residuals, self._linearizer.measured, strict=True):
            own = self._linearizer.system_of(term, self._state)
            found[name] = term.numbers - factor.trace(own)
        return found

    # ------------------------------------------------------------------ how sure

    @cached_property
    def _undamped(self) -> Factor | None:
        """None where it is singular."""
        try:
            return self._system.factor(np.zeros(self._linearizer.model.total))
        except SingularError:
            return None

    @property
    def _factor(self) -> Factor:
        if self._undamped is None:
            raise ValueError(f"covariance: the measurements do not determine all unknowns: {self._open}")
        return self._undamped

    def _determined(self) -> Factor:
        if not self._surely_determined and self.observability:
            raise ValueError(f"covariance: the measurements do not determine all unknowns: {self._open}")
        return self._factor

    @property
    def _open(self) -> str:
        """The first of the open directions, in words."""
        named, more = self.observability[:_NAMED], len(self.observability) - _NAMED
        words = "; ".join(map(str, named)) or "rounding leaves no direction to name"
        return words + (f"; and {more} more" if more > 0 else "")

    @cached_property
    def _surely_determined(self) -> bool:
        """Whether no direction is open, without looking for them.

        The smallest eigenvalue is at least one over the trace of the inverse, here of the scaled equations.
        """
        diagonal = self._system.diagonal()
        if not isinstance(self._system, BandSystem) or not (diagonal > 0).all() or self._undamped is None:
            return False
        inverse = self._undamped.diagonal()
        return bool((inverse > 0).all()) and float(np.einsum("n,n->", inverse, diagonal)) < 1.0 / _OPEN

    def covariance(self, variable: Variable) -> Tensor:
        """Of a variable's step: `(dimension, dimension)`, or `(L, dimension, dimension)` for several.

        In plain numbers; a body tangent for a point of a group; two angles [rad] for a direction.

        Raises:
            ValueError: it was frozen, or the measurements do not determine all unknowns (the message says which).
        """
        checks.instance("variable", variable, Variable, "a torchspline.fit.Variable")
        columns = self._linearizer.model.columns.get(id(variable))
        if columns is None:
            raise ValueError(f"variable: {variable.name} is not among the unknowns that were solved for")
        i, j = np.broadcast_arrays(columns[:, :, None], columns[:, None, :])
        blocks = torch.from_numpy(self._determined().inverse(i, j))
        return blocks[0] if variable.value.ndim == 1 else blocks

    def standard_deviation(self, variable: Variable | BSpline, stretch: float | None = None) -> Tensor:
        """Of a variable, square roots of the diagonal of `covariance`; of a spline, of its control points, `(M, D)`.

        0 of control points that were frozen.

        Args:
            variable: or the trajectory, or a spline that a residual depends on.
            stretch: s. Residuals may be correlated within stretches of the trajectory of this length, as they are where
                a model is not exact or a bias wanders: the scatter of what stretches pull at counts then
                (the cluster-robust covariance [Liang and Zeger 1986]), where it is larger. There are six
                at least, and no more than the trajectory has stretches between knots. For a spline at most its knot
                spacing: errors alike for longer look like the spline. All its control points together tell one factor
                for each component; it comes out a few percent too small where errors are alike for a tenth of a
                stretch.
        Raises:
            ValueError: as `covariance`; a stretch that is not above zero, or too long for a spline.
        """
        if not isinstance(variable, BSpline):
            own = self.covariance(variable).diagonal(dim1=-2, dim2=-1).sqrt()
            if stretch is None:
                return own
            variances = self._scattered(stretch).variances(self._linearizer.model.columns[id(variable)])
            return torch.maximum(own, torch.from_numpy(np.sqrt(variances)).reshape(own.shape))
        own = torch.from_numpy(np.sqrt(self._variances(variable)))
        return own if stretch is None else own * torch.from_numpy(self._inflation(variable, stretch))

    def _variances(self, spline: BSpline) -> Array:
        """Of control points (M, D), 0 of those that stay."""
        columns = self._linearizer.model.columns.get(id(spline))
        if columns is None:
            raise ValueError(
                f"variable: {spline!r} is not among the splines that were solved for; expected the trajectory or a "
                "spline that a residual depends on"
            )
        there, variances = columns >= 0, np.zeros(columns.shape)
        variances[there] = self._determined().inverse(columns[there], columns[there])
        return variances

    def _inflation(self, spline: BSpline, stretch: float) -> Array:
        """By what factors (D,) the errors of a spline are larger where they are alike for a while."""
        spacing = spacing_of(spline)
        if checks.positive("stretch", stretch) > spacing * (1 + 1e-9):
            raise ValueError(
                f"stretch: expected at most the knot spacing of the spline, {spacing:g} s, got {stretch:g}; errors "
                "alike for longer cannot be told from it: choose knots farther apart, a shorter stretch, or None"
            )
        columns = self._linearizer.model.columns[id(spline)]
        return self._scattered(stretch).inflation(columns, self._variances(spline))

    def _scattered(self, stretch: float) -> Scatter:
        checks.positive("stretch", stretch)
        if stretch not in self._scatter:
            self._scatter[stretch] = Scatter(self._linearizer, self._state, self._factor, stretch)
        return self._scatter[stretch]

    def trajectory_covariance(self, t: Tensor, derivatives: int = 0, stretch: float | None = None) -> Tensor:
        """Covariance of the trajectory's state at times `t`, `(N, (1 + derivatives) D, (1 + derivatives) D)`.

        Of the value's body tangent, then of the derivatives (body frame, per second).

        Args:
            stretch: s, as for `standard_deviation` of a spline.
        Raises:
            ValueError: a time outside the domain; the measurements do not determine all unknowns.
        """
        model = self._linearizer.model
        if isinstance(t, Tensor) and t.ndim > 1:
            raise ValueError(f"t: expected shape (N,) or (), got {tuple(t.shape)}")
        spline, trajectory = model.trajectory, model.trajectory.module
        jacobians = self._solved().jacobians(t, derivatives, side="right")
        stacked = torch.cat([x for x in jacobians[1 : 2 + derivatives] if x is not None], dim=-2).double()
        N, k, rows, D = stacked.reshape(-1, *stacked.shape[-3:]).shape
        J = stacked.reshape(N, k, rows, D).transpose(1, 2).reshape(N, rows, k * D).numpy()
        windows = jacobians.first.reshape(-1).numpy()[:, None] + np.arange(spline.order)
        columns = model.columns[id(trajectory)][windows].reshape(N, k * D)
        # Control points that stay have no variance; any column stands in for theirs.
        J = np.where((columns >= 0)[:, None], J, 0.0)
        columns = np.where(columns >= 0, columns, np.maximum(columns.max(axis=1, keepdims=True), 0))
        i, j = np.broadcast_arrays(columns[:, :, None], columns[:, None, :])
        covariance = torch.from_numpy(J @ self._determined().inverse(i, j) @ J.swapaxes(1, 2))
        if stretch is not None:
            factors = torch.from_numpy(np.tile(self._inflation(trajectory, stretch), 1 + derivatives))
            covariance = factors[:, None] * covariance * factors
        return covariance[0] if t.ndim == 0 else covariance

    def _solved(self) -> BSpline:
        """The trajectory as it was solved for, wherever its module went since."""
        trajectory = self._linearizer.model.trajectory.module
        start = trajectory.domain[0]
        options: dict[str, Any] = {"dt_ns": trajectory.dt_ns, "t0_ns": start}
        if trajectory.dt is not None:
            options = {"dt": float(trajectory.dt.detach()), "t0": start}
        points = torch.from_numpy(self._state.points[id(trajectory)])
        return BSpline(points, group=trajectory.group, order=trajectory.order, learnable=False, **options)

    # ------------------------------------------------------------------ what is left open

    @property
    def banded(self) -> bool:
        """Whether the normal equations are a band with a narrow border, else a sparse matrix."""
        return isinstance(self._system, BandSystem)

    @cached_property
    def observability(self) -> list[OpenDirection]:
        """Combinations of unknowns that the measurements do not determine, at most a dozen; empty is good."""
        if self._surely_determined:
            return []
        diagonal = self._system.diagonal()
        dead = np.flatnonzero(diagonal <= 0)
        found = []
        if len(dead):
            step = np.zeros(len(diagonal))
            step[dead] = 1.0
            found.append(self._direction(0.0, step))
        scale = np.where(diagonal > 0, 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 1.0)
        for value, vector in self._smallest(scale, dead):
            if value < _OPEN:
                found.append(self._direction(value, scale * vector))
        return found

    def _smallest(self, scale: Array, dead: Array) -> list[tuple[float, Array]]:
        """Smallest eigenvalues of the scaled normal equations and their vectors, by inverse iteration on a subspace."""
        total = len(scale)
        count = min(_DIRECTIONS, total - len(dead))
        if count <= 0:
            return []
        shift = 1e-11
        damping = shift / scale**2
        damping[dead] = 1.0
        factor = self._system.factor(damping)
        basis = np.random.default_rng(0).normal(size=(total, min(count + 4, total - len(dead))))
        basis[dead] = 0.0
        for _ in range(8):
            basis, _ = np.linalg.qr(basis)
            basis = factor.solve(basis / scale[:, None]) / scale[:, None]
            basis[dead] = 0.0
        basis, _ = np.linalg.qr(basis)
        image = np.stack([scale * self._system.multiply(scale * b) for b in basis.T], axis=1)
        values, rotation = np.linalg.eigh(basis.T @ image)
        vectors = basis @ rotation
        return [(max(float(v), 0.0), x) for v, x in zip(values[:count], vectors.T, strict=False)]

    def _direction(self, value: float, step: Array) -> OpenDirection:
        step = step / max(np.abs(step).max(), 1e-300)
        model, shares, steps = self._linearizer.model, {}, {}
        diagonal = np.sqrt(np.maximum(self._system.diagonal(), 0.0))
        diagonal = np.where(diagonal > 0, diagonal, 1.0)
        weight = np.square(step * diagonal)
        for name, unknown in self._named():
            columns = model.columns.get(id(unknown))
            if columns is None:
                continue
            there = columns >= 0
            shares[name] = float(weight[columns[there]].sum() / weight.sum())
            steps[name] = torch.from_numpy(np.where(there, step[columns], 0.0))
        return OpenDirection(value, dict(sorted(shares.items(), key=lambda x: -x[1])), steps)

    def _named(self) -> list[tuple[str, Unknown]]:
        model = self._linearizer.model
        names: list[tuple[str, Unknown]] = [
            ("trajectory" if i == 0 else f"spline {i}", spline.module)
            for i, spline in enumerate(model.splines)
        ]
        return names + [(variable.name, variable) for variable in model.variables]
