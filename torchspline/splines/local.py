"""A uniform B-spline as least squares sees it: states at places, and Jacobians in local coordinates.

Everything is a NumPy array. Control points move by body tangents, `X_j Exp(x_j)`. A query at place (base, u) depends on
the control points base ... base + k - 1, and its Jacobian comes in local coordinates first: the body tangent of control
point `base`, then the k - 1 logarithms of neighbours. The reverse sweep of `arithmetic/recurrence.py`, run once for
each row, gives them in O(k): [S20] Theorems 5.4-5.6, transposed, for any group.

Symbols: N queries, R rows a query, P numbers of a point, D of a tangent, k order, M control points in all.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline.arithmetic.recurrence import difference_tangent, forward, reverse
from torchspline.arithmetic.registry import arithmetic
from torchspline.arithmetic.vector import scale, zero
from torchspline.groups.components import join, split
from torchspline.kernels.assemble import fast, to_each_point
from torchspline.kernels.linearize import LinearizeKernels
from torchspline.kernels.mode import RefusedError, usable
from torchspline.kernels.programs import retraction
from torchspline.kernels.spline import SplineKernels
from torchspline.splines.basis import cumulative_matrix, cumulative_weights
from torchspline.splines.sweep import continue_signs, first, second

Array = NDArray[Any]


@dataclass(frozen=True)
class Local:
    """What one set of control points determines, once for all queries."""

    #: Unit points (M, P) of continuous sign and logarithms of neighbours (M, D); the last of a trajectory is not used.
    unit: Array
    logs: Array


class LocalSpline:
    """Uniform B-splines of one group and order, all of the same number of control points.

    Args:
        spacing: knot spacing, s. points: control points of each trajectory.
    """

    def __init__(
        self, group: str, order: int, spacing: float, points: int, dtype: torch.dtype = torch.float64
    ):
        self.name, self.group, self.order, self.points = group, arithmetic(group), order, points
        self.spacing, self.dtype = spacing, dtype
        self.real = np.float32 if dtype == torch.float32 else np.float64
        self.fused = usable()
        self.width = order * self.group.tangent_size
        self._kernels = _kernels(group, order, dtype)
        self._scales = np.array([spacing ** -(r + 1) for r in range(4)], self.real)

    def at(self, control_points: Array) -> Local:
        """Logarithms of neighbours of stored control points `(M, P)`."""
        P, D = self.group.point_size, self.group.tangent_size
        if self.fused:
            pairs, bad = _pair_kernels(self.name, self.order, self.dtype).pairs(
                control_points.reshape(-1), len(control_points) // self.points, self.points
            )
            if bad:
                raise RefusedError
            return Local(pairs.unit.reshape(-1, P), pairs.logs.reshape(-1, D))
        stored = torch.from_numpy(control_points).reshape(-1, self.points, P)
        points = self.group.normalize(split(stored))
        between = self.group.between(first(points), second(points))
        signed = continue_signs(self.group, points, between)
        unit, logs = join(signed, stored[..., :0]), join(self.group.log(between), stored[:, 1:, :0])
        logs = torch.nn.functional.pad(logs, (0, 0, 0, 1))
        return Local(unit.reshape(-1, P).numpy(), logs.reshape(-1, D).numpy())

    def evaluate(self, local: Local, base: Array, u: Array, derivatives: int) -> list[Array]:
        """Value `(N, P)` and rates `(N, D)` per second."""
        if self.fused:
            sizes = [self.group.point_size, *[self.group.tangent_size] * derivatives]
            outputs = [np.empty((len(u), size), self.real) for size in sizes]
            flat = [x.reshape(-1) for x in outputs]
            numbers = local.unit.reshape(-1), local.logs.reshape(-1)
            self._kernels.evaluate(*numbers, base, u, self._scales[:derivatives], flat)
            return outputs
        at = torch.from_numpy(base)
        steps, weights = (
            self._steps(local, at),
            cumulative_weights(torch.from_numpy(u), self.order, derivatives),
        )
        value, trace = forward(
            self.group, split(torch.from_numpy(local.unit)[at]), steps, weights, derivatives, short=True
        )
        like = torch.from_numpy(local.unit)[at][:, :0]
        states = [join(value, like), *(join(rate, like) for rate in trace[-1].rates)]
        return [x.numpy() / self.spacing**r for r, x in enumerate(states)]

    def rows(
        self,
        local: Local,
        base: Array,
        u: Array,
        cotangents: Array,
        parts: tuple[bool, ...],
        out: Array | None = None,
        offset: int = 0,
    ) -> Array:
        """Rows `(N, R, k D)` of a Jacobian in local coordinates.

        Args:
            cotangents: (N, R, C), for each row the factors of the state's changes: body tangent of the value,
                changes of the rates, those of the `parts` that are True side by side.
            out: an array (N, R, W) in row-major order, whose k D columns from `offset` on are then filled.
        """
        count = cotangents.shape[1]
        if out is None:
            out = np.empty((len(u), count, self.width), self.real)
        if self.fused:
            cotangents = np.ascontiguousarray(cotangents, self.real).reshape(-1)
            scales = self._scales[: len(parts) - 1]
            self._kernels.rows_of(
                local.logs.reshape(-1),
                base,
                u,
                scales,
                cotangents,
                parts,
                out.reshape(-1)[offset:],
                count,
                out.shape[2],
            )
            return out
        at, derivatives = torch.from_numpy(base), len(parts) - 1
        steps = [tuple(c.unsqueeze(-1) for c in step) for step in self._steps(local, at)]
        weights = [
            [w.unsqueeze(-1) for w in row]
            for row in cumulative_weights(torch.from_numpy(u), self.order, derivatives)
        ]
        identity = self.group.identity()
        start = tuple(torch.full((len(u), 1), x, dtype=self.dtype) for x in identity)
        _, trace = forward(self.group, start, steps, weights, derivatives, short=True)
        D, given = self.group.tangent_size, iter(np.split(cotangents, sum(parts), axis=-1))
        value_g, *rates_g = (split(torch.from_numpy(next(given))) if part else zero(D) for part in parts)
        scaled = [scale(float(s), g) for s, g in zip(self._scales, rates_g, strict=False)]
        start_g, steps_g, _ = reverse(self.group, steps, weights, trace, value_g, scaled, short=True)
        like = torch.empty((len(u), count, 0), dtype=self.dtype)
        for j, g in enumerate((start_g, *steps_g)):
            out[..., offset + j * D : offset + (j + 1) * D] = join(g, like).numpy()
        return out

    def pair_jacobians(self, local: Local) -> Array:
        """`(M, 2, D, D)`: how each logarithm moves with the first and with the second control point of its pair."""
        D = self.group.tangent_size
        if self.fused:
            result = np.empty((len(local.logs), 2, D, D), self.real)
            self._kernels.pair_jacobians([local.logs.reshape(-1)], [result.reshape(-1)], len(local.logs))
            return result
        logs = torch.from_numpy(local.logs).unsqueeze(1).expand(-1, D, -1)
        unit = torch.eye(D, dtype=self.dtype).expand_as(logs)
        still = zero(D)
        columns = [
            join(difference_tangent(self.group, split(logs), *rates), logs)
            for rates in ((split(unit), still), (still, split(unit)))
        ]
        return torch.stack(columns, dim=1).mT.contiguous().numpy()

    def to_points(self, rows: Array, chain: Array, start: Array, base: Array) -> Array:
        """From local coordinates to control points: rows `(N, R, k D)` to `(N, k, R, D)`.

        Args:
            chain: of `pair_jacobians`, (M, 2, D, D). start: (M, D, D), how each control point itself counts. Both may
                carry whatever the columns shall be multiplied by on the right.
        """
        N, R, _ = rows.shape
        D, k = self.group.tangent_size, self.order
        result = np.empty((N, k, R, D), self.real)
        if self.fused and self.real is np.float64:
            fast(to_each_point)(rows, base, chain, start, k, D, result)
            return result
        blocks = rows[..., : k * D].reshape(N, R, k, D)
        result[:, 0] = blocks[:, :, 0] @ start[base]
        for j in range(1, k):
            to_first, to_second = chain[base + (j - 1)].transpose(1, 0, 2, 3)
            result[:, j - 1] += blocks[:, :, j] @ to_first
            result[:, j] = blocks[:, :, j] @ to_second
        return result

    def retract(self, control_points: Array, tangents: Array) -> Array:
        """`X_j Exp(x_j)` of points `(M, P)` and tangents `(M, D)`."""
        if self.fused:
            result = np.empty_like(control_points)
            flat = (control_points.reshape(-1), np.ascontiguousarray(tangents).reshape(-1))
            self._kernels.retract(flat, [result.reshape(-1)], len(result))
            return result
        pair = (split(torch.from_numpy(x)) for x in (control_points, tangents))
        return join(retraction(self.group, *pair), torch.from_numpy(control_points[:, :0])).numpy()

    def _steps(self, local: Local, at: Tensor) -> list[tuple]:
        logs = torch.from_numpy(local.logs)
        return [split(logs[at + j]) for j in range(self.order - 1)]


@cache
def _kernels(group: str, order: int, dtype: torch.dtype) -> LinearizeKernels:
    return LinearizeKernels(group, cumulative_matrix(order)[1:], dtype)


@cache
def _pair_kernels(group: str, order: int, dtype: torch.dtype) -> SplineKernels:
    return SplineKernels(group, cumulative_matrix(order)[1:], 0, dtype, False)
