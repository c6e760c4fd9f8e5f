"""Compiled loops over the times of a curve made of segments: where each falls is found in the same loop."""

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchspline.arithmetic.scalar import Scalar
from torchspline.kernels import emit
from torchspline.kernels.build import compiled
from torchspline.kernels.threads import SERIAL_BELOW, run, spans
from torchspline.kernels.trace import trace

Array = NDArray[Any]


class CurveKernel:
    """`function` at every time.

    Args:
        name: a Python name, unique to the function.
        function: what determines a segment, u (a vector of one number) and one over the segment's duration (likewise)
            to the components of all results, one flat sequence.
        columns: numbers that determine a segment. results: components of each result.
    """

    def __init__(
        self,
        name: str,
        function: Callable[..., Sequence[Scalar]],
        columns: int,
        results: Sequence[int],
        dtype: torch.dtype,
    ):
        self.columns, self.results, self.dtype = columns, list(results), dtype
        self.function = lambda u, inverse, row: function(row, u, inverse)
        self.real = np.float32 if dtype == torch.float32 else np.float64
        self.name = f"{name}_{self.real.__name__}"

    def __call__(
        self, table: Array, knots: Array, times: Array, ends: tuple[float, float], outputs: Sequence[Array]
    ) -> int:
        """Fill the outputs; how many times lie outside the ends. Arrays are flat; knots and times in float64."""
        kernel, count = self._kernel, len(times)
        outside = []

        def part(begin: int, stop: int) -> None:
            outside.append(kernel(table, knots, times, *ends, *outputs, begin, stop))

        parts = 1 if count < 2 * SERIAL_BELOW else torch.get_num_threads()
        run([partial(part, begin, stop) for begin, stop in spans(count, parts, emit.BLOCK)])
        return sum(outside)

    @cached_property
    def _kernel(self) -> Callable:
        numbers, doubles = f"{self.real.__name__}[::1]", "float64[::1]"
        arrays = ", ".join([numbers, doubles, doubles, "float64", "float64", *[numbers] * len(self.results)])
        return compiled(self.name, self.source(), f"({arrays}, int64, int64)")

    def source(self) -> str:
        """Straight-line code twice where the function has a far path: blocks that stay near take the short one."""
        sizes = [1, 1, self.columns]
        near = trace(self.function, sizes, self.dtype, near=True)
        far = trace(self.function, sizes, self.dtype) if near.guarded else None
        return emit.emit_curve(self.name, near, far, self.columns, self.results, self.dtype)
