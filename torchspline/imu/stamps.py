"""Times of samples as intervals between them."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchspline import checks, units

#: What float32 may round off times, as a share of the mean interval. That errors of intervals sum to nothing is why it
#: may be more than the thousandth of a spline's spacing.
_ROUNDED = 0.05


def intervals(
    t: Tensor,
    samples: Sequence[int],
    dtype: torch.dtype,
    repeated: bool = False,
    device: torch.device | None = None,
) -> Tensor:
    """Seconds between neighbouring times, (..., N - 1); differences are taken before any rounding.

    Args:
        t: seconds (float; in float32 within 2000 s of zero at 200 Hz) or nanoseconds (int64), (N,) or what broadcasts
            to `samples`. samples: (*batch, N).
        repeated: whether times may be equal. device: where the samples are, if they are somewhere.
    Raises:
        TypeError, ValueError: not times, of a wrong shape, not increasing, or float32 too far from zero.
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
    if t.dtype == torch.float32:
        _check_rounding(t.detach(), steps.detach())
    return (units.seconds(steps) if t.dtype == torch.int64 else steps).to(dtype)


def _check_rounding(t: Tensor, steps: Tensor) -> None:
    """Refuses single precision where intervals are made of rounding errors."""
    if steps.numel() == 0 or not checks.values_visible(t):
        return
    rounding = torch.finfo(torch.float32).eps * t.abs().amax(-1)
    interval = steps.mean(-1)
    if checks.seen_true(((rounding > _ROUNDED * interval) & (interval > 0)).any()):
        raise ValueError(
            f"t: float32 rounds times near {t.abs().max().item():.3g} s to {rounding.max().item():.1g} s, more than "
            f"a twentieth of the interval of {interval.min().item():.3g} s; pass float64 times, int64 nanoseconds, or "
            "times relative to a nearer origin"
        )
