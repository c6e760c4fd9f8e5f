"""Checks at the public boundary: each error names the argument, what came and what was expected."""

import math
from collections.abc import Sequence
from numbers import Real
from operator import attrgetter
from typing import Any, Protocol

import torch
from torch import Tensor


class HasPoints(Protocol):
    """What `points` wants to know of a group; this module lies below the groups."""

    @property
    def point_size(self) -> int: ...

    @property
    def arithmetic(self) -> Any: ...


#: Quaternions may have any length in this range; beyond it their squares leave the range of float32.
SHORTEST_QUATERNION, LONGEST_QUATERNION = 1e-15, 1e15
_is_cpu = attrgetter("is_cpu")


def is_floating_tensor(name: str, x: object) -> Tensor:
    """`x` itself if it is a float32 or float64 tensor."""
    if not isinstance(x, Tensor):
        raise TypeError(
            f"{name}: expected a torch.Tensor, got {type(x).__name__}; convert it with torch.as_tensor"
        )
    if x.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"{name}: expected dtype torch.float32 or torch.float64, got {x.dtype}")
    return x


def is_times(name: str, x: object) -> Tensor:
    """`x` itself if it holds times: floating seconds, or whole nanoseconds (int64)."""
    if isinstance(x, Tensor) and x.dtype == torch.int64:
        return x
    if isinstance(x, Tensor) and x.dtype not in (torch.float32, torch.float64):
        raise TypeError(
            f"{name}: expected dtype torch.float32 or torch.float64 (seconds) or torch.int64 (nanoseconds), "
            f"got {x.dtype}"
        )
    return is_floating_tensor(name, x)


def has_last(name: str, x: Tensor, size: int, meaning: str) -> Tensor:
    """`x` itself if its last dimension is `size`."""
    if x.ndim == 0 or x.shape[-1] != size:
        raise ValueError(f"{name}: expected shape (..., {size}), {meaning}, got {tuple(x.shape)}")
    return x


def same_kind(**tensors: Tensor) -> None:
    """All tensors agree in dtype and device."""
    (first_name, first), *others = tensors.items()
    for name, x in others:
        if x.dtype != first.dtype:
            raise TypeError(
                f"{name}: dtype {x.dtype} differs from that of {first_name}, {first.dtype}; "
                "convert one of them with .to(dtype)"
            )
        if x.device != first.device:
            raise ValueError(
                f"{name}: on device {x.device}, but {first_name} is on {first.device}; move one with .to(device)"
            )


def broadcast(**shapes: Sequence[int]) -> torch.Size:
    """The common shape of the named shapes."""
    try:
        return torch.broadcast_shapes(*shapes.values())
    except RuntimeError:
        listed = ", ".join(f"{name} {tuple(shape)}" for name, shape in shapes.items())
        raise ValueError(f"batch shapes do not broadcast: {listed}") from None


def values_visible(*tensors: Tensor) -> bool:
    """Whether looking at values is possible and free of a device round trip: eager code on the CPU."""
    return not torch.compiler.is_compiling() and all(map(_is_cpu, tensors))


def finite(name: str, x: Tensor) -> None:
    """Every number is finite. Silent where values cannot be seen (other devices, `vmap`, compilation)."""
    if not values_visible(x) or x.numel() == 0:
        return
    x = x.detach()
    # A sum is finite only if every term is, and needs no memory; if it is not, look again to be sure.
    if _truth(torch.isfinite(x.sum())) or _truth(torch.isfinite(x).all()):
        return
    where = tuple(torch.nonzero(~torch.isfinite(x))[0].tolist())
    raise ValueError(f"{name}: expected finite numbers, got {x[where].item()} at index {where}")


def quaternions(name: str, x: Tensor, blocks: Sequence[tuple[int, int]]) -> None:
    """Every quaternion (or [cos, sin]) in the component ranges `blocks` has a length that can be divided by."""
    if not values_visible(x) or x.numel() == 0:
        return
    for start, stop in blocks:
        length = x.detach()[..., start:stop].norm(dim=-1)
        good = (length >= SHORTEST_QUATERNION * 0.999) & (length <= LONGEST_QUATERNION * 1.001)
        if _truth(good.all()):
            continue
        where = tuple(torch.nonzero(~good)[0].tolist())
        what = "quaternions" if stop - start == 4 else "pairs [cos, sin]"
        raise ValueError(
            f"{name}: expected {what} (components {start} to {stop - 1}) of a length between "
            f"{SHORTEST_QUATERNION:g} and {LONGEST_QUATERNION:g}, got length {length[where].item():g} "
            f"at index {where}"
        )


