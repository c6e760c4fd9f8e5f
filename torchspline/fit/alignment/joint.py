"""All unknowns of an alignment at once: the least-squares problem and how sure its solution is."""

import math
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline.fit.alignment import start as align_start
from torchspline.fit.losses import Loss
from torchspline.fit.problem import Linearizer, Problem
from torchspline.fit.residual import Clock, Residual
from torchspline.fit.residuals import RESIDUALS
from torchspline.fit.solving.terms import Term
from torchspline.fit.variables import Variable
from torchspline.groups.group import SO3
from torchspline.splines.bspline import BSpline

Array = NDArray[Any]
#: Fewer readings than this are no recording.
FEWEST = 30
#: What is known of the delay between the sensors beforehand, s: filters on one chip are not farther apart than this.
_DELAY = 5e-3
#: Solutions, each weighted by the residuals of the one before.
_ROUNDS = 5
#: Standard deviations beyond which an estimate counts as not determined: its name, the limit, its unit.
_LIMITS = {
    "time_offset": (0.01, "s"),
    "clock_skew": (0.01, "s/s"),
    "accel_delay": (0.002, "s"),
    "rotation_imu_body": (0.1, "rad"),
    "lever_arm": (0.2, "m"),
    "gyro_bias": (0.05, "rad/s"),
    "accel_bias": (0.5, "m/s²"),
    "gravity": (0.5, "m/s²"),
}


#: Residuals of more than this share of how readings vary are worth a word, and delays of more than so many `_DELAY`.
_UNEXPLAINED, _LONG = 0.4, 4.0
#: What each sensor is taken to read.
_READS = {
    "gyro": ("rad/s", "rad/s"),
    "accel": ("m/s²", "specific force in m/s², which at rest points up, and is gravity_magnitude right"),
}


class Readings(NamedTuple):
    """Of one sensor, in order of time: `s` (N,) seconds from the first stamp, `x` (N, 3)."""

    s: Array
    x: Array


class Solution(NamedTuple):
    """Seconds by which the IMU's stamps, counted from the first, are ahead of the trajectory's time, counted from its
    start, at `mid`; values and standard deviations by name; of each sensor root mean square residual and readings."""

    lag: float
    mid: float
    values: dict[str, Tensor]
    std: dict[str, Tensor]
    rms: list[float]
    used: list[int]
    notes: list[str]


