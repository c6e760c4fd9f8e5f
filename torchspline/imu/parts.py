"""Keeping and checking the parameters that sensors are made of."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchspline import checks
from torchspline.splines.trajectory import Trajectory


def keep(module: nn.Module, name: str, x: Tensor | None) -> None:
    """A `Parameter` or a tensor that carries a graph as given, any other as a copy that is not learnt."""
    if isinstance(x, nn.Parameter):
        module.register_parameter(name, x)
    else:
        module.register_buffer(name, x if x is None or x.requires_grad else x.detach().clone())


def tensor_of(name: str, x: Any, shape: tuple[int, ...], meaning: str, batched: bool = True) -> Tensor | None:
    """`x` (a tensor, a number, nested sequences of numbers, None) as a floating tensor (*batch, *shape).

    A number stands for all entries of a vector. Sequences become float64.
    """
    if x is None:
        return None
    if isinstance(x, Tensor):
        checks.is_floating_tensor(name, x)
    else:
        try:
            x = torch.tensor(x, dtype=torch.float64)
        except (TypeError, ValueError, RuntimeError):
            raise TypeError(f"{name}: expected a tensor or numbers, {meaning}, got {x!r}") from None
    if x.ndim == 0 and len(shape) == 1:
        x = x.expand(shape)
    size = len(shape)
    if tuple(x.shape[x.ndim - size :]) != shape or x.ndim < size or (x.ndim > size and not batched):
        lead = "(*batch, " if batched else "("
        numbers = ", ".join(map(str, shape)) + ("," if len(shape) == 1 and not batched else "")
        raise ValueError(f"{name}: expected shape {lead}{numbers}), {meaning}, got {tuple(x.shape)}")
    checks.finite(name, x)
    return x


def above_zero(name: str, x: Tensor | None, zero_too: bool = False) -> None:
    """Every number is positive (or zero)."""
    if x is None or not checks.values_visible(x):
        return
    y = x.detach()
    good = y >= 0 if zero_too else y > 0
    if checks.seen_true(good.all()) is False:
        where = tuple(torch.nonzero(~good)[0].tolist())
        least = "of at least zero" if zero_too else "above zero"
        raise ValueError(f"{name}: expected numbers {least}, got {y[where].item():g}")


def along_time(x: Tensor, like: Tensor, dims: int = 1) -> Tensor:
    """A parameter (*batch, ...) with `dims` of its own as (*batch, 1, ...), of the dtype of `like`."""
    if x.device != like.device:
        raise ValueError(
            f"trajectory: on device {like.device}, but the sensor is on {x.device}; move one with .to(device)"
        )
    x = x.to(like.dtype)
    return x if x.ndim == dims else x.unsqueeze(-1 - dims)


def bias_of(name: str, x: Any, size: int, unit: str) -> Tensor | Trajectory | None:
    """A constant bias, or a trajectory in R^size whose value it is."""
    if isinstance(x, Trajectory):
        if x.group.name != f"R{size}" and x.group.point_size != size:
            raise ValueError(f"{name}: expected a trajectory in R{size}, got one in {x.group}")
        return x
    return tensor_of(name, x, (size,), f"{unit}, or a trajectory in R{size}")


def times_of(t: Tensor, trajectory: Trajectory) -> Tensor:
    """The stamps, checked as far as sampling needs it before the trajectory sees them."""
    checks.instance("trajectory", trajectory, Trajectory, "a Trajectory")
    if not isinstance(t, Tensor):
        raise TypeError(
            f"t: expected a torch.Tensor, got {type(t).__name__}; convert it with torch.as_tensor"
        )
    if t.dtype not in (torch.float32, torch.float64, torch.int64):
        raise TypeError(f"t: expected dtype torch.float32, torch.float64 or torch.int64, got {t.dtype}")
    if t.dtype != torch.int64:
        checks.finite("t", t)
    return t


def common_batch(*shapes: Sequence[int]) -> torch.Size:
    """The batch that trajectory, times and parameters make together."""
    try:
        return torch.broadcast_shapes(*shapes)
    except RuntimeError:
        listed = ", ".join(str(tuple(shape)) for shape in shapes)
        raise ValueError(
            f"trajectory: batch shapes of trajectory, times and sensor do not broadcast: {listed}"
        ) from None
