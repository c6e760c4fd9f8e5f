"""The uniform cumulative B-spline as one autograd function for every group.

Forward and reverse sweep follow `arithmetic/recurrence.py`. What depends on control points alone (unit points,
signs, `d = Log(X^-1 Y)` of neighbours) is computed once a pair, not once a query, and in reverse the gradient of
d is summed over the queries before it passes through the logarithm.

Layout: control points `(*batch, M, P)`; `u` and `index` either `(N,)`, shared by the batch, or `(*batch, N)`.
Inside, components come first: points `(P, *batch, M)`, steps `(D, *batch, order - 1, N)`.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.recurrence import (
    Step,
    difference_reverse,
    difference_tangent,
    forward,
    parameter_cotangent,
    reverse,
    tangent,
)
from torchspline.arithmetic.registry import arithmetic
from torchspline.arithmetic.vector import Vector, times, zero
from torchspline.groups.components import join, split
from torchspline.groups.nested import outer_levels, primals
from torchspline.kernels.mode import batched
from torchspline.splines.basis import cumulative_weights
from torchspline.splines.fused import placed_kernels


class _Pairs(NamedTuple):
    """What control points alone determine."""

    stored: Vector
    points: Vector
    steps: Vector


class _Queries(NamedTuple):
    """What a query adds: the recurrences' arguments and what they leave behind."""

    at: Tensor
    steps: list[Vector]
    weights: list[tuple[Tensor, ...]]
    value: Vector
    trace: list[Step]


def _pairs(group: GroupArithmetic, control_points: Tensor) -> _Pairs:
    stored = split(control_points)
    points = group.normalize(stored)
    between = group.between(first(points), second(points))
    return _Pairs(stored, continue_signs(group, points, between), group.log(between))


def first(components: Vector) -> Vector:
    """Of each pair of neighbours the first."""
    return tuple(c[..., :-1] for c in components)


def second(components: Vector) -> Vector:
    return tuple(c[..., 1:] for c in components)


def continue_signs(group: GroupArithmetic, points: Vector, between: Vector) -> Vector:
    """Flip quaternions so that each lies on the side of its predecessor: the output never jumps in sign."""
    signed = list(points)
    for (start, stop), far in zip(group.sign_blocks, group.long_way(between), strict=True):
        flips = torch.nn.functional.pad(far.to(torch.int64).cumsum(-1), (1, 0))
        odd = flips % 2 == 1
        signed[start:stop] = [torch.where(odd, -c, c) for c in signed[start:stop]]
    return tuple(signed)


def _take(table: Tensor, index: Tensor) -> Tensor:
    """Columns of `table` (C, *batch, L) at `index` (n,) or (*batch, n)."""
    if index.ndim == 1:
        return table.index_select(-1, index)
    return table.gather(-1, index.expand(*table.shape[:-1], index.shape[-1]))


def _scatter(columns: Tensor, index: Tensor, length: int) -> Tensor:
    """Transpose of `_take`: columns that share an index are summed."""
    table = columns.new_zeros(*columns.shape[:-1], length)
    return table.scatter_add(-1, index.expand(columns.shape), columns)


def _flat(x: Tensor) -> Tensor:
    """The last two dimensions as one."""
    return x.reshape(*x.shape[:-2], x.shape[-2] * x.shape[-1])


def _take_steps(table: Tensor, at: Tensor, count: int) -> list[Vector]:
    columns = _take(table, _flat(at))
    columns = columns.reshape(*columns.shape[:-1], count, at.shape[-1])
    return [tuple(c[..., j, :] for c in columns.unbind(0)) for j in range(count)]


def _queries(
    group: GroupArithmetic,
    pairs: _Pairs,
    u: Tensor,
    index: Tensor,
    order: int,
    derivatives: int,
    more: int = 0,
) -> _Queries:
    """Gather and run the forward recurrence; `more` derivatives of the weights are added for the sweeps."""
    count = order - 1
    at = index.unsqueeze(-2) + torch.arange(count, device=index.device).unsqueeze(-1)
    steps = _take_steps(torch.stack(pairs.steps), at, count)
    weights = cumulative_weights(u, order, derivatives + more)
    start = _take(torch.stack(pairs.points), index).unbind(0)
    value, trace = forward(group, start, steps, weights[: derivatives + 1], derivatives, short=True)
    return _Queries(at, steps, weights, value, trace)


