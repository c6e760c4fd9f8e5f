"""The uniform B-spline through compiled kernels: one call forward, one call backward.

On the CPU a loop does all of it, from times on (`fused_bspline`). Where times have become segments and places within
them, as on a GPU and in compiled graphs, `placed_kernels` finds what does the rest.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.autograd import Function

from torchspline.arithmetic.registry import arithmetic
from torchspline.kernels.build import available
from torchspline.kernels.mode import (
    RefusedError,
    batched,
    current,
    flat,
    plain,
    transformed,
    triton_available,
)
from torchspline.kernels.spline import Clock, Places, SplineKernels
from torchspline.kernels.triton import TritonSpline
from torchspline.splines.basis import cumulative_matrix
from torchspline.splines.clock import tolerance

#: Largest order times dimension for which a kernel is compiled: beyond, straight-line code takes minutes to compile.
_SMALL = 64


def small(group: str, order: int) -> bool:
    """Whether a problem is small enough to compile a kernel for it."""
    return order * arithmetic(group).tangent_size <= _SMALL


@dataclass(eq=False)
class Call:
    """What does not change hands as a tensor: sizes, knots as numbers, and the same computation by the reference."""

    kernels: SplineKernels
    segments: int
    t0: float | int
    dt: float | int
    #: How far outside the domain times may lie, in knot spacings; None: anywhere.
    tolerance: float | None
    #: (control_points, t, t0, dt) -> value and rates per second.
    reference: Callable[[Tensor, Tensor, Any, Any], tuple[Tensor, ...]]

    def clock(self, control_points: Tensor, t: Tensor) -> Clock:
        trajectories = control_points.shape[:-2].numel()
        return Clock(
            flat(t),
            t.ndim == 1,
            self.t0,
            self.dt,
            float("inf") if self.tolerance is None else self.tolerance,
            self.segments,
            control_points.shape[-2],
            trajectories,
        )


def fused_bspline(
    control_points: Tensor,
    t: Tensor,
    t0: Tensor | float | int,
    dt: Tensor | float | int,
    kernels: SplineKernels,
    segments: int,
    validate: bool,
    reference: Callable[[Tensor, Tensor, Any, Any], tuple[Tensor, ...]],
) -> tuple[Tensor, ...] | None:
    """Value and rates per second, or None if a number is not acceptable.

    Args:
        t: `(N,)` or `(*batch, N)`; t0, dt: numbers or 0-dim tensors; `reference` does the same on tensors.
    """
    start, spacing = _number(t0), _number(dt)
    slack = float(tolerance(t, start, spacing, segments)) if validate else None
    call = Call(kernels, segments, start, spacing, slack, reference)
    times = t.to(torch.float64) if t.dtype == torch.float32 else t
    try:
        return FusedBSpline.apply(control_points, times, _learnt(t0), _learnt(dt), call)
    except RefusedError:
        return None


def _number(x: Tensor | float | int) -> float | int:
    return x.item() if isinstance(x, Tensor) else x


def _learnt(x: Tensor | float | int) -> Tensor | None:
    return x if isinstance(x, Tensor) and x.requires_grad else None


@cache
def kernels_of(
    group: str, order: int, derivatives: int, dtype: torch.dtype, nanoseconds: bool | None
) -> SplineKernels:
    """One set of kernels for each combination in a process."""
    return SplineKernels(group, cumulative_matrix(order)[1:], derivatives, dtype, nanoseconds)


@cache
def triton_kernels_of(group: str, order: int, derivatives: int, dtype: torch.dtype) -> TritonSpline:
    """One set of kernels for each combination in a process."""
    return TritonSpline(group, cumulative_matrix(order)[1:], derivatives, dtype)


class FusedBSpline(Function):
    """Value and rates per second of control points `(*batch, M, P)` at `t` `(N,)` or `(*batch, N)`.

    `t` is float64 or int64; `t0` and `dt` are tensors if they require grad, else None.
    """

    @staticmethod
    def forward(
        ctx: Any, control_points: Tensor, t: Tensor, t0: Tensor | None, dt: Tensor | None, call: Call
    ) -> tuple[Tensor, ...]:
        batch = control_points.shape[:-2]
        clock = call.clock(control_points, t)
        pairs, bad = call.kernels.pairs(flat(control_points), clock.trajectories, clock.points)
        if bad and call.tolerance is not None:
            raise RefusedError
        results = call.kernels.results((*batch, t.shape[-1]))
        if call.kernels.forward(pairs, clock, [x.reshape(-1) for x in results]):
            raise RefusedError
        outputs = tuple(map(torch.from_numpy, results))
        ctx.call, ctx.clock, ctx.pairs = call, clock, pairs
        ctx.save_for_backward(control_points, t, t0, dt)
        # Not saved for backward: there, writing to a result in place would be an error, which it is not elsewhere.
        ctx.results = tuple(x.detach() for x in (outputs[:1] if dt is None else outputs))
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:
        control_points, t, t0, dt = ctx.saved_tensors
        call: Call = ctx.call
        results: tuple[Tensor, ...] = ctx.results
        overwritten = any(x._version > 0 for x in results)
        if overwritten or torch.is_grad_enabled() or transformed() or any(map(batched, cotangents)):
            return *_through_reference(call, (control_points, t, t0, dt), cotangents), None
        shape, sizes = results[0].shape[:-1], call.kernels.result_sizes
        filled = [
            control_points.new_zeros(*shape, size) if c is None else c
            for c, size in zip(cotangents, sizes, strict=True)
        ]
        value, value_g, *rates_g = map(flat, (results[0], *filled))
        stored = flat(control_points)
        stored_g, u_g = call.kernels.reverse(stored, ctx.pairs, ctx.clock, value, value_g, rates_g)
        t_g = None
        if any(ctx.needs_input_grad[1:4]):
            t_g = torch.from_numpy(u_g).reshape(shape).to(torch.float64) / call.dt
        t0_g = -t_g.sum() if t0 is not None and t_g is not None else None
        dt_g = None
        if dt is not None and t_g is not None:
            # u = (t - t0) / dt - segment, and the r-th rate carries a factor dt^-r.
            dt_g = -(t_g * (t - call.t0)).sum()
            for r, (g, x) in enumerate(zip(filled, results, strict=True)):
                dt_g = dt_g - r * (g * x).sum(dtype=torch.float64)
            dt_g = dt_g / call.dt
        if t_g is not None:
            t_g = t_g.sum_to_size(t.shape) if ctx.needs_input_grad[1] else None
        return torch.from_numpy(stored_g).reshape(control_points.shape), t_g, t0_g, dt_g, None


def _through_reference(
    call: Call,
    saved: tuple[Tensor, Tensor, Tensor | None, Tensor | None],
    cotangents: tuple[Tensor | None, ...],
) -> list[Tensor | None]:
    """Gradients as differentiable operations: the reference run again on the saved tensors, whose graph it extends."""
    again = torch.is_grad_enabled()
    with torch.enable_grad():
        # Views, so that where one of these was computed from another no gradient passes from argument to argument.
        control_points, t = (x.view_as(x) if x.requires_grad else x for x in saved[:2])
        t0, dt = (x.view_as(x) if x is not None and x.requires_grad else x for x in saved[2:])
        wanted = [x for x in (control_points, t, t0, dt) if x is not None and x.requires_grad]
        outputs = call.reference(
            control_points, t, call.t0 if t0 is None else t0, call.dt if dt is None else dt
        )
        used = [(x, g) for x, g in zip(outputs, cotangents, strict=True) if g is not None and x.requires_grad]
        if not used:
            return [None] * len(saved)
        gradients = iter(
            torch.autograd.grad(
                [x for x, _ in used], wanted, [g for _, g in used], create_graph=again, allow_unused=True
            )
        )
    return [next(gradients) if x is not None and x.requires_grad else None for x in saved]


class PlacedKernels(Protocol):
    """Sweeps at `u` and `index`, places in segments and segments, `(N,)` or `(*batch, N)`; derivatives are by u."""

    def forward(self, control_points: Tensor, u: Tensor, index: Tensor) -> list[Tensor]:
        """Value and rates, `(*batch, N, P or D)`."""

    def reverse(
        self, control_points: Tensor, u: Tensor, index: Tensor, cotangents: Sequence[Tensor | None]
    ) -> tuple[Tensor, Tensor]:
        """Gradients of control points and u."""


class _OnCPU:
    """`SplineKernels` as `PlacedKernels`."""

    def __init__(self, kernels: SplineKernels):
        self.kernels = kernels

    def forward(self, control_points: Tensor, u: Tensor, index: Tensor) -> list[Tensor]:
        return self._forward(control_points, self._places(control_points, u, index))[1]

    def reverse(
        self, control_points: Tensor, u: Tensor, index: Tensor, cotangents: Sequence[Tensor | None]
    ) -> tuple[Tensor, Tensor]:
        places = self._places(control_points, u, index)
        pairs, results = self._forward(control_points, places)
        given = [torch.zeros_like(x) if g is None else g for g, x in zip(cotangents, results, strict=True)]
        value, value_g, *rates_g = map(flat, (results[0], *given))
        stored_g, u_g = self.kernels.reverse(flat(control_points), pairs, places, value, value_g, rates_g)
        per_query = torch.from_numpy(u_g).reshape(results[0].shape[:-1])
        return torch.from_numpy(stored_g).reshape(control_points.shape), per_query.sum_to_size(u.shape)

    def _forward(self, control_points: Tensor, places: Places) -> tuple[Any, list[Tensor]]:
        pairs, _ = self.kernels.pairs(flat(control_points), places.trajectories, places.points)
        results = self.kernels.results((*control_points.shape[:-2], places.queries))
        self.kernels.forward(pairs, places, [x.reshape(-1) for x in results])
        return pairs, list(map(torch.from_numpy, results))

    def _places(self, control_points: Tensor, u: Tensor, index: Tensor) -> Places:
        pairs = torch.stack([u.detach().to(torch.float64), index.to(torch.float64)], dim=-1)
        points = control_points.shape[-2]
        trajectories = control_points.shape[:-2].numel()
        segments = points - self.kernels.order + 1
        return Places(flat(pairs), u.ndim == 1, 0.0, 1.0, float("inf"), segments, points, trajectories)


def _on_cpu(
    device: torch.device, group: str, order: int, derivatives: int, dtype: torch.dtype
) -> PlacedKernels | None:
    return _OnCPU(kernels_of(group, order, derivatives, dtype, None)) if available() else None


def _on_gpu(
    device: torch.device, group: str, order: int, derivatives: int, dtype: torch.dtype
) -> PlacedKernels | None:
    return triton_kernels_of(group, order, derivatives, dtype) if triton_available(device) else None


#: By type of device. A new kind of kernel is a line here.
ENGINES: dict[str, Callable[..., PlacedKernels | None]] = {"cpu": _on_cpu, "cuda": _on_gpu}


def placed_kernels(
    control_points: Tensor, u: Tensor, index: Tensor, group: str, order: int, derivatives: int
) -> PlacedKernels | None:
    """Kernels for a call with these tensors, or None where the reference has to do it."""
    engine = ENGINES.get(control_points.device.type)
    if engine is None or current() == "reference" or not small(group, order):
        return None
    if not plain(control_points, u, index):
        return None
    return engine(control_points.device, group, order, derivatives, control_points.dtype)
