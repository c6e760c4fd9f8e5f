"""The end of the chain: a converter of limited range and finitely many steps."""

import torch
from torch import Tensor

from torchspline.kernels.mode import transformed


def saturate(x: Tensor, limit: Tensor) -> Tensor:
    """`x` within [-limit, limit]. The gradient is that of the value: zero to `x` where it is clipped."""
    return torch.clamp(x, -limit, limit)


def quantise(x: Tensor, step: Tensor) -> Tensor:
    """`x` rounded to the nearest multiple of `step` (half to even).

    The derivative of a staircase is zero almost everywhere and teaches nothing: the gradient passes straight through,
    as if nothing had been rounded. The step gets none.
    """
    if (torch.is_grad_enabled() and x.requires_grad) or transformed():
        return x + (torch.round(x / step) * step - x).detach()
    return torch.round(x / step).mul_(step)
