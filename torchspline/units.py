"""Units of time: seconds (floating), and whole nanoseconds (int64), which tell stamps since an epoch apart."""

import torch
from torch import Tensor

#: Nanoseconds in a second, exact, and seconds in a nanosecond.
SECOND = 1_000_000_000
NANOSECOND = 1e-9


def unit_of(t: Tensor) -> float:
    """Seconds in a unit of these times: int64 are nanoseconds, all others seconds."""
    return NANOSECOND if t.dtype == torch.int64 else 1.0


def seconds(span: Tensor) -> Tensor:
    """Differences of times as float64 seconds; those of an epoch have to be taken first, in whole nanoseconds."""
    # Before the factor: torch makes float32 of whole numbers times a float.
    span_s = span.to(torch.float64)
    return span_s * NANOSECOND if span.dtype == torch.int64 else span_s


def seconds_since(t: Tensor, origin: float | int) -> Tensor:
    """Times as float64 seconds from an origin in their unit."""
    return seconds(t - int(origin)) if t.dtype == torch.int64 else t.to(torch.float64) - origin


def nanoseconds(span_s: Tensor) -> Tensor:
    """The nearest whole nanoseconds, int64, of float64 seconds."""
    return (span_s * SECOND).round().to(torch.int64)
