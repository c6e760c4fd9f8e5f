"""This library as a contender, and what the memory alone would take."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from bench.problems import DT, Problem, UnavailableError
from bench.timing import Task
from torchspline import BSpline, Group
from torchspline.functional import bspline
from torchspline.kernels.build import available


def function(problem: Problem, kernels: str) -> Task:
    """The functional form; backward: through the value and all derivatives at once."""
    _check(kernels)
    X, t = problem.control_points(), problem.times()
    options: dict[str, Any] = {
        "group": Group(problem.group),
        "order": problem.order,
        "dt": DT,
        "derivatives": problem.derivatives,
    }
    if not problem.backward:
        return _task(lambda: fields(bspline(X, t, **options)), problem, kernels)
    X.requires_grad_()
    t.requires_grad_()
    cotangents = problem.cotangents()
    return _task(
        lambda: torch.autograd.grad(fields(bspline(X, t, **options)), (X, t), cotangents), problem, kernels
    )


def module(problem: Problem, kernels: str) -> Task:
    """The layer; backward: to its parameter and the times."""
    _check(kernels)
    spline = BSpline(problem.control_points(), group=Group(problem.group), order=problem.order, dt=DT)
    t = problem.times()
    if not problem.backward:
        return _task(lambda: fields(spline.evaluate(t, problem.derivatives)), problem, kernels)
    t.requires_grad_()
    wanted, cotangents = (spline.control_points, t), problem.cotangents()
    return _task(
        lambda: torch.autograd.grad(fields(spline.evaluate(t, problem.derivatives)), wanted, cotangents),
        problem,
        kernels,
    )


def kinematics(problem: Problem, kernels: str) -> Task:
    """Rotation, position and their rates."""
    _check(kernels)
    spline = BSpline(
        problem.control_points(), group=Group(problem.group), order=problem.order, dt=DT, learnable=False
    )
    t = problem.times()
    return _task(lambda: fields(spline.kinematics(t)), problem, kernels)


def fields(state: Sequence[Tensor | None]) -> list[Tensor]:
    return [x for x in state if x is not None]


def _task(call: Any, problem: Problem, kernels: str) -> Task:
    return Task(call, problem.total, problem.threads, kernels, read=arrays)


def arrays(tensors: Sequence[Tensor]) -> list[Any]:
    return [x.detach().double().numpy() for x in tensors]


def _check(kernels: str) -> None:
    if kernels == "fused" and not available():
        raise UnavailableError("no compiled kernels without Numba")


def _written(problem: Problem) -> list[tuple[int, ...]]:
    """Shapes of all that a call has to write."""
    batch = max(problem.batch, 1)
    shapes: list[tuple[int, ...]] = [(batch, problem.queries, size) for size in problem.sizes]
    if problem.backward:
        shapes += [(batch, problem.points, problem.sizes[0]), (problem.queries,)]
    return shapes


def fill(problem: Problem) -> Task:
    """The bandwidth limit: writing all outputs once, into memory that is there already."""
    outputs = [torch.empty(shape, dtype=problem.real) for shape in _written(problem)]
    return Task(lambda: [x.fill_(1.0) for x in outputs], problem.total, problem.threads)


def allocate_and_fill(problem: Problem) -> Task:
    """The same into fresh memory, as every call that returns its results has to."""
    shapes, dtype = _written(problem), problem.real
    return Task(
        lambda: [torch.empty(shape, dtype=dtype).fill_(1.0) for shape in shapes],
        problem.total,
        problem.threads,
    )
