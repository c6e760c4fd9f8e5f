"""Explicit Jacobians of value, velocity and acceleration with respect to every active control point."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from bench.contenders import deviation
from bench.ours import fields
from bench.problems import DT, Problem
from bench.timing import Task, measure, prepared
from torchspline import Group
from torchspline.functional import bspline
from torchspline.splines.bspline import BSpline

GROUPS = ("SO3", "SE3")
#: An established C++ library on a 2-core machine, clang -O3, SO(3), ns per query: value, velocity and acceleration with
#: their Jacobians, by order. Not measured here.
QUOTED = {("SO3", 4): 1239, ("SO3", 5): 1650, ("SO3", 6): 2082}


def explicit(problem: Problem) -> Task:
    """`BSpline.jacobians`, left perturbations."""
    spline = _spline(problem)
    t = problem.times()
    return Task(lambda: spline.jacobians(t, problem.derivatives), problem.total, read=_stacked)


def forward_mode(problem: Problem) -> Task:
    """A forward-mode pass of the reference for each component of a step of every control point.

    Steps of every k-th control point are taken together: no query sees two of them.
    """
    X, t = problem.control_points(), problem.times()
    group, k = Group(problem.group), problem.order
    D = group.tangent_size

    def stepped(steps: Tensor) -> tuple[Tensor, ...]:
        moved = group.retract(X, steps, side="left")
        value, *rates = fields(
            bspline(moved, t, group=group, order=k, dt=DT, derivatives=problem.derivatives)
        )
        return (group.log(group.compose(value, group.inverse(fixed))), *rates)

    fixed = bspline(X, t, group=group, order=k, dt=DT, derivatives=0).value
    zero = X.new_zeros(len(X), D)

    def call() -> list[Tensor]:
        columns = []
        for residue in range(k):
            for component in range(D):
                step = zero.clone()
                step[residue::k, component] = 1.0
                columns.append(torch.func.jvp(stepped, (zero,), (step,))[1])
        return [torch.stack(x, dim=-1) for x in zip(*columns, strict=True)]

    def read(found: Sequence[Tensor]) -> list[Any]:
        segment = _spline(problem).jacobians(t, 0).first
        # Column block j belongs to control point first + (j - first) mod k.
        order = (segment[:, None] + torch.arange(k)) % k
        blocks = [x.unflatten(-1, (k, D)).movedim(1, -2) for x in found]
        return [x[torch.arange(len(t))[:, None], order].numpy() for x in blocks]

    return Task(call, problem.total, kernels="reference", read=read)


def _spline(problem: Problem) -> BSpline:
    return BSpline(
        problem.control_points(), group=Group(problem.group), order=problem.order, dt=DT, learnable=False
    )


def _stacked(found: Any) -> list[Any]:
    return [x.numpy() for x in (found.value, found.velocity, found.acceleration) if x is not None]


def evaluate(
    orders: Sequence[int], queries: int, rounds: int, patience: float, notes: set[str]
) -> list[dict[str, Any]]:
    rows = []
    for group in GROUPS:
        for order in orders:
            problem = Problem(queries, group=group, order=order, points=1000)
            candidates = (("torchspline", explicit), ("forward mode of the reference", forward_mode))
            tasks = prepared(((name, partial(f, problem)) for name, f in candidates), notes)
            ours, others = (task.read(task.run()) for _, task in tasks if task.read is not None)
            apart = max(deviation(a, b) for a, b in zip(ours, others, strict=True))
            for (name, _), timing in zip(
                tasks, measure([task for _, task in tasks], rounds, patience), strict=True
            ):
                rows.append(
                    {
                        "group": group,
                        "order": order,
                        "contender": name,
                        "deviation": apart,
                        "quoted_ns": QUOTED.get((group, order)),
                        **timing.record(),
                    }
                )
    return rows
