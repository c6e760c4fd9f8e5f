"""Group operations with hand-derived derivatives: one autograd function runs all of them on every group.

An operation says how it acts on components and how first changes pass through it, forwards (`tangent`) and
backwards (`reverse`). Derivatives of higher order come from automatic differentiation of these, which is why
they consist of plain differentiable arithmetic.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cache, reduce
from itertools import chain
from operator import and_
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.recurrence import (
    Step,
    difference,
    difference_reverse,
    difference_tangent,
    forward,
    reverse,
    tangent,
)
from torchspline.arithmetic.registry import arithmetic
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector, add, negate, zero
from torchspline.groups.components import join, split
from torchspline.groups.nested import outer_levels, primals
from torchspline.kernels.mode import RefusedError, batched, flat, transformed, usable
from torchspline.kernels.programs import finite, valid_point
from torchspline.kernels.rowwise import RowKernel
from torchspline.kernels.trace import Symbol

#: Fewest rows worth a kernel: a few tensor operations on less cost little, and compiling a kernel takes seconds once.
FUSED_ROWS = 4096

Arguments = tuple[Vector, ...]


class Operation(ABC):
    """One operation on components. Points are stored numbers, quaternions of any length."""

    #: What each argument is: "point", or anything else whose numbers only have to be finite; and what the result is.
    kinds: tuple[str, ...]
    result = "point"

    def compiles(self, group: GroupArithmetic) -> tuple[bool, bool]:
        """Whether kernels are compiled, forward and in reverse: straight-line code of thousands of operations takes
        minutes."""
        return True, True

    def result_size(self, group: GroupArithmetic) -> int:
        """Components of the result."""
        by_kind = {"point": group.point_size, "tangent": group.tangent_size, "vector": group.act_size}
        return by_kind[self.result]

    @abstractmethod
    def forward(self, group: GroupArithmetic, arguments: Arguments) -> Vector:
        """The result."""

    @abstractmethod
    def reverse(self, group: GroupArithmetic, arguments: Arguments, cotangent: Vector) -> Arguments:
        """Euclidean gradients of all arguments."""

    @abstractmethod
    def tangent(self, group: GroupArithmetic, arguments: Arguments, rates: Arguments) -> Vector:
        """Rate of the result, given those of the arguments."""


class Exp(Operation):
    kinds = ("tangent",)

    def forward(self, group: GroupArithmetic, arguments: Arguments) -> Vector:
        (x,) = arguments
        return group.exp(x)

    def reverse(self, group: GroupArithmetic, arguments: Arguments, cotangent: Vector) -> Arguments:
        (x,) = arguments
        return (group.right_jacobian_transpose(x, group.pull(group.exp(x), cotangent)),)

    def tangent(self, group: GroupArithmetic, arguments: Arguments, rates: Arguments) -> Vector:
        (x,), (dx,) = arguments, rates
        return group.push(group.exp(x), group.right_jacobian(x, dx))


class Log(Operation):
    kinds = ("point",)
    result = "tangent"

    def forward(self, group: GroupArithmetic, arguments: Arguments) -> Vector:
        (stored,) = arguments
        return group.log(group.normalize(stored))

    def reverse(self, group: GroupArithmetic, arguments: Arguments, cotangent: Vector) -> Arguments:
        x = self.forward(group, arguments)
        return (group.embed(arguments[0], group.right_jacobian_inverse_transpose(x, cotangent, short=True)),)

    def tangent(self, group: GroupArithmetic, arguments: Arguments, rates: Arguments) -> Vector:
        x = self.forward(group, arguments)
        return group.right_jacobian_inverse(x, group.extract(arguments[0], rates[0]), short=True)


class Compose(Operation):
    kinds = ("point", "point")

    def forward(self, group: GroupArithmetic, arguments: Arguments) -> Vector:
        left, right = arguments
        return group.compose(group.normalize(left), group.normalize(right))

    def reverse(self, group: GroupArithmetic, arguments: Arguments, cotangent: Vector) -> Arguments:
        left, right = arguments
        g = group.pull(self.forward(group, arguments), cotangent)
        return group.embed(left, group.coadjoint_inverse(group.normalize(right), g)), group.embed(right, g)

    def tangent(self, group: GroupArithmetic, arguments: Arguments, rates: Arguments) -> Vector:
        left, right = arguments
        moved = group.adjoint_inverse(group.normalize(right), group.extract(left, rates[0]))
        return group.push(self.forward(group, arguments), add(moved, group.extract(right, rates[1])))


class Inverse(Operation):
    kinds = ("point",)

    def forward(self, group: GroupArithmetic, arguments: Arguments) -> Vector:
        (stored,) = arguments
        return group.inverse(group.normalize(stored))

    def reverse(self, group: GroupArithmetic, arguments: Arguments, cotangent: Vector) -> Arguments:
        inverse = self.forward(group, arguments)
        g = group.coadjoint_inverse(inverse, group.pull(inverse, cotangent))
        return (group.embed(arguments[0], negate(g)),)

    def tangent(self, group: GroupArithmetic, arguments: Arguments, rates: Arguments) -> Vector:
        inverse = self.forward(group, arguments)
        xi = group.adjoint_inverse(inverse, group.extract(arguments[0], rates[0]))
        return group.push(inverse, negate(xi))


class Act(Operation):
    kinds = ("point", "vector")
    result = "vector"

    def forward(self, group: GroupArithmetic, arguments: Arguments) -> Vector:
        stored, point = arguments
        return group.act(group.normalize(stored), point)

    def reverse(self, group: GroupArithmetic, arguments: Arguments, cotangent: Vector) -> Arguments:
        stored, point = arguments
        g, point_cotangent = group.act_reverse(group.normalize(stored), point, cotangent)
        return group.embed(stored, g), point_cotangent

    def tangent(self, group: GroupArithmetic, arguments: Arguments, rates: Arguments) -> Vector:
        stored, point = arguments
        xi = group.extract(stored, rates[0])
        return group.act_tangent(group.normalize(stored), point, xi, rates[1])


class Interpolate(Operation):
    """The geodesic from `start` (s = 0) to `end` (s = 1): a cumulative product of one step, weight s."""

    kinds = ("point", "point", "scalar")

    @staticmethod
    def _sweep(group: GroupArithmetic, arguments: Arguments) -> tuple[Vector, Vector, list[Step]]:
        start, end, s = arguments
        a, b = group.normalize(start), group.normalize(end)
        d = difference(group, a, b)
        value, trace = forward(group, a, [d], [s], derivatives=0)
        return d, value, trace

    def forward(self, group: GroupArithmetic, arguments: Arguments) -> Vector:
        return self._sweep(group, arguments)[1]

    def reverse(self, group: GroupArithmetic, arguments: Arguments, cotangent: Vector) -> Arguments:
        start, end, s = arguments
        d, value, trace = self._sweep(group, arguments)
        g, (d_g,), (s_g,) = reverse(group, [d], [s], trace, group.pull(value, cotangent), [])
        start_g, end_g = difference_reverse(group, d, d_g)
        return group.embed(start, add(g, start_g)), group.embed(end, end_g), tuple(s_g)

    def tangent(self, group: GroupArithmetic, arguments: Arguments, rates: Arguments) -> Vector:
        start, end, s = arguments
        d, value, trace = self._sweep(group, arguments)
        start_rate, end_rate = group.extract(start, rates[0]), group.extract(end, rates[1])
        d_rate = difference_tangent(group, d, start_rate, end_rate)
        xi, _ = tangent(group, [d], [s], trace, start_rate, [d_rate], [rates[2]])
        return group.push(value, xi)


class Geodesics(Operation):
    """`start Exp(l_1 d_1) ... Exp(l_n d_n)` and its body-frame rates by u, for any l_j(u): one row
    [value, velocity, ...].

    The steps come as d_1, ..., d_n in a row, the weights as l_1 ... l_n, then their first derivatives, and so on.
    [E17] (24), (33), (36) mirrored to the body frame, and the structural differentials (39)-(52) as one reverse sweep.
    """

    kinds = ("point", "tangent", "scalar")

    def __init__(self, count: int, derivatives: int):
        self.count, self.derivatives = count, derivatives

    def result_size(self, group: GroupArithmetic) -> int:
        return group.point_size + self.derivatives * group.tangent_size

    def compiles(self, group: GroupArithmetic) -> tuple[bool, bool]:
        size = self.count * group.tangent_size
        return size <= 30, size <= 15

    def _sweep(
        self, group: GroupArithmetic, arguments: Arguments
    ) -> tuple[list[Vector], list[Vector], Vector, list[Step]]:
        start, steps, weights = arguments
        d, l = _chop(steps, group.tangent_size), _chop(weights, self.count)
        return d, l, *forward(group, group.normalize(start), d, l, self.derivatives)

    def forward(self, group: GroupArithmetic, arguments: Arguments) -> Vector:
        _, _, value, trace = self._sweep(group, arguments)
        return (*value, *chain.from_iterable(trace[-1].rates))

    def reverse(self, group: GroupArithmetic, arguments: Arguments, cotangent: Vector) -> Arguments:
        d, l, value, trace = self._sweep(group, arguments)
        size = group.point_size
        rates_g = _chop(cotangent[size:], group.tangent_size)
        g, d_g, l_g = reverse(group, d, l, trace, group.pull(value, cotangent[:size]), rates_g)
        return group.embed(arguments[0], g), tuple(chain(*d_g)), tuple(chain(*l_g))

    def tangent(self, group: GroupArithmetic, arguments: Arguments, rates: Arguments) -> Vector:
        d, l, value, trace = self._sweep(group, arguments)
        start_rate = group.extract(arguments[0], rates[0])
        d_rate, l_rate = _chop(rates[1], group.tangent_size), _chop(rates[2], self.count)
        xi, moved = tangent(group, d, l, trace, start_rate, d_rate, l_rate)
        return (*group.push(value, xi), *chain(*moved))


def _chop(v: Vector, size: int) -> list[Vector]:
    return [v[i : i + size] for i in range(0, len(v), size)]


#: A new operation is a class above, a line here and a method of `Group`.
OPERATIONS: dict[str, Operation] = {
    "exp": Exp(),
    "log": Log(),
    "compose": Compose(),
    "inverse": Inverse(),
    "act": Act(),
    "interpolate": Interpolate(),
}


def operation_of(name: str) -> Operation:
    """By name: one of `OPERATIONS`, or "geodesics_<steps>_<derivatives>", which join them when first used."""
    if name not in OPERATIONS:
        kind, count, derivatives = name.split("_")
        assert kind == "geodesics"
        OPERATIONS[name] = Geodesics(int(count), int(derivatives))
    return OPERATIONS[name]


def _result_size(operation: str, group: str) -> int:
    return operation_of(operation).result_size(arithmetic(group))


def _forward(operation: str, group: str, *arguments: Tensor) -> Tensor:
    components = operation_of(operation).forward(arithmetic(group), tuple(map(split, arguments)))
    return join(components, arguments[0])


def _reverse(
    operation: str, group: str, arguments: tuple[Tensor, ...], cotangent: Tensor
) -> tuple[Tensor, ...]:
    components = tuple(map(split, arguments))
    gradients = operation_of(operation).reverse(arithmetic(group), components, split(cotangent))
    return tuple(join(g, x) for g, x in zip(gradients, arguments, strict=True))


class GroupFunction(Function):
    """Any operation on any group, for arguments of one batch shape."""

    generate_vmap_rule = True

    @staticmethod
    def forward(operation: str, group: str, *arguments: Tensor) -> Tensor:
        return _forward(operation, group, *arguments)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.operation, ctx.group, *arguments = inputs
        ctx.save_for_backward(*arguments)
        ctx.save_for_forward(*arguments)

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, *_reverse(ctx.operation, ctx.group, ctx.saved_tensors, cotangent)

    @staticmethod
    def jvp(ctx: Any, _operation: None, _group: None, *rates: Tensor | None) -> Tensor:
        with outer_levels():
            arguments = primals(ctx.saved_tensors)
            components = tuple(map(split, arguments))
            moved = tuple(
                zero(x.shape[-1]) if rate is None else split(rate)
                for x, rate in zip(arguments, rates, strict=True)
            )
            result = operation_of(ctx.operation).tangent(arithmetic(ctx.group), components, moved)
            return join(result, arguments[0])


@torch.library.custom_op("torchspline::group", mutates_args=())
def _compiled(operation: str, group: str, arguments: list[Tensor]) -> Tensor:
    return _forward(operation, group, *arguments)


@torch.library.custom_op("torchspline::group_reverse", mutates_args=())
def _compiled_reverse(operation: str, group: str, arguments: list[Tensor], cotangent: Tensor) -> list[Tensor]:
    return list(_reverse(operation, group, tuple(arguments), cotangent))


@_compiled.register_fake
def _(operation: str, group: str, arguments: list[Tensor]) -> Tensor:
    return arguments[0].new_empty(*arguments[0].shape[:-1], _result_size(operation, group))


@_compiled_reverse.register_fake
def _(operation: str, group: str, arguments: list[Tensor], cotangent: Tensor) -> list[Tensor]:
    return [torch.empty_like(x, memory_format=torch.contiguous_format) for x in arguments]


def _save(ctx: Any, inputs: tuple, output: Tensor) -> None:
    ctx.operation, ctx.group, arguments = inputs
    ctx.save_for_backward(*arguments)


def _compiled_backward(ctx: Any, cotangent: Tensor) -> tuple:
    return None, None, _compiled_reverse(ctx.operation, ctx.group, list(ctx.saved_tensors), cotangent)


_compiled.register_autograd(_compiled_backward, setup_context=_save)


def run(operation: str, group: str, *arguments: Tensor, check: Callable[[], None] | None = None) -> Tensor:
    """`operation` of `group`; all but the last dimension of the arguments broadcast.

    Large tensors go through compiled kernels. Under `torch.compile` the operation is one opaque operator, since
    tracing through its arithmetic would take the compiler minutes; everywhere else it is the autograd function, which
    also knows `jvp` and `vmap`.

    Args:
        check: looks at the values of the arguments and raises; kernels look for themselves and call it if need be.
    """
    batch = torch.broadcast_shapes(*(x.shape[:-1] for x in arguments))
    expanded = tuple(x.expand(*batch, x.shape[-1]) for x in arguments)
    if torch.compiler.is_compiling():
        return _compiled(operation, group, list(expanded))
    compiles, _ = operation_of(operation).compiles(arithmetic(group))
    if compiles and batch.numel() >= FUSED_ROWS and usable(*arguments):
        result = fused(operation, group, expanded, validate=check is not None)
        if result is not None:
            return result
    if check is not None:
        check()
    return GroupFunction.apply(operation, group, *expanded)


@cache
def _kernels(
    operation: str, group: str, sizes: tuple[int, ...], dtype: torch.dtype
) -> tuple[RowKernel, RowKernel]:
    """Forward and reverse of an operation; the forward refuses rows that the checks would."""
    algebra, rules = arithmetic(group), operation_of(operation)

    def valid(*components: Vector) -> Symbol:
        pairs = zip(rules.kinds, components, strict=True)
        verdicts = [valid_point(algebra, x) if kind == "point" else finite(x) for kind, x in pairs]
        return reduce(and_, verdicts)

    def forward(*components: Vector) -> Vector:
        return rules.forward(algebra, components)

    def backward(*components: Vector) -> list[Scalar]:
        gradients = rules.reverse(algebra, components[:-1], components[-1])
        return [c for gradient in gradients for c in gradient]

    result = _result_size(operation, group)
    name = f"{operation}_{group}"
    return (
        RowKernel(name, forward, sizes, [result], dtype, valid),
        RowKernel(f"{name}_reverse", backward, [*sizes, result], sizes, dtype),
    )


class FusedGroupFunction(Function):
    """`GroupFunction` through compiled kernels."""

    @staticmethod
    def forward(ctx: Any, operation: str, group: str, validate: bool, *arguments: Tensor) -> Tensor:
        first = arguments[0]
        sizes = tuple(x.shape[-1] for x in arguments)
        ctx.operation, ctx.group, ctx.kernels = (
            operation,
            group,
            _kernels(operation, group, sizes, first.dtype),
        )
        result = first.new_empty(*first.shape[:-1], _result_size(operation, group))
        refused = ctx.kernels[0](list(map(flat, arguments)), [flat(result)], first.shape[:-1].numel())
        if refused and validate:
            raise RefusedError
        ctx.save_for_backward(*arguments)
        return result

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        arguments = ctx.saved_tensors
        _, compiles = operation_of(ctx.operation).compiles(arithmetic(ctx.group))
        if not compiles or torch.is_grad_enabled() or transformed() or batched(cotangent):
            return None, None, None, *_reverse(ctx.operation, ctx.group, arguments, cotangent)
        gradients = [torch.empty_like(x, memory_format=torch.contiguous_format) for x in arguments]
        rows = cotangent.shape[:-1].numel()
        ctx.kernels[1]([*map(flat, arguments), flat(cotangent)], list(map(flat, gradients)), rows)
        return None, None, None, *gradients


def fused(operation: str, group: str, arguments: tuple[Tensor, ...], validate: bool) -> Tensor | None:
    """The result, or None if a value is not acceptable."""
    try:
        return FusedGroupFunction.apply(operation, group, validate, *arguments)
    except RefusedError:
        return None


def geodesics(group: str, start: Tensor, steps: Tensor, weights: Tensor) -> tuple[Tensor, ...]:
    """Value and rates by u of products of geodesics, see `Geodesics`.

    Args:
        start: stored points `(*B, P)`; steps: `(*B, n, D)`; weights: `(*B, R + 1, n)`, l_j and R of its derivatives by
            u. All three broadcast over B.
    Returns:
        `(*B, P)` and R times `(*B, D)`.
    """
    derivatives, count = weights.shape[-2] - 1, weights.shape[-1]
    sizes = arithmetic(group)
    rows = run(f"geodesics_{count}_{derivatives}", group, start, steps.flatten(-2), weights.flatten(-2))
    return rows.split([sizes.point_size, *[sizes.tangent_size] * derivatives], dim=-1)
