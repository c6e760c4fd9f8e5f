"""A compiled loop for low-pass filters: a complex state that follows each signal through time."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchspline.kernels.build import compiled
from torchspline.kernels.threads import SERIAL_BELOW, run, spans

Array = NDArray[Any]

# The state s follows s' = p s + g u, the result is its real part; the formulas are those of `imu/filters.py`.
# Weights are kept while intervals are equal up to their rounding.
_SOURCE = """\
import math
import numpy as np
from numba import njit


@njit("{signature}", nogil=True, cache={cache}, error_model="numpy")
def low_pass(x, step, y, samples, channels, by_row, pr, pi, gr, gi, begin, stop):
    size = pr * pr + pi * pi
    qr, qi = (gr * pr + gi * pi) / size, (gi * pr - gr * pi) / size
    state = np.empty((2, channels))
    last, er, ei, dr, di, br, bi = -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for row in range(begin, stop):
        at = row * samples * channels
        for c in range(channels if samples else 0):
            u = x[at + c]
            state[0, c] = -qr * u
            state[1, c] = -qi * u
            y[at + c] = -qr * u
        for i in range(1, samples):
            h = step[row * by_row + i - 1]
            if not abs(h - last) <= 1e-12 * last:
                last = h
                zr, zi = pr * h, pi * h
                if zr * zr + zi * zi < 0.25:
                    br, bi = 0.0, 0.0
                    for k in range(16, 1, -1):
                        br, bi = ((br + 1.0) * zr - bi * zi) / k, ((br + 1.0) * zi + bi * zr) / k
                    er, ei = 1.0 + zr * (1.0 + br) - zi * bi, zi * (1.0 + br) + zr * bi
                else:
                    grown = math.exp(zr)
                    er, ei = grown, 0.0
                    if zi != 0.0:
                        er, ei = grown * math.cos(zi), grown * math.sin(zi)
                    nr, ni = er - 1.0 - zr, ei - zi
                    square = zr * zr + zi * zi
                    br, bi = (nr * zr + ni * zi) / square, (ni * zr - nr * zi) / square
                ar, ai = er - 1.0 - br, ei - bi
                dr, di = qr * ar - qi * ai, qr * ai + qi * ar
                br, bi = qr * br - qi * bi, qr * bi + qi * br
            at += channels
            for c in range(channels):
                before, now = x[at + c - channels], x[at + c]
                sr, si = state[0, c], state[1, c]
                state[0, c] = er * sr - ei * si + dr * before + br * now
                state[1, c] = er * si + ei * sr + di * before + bi * now
                y[at + c] = state[0, c]
"""


@cache
def _kernel(real: str) -> Callable[..., None]:
    arrays = f"{real}[::1], float64[::1], {real}[::1]"
    return compiled("low_pass", _SOURCE, f"({arrays}, int64, int64, int64{', float64' * 4}, int64, int64)")


def low_pass(x: Array, step: Array, pole: complex, gain: complex) -> Array:
    """Real part of the state of `s' = pole s + gain x`, x linear between samples; at rest before the first.

    Args:
        x: (rows, N, channels), contiguous. step: (1 or rows, N - 1), float64, contiguous, above zero.
    """
    rows, samples, channels = x.shape
    y = np.empty_like(x)
    by_row = step.shape[1] if step.shape[0] > 1 else 0
    arguments = (x.reshape(-1), step.reshape(-1), y.reshape(-1), samples, channels, by_row,
                 pole.real, pole.imag, gain.real, gain.imag)  # fmt: skip
    parts = torch.get_num_threads() if x.size >= SERIAL_BELOW else 1
    kernel = _kernel(x.dtype.name)
    run([partial(kernel, *arguments, begin, stop) for begin, stop in spans(rows, parts, 1)])
    return y
