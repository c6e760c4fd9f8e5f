"""The compiled sweeps that least squares on a spline is made of: on flat NumPy arrays, at places known already.

A place is the index of the first control point a query touches and the position u in its segment. Jacobians are in
local coordinates: body tangent of the first control point, then the order - 1 logarithms of neighbours. How those
move with the control points is a property of pairs, not of queries.

Symbols: N queries, R rows a query, P numbers of a point, D of a tangent, k order.
"""

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cached_property, partial

import numpy as np
import torch

from torchspline.arithmetic.registry import arithmetic
from torchspline.kernels import emit, programs
from torchspline.kernels.build import compiled
from torchspline.kernels.emit import Access
from torchspline.kernels.rowwise import Array, RowKernel
from torchspline.kernels.threads import SERIAL_BELOW, run, spans

_LETTERS = {"i": "int64[::1]", "n": "int64"}


class LinearizeKernels:
    """Kernels of one group, order and precision; compiled when first used."""

    def __init__(self, group: str, rows: Sequence[Sequence[Fraction]], dtype: torch.dtype):
        self.group, self.rows, self.dtype = arithmetic(group), rows, dtype
        self.order = len(rows) + 1
        self.real = np.float32 if dtype == torch.float32 else np.float64
        self._functions: dict[str, Callable] = {}

    def evaluate(
        self, unit: Array, logs: Array, base: Array, u: Array, scale: Array, outputs: Sequence[Array]
    ) -> None:
        """Fill value `(N, P)` and as many rates `(N, D)` as `scale` has factors, all flat."""
        function = self._forward(len(outputs) - 1)
        _spread(function, (unit, logs, base, u, scale, *outputs), len(u))

    def rows_of(
        self,
        logs: Array,
        base: Array,
        u: Array,
        scale: Array,
        cotangents: Array,
        parts: tuple[bool, ...],
        out: Array,
        count: int,
        stride: int,
    ) -> None:
        """Row r of query n, `out[(n R + r) stride:][: k D]`, is the Jacobian of cotangents[n, r] . state.

        Args:
            cotangents: (N, R, D for each of the `parts` that is True), flat; of the value in its body frame, of the
                rates per second. count: R.
        """
        function = self._row(parts)
        _spread(function, (logs, base, u, scale, cotangents, out, count, stride), len(u) * count)

    @cached_property
    def pair_jacobians(self) -> RowKernel:
        """From logarithms to (2, D, D): how they move with the first and with the second of their pair."""
        D = self.group.tangent_size
        name = f"pair_jacobian_{self.group.name}"
        return RowKernel(name, partial(programs.pair_jacobian, self.group), [D], [2 * D * D], self.dtype)

    @cached_property
    def retract(self) -> RowKernel:
        """From points and body tangents to points."""
        P, D = self.group.point_size, self.group.tangent_size
        name = f"retract_{self.group.name}"
        return RowKernel(name, partial(programs.retraction, self.group), [P, D], [P], self.dtype)

    # ------------------------------------------------------------------ compilation

    def _forward(self, derivatives: int) -> Callable:
        name = f"place_{self.group.name}_k{self.order}_d{derivatives}_{self.real.__name__}"
        if name not in self._functions:
            P, D, count = self.group.point_size, self.group.tangent_size, self.order - 1
            rates = [f"rate{r}" for r in range(derivatives)]
            source = emit.emit_placed(
                name,
                programs.forward_program(self.group, self.rows, derivatives, self.dtype),
                ["unit", "logs", "base", "u", "scale", "value", *rates],
                ["place = base[item]"],
                [
                    Access("u", "item", 1),
                    Access("unit", f"place * {P}", P),
                    Access("logs", f"place * {D}", count * D),
                ],
                [Access("scale", "0", derivatives)],
                [Access("value", f"item * {P}", P), *(Access(rate, f"item * {D}", D) for rate in rates)],
                self.dtype,
            )
            self._functions[name] = compiled(name, source, self._types("rrirrr" + "r" * derivatives + "nn"))
        return self._functions[name]

    def _row(self, parts: tuple[bool, ...]) -> Callable:
        asked = "".join(str(int(part)) for part in parts)
        name = f"row_{self.group.name}_k{self.order}_{asked}_{self.real.__name__}"
        if name not in self._functions:
            D, count = self.group.tangent_size, self.order - 1
            given = sum(parts) * D
            source = emit.emit_placed(
                name,
                programs.row_program(self.group, self.rows, parts, self.dtype),
                ["logs", "base", "u", "scale", "cotangents", "out", "count", "stride"],
                ["query = item // count", "place = base[query]"],
                [
                    Access("u", "query", 1),
                    Access("logs", f"place * {D}", count * D),
                    Access("cotangents", f"item * {given}", given),
                ],
                [Access("scale", "0", len(parts) - 1)],
                [Access("out", "item * stride", (count + 1) * D)],
                self.dtype,
            )
            self._functions[name] = compiled(name, source, self._types("rirrrrnnnn"))
        return self._functions[name]

    def _types(self, letters: str) -> str:
        """A Numba signature: r array of reals, i array of indices, n a whole number."""
        real = f"{self.real.__name__}[::1]"
        return f"({', '.join(_LETTERS.get(letter, real) for letter in letters)})"


def _spread(function: Callable, arguments: tuple, items: int) -> None:
    """Over several threads if there are many items."""
    parts = torch.get_num_threads() if items >= 2 * SERIAL_BELOW else 1
    run([partial(function, *arguments, begin, stop) for begin, stop in spans(items, parts, emit.BLOCK)])
