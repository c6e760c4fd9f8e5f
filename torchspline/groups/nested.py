"""Forward-mode derivatives of forward-mode derivatives through hand-written `jvp` rules."""

from collections.abc import Sequence
from contextlib import AbstractContextManager

from torch import Tensor
from torch.autograd import forward_ad


def primals(tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """The tensors without the tangents of the level whose `jvp` rule is running.

    Those of outer levels stay, so that under `outer_levels` the rule itself can be differentiated.
    """
    return tuple(forward_ad.unpack_dual(x).primal for x in tensors)


def outer_levels() -> AbstractContextManager:
    """Let outer levels of `torch.func.jvp` see what a `jvp` rule computes.

    torch turns forward mode off while it runs the rule of an `autograd.Function`: without this, `jvp` of `jvp` and
    `jacfwd(jacfwd(...))` silently lack every term that goes through the function (torch 2.13).
    """
    return forward_ad._set_fwd_grad_enabled(True)