class Joint:
    """The least-squares problem of all unknowns, and what follows from its solution."""

    def __init__(
        self,
        trajectory: BSpline,
        epoch: float,
        sensors: list[Readings],
        start: align_start.Start,
        skew: bool,
        delay: bool,
        magnitude: float | None,
        loss: Loss | None,
    ):
        self.trajectory, self.epoch, self.start, self.loss = trajectory, epoch, start, loss
        length = align_start.length_of(trajectory)
        # A spline knows least at its ends, and the offset is still to move.
        margin = min(max(2.0 * float(np.median(np.diff(sensors[0].s))), 0.05), 0.1 * length)
        self.used = [Readings(*(v[_inside(r.s - start.lag, margin, length)] for v in r)) for r in sensors]
        for name, readings in zip(("gyro", "accel"), self.used, strict=False):
            if len(readings.s) < FEWEST:
                raise ValueError(
                    f"{name}: expected at least {FEWEST} readings within the trajectory's domain, "
                    f"got {len(readings.s)} at a time offset of {start.lag + epoch:.4g} s"
                )
        self.mid = 0.5 * float(self.used[0].s[0] + self.used[0].s[-1]) - start.lag
        self.offset = Variable("time_offset", torch.zeros(1, dtype=torch.float64))
        self.skew = Variable("clock_skew", torch.zeros(1, dtype=torch.float64)) if skew else None
        both = delay and len(sensors) > 1
        self.delay = Variable("accel_delay", torch.zeros(1, dtype=torch.float64)) if both else None
        self.arguments = self._arguments(magnitude)
        self.notes: list[str] = []

    def _arguments(self, magnitude: float | None) -> list[dict[str, Variable]]:
        """Of the residual of each sensor, at their start values."""
        R, bias = self.start.rotation, self.start.bias
        tau = self.used[0].s - self.start.lag
        error = self.used[0].x - align_start.angular_velocity(self.trajectory, tau) @ R.T - bias
        self.sigmas = [_spread(error, self.loss is not None)]
        more: dict[str, Variable] = {}
        if len(self.used) > 1:
            moves = align_start.motion(self.trajectory, self.used[1].s - self.start.lag)
            force = align_start.force(self.start, moves, self.used[1].x, magnitude)
            R = force.rotation
            self.sigmas.append(max(force.scale, 1e-9))
            sphere = magnitude is not None
            more = {
                "bias": _variable("accel_bias", force.bias),
                "gravity": _variable("gravity", force.gravity, sphere=sphere),
                "lever_arm": _variable("lever_arm", force.lever_arm),
            }
        q = SO3.from_matrix(torch.from_numpy(np.ascontiguousarray(R.T)))
        rotation = Variable("rotation_imu_body", q, group=SO3)
        both = [{"bias": _variable("gyro_bias", bias), "rotation": rotation}]
        return both + ([{**more, "rotation": rotation}] if more else [])

    def _problem(self) -> Problem:
        problem = Problem(self.trajectory)
        mid = align_start.times_of(self.trajectory, np.array([self.mid]))[0].item()
        clock = Clock(offset=self.offset, skew=self.skew, mid=mid)
        clocks = [clock, clock]
        if self.delay is not None:
            late = torch.ones(len(self.used[1].s), dtype=torch.float64)
            clocks[1] = replace(clock, delay=self.delay, late=late)
        kinds = RESIDUALS["Gyroscope"], RESIDUALS["Accelerometer"]
        for kind, readings, sigma, arguments, clock in zip(
            kinds, self.used, self.sigmas, self.arguments, clocks, strict=False
        ):
            t = align_start.times_of(self.trajectory, readings.s - self.start.lag)
            residual: Residual = kind(
                t,
                torch.from_numpy(readings.x),
                sigma=sigma,
                loss=self.loss,
                clock=clock,
                **cast(Any, arguments),
            )
            problem.add(residual)
        if self.delay is not None:
            problem.add_prior(self.delay, sigma=_DELAY)
        problem.freeze(problem.trajectory)
        return problem

    def _solve(self) -> Problem:
        """At the minimum, with each sensor weighted by its own residuals."""
        for _ in range(_ROUNDS):
            problem = self._problem()
            result = problem.solve()
            before = self.sigmas
            self.sigmas = [_spread(r, self.loss is not None) for r in self._residuals(problem)]
            if np.allclose(before, self.sigmas, rtol=2e-3):
                break
        if not result.converged:
            self.notes.append(f"the joint refinement did not converge: {result.reason}")
        return self._problem()

    def _residuals(self, problem: Problem) -> list[Array]:
        linearizer = problem.prepare()
        state = linearizer.model.state()
        return [np.concatenate([r for _, _, r in term.linearize(state)]) for term in _terms(linearizer)]

    def run(self) -> Solution:
        """The solution."""
        with torch.no_grad():
            problem = self._solve()
            errors = self._residuals(problem)
            covariances = _covariances(problem, {} if self.delay is None else {"accel_delay": _DELAY**-2})
        std = {name: _deviations(problem.variables[name], c) for name, c in covariances.items()}
        offset = float(self.offset.value[0])
        self._note(std, offset, errors)
        return Solution(
            lag=self.start.lag + offset,
            mid=self.mid,
            values={name: v.value for name, v in problem.variables.items()},
            std=std,
            rms=[math.sqrt(float(np.mean(e**2))) for e in errors],
            used=[len(r.s) for r in self.used],
            notes=self.notes,
        )

    def _note(self, std: dict[str, Tensor], offset: float, errors: list[Array]) -> None:
        for name, x in std.items():
            limit, unit = _LIMITS[name]
            worst = float(x.max())
            if not worst <= limit:
                self.notes.append(
                    f"{name}: the motion hardly tells it, standard deviation {worst:.2g} {unit}"
                )
        if abs(offset) > 0.1:
            self.notes.append(
                f"time_offset: refinement moved it by {offset:.3g} s from where angular speeds correlate best"
            )
        rival, best = self.start.rival, self.start.explained
        if rival is not None and 1.0 - rival[1] < 1.25 * (1.0 - best):
            self.notes.append(
                f"time_offset: {self.epoch + rival[0]:.4g} s explains the gyroscope almost as well "
                f"({rival[1]:.1%} of its variance, the one chosen {best:.1%}): the motion repeats itself"
            )
        delay = 0.0 if self.delay is None else float(self.delay.value[0])
        if abs(delay) > _LONG * _DELAY:
            self.notes.append(f"accel_delay: {delay:.3g} s, more than the filters of a chip make")
        for name, error, readings in zip(("gyro", "accel"), errors, self.used, strict=False):
            left, there = (_spread(x, True) for x in (error, readings.x - np.median(readings.x, axis=0)))
            if left > _UNEXPLAINED * there:
                unit, expected = _READS[name]
                self.notes.append(
                    f"{name}: the motion leaves {left:.3g} {unit} of readings that vary by {there:.3g}; vibrations, or "
                    f"do the knots miss the motion, is it the same body, are the readings {expected}?"
                )
        for name, error, sigma in zip(("gyro", "accel"), errors, self.sigmas, strict=False):
            share = float(np.mean(np.linalg.norm(error, axis=1) > 6.0 * sigma))
            if share > 0.01:
                self.notes.append(
                    f"{name}: {share:.1%} of the readings lie more than 6 standard deviations off; they hardly count"
                    if self.loss is not None
                    else f"{name}: {share:.1%} of the readings lie more than 6 standard deviations off"
                )


