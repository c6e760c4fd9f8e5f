"""Times of samples as intervals between them."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchspline import checks

_NANOSECOND = 1e-9


def intervals(
    t: Tensor,
    samples: Sequence[int],
    dtype: torch.dtype,
    repeated: bool = False,
    device: torch.device | None = None,
) -> Tensor:
    """Seconds between neighbouring times, (..., N - 1); differences are taken before any rounding.

    Args:
        t: seconds (float) or nanoseconds (int64), (N,) or what broadcasts to `samples`. samples: (*batch, N).
        repeated: whether times may be equal. device: where the samples are, if they are somewhere.
    Raises:
        TypeError, ValueError: not times, of a wrong shape, or not increasing.
    """
    if not isinstance(t, Tensor):
        raise TypeError(
            f"t: expected a torch.Tensor, got {type(t).__name__}; convert it with torch.as_tensor"
        )
    if t.dtype != torch.int64:
        if t.dtype not in (torch.float32, torch.float64):
            raise TypeError(
                f"t: expected dtype torch.float32 or torch.float64, or torch.int64, got {t.dtype}"
            )
        checks.finite("t", t)
    if device is not None and t.device != device:
        raise ValueError(
            f"t: on device {t.device}, but the samples are on {device}; move one with .to(device)"
        )
    if t.ndim == 0 or t.shape[-1] != samples[-1]:
        raise ValueError(
            f"t: expected shape ({samples[-1]},) or (*batch, {samples[-1]}), a time for each sample, "
            f"got {tuple(t.shape)}"
        )
    try:
        fits = torch.broadcast_shapes(t.shape, samples) == torch.Size(samples)
    except RuntimeError:
        fits = False
    if not fits:
        raise ValueError(f"t: expected what broadcasts to {tuple(samples)}, got {tuple(t.shape)}")
    steps = t.diff(dim=-1)
    backward = steps.detach() < 0 if repeated else steps.detach() <= 0
    if checks.values_visible(steps) and checks.seen_true(backward.any()):
        at = torch.nonzero(backward)[0].tolist()
        a, b = (t.detach()[(*at[:-1], at[-1] + i)].item() for i in (0, 1))
        expected = "times that do not decrease" if repeated else "increasing times"
        raise ValueError(f"t: expected {expected}, got {a} and then {b}")
    seconds = steps.to(torch.float64) * _NANOSECOND if t.dtype == torch.int64 else steps
    return seconds.to(dtype)
