"""Which implementation runs: compiled kernels or the reference made of tensor operations."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from operator import attrgetter
from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.nn import Parameter

from torchspline import checks
from torchspline.kernels import triton
from torchspline.kernels.build import available

Mode = Literal["auto", "fused", "reference"]
MODES: tuple[str, ...] = ("auto", "fused", "reference")
#: Environment variable with the mode of a process.
VARIABLE = "TORCHSPLINE_KERNELS"

# Subclasses want to see what is done to them.
_PLAIN = {Tensor, Parameter}
_is_cpu = attrgetter("is_cpu")

_mode: ContextVar[str | None] = ContextVar("torchspline_kernels", default=None)


@contextmanager
def use_kernels(mode: Mode) -> Iterator[None]:
    """Within the block use compiled kernels where they can ("auto"), must ("fused"), or may not ("reference") run.

    Holds for the thread that entered the block; others follow the environment variable.
    The results are the same up to rounding. "fused" raises `RuntimeError` where a kernel exists but cannot run; calls
    that have none (group operations on few rows or on a GPU, linear maps) use the reference in every mode.
    """
    checks.choice("mode", mode, MODES)
    token = _mode.set(mode)
    try:
        yield
    finally:
        _mode.reset(token)


def current() -> str:
    mode = _mode.get() or os.environ.get(VARIABLE, "auto")
    return checks.choice(VARIABLE, mode, MODES)


def usable(*tensors: object) -> bool:
    """Whether a loop may serve a call with these tensors (numbers are welcome): eager, on the CPU, untransformed.

    On a GPU there are none, but see `splines/fused.py`.
    """
    mode = current()
    if mode == "reference":
        return False
    seen = [x for x in tensors if isinstance(x, Tensor)]
    eager = plain(*seen)
    here = eager and all(map(_is_cpu, seen)) and available()
    if mode == "fused" and not here and not (eager and all(triton_available(x.device) for x in seen)):
        raise RuntimeError(
            f"{VARIABLE}=fused: no kernel serves this call; kernels need eager tensors outside torch.func transforms "
            "and forward-mode differentiation, and Numba on the CPU or Triton on a GPU"
        )
    return here


def plain(*tensors: Tensor) -> bool:
    """Whether these are numbers in memory, and nothing needs to see what is done to them."""
    return (
        _PLAIN.issuperset(map(type, tensors))
        and not (torch.is_grad_enabled() and any(map(Tensor.is_inference, tensors)))
        and not torch.compiler.is_compiling()
        and not transformed()
    )


def triton_available(device: torch.device) -> bool:
    """Whether kernels can be had for a GPU."""
    return device.type == "cuda" and triton.available(device)


def transformed() -> bool:
    """Whether `torch.func`, forward mode, a tracer or a dispatch mode is at work: they need operations they can see."""
    return (
        torch._C._functorch.peek_interpreter_stack() is not None
        or forward_ad._current_level >= 0
        or torch.jit.is_tracing()
        or torch._C._len_torch_dispatch_stack() > 0
    )


class RefusedError(Exception):
    """A kernel met a value that is not acceptable; the reference's checks say which."""


def batched(x: Tensor | None) -> bool:
    """Whether `x` is a batch in disguise (`vmap`, `is_grads_batched`) rather than numbers in memory."""
    functorch = torch._C._functorch
    return x is not None and (functorch.is_batchedtensor(x) or functorch.is_legacy_batchedtensor(x))


def flat(x: Tensor) -> Any:
    """Its numbers as a flat array, without a copy if they lie in order."""
    return x.detach().contiguous().numpy().reshape(-1)
