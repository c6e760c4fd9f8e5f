"""Compiled loops over the rows of large tensors: the group operations and their reverses."""

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector
from torchspline.kernels import emit
from torchspline.kernels.build import compiled
from torchspline.kernels.threads import SERIAL_BELOW, run, spans
from torchspline.kernels.trace import indicator, trace

Array = NDArray[Any]


class RowKernel:
    """`function` on every row of its arguments.

    Args:
        name: a Python name, unique to the function.
        function: components of the arguments to components of the result, one flat sequence.
        sizes: components of each argument. results: of each output.
        valid: components of the arguments to the condition under which a row is accepted; None accepts all.
        shared: components of further arguments, each one row that all rows share.
    """

    def __init__(
        self,
        name: str,
        function: Callable[..., Sequence[Scalar]],
        sizes: Sequence[int],
        results: Sequence[int],
        dtype: torch.dtype,
        valid: Callable[..., Scalar] | None = None,
        shared: Sequence[int] = (),
    ):
        self.function, self.sizes, self.results = function, list(sizes), list(results)
        self.shared = list(shared)
        self.dtype, self.valid = dtype, valid
        self.real = np.float32 if dtype == torch.float32 else np.float64
        self.name = f"{name}_{self.real.__name__}"

    def __call__(self, arguments: Sequence[Array], outputs: Sequence[Array], rows: int) -> int:
        """Fill the outputs; how many rows were refused. Arrays are flat."""
        kernel = self._kernel
        if rows < 2 * SERIAL_BELOW:
            return kernel(*arguments, *outputs, 0, rows)
        refused = []

        def part(begin: int, stop: int) -> None:
            refused.append(kernel(*arguments, *outputs, begin, stop))

        parts = torch.get_num_threads()
        run([partial(part, begin, stop) for begin, stop in spans(rows, parts, emit.BLOCK)])
        return sum(refused)

    @cached_property
    def _kernel(self) -> Callable:
        sizes = self.sizes + self.shared
        arrays = ", ".join([f"{self.real.__name__}[::1]"] * (len(sizes) + len(self.results)))
        return compiled(self.name, self.source(), f"({arrays}, int64, int64)")

    def source(self) -> str:
        """Straight-line code twice where the function has a far path: blocks that stay near take the short one."""

        def with_verdict(*arguments: Vector) -> list[Scalar]:
            results = list(self.function(*arguments))
            refused = 0.0 if self.valid is None else 1.0 - indicator(self.valid(*arguments))
            return [*results, refused]

        sizes = self.sizes + self.shared
        near = trace(with_verdict, sizes, self.dtype, near=True)
        far = trace(with_verdict, sizes, self.dtype) if near.guarded else None
        return emit.emit_rows(self.name, near, far, self.sizes, self.shared, self.results, self.dtype)
