"""The problems of [S20] 6.1: recorded ones, or made alike."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

import torchspline as ts
from torchspline.fit.problem import Problem
from torchspline.fit.residuals import StateAcceleration, StateValue, StateVelocity

RATES = {"vel": StateVelocity, "acc": StateAcceleration}


class Sequence(NamedTuple):
    """Control points to find, where to start, and exact measurements."""

    group: str
    order: int
    kind: str
    spacing: float
    start: Tensor
    value_times: Tensor
    values: Tensor
    rate_times: Tensor
    rates: Tensor

    def spline(self) -> ts.BSpline:
        return ts.BSpline(self.start, group=ts.Group(self.group), order=self.order, dt=self.spacing)

    def problem(self, spline: ts.BSpline) -> Problem:
        problem = Problem(spline)
        problem.add(StateValue(self.value_times, self.values))
        problem.add(RATES[self.kind](self.rate_times, self.rates))
        return problem


def read_sequence(folder: Path, group: str, order: int, kind: str) -> Sequence:
    """One of the twelve files."""
    with np.load(folder / f"{group}_k{order}_{kind}.npz", allow_pickle=False) as file:
        numbers = {name: torch.from_numpy(file[name]) for name in file.files}
    return Sequence(
        group, order, kind, float(numbers["dt"]), numbers["initial_control_points"], numbers["value_times"],
        numbers["values"], numbers["derivative_times"], numbers["derivatives"],
    )  # fmt: skip


def make_sequence(
    group: str, order: int, kind: str, seed: int, points: int = 100, per_interval: float = 20.2
) -> Sequence:
    """A random problem of the paper's kind: `points + order` control points 2 s apart, 25 values (for 100 points)."""
    generator = torch.Generator().manual_seed(seed)
    space, spacing, count = ts.Group(group), 2.0, points + order

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    steps = 0.4 * random(count, space.tangent_size)
    truth = [space.identity()]
    for step in steps[1:]:
        truth.append(space.retract(truth[-1], step, side="right", validate=False))
    control_points = torch.stack(truth)
    spline = ts.BSpline(control_points, group=space, order=order, dt=spacing, learnable=False)
    end = spline.domain[1]
    value_times = torch.linspace(0.0, end, max(points // 4, 2), dtype=torch.float64)
    rate_times = torch.linspace(0.0, end, round(per_interval * points), dtype=torch.float64)
    state = spline.evaluate(rate_times, 1 if kind == "vel" else 2)
    rates = state.velocity if kind == "vel" else state.acceleration
    assert rates is not None
    start = space.retract(control_points, 0.1 * random(count, space.tangent_size), validate=False)
    return Sequence(group, order, kind, spacing, start, value_times, spline(value_times), rate_times, rates)
