"""Compiled loops that go through time sample after sample: what cannot be split into independent rows."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchspline.kernels.build import compiled
from torchspline.kernels.threads import SERIAL_BELOW, run, spans

Array = NDArray[Any]

# `strides` of the factors along rows, samples and channels: 0 where one number serves all.
_LINEAR = """\
from numba import njit


@njit("{signature}", nogil=True, cache={cache}, error_model="numpy")
def linear_recurrence(factors, x, y, samples, channels, by_row, by_sample, by_channel, begin, stop):
    for row in range(begin, stop):
        at = row * samples * channels
        for c in range(channels if samples else 0):
            y[at + c] = x[at + c]
        for i in range(1, samples):
            factor = row * by_row + i * by_sample
            at += channels
            for c in range(channels):
                y[at + c] = x[at + c] + factors[factor + c * by_channel] * y[at + c - channels]
"""


@cache
def _linear(real: str) -> Callable[..., None]:
    arrays = ", ".join([f"{real}[::1]"] * 3)
    return compiled("linear_recurrence", _LINEAR, f"({arrays}{', int64' * 7})")


def linear_recurrence(factors: Array, x: Array) -> Array:
    """`y[:, k] = factors[:, k] y[:, k-1] + x[:, k]` with `y[:, 0] = x[:, 0]`; all contiguous.

    Args:
        factors: (1 or rows, N, 1 or channels); those of the first sample are not used. x: (rows, N, channels).
    """
    rows, samples, channels = x.shape
    y = np.empty_like(x)
    by = zip(factors.strides, factors.shape, strict=True)
    strides = [step // factors.itemsize if size > 1 else 0 for step, size in by]
    kernel = _linear(x.dtype.name)
    arguments = (factors.reshape(-1), x.reshape(-1), y.reshape(-1), samples, channels, *strides)
    parts = torch.get_num_threads() if x.size >= SERIAL_BELOW else 1
    run([partial(kernel, *arguments, begin, stop) for begin, stop in spans(rows, parts, 1)])
    return y
