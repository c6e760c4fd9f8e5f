"""Noise: distributions against SciPy's, covariances and spectra against formulas, generators against NumPy's."""

import math

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.signal import periodogram

from torchspline import use_kernels
from torchspline.imu import flicker_noise, gauss_markov, item_generator, random_walk, white_noise

F32, F64 = torch.float32, torch.float64
MODES = pytest.mark.parametrize("mode", ["reference", "auto"])


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def jittered(count, interval=0.01, seed=5, *batch):
    steps = interval * (0.2 + 1.6 * torch.rand((*batch, count), generator=seeded(seed), dtype=F64))
    return 3.0 + steps.cumsum(-1)


def processes(t, shape, generator, dtype=None):
    """One of each kind."""
    return {
        "white": white_noise(shape, 1e-3, 200.0, generator, dtype),
        "walk": random_walk(shape, 0.3, t, generator, dtype),
        "markov": gauss_markov(shape, 0.3, 0.5, t, generator, dtype),
        "flicker": flicker_noise(shape, 0.3, t, generator, dtype),
    }


# ---------------------------------------------------------------------- generators


def test_the_twister_of_an_item_is_seeded_in_full():
    """NumPy's Mersenne twister with those words draws the same bits; `manual_seed` would keep 32 of them."""
    generator = item_generator(12, 345)
    words = generator.get_state().numpy().view(np.uint64)[3:627].astype(np.uint32)
    twister = np.random.MT19937()
    twister.state = {"bit_generator": "MT19937", "state": {"key": words, "pos": 624}}
    drawn = torch.empty(2000, dtype=torch.int32).random_(generator=generator)
    assert (drawn.numpy() == twister.random_raw(2000) % 2**31).all()
    assert torch.equal(
        torch.randn(9, generator=seeded(1)), torch.randn(9, generator=seeded(1 + 2**32))
    )  # the trap


def test_items_are_reproducible_and_unlike_each_other():
    pairs = [(seed, index) for seed in (0, 1, 2**40) for index in (0, 1, 2, 2**32, 2**32 + 1, 2**62)]
    draws = torch.stack([torch.randn(20_000, generator=item_generator(*p), dtype=F64) for p in pairs])
    again = torch.randn(20_000, generator=item_generator(*pairs[7]), dtype=F64)
    assert torch.equal(draws[7], again)
    correlation = torch.corrcoef(draws) - torch.eye(len(pairs))
    assert correlation.abs().max() * math.sqrt(20_000) < 4.5  # of 153 normal numbers
    for lag in (1, 5):
        shifted = (draws[:-1, lag:] * draws[1:, :-lag]).mean(-1) * math.sqrt(20_000)
        assert shifted.abs().max() < 4.0


def test_the_first_number_of_items_is_normal_across_items():
    first = torch.tensor([torch.randn((), generator=item_generator(3, i), dtype=F64) for i in range(3000)])
    assert stats.kstest(first.numpy(), "norm").pvalue > 1e-3
    assert (first[1:] * first[:-1]).mean().abs() * math.sqrt(3000) < 4.0


@MODES
@pytest.mark.parametrize("dtype", [F32, F64])
def test_noise_of_an_item_does_not_depend_on_its_batch(mode, dtype):
    t = jittered(700, 0.01, 5, 6)
    with use_kernels(mode):
        together = processes(t, (6, 700, 3), [item_generator(0, i) for i in range(6)], dtype)
        # Every process goes on where the one before left each generator.
        for i in (0, 3, 5):
            alone = processes(t[i], (1, 700, 3), [item_generator(0, i)], dtype)
            for name, x in alone.items():
                assert torch.equal(x[0], together[name][i]), name


def test_threads_change_nothing():
    before = torch.get_num_threads()
    results = []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            results.append(white_noise((4, 3000, 3), 1.0, 1.0, [item_generator(0, i) for i in range(4)]))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*results)


# ---------------------------------------------------------------------- distributions


