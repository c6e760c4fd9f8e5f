"""Regularisation of splines by their own control points: differences of neighbours, or of the logarithms of these."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchspline.fit.solving.model import Model, State
from torchspline.fit.solving.system import Rows, System
from torchspline.fit.solving.terms import CHUNK
from torchspline.splines.bspline import BSpline

Array = NDArray[Any]


class Bends:
    """`weight (d_{j+1} - d_j)` of all neighbouring logarithms d, or `weight d_j` if there are but two control points.

    Bridges stretches without data: there the logarithms run from one value to the other at a steady pace.

    Args:
        weight: (D,), of each component.
        last: only those that begin before this control point; None for all.
    """

    def __init__(self, model: Model, weight: Array, last: int | None = None):
        spline = model.trajectory
        self.weight, self.module = weight, spline.module
        self.span = min(3, spline.count)
        first = np.arange(spline.count - self.span + 1)[:last]
        own = model.columns[id(spline.module)]
        self.columns = own[first[:, None] + np.arange(self.span)].reshape(len(first), -1)
        self.bases = np.ascontiguousarray(first[:, None].astype(np.int64))

    def __len__(self) -> int:
        return len(self.bases)

    def touched(self, state: State) -> Array:
        """Columns of the unknowns of each run."""
        return self.columns

    def cost_of(self, numbers: Mapping[int, torch.Tensor], given: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """The cost as differentiable operations."""
        group, points = self.module.group, numbers[id(self.module)]
        logs = group.log(group.between(points[:-1], points[1:], validate=False), validate=False)
        bends = logs.diff(dim=0) if self.span == 3 else logs
        return 0.5 * (bends * torch.from_numpy(self.weight)).square().sum()

    def add_to(self, system: System, state: State) -> None:
        """Add cost and normal equations."""
        system.add_all(self.linearize(state), state)

    def linearize(self, state: State) -> Iterator[tuple[float, Rows, Array]]:
        """Cost, rows and residuals, chunk by chunk."""
        assert state.local is not None
        D = len(self.weight)
        for begin in range(0, len(self), CHUNK):
            stop = min(begin + CHUNK, len(self))
            logs = state.local.logs
            bend = logs[begin + 1 : stop + 1] - logs[begin:stop] if self.span == 3 else logs[begin:stop]
            residual = self.weight * bend
            rows = np.zeros((stop - begin, D, self.span * D + 1))
            each = np.arange(D)
            rows[:, each, (self.span - 1) * D + each] = self.weight
            if self.span == 3:
                rows[:, each, D + each] = -self.weight
            rows[..., -1] = residual
            starts = np.arange(stop - begin + 1, dtype=np.int64)
            part = Rows(rows, starts, self.bases[begin:stop], self.columns[begin:stop], self.span)
            yield 0.5 * float(np.square(residual).sum()), part, residual


class Walk:
    """`weight (b_{j+1} - b_j)` of all neighbouring control points of a spline in R^n.

    Args:
        weight: (n,), of each component. last: only those that begin before this control point; None for all.
    """

    def __init__(self, model: Model, spline: BSpline, weight: Array, last: int | None = None):
        self.weight, self.module = weight, spline
        own = model.columns[id(spline)]
        first = np.arange(len(own) - 1)[:last]
        self.columns = own[first[:, None] + np.arange(2)].reshape(len(first), 2 * len(weight))

    def __len__(self) -> int:
        return len(self.columns)

    def touched(self, state: State) -> Array:
        """Columns of the unknowns of each run."""
        return self.columns

    def cost_of(self, numbers: Mapping[int, torch.Tensor], given: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """The cost as differentiable operations."""
        steps = numbers[id(self.module)].diff(dim=0)[: len(self)]
        return 0.5 * (steps * torch.from_numpy(self.weight)).square().sum()

    def add_to(self, system: System, state: State) -> None:
        """Add cost and normal equations."""
        assert state.chain is not None
        n = len(self.weight)
        steps = np.diff(state.points[id(self.module)], axis=0)[: len(self)]
        rows = np.zeros((len(steps), n, 2 * n + 1))
        each = np.arange(n)
        rows[:, each, each], rows[:, each, n + each] = -self.weight, self.weight
        rows[..., -1] = self.weight * steps
        system.cost += 0.5 * float(np.square(rows[..., -1]).sum())
        starts, bases = np.arange(len(steps) + 1, dtype=np.int64), np.empty((len(steps), 0), np.int64)
        system.add(Rows(rows, starts, bases, self.columns, 0), state.chain)
