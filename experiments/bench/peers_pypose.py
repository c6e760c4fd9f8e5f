"""PyPose as a contender: its `bspline`, and the cubic that its users write by hand for times of their choice."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from bench.ours import arrays
from bench.problems import DT, Problem, UnavailableError, peer
from bench.timing import Task
from torchspline.splines.basis import cumulative_weights

# This library's layout from PyPose's: quaternions are xyzw there.
TO_PYPOSE = {"SO3": [1, 2, 3, 0], "SE3": [0, 1, 2, 4, 5, 6, 3]}
FROM_PYPOSE = {"SO3": [3, 0, 1, 2], "SE3": [0, 1, 2, 6, 3, 4, 5]}


def points(problem: Problem) -> Any:
    kind = getattr(peer("pypose"), problem.group)
    return kind(problem.control_points()[..., TO_PYPOSE[problem.group]].contiguous())


def grid(problem: Problem) -> Task:
    """`pypose.bspline`: SE(3), pose only, at even places in every segment."""
    pypose = peer("pypose")
    if problem.order != 4 or problem.batch or problem.group not in TO_PYPOSE:
        raise UnavailableError("one cubic of poses only")
    places = round(problem.queries / problem.segments)
    if places < 2:
        raise UnavailableError("two queries in every segment at least")
    problem = replace(problem, group="SE3", derivatives=0)
    X = points(problem)
    inner = torch.arange(0, 1, 1 / places, dtype=torch.float64)  # as it does
    times = (torch.arange(problem.segments, dtype=torch.float64)[:, None] + inner).flatten()
    times = DT * torch.cat([times, times.new_tensor([problem.segments])])

    def forward() -> Tensor:
        return pypose.bspline(X, 1 / places).tensor()

    if not problem.backward:
        return Task(
            forward,
            len(times),
            problem.threads,
            read=lambda x: arrays([x[..., FROM_PYPOSE["SE3"]]]),
            times=times,
        )
    X.requires_grad_()
    generator = torch.Generator().manual_seed(1)
    cotangent = torch.randn(len(times), 7, generator=generator, dtype=problem.real)
    return Task(lambda: torch.autograd.grad(forward(), X, cotangent), len(times), problem.threads)


def bracket(a: Tensor, b: Tensor) -> Tensor:
    if a.shape[-1] == 3:
        return torch.linalg.cross(a, b)
    (v, w), (x, y) = a.split(3, -1), b.split(3, -1)
    return torch.cat([torch.linalg.cross(w, x) + torch.linalg.cross(v, y), torch.linalg.cross(w, y)], -1)


def cubic(problem: Problem) -> Task:
    """[S20] (36), (41) with PyPose's Exp, Log, products and adjoints; logarithms once for each pair of neighbours."""
    pypose = peer("pypose")
    if problem.group not in TO_PYPOSE:
        raise UnavailableError("SO3 and SE3 only")
    if problem.order != 4:
        raise UnavailableError("order 4 only")
    X, t = points(problem), problem.times()
    algebra = {"SO3": pypose.so3, "SE3": pypose.se3}[problem.group]

    def forward() -> list[Tensor]:
        s = t / DT
        segment = s.detach().floor().clamp(0, problem.segments - 1).long()
        u = (s - segment).to(problem.real)
        weights = cumulative_weights(u, 4, problem.derivatives)
        logs = (X[..., :-1, :].Inv() * X[..., 1:, :]).Log().tensor()
        value, rates = X[..., segment, :], []
        for j in range(3):
            d = logs[..., segment + j, :]
            step = algebra(weights[0][j].unsqueeze(-1) * d).Exp()
            value = value * step
            moved = [step.Inv().Adj(algebra(rate)).tensor() for rate in rates]
            parts = [row[j].unsqueeze(-1) * d for row in weights[1:]]
            rates = [a + b for a, b in zip(moved, parts, strict=True)] if rates else parts
            if len(rates) > 1:
                rates[1] = rates[1] + bracket(rates[0], parts[0])
        return [value.tensor(), *(rate / DT ** (r + 1) for r, rate in enumerate(rates))]

    if not problem.backward:
        order = FROM_PYPOSE[problem.group]
        return Task(
            forward, problem.total, problem.threads, read=lambda x: arrays([x[0][..., order], *x[1:]])
        )
    X.requires_grad_()
    t.requires_grad_()
    cotangents = problem.cotangents()
    return Task(lambda: torch.autograd.grad(forward(), (X, t), cotangents), problem.total, problem.threads)