@pytest.mark.parametrize("dtype", [F32, F64])
def test_white_noise_is_normal_and_as_strong_as_asked(dtype):
    x = white_noise((2, 40_000, 3), torch.tensor([1e-3, 2e-3, 0.0], dtype=dtype), 250.0, seeded())
    assert x.dtype == dtype
    assert (x[..., 2] == 0).all()
    for channel, density in ((0, 1e-3), (1, 2e-3)):
        scaled = x[..., channel].double().flatten().numpy() / (density * math.sqrt(250.0))
        assert stats.kstest(scaled, "norm").pvalue > 1e-3
        assert stats.kstest(np.abs(scaled)[np.abs(scaled) > 3], stats.truncnorm(3, np.inf).cdf).pvalue > 1e-3
        assert abs(np.corrcoef(scaled[1:], scaled[:-1])[0, 1]) * math.sqrt(80_000) < 4
    assert abs(np.corrcoef(x[..., 0].flatten().numpy(), x[..., 1].flatten().numpy())[0, 1]) < 4 / math.sqrt(
        8e4
    )


def test_a_random_walk_has_independent_steps_of_the_right_size():
    t = jittered(30_000)
    walk = random_walk((30_000, 2), torch.tensor([0.3, 5.0]), t, seeded())
    assert walk.dtype == F32
    assert (walk[0] == 0).all()
    walk = random_walk((30_000, 2), torch.tensor([0.3, 5.0], dtype=F64), t, seeded())
    steps = (walk.diff(dim=0) / t.diff()[:, None].sqrt() / torch.tensor([0.3, 5.0])).numpy()
    assert stats.kstest(steps.flatten(), "norm").pvalue > 1e-3
    for x in (steps[:, 0], steps[:, 1], (t.diff() * 100).numpy()):
        assert abs(np.mean(x[1:] * steps[:-1, 0])) < 4 / math.sqrt(3e4) * 1.3


@MODES
def test_gauss_markov_has_the_covariance_of_the_process(mode):
    """Over many realisations at uneven times, `s^2 exp(-|t_i - t_j| / T)`, from the first sample on."""
    t, T, s, count = jittered(12, 0.3), 0.8, 2.0, 40_000
    with use_kernels(mode):
        x = gauss_markov((count, 12, 1), s * math.sqrt(2 / T), T, t, seeded())[..., 0]
    found = x.T @ x / count
    expected = s**2 * (-(t[:, None] - t).abs() / T).exp()
    deviation = ((expected.diag()[:, None] * expected.diag() + expected**2) / count).sqrt()
    assert ((found - expected) / deviation).abs().max() < 4.5


@MODES
def test_an_infinite_correlation_time_is_a_random_walk(mode):
    t = jittered(500)
    shape = (2, 500, 3)
    with use_kernels(mode):
        walk = random_walk(shape, 0.3, t, seeded())
        endless = gauss_markov(shape, 0.3, math.inf, t, seeded())
        assert torch.allclose(walk, endless, rtol=0, atol=1e-13)
        # It is what long correlation times come to; they differ in where they start.
        long = gauss_markov(shape, 0.3, 1e9, t, seeded())
        assert torch.allclose(walk, long - long[:, :1], rtol=0, atol=1e-4)
        assert long[:, 0].abs().min() > 100
        mixed = gauss_markov(shape, 0.3, torch.tensor([0.5, math.inf, 1e9], dtype=F64), t, seeded())
        assert torch.equal(mixed[..., 1], endless[..., 1])
        assert torch.allclose(mixed[..., 0], gauss_markov(shape, 0.3, 0.5, t, seeded())[..., 0], atol=1e-14)


def test_the_bias_of_a_gauss_markov_process_is_not_white():
    """The bug of a simulator: with an infinite correlation time, neighbours were independent."""
    x = gauss_markov((2000, 3), 0.1, math.inf, torch.arange(2000, dtype=F64) / 100, seeded())
    assert x.diff(dim=0).std() < 0.05 * x.std()


