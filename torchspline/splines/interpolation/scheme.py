"""What an interpolation scheme has to say; a new one is a module beside this one and a line in `registry.py`."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from torchspline.arithmetic import jet
from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.jet import Jet
from torchspline.arithmetic.registry import arithmetic
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector
from torchspline.groups.components import join, split
from torchspline.groups.group import Group
from torchspline.groups.operations import FUSED_ROWS
from torchspline.kernels.mode import flat, usable
from torchspline.kernels.rowwise import RowKernel
from torchspline.kernels.trace import trace
from torchspline.splines.located import LONGEST


@dataclass(frozen=True)
class Properties:
    """What holds for keys in general position; every field is verified numerically by the tests."""

    #: Whether the curve meets every key, or only comes near.
    interpolates: bool
    #: Number of derivatives by time that are continuous at keys; None: all, there is one segment.
    continuity: int | None
    #: How many keys before and after a segment's own two it depends on: local control; None: all of them.
    reach: int | None
    #: Derivatives by time available, one-sided where they jump.
    derivatives: int = 3


class Scheme(ABC):
    """A curve made of segments between keys. Keys come unit, in the signs that are meant: where neighbours lie on
    different sides of the double cover the long way round is."""

    properties: Properties
    #: Fewest keys.
    least = 2
    #: Options by name, their values, the default first.
    options: Mapping[str, tuple[str, ...]] = MappingProxyType({})

    def segments(self, times: Tensor) -> Tensor:
        """Times of the ends of segments, from those of the keys."""
        return times

    @abstractmethod
    def table(self, group: Group, keys: Tensor, times: Tensor, **options: str) -> Tensor:
        """What each segment needs, `(*batch, S, C)`, from keys (*batch, M, P) and times (M,)."""

    @abstractmethod
    def fields(self, group: Group, rows: Tensor, u: Tensor, derivatives: int) -> tuple[Tensor, ...]:
        """Value and rates by u, in [0, 1], from rows (*batch, n, C) of the table and u (n,) or (*batch, n)."""

    @abstractmethod
    def components(self, group: GroupArithmetic, row: Vector, u: Scalar, derivatives: int) -> list[Vector]:
        """The same on components."""


class CurveScheme(Scheme):
    """A scheme that is written as group operations; power series for u give its rates."""

    @abstractmethod
    def point(self, group: GroupArithmetic, row: Vector, u: Jet) -> Vector:
        """The curve's stored numbers, of any length, as jets."""

    def components(self, group: GroupArithmetic, row: Vector, u: Scalar, derivatives: int) -> list[Vector]:
        """Value and rates by u."""
        constants = tuple(Jet(c, *(0.0,) * derivatives) for c in row)
        stored = self.point(group, constants, jet.variable(u, derivatives))
        return [group.normalize(jet.values(stored, 0)), *jet.rates(group, stored, derivatives)]

    def fields(self, group: Group, rows: Tensor, u: Tensor, derivatives: int) -> tuple[Tensor, ...]:
        u = u.expand(rows.shape[:-1])
        if u.numel() >= FUSED_ROWS and not torch.compiler.is_compiling() and usable(rows, u):
            kernel = curve_kernel(self, group.name, rows.shape[-1], derivatives, rows.dtype)
            if kernel is not None:
                return FusedCurve.apply(rows, u, self, group, derivatives, kernel)
        return self.reference(group, rows, u, derivatives)

    def reference(self, group: Group, rows: Tensor, u: Tensor, derivatives: int) -> tuple[Tensor, ...]:
        """The same by tensor operations."""
        fields = self.components(group.arithmetic, split(rows), u, derivatives)
        return tuple(join(x, rows) for x in fields)


@cache
def curve_kernel(
    scheme: CurveScheme, group: str, columns: int, derivatives: int, dtype: torch.dtype
) -> RowKernel | None:
    """The scheme on rows of a table, compiled; None if that would be too long a code."""
    algebra = arithmetic(group)

    def run(row: Vector, u: Vector) -> list[Scalar]:
        return [c for field in scheme.components(algebra, row, u[0], derivatives) for c in field]

    if len(trace(run, [columns, 1], dtype, near=True).operations) > LONGEST:
        return None
    name = f"{type(scheme).__name__}_{group}_{columns}_d{derivatives}"
    results = [algebra.point_size, *[algebra.tangent_size] * derivatives]
    return RowKernel(name, run, [columns, 1], results, dtype)


class FusedCurve(Function):
    """Value and rates through a kernel; gradients through the reference, run again."""

    @staticmethod
    def forward(
        ctx: Any,
        rows: Tensor,
        u: Tensor,
        scheme: CurveScheme,
        group: Group,
        derivatives: int,
        kernel: RowKernel,
    ) -> tuple[Tensor, ...]:
        ctx.save_for_backward(rows, u)
        ctx.again = (scheme, group, derivatives)
        outputs = tuple(rows.new_empty(*u.shape, size) for size in kernel.results)
        kernel([flat(rows), flat(u)], [flat(x) for x in outputs], u.numel())
        return outputs

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        scheme, group, derivatives = ctx.again
        create_graph = torch.is_grad_enabled()
        with torch.enable_grad():
            # Views, so that no gradient passes from one argument to the other.
            given = [x.view_as(x) if x.requires_grad else x for x in ctx.saved_tensors]
            wanted = [x for x in given if x.requires_grad]
            fields = scheme.reference(group, *given, derivatives)
            used = [(x, g) for x, g in zip(fields, cotangents, strict=True) if x.requires_grad]
            outputs, grads = zip(*used, strict=True)
            found = torch.autograd.grad(outputs, wanted, grads, create_graph=create_graph, allow_unused=True)
        gradients = iter(found)
        return *(next(gradients) if x.requires_grad else None for x in given), None, None, None, None
