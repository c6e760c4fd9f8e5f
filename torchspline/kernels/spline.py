"""The compiled sweeps of a uniform cumulative B-spline: on NumPy arrays, flat, no autograd.

Symbols: B trajectories of M control points with P numbers and D dimensions, N times each, shared by all or not.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache, partial

import numpy as np
import torch

from torchspline.arithmetic.registry import arithmetic
from torchspline.kernels import emit, programs
from torchspline.kernels.build import compiled
from torchspline.kernels.rowwise import Array, RowKernel
from torchspline.kernels.threads import SERIAL_BELOW, run, spans
from torchspline.units import NANOSECOND

#: Queries a chunk of the reverse sweep. Chunks are summed in order whatever the number of threads, so that gradients
#: are the same to the last bit.
REVERSE_CHUNK = 16384


@dataclass(eq=False)  # not frozen: that makes them five times as slow to make
class Clock:
    """Times of all queries, flat, and the knots they refer to; seconds in float64 or whole nanoseconds."""

    times: Array
    shared: bool
    t0: float | int
    dt: float | int
    tolerance: float
    segments: int
    points: int
    trajectories: int

    @property
    def queries(self) -> int:
        return len(self.times) if self.shared else len(self.times) // max(self.trajectories, 1)

    def arguments(self) -> tuple:
        t0, dt = self.t0, self.dt
        return self.times, self.shared, t0, dt, self.tolerance, self.segments, self.points, self.queries

    def reach(self, begin: int, stop: int, order: int) -> tuple[int, int]:
        """First control point that queries `begin` to `stop` touch and one past the last, over all trajectories."""
        first, last = begin // self.queries, (stop - 1) // self.queries
        everything = first * self.points, (last + 1) * self.points
        if first < last:
            return everything
        offset = first * self.queries if self.shared else 0
        low, high = self.extent(begin - offset, stop - offset)
        if not np.isfinite(low + high):
            return everything
        start = min(max(int(low) - 1, 0), self.segments - 1)
        end = min(max(int(high) + 2, 1), self.segments) + order - 1
        return first * self.points + start, first * self.points + min(end, self.points)

    def extent(self, begin: int, stop: int) -> tuple[float, float]:
        """Where the times `begin` to `stop` lie, in knot spacings from the start; NaN where the loops overflow."""
        times = self.times[begin:stop]
        # Whole nanoseconds as Python's numbers: in float64 an epoch is off by more than a short spacing.
        low, high = (t.item() - self.t0 for t in (times.min(), times.max()))
        if times.dtype == np.int64 and max(abs(low), abs(high)) >= 2**63:
            return np.nan, np.nan
        return low / self.dt, high / self.dt


@dataclass(eq=False)
class Places(Clock):
    """Pairs in float64 of a place in a segment, u, and the segment, instead of times; with t0 = 0 and dt = 1 all
    derivatives are by u."""

    @property
    def queries(self) -> int:
        return super().queries // 2

    def extent(self, begin: int, stop: int) -> tuple[float, float]:
        segments = self.times[2 * begin + 1 : 2 * stop : 2]
        return segments.min(), segments.max()


@dataclass(eq=False)
class Pairs:
    """What control points alone determine: unit points of continuous sign and logarithms of neighbours, flat."""

    unit: Array
    logs: Array


class SplineKernels:
    """Kernels of one group, order, number of derivatives, precision and kind of time; compiled when first used."""

    def __init__(
        self,
        group: str,
        rows: Sequence[Sequence[Fraction]],
        derivatives: int,
        dtype: torch.dtype,
        nanoseconds: bool | None,
    ):
        """`nanoseconds`: whether times are; None: for `Places`."""
        self.group, self.rows, self.derivatives = arithmetic(group), rows, derivatives
        self.dtype, self.nanoseconds = dtype, nanoseconds
        self.real = np.float32 if dtype == torch.float32 else np.float64
        self.order = len(rows) + 1
        #: Components of the value and of each rate.
        self.result_sizes = [self.group.point_size, *[self.group.tangent_size] * derivatives]

    # ------------------------------------------------------------------ forward

    def pairs(self, stored: Array, trajectories: int, points: int) -> tuple[Pairs, int]:
        """Once for every pair of neighbours; and how many control points are not valid points."""
        total = trajectories * points
        unit = np.empty(total * self.group.point_size, self.real)
        logs = np.empty(total * self.group.tangent_size, self.real)
        bad = self._pairs(stored, points, unit, logs, 0, total)
        return Pairs(unit, logs), bad

    def results(self, shape: tuple[int, ...]) -> list[Array]:
        """Room for what `forward` fills, `(*shape, P or D)`."""
        return [np.empty((*shape, size), self.real) for size in self.result_sizes]

    def forward(self, pairs: Pairs, clock: Clock, outputs: Sequence[Array]) -> int:
        """Fill value and rates (per second); how many times lie outside the domain."""
        total = clock.trajectories * clock.queries
        arguments = (*clock.arguments(), self._scale(clock), *outputs)
        function = self._forward
        if 0 < total < 2 * SERIAL_BELOW:  # also without what follows, which counts when there are few
            return function(pairs.unit, pairs.logs, *arguments, 0, total)
        outside = []

        def part(begin: int, stop: int) -> None:
            outside.append(function(pairs.unit, pairs.logs, *arguments, begin, stop))

        parts = torch.get_num_threads()
        run([partial(part, begin, stop) for begin, stop in spans(total, parts, emit.BLOCK)])
        return sum(outside)

    # ------------------------------------------------------------------ reverse

    def reverse(
        self,
        stored: Array,
        pairs: Pairs,
        clock: Clock,
        value: Array,
        value_g: Array,
        rates_g: Sequence[Array],
    ) -> tuple[Array, Array]:
        """Gradients of the stored control points and of the place u in a segment of every query."""
        P, D = self.group.point_size, self.group.tangent_size
        total, points = clock.trajectories * clock.queries, clock.trajectories * clock.points
        u_g = np.empty(total, self.real)
        start_g, logs_g = np.zeros(points * D, self.real), np.zeros(points * D, self.real)
        arguments = (*clock.arguments(), self._scale(clock), value, value_g, *rates_g)
        function = self._reverse

        def chunk(begin: int, stop: int, first: int, start: Array, logs: Array) -> None:
            function(pairs.logs, *arguments, first, start, logs, u_g, begin, stop)

        chunks = spans(total, _chunk_count(total, points), emit.BLOCK)
        if len(chunks) == 1:
            chunk(0, total, 0, start_g, logs_g)
        else:
            reaches = [clock.reach(begin, stop, self.order) for begin, stop in chunks]
            sums = [np.zeros((2, (last - first) * D), self.real) for first, last in reaches]
            run(
                [
                    partial(chunk, begin, stop, first, part[0], part[1])
                    for (begin, stop), (first, _), part in zip(chunks, reaches, sums, strict=True)
                ]
            )
            for (first, last), part in zip(reaches, sums, strict=True):
                for whole, share in ((start_g, part[0]), (logs_g, part[1])):
                    here = whole[first * D : last * D]
                    np.add(here, share, out=here)
        return self._to_stored(stored, pairs, clock, start_g, logs_g, P, D), u_g

    def _to_stored(
        self, stored: Array, pairs: Pairs, clock: Clock, start_g: Array, logs_g: Array, P: int, D: int
    ) -> Array:
        """Through the logarithms of neighbours to body cotangents, and from those to stored numbers."""
        points = clock.trajectories * clock.points
        second, first = np.empty(points * D, self.real), np.empty(points * D, self.real)
        self._pairs_reverse([pairs.logs, logs_g], [second, first], points)
        body = start_g.reshape(clock.trajectories, clock.points, D)
        for here, share in ((body[:, 1:], second), (body[:, :-1], first)):
            np.add(here, share.reshape(body.shape)[:, :-1], out=here)
        gradient = np.empty(points * P, self.real)
        self._embed([stored, start_g], [gradient], points)
        return gradient

    def _scale(self, clock: Clock) -> Array:
        return _scale(clock.dt * NANOSECOND if self.nanoseconds else clock.dt, self.derivatives, self.real)

    # ------------------------------------------------------------------ compilation

    def _types(self, *kinds: str) -> str:
        """A Numba signature from a letter an argument: r array of reals, t array of times, s a time, b i f scalars."""
        real = self.real.__name__
        time = "int64" if self.nanoseconds else "float64"
        letters = {
            "r": f"{real}[::1]",
            "t": f"{time}[::1]",
            "s": time,
            "b": "boolean",
            "i": "int64",
            "f": "float64",
        }
        return f"({', '.join(letters[letter] for letter in ''.join(kinds))})"

    def _name(self, kind: str) -> str:
        return f"{kind}_{self.group.name}_k{self.order}_d{self.derivatives}_{self.real.__name__}"

    @cached_property
    def _pairs(self) -> Callable:
        group, name = self.group, f"pairs_{self.group.name}_{self.real.__name__}"
        program = programs.pairs_program(group, self.dtype)
        source = emit.emit_pairs(
            name, program, group.point_size, group.tangent_size, group.sign_blocks, self.dtype
        )
        return compiled(name, source, self._types("rirr", "ii"))

    @cached_property
    def _pairs_reverse(self) -> RowKernel:
        group, D = self.group, self.group.tangent_size
        name = f"pairs_reverse_{group.name}"
        return RowKernel(name, partial(programs.pairs_reverse, group), [D, D], [D, D], self.dtype)

    @cached_property
    def _embed(self) -> RowKernel:
        group, P, D = self.group, self.group.point_size, self.group.tangent_size
        return RowKernel(f"embed_{group.name}", group.embed, [P, D], [P], self.dtype)

    @cached_property
    def _forward(self) -> Callable:
        return compiled(
            self._name("forward"),
            self.forward_source(),
            self._types("rrtbssfiii", "r", "r" * (self.derivatives + 1), "ii"),
        )

    @cached_property
    def _reverse(self) -> Callable:
        arguments = self._types("rtbssfiii", "r", "rr", "r" * self.derivatives, "i", "rrr", "ii")
        return compiled(self._name("reverse"), self.reverse_source(), arguments)

    def forward_source(self) -> str:
        program = programs.forward_program(self.group, self.rows, self.derivatives, self.dtype)
        return emit.emit_forward(self._name("forward"), program, self._layout())

    def reverse_source(self) -> str:
        program = programs.reverse_program(self.group, self.rows, self.derivatives, self.dtype)
        return emit.emit_reverse(self._name("reverse"), program, self._layout())

    def _layout(self) -> emit.SplineLayout:
        group = self.group
        return emit.SplineLayout(
            group.point_size,
            group.tangent_size,
            self.order - 1,
            self.derivatives,
            self.dtype,
            self.nanoseconds,
        )


@lru_cache(256)
def _scale(seconds: float, derivatives: int, real: type) -> Array:
    """1/dt, 1/dt^2, ...: only read."""
    return np.array([seconds ** -(r + 1) for r in range(derivatives)], dtype=real)


def _chunk_count(total: int, points: int) -> int:
    """How many pieces of the reverse sweep, from sizes alone; sums of unsorted times may need all points each."""
    return max(1, min(total // REVERSE_CHUNK, 4 * total // max(points, 1), 256))