@pytest.mark.parametrize("default", [False, True])
def test_flicker_noise_falls_as_one_over_frequency(default):
    level, rate, count = 0.7, 100.0, 8192
    t = torch.arange(count, dtype=F64) / rate
    with use_kernels("auto"):
        x = flicker_noise(
            (count, 64), level, t, seeded(), correlation_times=None if default else (1 / 300, 400.0)
        )
    f, power = periodogram(x.numpy(), rate, axis=0, window="hann")
    f, power = f[1:, None], power[1:]
    times = (0.006 if default else 1 / 300) * 4.0 ** np.arange(10)
    assert times[-1] > 400.0
    phi = np.exp(-1 / rate / times)  # of the sampled processes, autoregressive of order one
    sampled = (1 - phi**2) / (1 - 2 * phi * np.cos(2 * math.pi * f / rate) + phi**2)
    expected = 2 * level**2 * math.log(4) / math.pi / rate * sampled.sum(1, keepdims=True)
    for low in (0.1, 0.4, 1.6, 5.0, 20.0):
        band = (f >= low)[:, 0] & (f < 2 * low)[:, 0]
        ratio = power[band] / expected[band]
        # A Hann window spreads each independent chi^2 of two degrees of freedom over 1.94 bins.
        assert abs(ratio.mean() - 1) < 4 * math.sqrt(1.94 / ratio.size)
        if default:  # twice level^2 / (2 pi f)
            assert np.abs(expected[band] * math.pi * f[band] / level**2 - 1).max() < (
                0.05 if f[band].max() < 33 else 0.3
            )


def test_spectra_of_neighbouring_flicker_processes_add_up_without_ripples():
    f = np.geomspace(0.01, 1.0, 300)[:, None]
    T = 1e7 * 4.0 ** -np.arange(24)
    spectrum = (2 * (math.log(4) / math.pi) * T / (1 + (2 * math.pi * f * T) ** 2)).sum(1)
    assert np.abs(spectrum * 2 * math.pi * f[:, 0] - 1).max() < 0.0033


# ---------------------------------------------------------------------- times, dtypes, gradients


def test_nanoseconds_and_seconds_are_the_same_times():
    ns = torch.arange(300) * 5_000_000 + 1_520_530_308_000_000_000
    seconds = (ns - ns[0]).double() * 1e-9
    for a, b in zip(processes(ns, (2, 300, 3), seeded()).values(),
                    processes(seconds, (2, 300, 3), seeded()).values(), strict=True):  # fmt: skip
        assert a.dtype == F64
        assert torch.allclose(a, b, rtol=1e-12, atol=1e-14)
    repeated = torch.tensor([0, 5, 5, 9]) * 10**8
    for make in (lambda: random_walk((4, 2), 1.0, repeated, seeded()),
                 lambda: gauss_markov((4, 2), 1.0, 3.0, repeated, seeded())):  # fmt: skip
        x = make()
        assert torch.equal(x[1], x[2])
        assert (x[0] != x[1]).all()


@MODES
@pytest.mark.parametrize("default", [F32, F64])
def test_dtype_is_that_of_the_arguments(mode, default):
    t = jittered(20)
    before = torch.get_default_dtype()
    torch.set_default_dtype(default)
    try:
        with use_kernels(mode):
            for dtype in (F32, F64):
                for times in (t.to(dtype), t):
                    asked = None if times.dtype == dtype else dtype
                    for name, x in processes(times, (20, 3), seeded(), asked).items():
                        assert x.dtype == (asked or dtype if name != "white" else asked or F64)
                        assert x.shape == (20, 3)
    finally:
        torch.set_default_dtype(before)


@MODES
def test_no_samples_and_one(mode):
    with use_kernels(mode):
        for count in (0, 1):
            for x in processes(jittered(count), (2, count, 3), seeded()).values():
                assert x.shape == (2, count, 3)
                assert x.isfinite().all()


@MODES
def test_gradients_of_noise(mode):
    t = jittered(6).requires_grad_()
    density = torch.tensor([0.3, 0.5], dtype=F64, requires_grad=True)
    T = torch.tensor([[[0.01, 1.0]], [[30.0, 0.2]]], dtype=F64, requires_grad=True)
    rate = torch.tensor(50.0, dtype=F64, requires_grad=True)
    shape = (2, 6, 2)
    with use_kernels(mode):
        for function, arguments in (
            (lambda d, r: white_noise(shape, d, r, seeded()), (density, rate)),
            (lambda d, t: random_walk(shape, d, t, seeded()), (density, t)),
            (lambda d, T, t: gauss_markov(shape, d, T, t, seeded()), (density, T, t)),
            (lambda d, t: flicker_noise(shape, d, t, seeded(), correlation_times=(0.01, 1.0)), (density, t)),
        ):
            assert torch.autograd.gradcheck(function, arguments)
    assert torch.autograd.gradgradcheck(lambda T: gauss_markov(shape, 0.3, T, t.detach(), seeded()), (T,))
