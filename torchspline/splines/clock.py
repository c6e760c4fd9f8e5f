"""From times to segments of uniform knots: all time arithmetic of the library, in float64 or whole nanoseconds."""

from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchspline import checks

Extrapolate = Literal["error", "clamp", "linear"]
EXTRAPOLATE: tuple[str, ...] = ("error", "clamp", "linear")


class Located(NamedTuple):
    """Where times fall, each of the shape of the times."""

    #: Segment, int64, and place within it in [0, 1] (float64).
    segment: Tensor
    u: Tensor
    #: How far before the start (negative) or past the end a time lies, in knot spacings; None if none may.
    beyond: Tensor | None


def locate(
    t: Tensor,
    t0: Tensor | float | int,
    dt: Tensor | float | int,
    segments: int,
    extrapolate: Extrapolate,
    validate: bool,
) -> Located:
    """Segment and place within it, computed before any rounding to float32.

    Args:
        t: seconds (float) with `t0`, `dt` in seconds, or whole nanoseconds (int64) with both in nanoseconds.
        segments: the domain is `[t0, t0 + segments dt]`; a few rounding errors beyond belong to it.
    Raises:
        ValueError: see `_refuse` and `check_float32`. Where values cannot be seen (other devices, `vmap`,
            compilation) times outside give NaN instead.
    """
    if t.dtype == torch.int64:
        elapsed = t - t0
        segment = torch.div(elapsed, dt, rounding_mode="floor").clamp(0, segments - 1)
        within = (elapsed - segment * dt).to(torch.float64)
        u = within / float(dt)
    else:
        if validate:
            check_float32(t, dt)
        s = (t.to(torch.float64) - t0) / dt
        segment = s.detach().floor().clamp(0, segments - 1).nan_to_num().to(torch.int64)
        u = s - segment
    slack = tolerance(t, t0, dt, segments)
    outside = (u.detach() < -slack) | (u.detach() > 1.0 + slack) | u.detach().isnan()
    if extrapolate != "error":
        inside = torch.where(outside, u.clamp(0.0, 1.0), u)
        return Located(segment, inside, u - inside)
    if validate and not _refuse(outside, t, t0, dt, segments):
        u = torch.where(outside, torch.nan, u)
    return Located(segment, u, None)


def tolerance(t: Tensor, t0: Tensor | float | int, dt: Tensor | float | int, segments: int) -> Tensor | float:
    """A few rounding errors of times inside the domain, in knot spacings; nanoseconds are exact."""
    if t.dtype == torch.int64:
        return 0.0
    start, spacing = _detach(t0), _detach(dt)
    share = 8.0 * torch.finfo(t.dtype).eps * (abs(start) / spacing + segments)
    return share.clamp_max(1e-2) if isinstance(share, Tensor) else min(share, 1e-2)


def _detach(x: Tensor | float) -> Any:
    return x.detach() if isinstance(x, Tensor) else x


def check_float32(t: Tensor, dt: Tensor | float) -> None:
    """float32 seconds are welcome while their rounding is far below the knot spacing."""
    if t.dtype != torch.float32 or t.numel() == 0 or not checks.values_visible(t):
        return
    rounding = torch.finfo(torch.float32).eps * t.detach().abs().amax()
    if checks.seen_true(rounding.to(torch.float64) > 1e-3 * _detach(dt)):
        raise ValueError(
            f"t: float32 rounds times near {t.detach().abs().amax().item():.6g} s to {rounding.item():.1e} s, "
            f"more than a thousandth of dt = {float(dt):g} s; pass float64 times, int64 nanoseconds, or times "
            "relative to a nearer origin"
        )


def _refuse(
    outside: Tensor, t: Tensor, t0: Tensor | float | int, dt: Tensor | float | int, segments: int
) -> bool:
    """An error if a time is outside; else whether values could be seen at all."""
    seen = checks.seen_true(outside.any()) if checks.values_visible(t, outside) else None
    if not seen:
        return seen is not None
    unit = "ns" if t.dtype == torch.int64 else "s"
    first = t.detach()[outside].flatten()[0].item()
    end = _detach(t0) + segments * _detach(dt)
    start, stop = (x.item() if isinstance(x, Tensor) else x for x in (_detach(t0), end))
    raise ValueError(
        f"t: {int(outside.sum())} of {outside.numel()} times lie outside the domain [{start}, {stop}] {unit}, "
        f"the first is {first!r}; choose times inside, or extrapolate='clamp' or 'linear'"
    )