def _inside(tau: Array, margin: float, length: float) -> Array:
    return (tau >= margin) & (tau <= length - margin)


def _variable(name: str, value: Array, sphere: bool = False) -> Variable:
    return Variable(name, torch.from_numpy(np.ascontiguousarray(value)), sphere=sphere)


def _spread(error: Array, robust: bool) -> float:
    """Standard deviation of a component: from the median of lengths, or the root mean square."""
    if not robust:
        return max(math.sqrt(float(np.mean(error**2))), 1e-9)
    return max(float(np.median(np.linalg.norm(error, axis=1))) / align_start.MEDIAN_LENGTH, 1e-9)


def _covariances(problem: Problem, known: dict[str, float]) -> dict[str, Array]:
    """Of the tangent of each variable, robust losses taken into account; infinite where nothing is known.

    `known` is what priors tell of variables by name.

    An M-estimate has the covariance `A^-1 B A^-1`, with A the mean curvature of the cost and B that of the squares of
    its gradient [Huber 1981, 7.6]; with weights of one, (J^T J)^-1 times the variance of the residuals. The errors of
    a sensor are taken as alike on its axes and independent in time.
    """
    linearizer: Linearizer = problem.prepare()
    model = linearizer.model
    curvature = np.zeros((model.total, model.total))
    squares = np.zeros_like(curvature)
    state = model.state()
    for term in _terms(linearizer):
        plain, total, s = np.zeros_like(curvature), 0, []
        sigma = term.residual.weighting[1]
        scale = 1.0 if sigma is None else float(sigma)
        for _, rows, error in term.linearize(state):
            width = rows.columns.shape[1]
            chosen = np.flatnonzero(rows.columns[0] >= 0)
            jacobian = rows.rows[..., :width][..., chosen].reshape(-1, len(chosen))
            columns = rows.columns[0, chosen]
            plain[np.ix_(columns, columns)] += jacobian.T @ jacobian
            total += len(error)
            s.append((error**2).sum(axis=1) / scale**2)
        lengths = torch.from_numpy(np.concatenate(s))
        weight, bend = torch.ones_like(lengths), torch.zeros_like(lengths)
        if (loss := term.residual.loss) is not None:
            with torch.enable_grad():
                leaf = lengths.clone().requires_grad_()
                weight = loss.weight(leaf)
                (bend,) = torch.autograd.grad(weight.sum(), leaf)
            weight = weight.detach()
        # Rows carry the roots of the weights: divided by their mean they are those of plain least squares.
        plain /= max(float(weight.mean()), 1e-12)
        curvature += plain * float((weight + 2.0 / 3.0 * bend * lengths).mean())
        squares += plain * float((weight**2 * lengths).mean()) / 3.0
    for name, information in known.items():
        own = model.columns[id(problem.variables[name])].reshape(-1)
        curvature[own, own] += information
        squares[own, own] += information
    inverse, unknown = _pseudo_inverse(curvature)
    covariance = inverse @ squares @ inverse
    covariance[np.diag_indices_from(covariance)] = np.where(unknown, np.inf, np.diagonal(covariance))
    return {
        v.name: covariance[np.ix_(c, c)]
        for v in problem.variables.values()
        for c in [model.columns[id(v)].reshape(-1)]
    }


def _terms(linearizer: Linearizer) -> list[Term]:
    """Those of the sensors."""
    return [term for term in linearizer.terms if isinstance(term, Term)]


def _pseudo_inverse(matrix: Array) -> tuple[Array, Array]:
    """Of a positive semidefinite matrix, and which unknowns have a share in its null space."""
    scale = np.sqrt(np.maximum(np.diagonal(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    good = values > 1e-12
    unknown = (vectors[:, ~good] ** 2).sum(axis=1) > 1e-6
    inverse = (vectors[:, good] / values[good]) @ vectors[:, good].T
    return inverse / np.outer(scale, scale), unknown


def _deviations(variable: Variable, covariance: Array) -> Tensor:
    basis = variable.basis(variable.value)
    if basis is not None and np.isfinite(covariance).all():
        covariance = basis[0].numpy() @ covariance @ basis[0].numpy().T
    elif basis is not None:
        return torch.full((3,), math.inf, dtype=torch.float64)
    return torch.from_numpy(np.sqrt(np.diagonal(covariance)))
