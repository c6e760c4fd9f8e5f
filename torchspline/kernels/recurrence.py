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

# Products stay of unit length by one step of Newton's method each, which needs neither root nor division. They are kept
# in double precision: steps of slow rates are not much above what rounds off a quaternion in single precision.
_ROTATIONS = """\
from numba import njit


@njit("{signature}", nogil=True, cache={cache}, error_model="numpy")
def rotation_products(start, steps, products, samples, begin, stop):
    for row in range(begin, stop):
        first, at, to = row * 4, row * samples * 4, row * (samples + 1) * 4
        w, x, y, z = float(start[first]), float(start[first + 1]), float(start[first + 2]), float(start[first + 3])
        products[to], products[to + 1], products[to + 2], products[to + 3] = w, x, y, z
        for i in range(samples):
            a, b, c, d = steps[at], steps[at + 1], steps[at + 2], steps[at + 3]
            p = w * a - x * b - y * c - z * d
            q = w * b + x * a + y * d - z * c
            r = w * c - x * d + y * a + z * b
            s = w * d + x * c - y * b + z * a
            scale = 1.5 - 0.5 * (p * p + q * q + r * r + s * s)
            w, x, y, z = scale * p, scale * q, scale * r, scale * s
            at += 4
            to += 4
            products[to], products[to + 1], products[to + 2], products[to + 3] = w, x, y, z
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


@cache
def _rotations(real: str) -> Callable[..., None]:
    arrays = ", ".join([f"{real}[::1]"] * 3)
    return compiled("rotation_products", _ROTATIONS, f"({arrays}{', int64' * 3})")


def rotation_products(start: Array, steps: Array) -> Array:
    """`start, start steps_0, start steps_0 steps_1, ...`, (rows, N + 1, 4); all contiguous unit quaternions.

    Args:
        start: (rows, 4). steps: (rows, N, 4).
    """
    rows, samples, _ = steps.shape
    products = np.empty((rows, samples + 1, 4), steps.dtype)
    kernel = _rotations(steps.dtype.name)
    arguments = (start.reshape(-1), steps.reshape(-1), products.reshape(-1), samples)
    parts = torch.get_num_threads() if steps.size >= SERIAL_BELOW else 1
    run([partial(kernel, *arguments, begin, stop) for begin, stop in spans(rows, parts, 1)])
    return products
