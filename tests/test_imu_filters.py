"""Low-pass filters of sensors: against transfer functions, and against matrix exponentials step by step."""

import math

import numpy as np
import pytest
import torch
from batteries import generator
from scipy.linalg import expm
from scipy.signal import butter

from torchspline import imu, use_kernels

F32, F64 = torch.float32, torch.float64
ORDERS = pytest.mark.parametrize("order", [1, 2])
BANDWIDTH = 20.0


def uneven(*shape, seed=0):
    """Times about 10 ms apart, some of them a hundredth of that, some ten times."""
    steps = 0.01 * 10 ** (3 * torch.rand(shape, generator=generator(seed), dtype=F64) - 2)
    return steps.cumsum(-1)


def noise(*shape, seed=1):
    return torch.randn(shape, generator=generator(seed), dtype=F64)


@ORDERS
@pytest.mark.parametrize("frequency", [0.5, 5.0, 20.0, 40.0, 80.0])
def test_gain_and_phase_are_those_of_the_transfer_function(order, frequency):
    rate = 200.0
    t = torch.arange(2000, dtype=F64) / rate
    tones = torch.stack([torch.cos(2 * math.pi * frequency * t), torch.sin(2 * math.pi * frequency * t)], -1)
    out = imu.LowPass(BANDWIDTH, order)(tones, t).numpy()[-1]
    measured = complex(out[0], out[1]) / np.exp(2j * math.pi * frequency * t[-1].item())
    b, a = butter(order, 2 * math.pi * BANDWIDTH, analog=True)

    def H(f):
        return np.polyval(b, 2j * math.pi * f) / np.polyval(a, 2j * math.pi * f)

    # What is linear between samples holds images of the tone around every multiple of the rate.
    images = np.arange(-3000, 3001)
    expected = (np.sinc(frequency / rate + images) ** 2 * H(frequency + images * rate)).sum()
    assert abs(measured - expected) < 1e-8
    if frequency <= 5.0:
        assert abs(measured - H(frequency)) < 2.5e-3
    if frequency == BANDWIDTH:  # a tenth of the rate
        assert abs(abs(measured) / math.sqrt(0.5) - 0.967) < 5e-3


@ORDERS
def test_uneven_steps_follow_the_differential_equation(order):
    t, x = uneven(60), noise(60, 1)
    b, a = butter(order, 2 * math.pi * BANDWIDTH, analog=True)
    companion = np.diag(np.ones(order - 1), 1)
    companion[-1] = -a[:0:-1] / a[0]
    states = [np.r_[x[0].item(), np.zeros(order - 1)]]
    for step, before, now in zip(t.diff().tolist(), x[:-1, 0].tolist(), x[1:, 0].tolist(), strict=True):
        # State, input and the slope of the input, which is constant over the step.
        whole = np.zeros((order + 2, order + 2))
        whole[:order, :order] = companion
        whole[order - 1, order] = b[-1]
        whole[order, order + 1] = 1.0
        states.append((expm(whole * step) @ np.r_[states[-1], before, (now - before) / step])[:order])
    expected = np.array(states)[:, 0]
    np.testing.assert_allclose(imu.LowPass(BANDWIDTH, order)(x, t)[:, 0].numpy(), expected, atol=1e-12)


@ORDERS
@pytest.mark.parametrize("dtype", [F32, F64])
def test_the_loop_equals_the_reference(order, dtype):
    low_pass, x = imu.LowPass(BANDWIDTH, order), noise(2, 3, 40, 2).to(dtype)
    for t in (
        uneven(40),
        uneven(3, 40),
        uneven(2, 3, 40),
        (uneven(40) * 1e9).to(torch.int64),
        0.01 * torch.arange(40.0),
    ):
        with use_kernels("reference"):
            expected = low_pass(x, t)
        with use_kernels("fused"), torch.no_grad():
            assert torch.allclose(low_pass(x, t), expected, rtol=0, atol=1e-12 if dtype == F64 else 1e-6)
        assert expected.dtype == dtype
        assert expected.shape == x.shape
    with use_kernels("fused"), torch.no_grad():  # one signal, a clock for each
        assert torch.equal(low_pass(x[0, 0], uneven(3, 40))[1], low_pass(x[0, 0], uneven(3, 40)[1]))


@ORDERS
def test_gradients(order):
    x, t, bandwidth = noise(2, 6, 2), uneven(6), torch.tensor(BANDWIDTH, dtype=F64)
    inputs = [y.clone().requires_grad_() for y in (x, t, bandwidth)]
    assert torch.autograd.gradcheck(lambda x, t, f: imu.LowPass(f, order)(x, t), inputs)
    assert torch.autograd.gradgradcheck(lambda x, t, f: imu.LowPass(f, order)(x, t), inputs)


@ORDERS
def test_what_does_not_change_passes(order):
    x = noise(3).expand(50, 3)
    assert torch.allclose(imu.LowPass(BANDWIDTH, order)(x, uneven(50)), x, atol=1e-14)
    assert torch.equal(imu.LowPass(BANDWIDTH, order)(x[:1], uneven(50)[:1]), x[:1])