def points(name: str, x: Tensor, group: "HasPoints", least: int, look: bool = True) -> None:
    """A sequence `(*batch, M, P)` of at least `least` points of `group`, finite, with usable quaternions.

    Args:
        look: whether to look at values.
    """
    is_floating_tensor(name, x)
    if x.ndim < 2 or x.shape[-1] != group.point_size:
        raise ValueError(
            f"{name}: expected shape (..., M, {group.point_size}), M points of {group}, got {tuple(x.shape)}"
        )
    if x.shape[-2] < least:
        raise ValueError(f"{name}: expected at least {least} points of {group}, got {x.shape[-2]}")
    if not look:
        return
    finite(name, x)
    quaternions(name, x, group.arithmetic.unit_blocks)


def unit_length(name: str, x: Tensor, tolerance: float) -> None:
    """Every vector along the last dimension has length one up to `tolerance`."""
    if not values_visible(x) or x.numel() == 0:
        return
    length = x.detach().norm(dim=-1)
    good = (length - 1.0).abs() <= tolerance
    if _truth(good.all()):
        return
    where = tuple(torch.nonzero(~good)[0].tolist())
    raise ValueError(
        f"{name}: expected vectors of length one, got length {length[where].item():g} at index {where}"
    )


def close_matrices(name: str, x: Tensor, valid: Tensor, tolerance: float) -> None:
    """Every matrix equals its nearest valid one up to `tolerance`, relative to entries above one."""
    if not values_visible(x) or x.numel() == 0:
        return
    defect = ((x.detach() - valid).abs() / valid.abs().clamp_min(1.0)).amax(dim=(-1, -2))
    if _truth((defect <= tolerance).all()):
        return
    where = tuple(torch.nonzero(~(defect <= tolerance))[0].tolist())
    raise ValueError(
        f"{name}: expected matrices of the group, but the one at index {where} is off by "
        f"{defect[where].item():.1e}: rotation blocks must be orthonormal with determinant one"
    )


def point(name: str, x: Tensor, group: "HasPoints", meaning: str) -> None:
    """Points `(..., P)` of `group`, finite, with usable quaternions."""
    is_floating_tensor(name, x)
    has_last(name, x, group.point_size, meaning)
    finite(name, x)
    quaternions(name, x, group.arithmetic.unit_blocks)


def instance(name: str, x: object, kind: type, meaning: str) -> None:
    """`x` is a `kind`."""
    if not isinstance(x, kind):
        raise TypeError(f"{name}: expected {meaning}, got {type(x).__name__}")


def number(name: str, x: float) -> None:
    """A real number of Python or NumPy; neither a truth value nor a tensor."""
    if isinstance(x, bool) or not isinstance(x, Real):
        raise TypeError(f"{name}: expected a number, got {type(x).__name__}")


def whole(name: str, x: int, least: int) -> None:
    """An int of at least `least`."""
    if isinstance(x, bool) or not isinstance(x, (int, torch.SymInt)) or x < least:
        raise ValueError(f"{name}: expected a whole number of at least {least}, got {x!r}")


def positive(name: str, x: float) -> float:
    """A finite number above zero."""
    number(name, x)
    if not (math.isfinite(x) and x > 0):
        raise ValueError(f"{name}: expected a finite number above zero, got {x}")
    return x


def finite_number(name: str, x: float) -> float:
    """A finite number."""
    number(name, x)
    if not math.isfinite(x):
        raise ValueError(f"{name}: expected a finite number, got {x}")
    return x


def choice(name: str, x: str, allowed: Sequence[str]) -> str:
    """One of the `allowed` words."""
    if x not in allowed:
        raise ValueError(f"{name}: expected one of {', '.join(map(repr, allowed))}, got {x!r}")
    return x


def seen_number(x: Tensor) -> float | None:
    """The number in a 0-dim tensor, or None where values cannot be seen."""
    if not values_visible(x):
        return None
    try:
        return x.item()
    except RuntimeError:
        return None


def seen_true(condition: Tensor) -> bool | None:
    """Its value, or None where torch will not tell (inside `vmap`)."""
    try:
        return bool(condition)
    except RuntimeError:
        return None


def _truth(condition: Tensor) -> bool:
    """Its value, or True where torch will not tell."""
    return seen_true(condition) is not False
