"""One compiled loop for curves made of segments: it finds where each time falls, reads that segment's row of the table
and evaluates."""

from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from torch import Tensor

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.registry import arithmetic
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector, scale
from torchspline.groups.group import Group
from torchspline.groups.operations import FUSED_ROWS
from torchspline.kernels.curve import CurveKernel
from torchspline.kernels.mode import flat, usable
from torchspline.kernels.trace import trace

#: Most operations of a curve that is compiled.
LONGEST = 2000
#: From a row of the table, u within [0, 1] and a number of derivatives to the value and so many rates by u, on
#: components; hashable, and the same object for the same curve, as kernels are kept by it.
Components = Callable[[GroupArithmetic, Vector, Scalar, int], list[Vector]]


def located(
    components: Components, group: Group, table: Tensor, t: Tensor, times: Tensor, derivatives: int
) -> list[Tensor] | None:
    """Value and rates per second of one curve at times (N,) between knots at `times`, both in float64 seconds.

    None where no loop serves the call (gradients, batches, few times, too long a code), or a time lies outside.
    """
    given = (table, t, times)
    if table.ndim != 2 or t.ndim != 1 or t.dtype != torch.float64 or times.dtype == torch.int64:
        return None
    if t.numel() < FUSED_ROWS or torch.compiler.is_compiling() or not usable(*given):
        return None
    if torch.is_grad_enabled() and any(x.requires_grad for x in given):
        return None
    kernel = located_kernel(components, group.name, table.shape[-1], derivatives, table.dtype)
    if kernel is None:
        return None
    knots = flat(times.to(torch.float64))
    outputs = [table.new_empty(t.shape[0], size) for size in kernel.results]
    outside = kernel(flat(table), knots, flat(t), bounds(knots), [flat(x) for x in outputs])
    return None if outside else outputs


@cache
def located_kernel(
    components: Components, group: str, columns: int, derivatives: int, dtype: torch.dtype
) -> CurveKernel | None:
    """The curve on its table, compiled; None if that would be too long a code."""
    algebra = arithmetic(group)

    def run(row: Vector, u: Vector, inverse: Vector) -> list[Scalar]:
        value, *rates = components(algebra, row, u[0], derivatives)
        results, factor = list(value), inverse[0]
        for rate in rates:
            results += scale(factor, rate)
            factor = factor * inverse[0]
        return results

    if len(trace(run, [columns, 1, 1], dtype, near=True).operations) > LONGEST:
        return None
    results = [algebra.point_size, *[algebra.tangent_size] * derivatives]
    return CurveKernel(f"curve_{group}_{columns}_d{derivatives}", run, columns, results, dtype)


def bounds(knots: Any) -> tuple[float, float]:
    """First and last time that belong to knots (an array of float64), a few rounding errors beyond the ends."""
    start, end = float(knots[0]), float(knots[-1])
    slack = rounding(torch.float64) * (max(abs(start), abs(end)) + end - start)
    return start - slack, end + slack


def rounding(dtype: torch.dtype) -> float:
    """A few rounding errors of times, in shares of the largest."""
    return 8.0 * torch.finfo(torch.float32 if dtype == torch.float32 else torch.float64).eps
