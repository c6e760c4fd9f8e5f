"""Keeping and checking the parameters that sensors are made of."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchspline import checks, units
from torchspline.splines.trajectory import Trajectory

#: A parameter of a sensor: a tensor, numbers, or one number for all its entries; None where there is none.
Given = Tensor | Sequence[float] | float | None


def keep(module: nn.Module, name: str, x: Tensor | None) -> None:
    """A `Parameter` or a tensor that carries a graph as given, any other as a copy that is not learnt."""
    if isinstance(x, nn.Parameter):
        module.register_parameter(name, x)
    else:
        module.register_buffer(name, x if x is None or x.requires_grad else x.clone())


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
            if isinstance(x, bool):
                raise TypeError
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


def along_time(x: Tensor, like: Tensor, name: str = "trajectory") -> Tensor:
    """A parameter (n,) or (*batch, n) as (n,) or (*batch, 1, n), of the dtype of `like`, which errors call `name`."""
    if x.device != like.device:
        raise ValueError(
            f"{name}: on device {like.device}, but the sensor is on {x.device}; move one with .to(device)"
        )
    x = x.to(like.dtype)
    return x if x.ndim == 1 else x.unsqueeze(-2)


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
        raise TypeError(
            "t: expected seconds as torch.float32 or torch.float64, or nanoseconds as torch.int64, "
            f"got {t.dtype}"
        )
    if t.dtype != torch.int64:
        checks.finite("t", t)
    return t


def sample_rate(t: Tensor, rate: float | None) -> Tensor:
    """Samples per second of the sensor: `rate`, (), or else the mean over the stamps `t` (*batch, N), (*batch,).

    Each row has its own: what one of a batch reads must not depend on the stamps of the others.
    """
    if rate is not None:
        return torch.tensor(float(rate), dtype=torch.float64, device=t.device)
    if t.shape[-1] < 2:
        raise ValueError(
            f"rate: expected samples per second where stamps have no interval ({t.shape[-1]} of them), got None"
        )
    seconds = units.seconds((t[..., -1] - t[..., 0]).detach())
    if checks.values_visible(seconds) and checks.seen_true((seconds > 0).all()) is False:
        raise ValueError(f"t: expected increasing times, got a duration of {seconds.min().item():g} s")
    return (t.shape[-1] - 1) / seconds


def batch_of(trajectory: Trajectory, t: Tensor) -> torch.Size:
    """The batch of readings of the trajectory at the times `t`, (N,) or (*batch, N)."""
    if t.shape[-1] == 0:
        return t.shape[:-1]
    start, stop = trajectory.domain
    with torch.no_grad():
        motion = trajectory.kinematics(t.detach()[..., :1].clamp(start, stop))
    moving = motion.rotation if motion.rotation is not None else motion.position
    assert moving is not None
    return moving.shape[:-2]


def drawing_device(generator: Any, device: torch.device) -> torch.device:
    """Where random numbers are drawn: where their generators are, so that a CPU's serve a GPU, too."""
    first = generator[0] if isinstance(generator, Sequence) and len(generator) else generator
    return first.device if isinstance(first, torch.Generator) else device