def _forward(
    control_points: Tensor, u: Tensor, index: Tensor, group: str, order: int, derivatives: int
) -> tuple[Tensor, ...]:
    algebra = arithmetic(group)
    queries = _queries(algebra, _pairs(algebra, control_points), u, index, order, derivatives)
    like = _like(queries, control_points)
    return tuple(join(x, like) for x in (queries.value, *queries.trace[-1].rates))


def _like(queries: _Queries, control_points: Tensor) -> Tensor:
    """A tensor whose shape without the last dimension is that of the results."""
    return control_points.new_empty(*queries.steps[0][0].shape, 0)


def _reverse(
    control_points: Tensor,
    u: Tensor,
    index: Tensor,
    group: str,
    order: int,
    cotangents: tuple[Tensor | None, ...],
    u_needed: bool,
) -> tuple[Tensor, Tensor | None]:
    """Gradients of control points and u; trailing derivatives without a cotangent are not even computed."""
    algebra = arithmetic(group)
    while len(cotangents) > 1 and cotangents[-1] is None:
        cotangents = cotangents[:-1]
    derivatives = len(cotangents) - 1
    pairs = _pairs(algebra, control_points)
    queries = _queries(algebra, pairs, u, index, order, derivatives, more=1)
    none = zero(algebra.tangent_size)
    value_cotangent = none if cotangents[0] is None else algebra.pull(queries.value, split(cotangents[0]))
    rate_cotangents = [none if c is None else split(c) for c in cotangents[1:]]
    weights = queries.weights[: derivatives + 1]
    start_g, steps_g, weights_g = reverse(
        algebra, queries.steps, weights, queries.trace, value_cotangent, rate_cotangents, short=True
    )
    like = _like(queries, control_points)
    u_gradient = _u_gradient(weights_g, queries.weights, like, u) if u_needed else None

    points = control_points.shape[-2]
    per_query = torch.stack([join(g, like).movedim(-1, 0) for g in steps_g], dim=-2)
    steps_sum = _scatter(_flat(per_query), _flat(queries.at), points - 1).unbind(0)
    start_sum = _scatter(join(start_g, like).movedim(-1, 0), index, points).unbind(0)
    to_first, to_second = difference_reverse(algebra, pairs.steps, steps_sum)
    pad = torch.nn.functional.pad
    body = tuple(
        s + pad(second, (1, 0)) + pad(first, (0, 1))
        for s, second, first in zip(start_sum, to_second, to_first, strict=True)
    )
    return join(algebra.embed(pairs.stored, body), control_points), u_gradient


def _u_gradient(weights_g, weights, like: Tensor, u: Tensor) -> Tensor:
    total = parameter_cotangent(weights_g, weights)
    total = join((total,), like).squeeze(-1)
    return total.sum_to_size(u.shape)


def _tangent(
    control_points: Tensor,
    u: Tensor,
    index: Tensor,
    group: str,
    order: int,
    derivatives: int,
    control_rate: Tensor | None,
    u_rate: Tensor | None,
) -> tuple[Tensor, ...]:
    """Rates of all results, given those of control points and u."""
    algebra = arithmetic(group)
    pairs = _pairs(algebra, control_points)
    queries = _queries(algebra, pairs, u, index, order, derivatives, more=1)
    if control_rate is None:
        start_rate = zero(algebra.tangent_size)
        steps_rate = [start_rate] * (order - 1)
    else:
        body = algebra.extract(pairs.stored, split(control_rate))
        pair_rate = difference_tangent(algebra, pairs.steps, first(body), second(body))
        start_rate = _take(torch.stack(body), index).unbind(0)
        steps_rate = _take_steps(torch.stack(pair_rate), queries.at, order - 1)
    weights = queries.weights[: derivatives + 1]
    moving = 0.0 if u_rate is None else u_rate
    weights_rate = [[times(rate, moving) for rate in row] for row in queries.weights[1:]]
    xi, rates = tangent(
        algebra, queries.steps, weights, queries.trace, start_rate, steps_rate, weights_rate, short=True
    )
    like = _like(queries, control_points)
    return tuple(join(x, like) for x in (algebra.push(queries.value, xi), *rates))


def _run(
    control_points: Tensor, u: Tensor, index: Tensor, group: str, order: int, derivatives: int
) -> tuple[Tensor, ...]:
    """The forward sweep by a kernel, or else by tensor operations."""
    kernels = placed_kernels(control_points, u, index, group, order, derivatives)
    if kernels is not None:
        return tuple(kernels.forward(control_points, u, index))
    return _forward(control_points, u, index, group, order, derivatives)


