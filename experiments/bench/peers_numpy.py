"""NumPy and SciPy as contenders: a plain recursion, and `RotationSpline`."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RotationSpline

from bench.problems import DT, Problem, UnavailableError
from bench.timing import Task
from torchspline.groups.convert import to_scipy
from torchspline.splines.basis import cumulative_matrix

Array = NDArray[Any]


def _rotations_forward(problem: Problem) -> None:
    if problem.group != "SO3":
        raise UnavailableError("rotations only")
    if problem.backward:
        raise UnavailableError("no gradients")


def multiply(p: Array, q: Array) -> Array:
    pw, px, py, pz = np.moveaxis(p, -1, 0)
    qw, qx, qy, qz = np.moveaxis(q, -1, 0)
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def conjugate(q: Array) -> Array:
    return q * np.array([1, -1, -1, -1], q.dtype)


def exponential(x: Array) -> Array:
    angle = np.linalg.norm(x, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * x], axis=-1)


def logarithm(q: Array) -> Array:
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    return np.divide(angle, sine, out=np.full_like(sine, 2), where=sine > 0) * q[..., 1:]


def back(q: Array, v: Array) -> Array:
    """q^-1 v q."""
    twice = 2 * np.cross(v, q[..., 1:])
    return v + q[..., :1] * twice + np.cross(twice, q[..., 1:])


def recursion(problem: Problem) -> Task:
    """[S20] (36), (41) over all queries at once, one array operation after the other."""
    _rotations_forward(problem)
    X, t = problem.control_points().numpy(), problem.times().numpy()
    rows = np.array(cumulative_matrix(problem.order), dtype=np.float64)[1:]
    powers = np.arange(problem.order)

    def call() -> list[Array]:
        s = t / DT
        segment = np.clip(s.astype(np.int64), 0, problem.segments - 1)
        u = s - segment
        logs = logarithm(multiply(conjugate(X[..., :-1, :]), X[..., 1:, :]))
        basis = u[:, None] ** powers
        first = np.zeros_like(basis)
        first[:, 1:] = powers[1:] * basis[:, :-1]
        second = np.zeros_like(basis)
        second[:, 2:] = powers[2:] * powers[1:-1] * basis[:, :-2]
        value, velocity, acceleration = X[..., segment, :], np.zeros(3, X.dtype), np.zeros(3, X.dtype)
        for j, row in enumerate(rows):
            d = logs[..., segment + j, :]
            l, l1, l2 = ((b @ row).astype(X.dtype)[:, None] for b in (basis, first, second))
            A = exponential(l * d)
            rate = l1 * d
            value = multiply(value, A)
            velocity = back(A, np.broadcast_to(velocity, d.shape)) + rate
            acceleration = back(A, np.broadcast_to(acceleration, d.shape)) + np.cross(velocity, rate) + l2 * d
        return [value, velocity / DT, acceleration / DT**2][: problem.derivatives + 1]

    return Task(call, problem.total, problem.threads, read=list)


def rotation_spline(problem: Problem) -> Task:
    """SciPy: another curve, through its points. Built beforehand; one call for each derivative."""
    _rotations_forward(problem)
    if problem.order != 4 or problem.batch or problem.dtype != "float64":
        raise UnavailableError("one cubic in float64 only")
    knots = np.linspace(0, problem.segments * DT, problem.points)
    rotations = to_scipy(problem.control_points())
    spline, t = RotationSpline(knots, rotations), problem.times().numpy()
    return Task(lambda: [spline(t, r) for r in range(problem.derivatives + 1)], problem.total)
