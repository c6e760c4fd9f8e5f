"""The bandwidth of a sensor: low-pass filters in continuous time, run on samples."""

import math

import torch
from torch import Tensor, nn

from torchspline import checks
from torchspline.imu import stamps
from torchspline.imu.parts import keep
from torchspline.imu.scan import Element, prefix
from torchspline.kernels.lowpass import low_pass
from torchspline.kernels.mode import usable

#: Below this |p h| the quotients of `_weights` cancel, and their series of this many terms are exact to rounding.
_SMALL, _TERMS = 1.0, 20


class LowPass(nn.Module):
    """A filter of first order, or of second order (Butterworth), as an analogue filter of a sensor has it.

    It follows the filter's differential equation exactly for a signal that is linear between samples, whatever the
    spacing of these; before the first sample the signal is taken to have been constant. Content that changes much
    between two samples is therefore passed less exactly: at a tenth of the sampling rate the gain is 3 % low.

    Args:
        bandwidth: Hz, where the power is halved (-3 dB); a number or a 0-dim tensor, which may be a `Parameter`.
        order: 1 or 2.
    """

    def __init__(self, bandwidth: Tensor | float, order: int = 1):
        super().__init__()
        if isinstance(bandwidth, Tensor):
            checks.is_floating_tensor("bandwidth", bandwidth)
            if bandwidth.ndim != 0:
                raise ValueError(
                    f"bandwidth: expected one number (a 0-dim tensor), got shape {tuple(bandwidth.shape)}"
                )
            if (number := checks.seen_number(bandwidth)) is not None:
                checks.positive("bandwidth", number)
        else:
            checks.positive("bandwidth", bandwidth)
            bandwidth = torch.tensor(float(bandwidth), dtype=torch.float64)
        if type(order) is not int or order not in (1, 2):
            raise ValueError(f"order: expected 1 or 2, got {order!r}")
        self.order = order
        self.bandwidth: Tensor
        keep(self, "bandwidth", bandwidth)

    def forward(self, x: Tensor, t: Tensor) -> Tensor:
        """The filtered signal.

        Args:
            x: (*batch, N, C). t: the times of its samples, increasing, (N,) or (*batch, N), seconds or int64
                nanoseconds.
        Returns:
            Like `x`. Differentiable in `x`, `t` and the bandwidth.
        Raises:
            TypeError, ValueError: a wrong type, shape or value.
        """
        checks.is_floating_tensor("x", x)
        if x.ndim < 2:
            raise ValueError(f"x: expected shape (*batch, N, C), got {tuple(x.shape)}")
        batch = checks.broadcast(x=x.shape[:-2], t=t.shape[:-1]) if isinstance(t, Tensor) else x.shape[:-2]
        step = stamps.intervals(t, (*batch, x.shape[-2]), torch.float64, device=x.device)
        if step.shape[-1] == 0:  # a single sample, or none: as constant as it has been before
            return x.expand(*batch, *x.shape[-2:])
        pole, gain = self._pole()
        tracked = torch.is_grad_enabled() and any(y.requires_grad for y in (x, step, pole))
        if not tracked and usable(x, step, self.bandwidth):
            return _fused(x, step, complex(pole.item()), complex(gain.item()))
        return _reference(x, step, pole, gain)

    def _pole(self) -> tuple[Tensor, Tensor]:
        """H(s) = Re of gain / (s - pole), for real signals."""
        w = 2.0 * math.pi * self.bandwidth.to(torch.float64)
        if self.order == 1:
            return torch.complex(-w, torch.zeros_like(w)), torch.complex(w, torch.zeros_like(w))
        # w^2 / (s^2 + sqrt(2) w s + w^2): poles w (-1 +- i) / sqrt(2), residues -+ i w / sqrt(2), two of each.
        half = w / math.sqrt(2.0)
        return torch.complex(-half, half), torch.complex(torch.zeros_like(w), -2.0 * half)

    def extra_repr(self) -> str:
        return f"bandwidth={float(self.bandwidth.detach()):g} Hz, order={self.order}"


def _weights(z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of the state before, and of the input before and now, over an interval of `z = p h`.

    y' = p y + g u with u linear from u0 to u1 over h has y1 = e^z y0 + (g/p) [(a - b) u0 + b u1] with
    a = e^z - 1 and b = (e^z - 1 - z) / z.
    """
    small = z.detach().abs() < _SMALL
    big = torch.where(small, torch.ones_like(z), z)
    tiny = torch.where(small, z, torch.zeros_like(z))
    series = torch.zeros_like(z)
    for k in range(_TERMS, 1, -1):  # (e^z - 1 - z) / z = z/2! + z^2/3! + ...
        series = (series + 1.0) * tiny / k
    b = torch.where(small, series, (big.exp() - 1.0 - big) / big)
    a = z + z * b
    return a + 1.0, a - b, b


def _reference(x: Tensor, step: Tensor, pole: Tensor, gain: Tensor) -> Tensor:
    """By tensor operations, differentiable to any order."""
    through, before, now = (y.unsqueeze(-1) for y in _weights(pole * step))
    share = gain / pole
    u = x.to(torch.float64)
    driven = share * (before * u[..., :-1, :] + now * u[..., 1:, :])
    start = -share * u[..., :1, :].expand(*driven.shape[:-2], 1, driven.shape[-1])
    factor = torch.cat([torch.ones_like(through[..., :1, :]), through], -2)
    states = prefix(
        _follow, (factor.expand(*driven.shape[:-2], -1, driven.shape[-1]), torch.cat([start, driven], -2))
    )[1]
    return states.real.to(x.dtype)


def _follow(earlier: Element, later: Element) -> Element:
    """Two steps y -> a y + x in a row."""
    (a, x), (b, y) = earlier, later
    return a * b, b * x + y


def _fused(x: Tensor, step: Tensor, pole: complex, gain: complex) -> Tensor:
    batch = torch.broadcast_shapes(x.shape[:-2], step.shape[:-1])
    x = x.expand(*batch, *x.shape[-2:])
    rows = batch.numel()
    steps = step if step.ndim == 1 else step.expand(*batch, step.shape[-1])
    flat_steps = steps.detach().reshape(1 if step.ndim == 1 else rows, steps.shape[-1]).contiguous().numpy()
    samples = x.detach().reshape(rows, *x.shape[-2:]).contiguous().numpy()
    return torch.from_numpy(low_pass(samples, flat_steps, pole, gain)).reshape(x.shape)