def _run_reverse(
    control_points: Tensor,
    u: Tensor,
    index: Tensor,
    group: str,
    order: int,
    cotangents: tuple[Tensor | None, ...],
    u_needed: bool,
) -> tuple[Tensor, Tensor | None]:
    """The reverse sweep by a kernel, or else by tensor operations, which alone can be differentiated again."""
    if not torch.is_grad_enabled() and not any(map(batched, cotangents)):
        kernels = placed_kernels(control_points, u, index, group, order, len(cotangents) - 1)
        if kernels is not None:
            return kernels.reverse(control_points, u, index, cotangents)
    return _reverse(control_points, u, index, group, order, cotangents, u_needed)


class CumulativeBSpline(Function):
    """Value and derivatives by u: (value, velocity, ...), each `(*batch, N, P or D)`."""

    generate_vmap_rule = True

    @staticmethod
    def forward(
        control_points: Tensor, u: Tensor, index: Tensor, group: str, order: int, derivatives: int
    ) -> tuple[Tensor, ...]:
        return _run(control_points, u, index, group, order, derivatives)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        control_points, u, index, ctx.group, ctx.order, ctx.derivatives = inputs
        ctx.save_for_backward(control_points, u, index)
        ctx.save_for_forward(control_points, u, index)
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:
        if all(c is None for c in cotangents):
            return (None,) * 6
        control_points, u, index = ctx.saved_tensors
        u_needed = ctx.needs_input_grad[1]
        gradients = _run_reverse(control_points, u, index, ctx.group, ctx.order, cotangents, u_needed)
        return *gradients, None, None, None, None

    @staticmethod
    def jvp(ctx: Any, control_rate: Tensor | None, u_rate: Tensor | None, *_: None) -> tuple[Tensor, ...]:
        with outer_levels():
            control_points, u, index = primals(ctx.saved_tensors)
            return _tangent(
                control_points, u, index, ctx.group, ctx.order, ctx.derivatives, control_rate, u_rate
            )


@torch.library.custom_op("torchspline::bspline", mutates_args=())
def _compiled(
    control_points: Tensor, u: Tensor, index: Tensor, group: str, order: int, derivatives: int
) -> list[Tensor]:
    return list(_run(control_points, u, index, group, order, derivatives))


@torch.library.custom_op("torchspline::bspline_reverse", mutates_args=())
def _compiled_reverse(
    control_points: Tensor, u: Tensor, index: Tensor, group: str, order: int, cotangents: list[Tensor]
) -> list[Tensor]:
    with torch.no_grad():  # nothing below records a graph, whatever the mode says
        gradients = _run_reverse(control_points, u, index, group, order, tuple(cotangents), True)
    control_gradient, u_gradient = gradients
    assert u_gradient is not None
    return [control_gradient, u_gradient]


@_compiled.register_fake
def _(
    control_points: Tensor, u: Tensor, index: Tensor, group: str, order: int, derivatives: int
) -> list[Tensor]:
    algebra = arithmetic(group)
    shape = (*control_points.shape[:-2], u.shape[-1])
    value = control_points.new_empty(*shape, algebra.point_size)
    return [value, *(control_points.new_empty(*shape, algebra.tangent_size) for _ in range(derivatives))]


@_compiled_reverse.register_fake
def _(
    control_points: Tensor, u: Tensor, index: Tensor, group: str, order: int, cotangents: list[Tensor]
) -> list[Tensor]:
    return [control_points.new_empty(control_points.shape), u.new_empty(u.shape)]


def _save(ctx: Any, inputs: tuple, output: list[Tensor]) -> None:
    control_points, u, index, ctx.group, ctx.order, ctx.derivatives = inputs
    ctx.save_for_backward(control_points, u, index)


def _compiled_backward(ctx: Any, cotangents: list[Tensor]) -> tuple[Tensor | None, ...]:
    gradients = _compiled_reverse(*ctx.saved_tensors, ctx.group, ctx.order, cotangents)
    return gradients[0], gradients[1], None, None, None, None


_compiled.register_autograd(_compiled_backward, setup_context=_save)


def cumulative_bspline(
    control_points: Tensor, u: Tensor, index: Tensor, group: str, order: int, derivatives: int
) -> tuple[Tensor, ...]:
    """Value and derivatives by u of the segment `index` at `u` within [0, 1]; one opaque operator when compiling."""
    if torch.compiler.is_compiling():
        return tuple(_compiled(control_points, u, index, group, order, derivatives))
    return CumulativeBSpline.apply(control_points, u, index, group, order, derivatives)
