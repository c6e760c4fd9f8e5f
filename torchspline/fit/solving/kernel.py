"""Residuals and the rows of their Jacobians, for all measurements at once: compiled loops or tensor operations."""

from collections.abc import Sequence
from functools import cache, cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline.arithmetic.registry import arithmetic
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector, is_zero, zero
from torchspline.fit.residual import Moment, Residual
from torchspline.groups.components import join, split
from torchspline.kernels.rowwise import RowKernel

Array = NDArray[Any]


class ResidualKernel:
    """A kind of residual on one group.

    Args:
        kind: its class. group: of the trajectory. given: its arguments as (slot, whether every measurement has its
            own); the others take their defaults.
    """

    def __init__(self, kind: type[Residual], group: str, given: tuple[tuple[str, bool], ...]):
        self.kind, self.group = kind, arithmetic(group)
        #: Arguments of which each measurement has its own come before those shared by all.
        self.order = [slot for slot, own in given if own] + [slot for slot, own in given if not own]
        self.own = sum(own for _, own in given)
        # A method that overrides nothing is called without an instance: kinds keep their numbers in the arguments.
        self._residual = kind.__new__(kind)
        P, D = self.group.point_size, self.group.tangent_size
        self.moment_sizes = [P, *[D] * kind.derivatives]
        self.slot_sizes = [kind.slots[slot].size for slot in self.order]
        self.rows, measured = kind.sizes(self.group)
        self.sizes = [*self.moment_sizes * kind.moments, measured, *self.slot_sizes[: self.own]]
        #: For each moment which parts of its state (value, velocity, ...) the residual depends on.
        self.parts = self._parts()
        counts = [D * sum(parts) for parts in self.parts]
        self.results = [self.rows, *(self.rows * c for c in counts)]
        self.results += [self.rows * self._cotangent_size(slot) for slot in self.order]

    def _cotangent_size(self, slot: str) -> int:
        size, group, _ = self.kind.slots[slot]
        return size if group is None else arithmetic(group).tangent_size

    # ------------------------------------------------------------------ on components

    def _arguments(self, vectors: Sequence[Vector]) -> tuple[list[Moment], dict[str, Vector], Vector]:
        """Moments, given arguments with defaults filled in, and the measurement."""
        per = len(self.moment_sizes)
        moments = [
            Moment(vectors[m * per], tuple(vectors[m * per + 1 : (m + 1) * per]))
            for m in range(self.kind.moments)
        ]
        measured, *slots = vectors[self.kind.moments * per :]
        given = {slot: default for slot, (_, _, default) in self.kind.slots.items() if default is not None}
        for slot, x in zip(self.order, slots, strict=True):
            group = self.kind.slots[slot].group
            given[slot] = x if group is None else arithmetic(group).normalize(x)
        return moments, given, measured

    def residual(self, *vectors: Vector) -> Vector:
        """The residual on components: states, measurement and arguments in the order of `sizes`, shared ones last."""
        moments, given, measured = self._arguments(vectors)
        return self._residual.evaluate(self.group, moments, given, measured)

    def _rows(self, vectors: Sequence[Vector]) -> tuple[Vector, list[tuple[list[Moment], dict[str, Vector]]]]:
        moments, given, measured = self._arguments(vectors)
        R = self.rows
        residual = self._residual.evaluate(self.group, moments, given, measured)
        unit = [tuple(float(i == r) for i in range(R)) for r in range(R)]
        return residual, [self._residual.reverse(self.group, moments, given, measured, e) for e in unit]

    def _parts(self) -> list[tuple[bool, ...]]:
        """Found by running on numbers that are not known to be zero."""
        sizes = self.sizes + self.slot_sizes[self.own :]
        vectors = [tuple(torch.full((), 0.5 + 0.1 * i) for i in range(size)) for size in sizes]
        _, rows = self._rows(vectors)
        parts = []
        for m in range(self.kind.moments):
            states = [(moments[m].value, *moments[m].rates) for moments, _ in rows]
            used = [any(not is_zero(state[r]) for state in states) for r in range(1 + self.kind.derivatives)]
            while len(used) > 1 and not used[-1]:
                used.pop()
            parts.append(tuple(used))
        return parts

    def _linearized(self, *vectors: Vector) -> list[Scalar]:
        """All results in a row: the residual, for each moment the cotangents of each row, the same for arguments."""
        residual, rows = self._rows(vectors)
        results = list(residual)
        for m, parts in enumerate(self.parts):
            for moments, _ in rows:
                state = (moments[m].value, *moments[m].rates)
                results += [c for v, part in zip(state, parts, strict=False) if part for c in v]
        for slot in self.order:
            missing = zero(self._cotangent_size(slot))
            results += [c for _, cotangents in rows for c in cotangents.get(slot, missing)]
        return results

    # ------------------------------------------------------------------ on arrays

    @cached_property
    def _compiled(self) -> RowKernel:
        marks = "".join(f"_{slot}{'s' if i < self.own else ''}" for i, slot in enumerate(self.order))
        name = f"residual_{self.kind.__name__}_{self.group.name}{marks}"
        shared = self.slot_sizes[self.own :]
        return RowKernel(name, self._linearized, self.sizes, self.results, torch.float64, shared=shared)

    def linearize(self, arrays: Sequence[Array], fused: bool) -> list[Array]:
        """Residual `(N, R)`, cotangents of states `(N, R, C)` for each moment, of arguments `(N, R, c)`.

        Args:
            arrays: (N, size) for each of `sizes`, then (size,) for each shared argument.
        """
        N, R = arrays[0].shape[0], self.rows
        if fused and self.kind.compiled:
            outputs = [np.empty((N, size)) for size in self.results]
            flat = [np.ascontiguousarray(x).reshape(-1) for x in arrays]
            self._compiled(flat, [x.reshape(-1) for x in outputs], N)
        else:
            tensors = [torch.from_numpy(np.ascontiguousarray(x)) for x in arrays]
            like = tensors[0][:, :0]
            flat_results = join(tuple(self._linearized(*map(split, tensors))), like).numpy()
            outputs = np.split(flat_results, np.cumsum(self.results)[:-1], axis=1)
        return [outputs[0], *(x.reshape(N, R, -1) for x in outputs[1:])]

    def on_tensors(self, *tensors: Tensor) -> Tensor:
        """The residual `(N, R)` as differentiable operations."""
        return join(self.residual(*map(split, tensors)), tensors[0][..., :0])


@cache
def kernel_of(kind: type[Residual], group: str, given: tuple[tuple[str, bool], ...]) -> ResidualKernel:
    """One for each combination in a process."""
    return ResidualKernel(kind, group, given)
