"""Running results along time, differentiable: compiled loops on the CPU, products of pairs elsewhere."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from torchspline.arithmetic import so3
from torchspline.groups.group import SO3
from torchspline.kernels import mode, recurrence

#: What the steps of a scan are made of, time along dimension -2.
Element = tuple[Tensor, ...]


def prefix(combine: Callable[[Element, Element], Element], steps: Element) -> Element:
    """Running products `s_0, s_0 s_1, s_0 s_1 s_2, ...` under an associative `combine(earlier, later)`.

    Neighbours are combined, their products scanned, and the steps in between caught up: O(N) work in 2 log2(N) rounds
    of tensor operations, so nothing but `combine` has to be differentiable.
    """
    count = steps[0].shape[-2]
    if count < 2:
        return steps
    even, odd = (tuple(x[..., first::2, :] for x in steps) for first in (0, 1))
    pairs = count // 2
    at_odd = prefix(combine, combine(tuple(x[..., :pairs, :] for x in even), odd))
    later = (count - 1) // 2
    caught_up = combine(tuple(x[..., :later, :] for x in at_odd), tuple(x[..., 1:, :] for x in even))
    results = []
    for first, at_even, after in zip(even, caught_up, at_odd, strict=True):
        at_even = torch.cat([first[..., :1, :].expand(*at_even.shape[:-2], 1, first.shape[-1]), at_even], -2)
        woven = torch.stack([at_even[..., :pairs, :], after], -2).flatten(-3, -2)
        results.append(torch.cat([woven, at_even[..., pairs:, :]], -2))
    return tuple(results)


def _usable(*tensors: Tensor) -> bool:
    # First, as what the mode is kept in cannot be traced.
    return not torch.compiler.is_compiling() and mode.usable(*tensors)


def linear_recurrence(factors: Tensor, x: Tensor) -> Tensor:
    """`y_k = factors_k y_{k-1} + x_k`, `y_0 = x_0`, along dimension -2; differentiable in both to any order.

    Args:
        factors: broadcasts to the shape of x; those of the first sample are not used. x: (*batch, N, C).
    """
    if not _usable(factors, x):
        return _linear_reference(factors, x)
    result: Tensor = _LinearRecurrence.apply(factors, x)
    return result


def _linear_reference(factors: Tensor, x: Tensor) -> Tensor:
    def combine(earlier: Element, later: Element) -> Element:
        (a, x), (b, y) = earlier, later
        return a * b, b * x + y

    return prefix(combine, (factors.expand_as(x), x))[1]


class _LinearRecurrence(Function):
    @staticmethod
    def forward(ctx: Any, factors: Tensor, x: Tensor) -> Tensor:
        rows = x.shape[:-2].numel()
        # One row of factors for all trajectories, or one each; along time and channels the loop takes either.
        shared = factors.ndim < 3 or factors.shape[:-2].numel() == 1
        samples = 1 if factors.ndim < 2 else factors.shape[-2]
        channels = 1 if factors.ndim < 1 else factors.shape[-1]
        given = (
            factors.detach().reshape(1, samples, channels)
            if shared
            else (factors.detach().expand(*x.shape[:-2], samples, channels).reshape(rows, samples, channels))
        )
        plain = x.detach().contiguous().reshape(rows, *x.shape[-2:])
        y = torch.from_numpy(recurrence.linear_recurrence(given.contiguous().numpy(), plain.numpy()))
        y = y.reshape(x.shape)
        ctx.save_for_backward(factors, y)
        return y

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, Tensor]:
        """The same recurrence backward in time; made of differentiable operations, so it may be differentiated."""
        factors, y = ctx.saved_tensors
        back = factors.expand(*factors.shape[:-2], y.shape[-2], -1) if factors.ndim > 1 else factors
        if factors.ndim > 1:
            back = torch.cat([back[..., :1, :], back[..., 1:, :].flip(-2)], -2)
        gx = linear_recurrence(back, g.flip(-2)).flip(-2)
        if not ctx.needs_input_grad[0]:
            return None, gx
        before = torch.cat([torch.zeros_like(y[..., :1, :]), y[..., :-1, :]], -2)
        return (gx * before).sum_to_size(factors.shape), gx


def rotation_products(start: Tensor, steps: Tensor) -> Tensor:
    """`q_0 = start`, `q_{k+1} = q_k steps_k`, (*batch, N + 1, 4); differentiable in both to any order.

    Args:
        start: unit quaternions (*batch, 4). steps: (*batch, N, 4), unit quaternions.
    """
    if not _usable(start, steps):
        return _products_reference(start, steps)
    result: Tensor = _RotationProducts.apply(start, steps)
    return result


def _products_reference(start: Tensor, steps: Tensor) -> Tensor:
    def combine(earlier: Element, later: Element) -> Element:
        (p,), (q,) = earlier, later
        product = torch.stack(so3.multiply(p.unbind(-1), q.unbind(-1)), -1)
        return (product * (1.5 - 0.5 * product.square().sum(-1, keepdim=True)),)

    return prefix(combine, (torch.cat([start[..., None, :], steps], -2),))[0]


class _RotationProducts(Function):
    @staticmethod
    def forward(ctx: Any, start: Tensor, steps: Tensor) -> Tensor:
        batch, rows = steps.shape[:-2], steps.shape[:-2].numel()
        first = start.detach().contiguous().reshape(rows, 4).numpy()
        plain = steps.detach().contiguous().reshape(rows, steps.shape[-2], 4).numpy()
        products = torch.from_numpy(recurrence.rotation_products(first, plain))
        products = products.reshape(*batch, steps.shape[-2] + 1, 4)
        ctx.save_for_backward(start, steps, products)
        return products

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor, Tensor]:
        """Turning one step turns all that follows as one body: in the world, the gradient of its turn is their sum.

        Written with the products, which are differentiable themselves: sums along time, and nothing is scanned.
        """
        start, steps, products = ctx.saved_tensors
        q = products.unbind(-1)
        turns = so3.rotate(q, SO3.arithmetic.pull(q, g.unbind(-1)))
        following = [x.flip(-1).cumsum(-1).flip(-1) for x in turns]
        body = so3.unrotate(q, tuple(following))
        gradients = []
        for point, at in ((start, 0), (steps, slice(1, None))):
            tangent = tuple(x[..., at] for x in body)
            gradients.append(torch.stack(SO3.arithmetic.embed(point.unbind(-1), tangent), -1))
        return gradients[0], gradients[1]
