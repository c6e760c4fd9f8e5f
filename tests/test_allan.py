"""Allan deviation against its definition and another library; parameters that are put in come out."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from torchspline import plot, use_kernels
from torchspline.imu import allan, allan_deviation, fit_noise, flicker_noise, random_walk, white_noise

F32, F64 = torch.float32, torch.float64
RATE = 100.0
TRUTH = {"white_noise": 0.01, "bias_instability": 0.01, "random_walk": 0.004}


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def stamps(count):
    return torch.arange(count, dtype=F64) / RATE


def simulated(count, channels, **coefficients):
    t, shape, g = stamps(count), (count, channels), seeded()
    makers = {
        "white_noise": lambda c: white_noise(shape, c, RATE, g),
        "bias_instability": lambda c: flicker_noise(shape, c, t, g),
        "random_walk": lambda c: random_walk(shape, c, t, g),
        # A counter: what is read is the difference of rounded integrals.
        "quantization": lambda c: RATE * white_noise((count + 1, channels), c, 1.0, g).diff(dim=0),
    }
    with use_kernels("auto"):
        return sum(makers[name](c) for name, c in coefficients.items())


def by_definition(x, m):
    """Half the mean square of differences of means of neighbouring clusters, at every start; without NaN."""
    means = np.array([x[i : i + m].mean() for i in range(len(x) - m + 1)])
    return math.sqrt(0.5 * np.nanmean((means[m:] - means[:-m]) ** 2))


def test_deviation_is_what_its_definition_says():
    x = torch.randn(2, 60, 3, generator=seeded(), dtype=F64).cumsum(-2) + 1e4
    found = allan_deviation(x, stamps(60), [1, 2, 5, 30])
    assert found.tau.tolist() == pytest.approx([0.01, 0.02, 0.05, 0.3])
    assert found.deviation.shape == (2, 4, 3)
    for k, m in enumerate((1, 2, 5, 30)):
        for i in range(2):
            for c in range(3):
                assert found.deviation[i, k, c].item() == pytest.approx(
                    by_definition(x[i, :, c].numpy(), m), rel=1e-9
                )
        assert (found.terms[:, k] == 60 - 2 * m + 1).all()


def test_deviation_equals_allantools():
    allantools = pytest.importorskip("allantools")
    x = torch.randn(2000, 2, generator=seeded(), dtype=F64).cumsum(0)
    found = allan_deviation(x, stamps(2000))
    for c in range(2):
        tau, theirs, _, count = allantools.oadev(
            x[:, c].numpy(), rate=RATE, data_type="freq", taus=found.tau.numpy()
        )
        np.testing.assert_allclose(found.tau.numpy(), tau, rtol=1e-12)
        np.testing.assert_allclose(found.deviation[:, c].numpy(), theirs, rtol=1e-9)
        np.testing.assert_allclose(found.terms[:, c].numpy(), count)


def test_gaps_and_missing_samples_belong_to_no_cluster():
    x = torch.randn(80, 2, generator=seeded(), dtype=F64)
    x[20:23, 0] = math.nan
    x[50, 1] = math.nan
    sizes = [1, 3, 10]
    found = allan_deviation(x, stamps(80), sizes)
    for k, m in enumerate(sizes):
        for c in range(2):
            assert found.deviation[k, c].item() == pytest.approx(by_definition(x[:, c].numpy(), m), rel=1e-9)
    keep = torch.cat([torch.arange(20), torch.arange(23, 80)])
    ns = (keep * 10_000_000) + 10**18 + torch.tensor([0, 1_000_000, -1_000_000]).repeat(26)[: len(keep)]
    left_out = allan_deviation(x[keep, :1], ns, sizes)
    assert torch.allclose(left_out.deviation, found.deviation[:, :1], rtol=1e-12)
    assert left_out.interval == pytest.approx(0.01, rel=1e-2)
    # The mean that sums are taken about knows only what is there.
    assert torch.allclose(allan_deviation(x + 1e6, stamps(80), sizes).deviation, found.deviation, rtol=1e-6)


def test_single_precision_is_summed_in_double():
    x = (100.0 + 1e-3 * torch.randn(5000, 1, generator=seeded(), dtype=F64)).to(F32)
    a, b = (allan_deviation(y, stamps(5000)) for y in (x, x.double()))
    assert a.deviation.dtype == F64
    assert torch.equal(a.deviation, b.deviation)


# ---------------------------------------------------------------------- what is in the formulas


@pytest.mark.parametrize("name", allan.COMPONENTS)
def test_variances_are_integrals_of_spectra(name):
    """Of sampled processes, over both signs of the frequency, with the transfer function of the estimator."""
    dt = 0.01
    for m in (1, 3, 10):

        def integrand(f, m=m):
            x = math.pi * f * dt
            (s,) = allan._spectrum(name, np.array([f]), dt)
            return 2 * 2 * math.sin(m * x) ** 4 / (m * math.sin(x)) ** 2 * s

        value = quad(integrand, 1e-7, 0.5 / dt, limit=2000, epsabs=0, epsrel=1e-9)[0]
        expected = allan.allan_variance(name, np.array([float(m)]), dt)[0]
        # Flicker is the continuous one, whose tail beyond half the rate short clusters miss.
        limit = 0.2 / m if name == "bias_instability" else 1e-6
        assert value == pytest.approx(expected, rel=limit)


@pytest.mark.parametrize("name", ["white_noise", "random_walk", "bias_instability"])
def test_degrees_of_freedom_and_bounds(name):
    """Of many records: the relative variance is 2 / degrees, and as many as promised lie within the bounds."""
    x = simulated(1024, 800, **{name: 1.0})
    sizes = [1, 4, 16, 64, 128]
    found = allan_deviation(x, stamps(1024), sizes)
    variance = found.deviation.square()
    degrees = 2 * variance.mean(-1).square() / variance.var(-1)
    promised = found.degrees.median(-1).values
    assert (degrees / promised - 1).abs().max() < 0.25
    mean = variance.mean(-1, keepdim=True).sqrt()
    for confidence in (0.683, 0.95):
        lower, upper = found.bounds(confidence)
        inside = ((lower < mean) & (mean < upper)).to(F64).mean(-1)
        assert (inside - confidence).abs().max() < 0.06


def test_covariances_between_cluster_times():
    """Those that weigh the fit, against the scatter of many records."""
    sizes, count = [1, 2, 5, 10, 30], 1000
    x = simulated(count, 2000, white_noise=1.0, random_walk=2.0)
    variance = allan_deviation(x, stamps(count), sizes).deviation.square().numpy()
    found = np.cov(variance)
    m, terms = np.array(sizes, float), count - 2 * np.array(sizes, float) + 1
    f = np.geomspace(0.02 / (m[-1] / RATE), 0.5 * RATE, allan._FREQUENCIES)
    power = 1.0 + 4.0 * allan._spectrum("random_walk", f, 1 / RATE)
    transfer = allan._transfer(f, m, 1 / RATE)
    duration = np.maximum(terms[:, None], terms) / RATE
    expected = (transfer * (4 * math.log(f[1] / f[0]) * f * power**2)) @ transfer.T / duration
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs(found - expected).max() > 0
    assert (np.abs(found - expected) / scale).max() < 0.12


# ---------------------------------------------------------------------- round trips


def test_parameters_come_out_as_they_went_in():
    """Within the uncertainty that is claimed: normalised errors of 30 records have mean 0 and deviation 1."""
    count, channels = 20_000, 30
    found = fit_noise(allan_deviation(simulated(count, channels, **TRUTH), stamps(count)))
    for name, truth in TRUTH.items():
        z = (found.coefficient[name] - truth) / found.std[name]
        assert z.mean().abs() * math.sqrt(channels) < 4.0, name
        assert 0.7 < z.square().mean().sqrt() < 1.4, name
        assert found.std[name].mean() < 0.35 * truth
    assert found.chi_square.mean() / found.degrees == pytest.approx(1.0, abs=0.35)


def test_quantization_is_told_from_white_noise():
    count, channels = 10_000, 12
    x = simulated(count, channels, white_noise=0.01, quantization=2e-4)
    found = fit_noise(allan_deviation(x, stamps(count)), ("white_noise", "quantization", "random_walk"))
    for name, truth in (("white_noise", 0.01), ("quantization", 2e-4)):
        z = (found.coefficient[name] - truth) / found.std[name]
        assert z.mean().abs() * math.sqrt(channels) < 4.0, name
        assert 0.5 < z.square().mean().sqrt() < 1.7, name
    # What is not there is not found, or is of the size of its uncertainty.
    assert (found.coefficient["random_walk"] < 3 * found.std["random_walk"]).all()


def test_batches_and_ranges():
    x = simulated(4000, 6, white_noise=0.01, random_walk=0.01).reshape(4000, 2, 3).movedim(1, 0)
    together = fit_noise(allan_deviation(x, stamps(4000)), ("white_noise", "random_walk"))
    alone = fit_noise(allan_deviation(x[1], stamps(4000)), ("white_noise", "random_walk"))
    for name in ("white_noise", "random_walk"):
        assert together.coefficient[name].shape == together.std[name].shape == (2, 3)
        assert torch.allclose(together.coefficient[name][1], alone.coefficient[name], rtol=1e-9)
    assert together.chi_square.shape == (2, 3)
    short = fit_noise(allan_deviation(x, stamps(4000)), ["white_noise"], tau=(0.009, 0.1))
    assert short.degrees == 7
    assert short.coefficient["white_noise"].mean().item() == pytest.approx(0.01, rel=0.02)


def test_figure(tmp_path):
    x = simulated(3000, 2, white_noise=0.01, random_walk=0.01)
    found = allan_deviation(x, stamps(3000))
    figure = plot.allan({"made": found}, {"made": fit_noise(found)}, "rad/s", "noise")
    figure.savefig(tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 20_000


def test_default_clusters_are_those_that_fit_between_gaps():
    """Unless sizes are asked for, in which case the first that does not fit is named."""
    x, t = simulated(600, 2, white_noise=0.01), stamps(600)
    x[[200, 400], 1] = math.nan
    found = allan_deviation(x, t)
    assert 60 < found.clusters.max() <= 100  # two in the 200 samples before the first gap
    assert found.deviation.isfinite().all()
    for i, m in enumerate(found.clusters.tolist()):
        assert found.deviation[i, 1].item() == pytest.approx(by_definition(x[:, 1].numpy(), m), rel=1e-9)
    with pytest.raises(ValueError, match=r"clusters.*between gaps of the record, got 101 samples"):
        allan_deviation(x, t, [1, 50, 100, 101])


@pytest.mark.parametrize("record", ["constant", "below its resolution"])
def test_deviations_of_zero_are_named(record):
    x = simulated(500, 2, white_noise=0.001)
    x[:, 1] = x[:, 1].round() if record == "below its resolution" else 3.0
    with pytest.raises(
        ValueError, match=r"allan: expected deviations above zero, got 0.0 over 0.01 s in channel 1"
    ):
        fit_noise(allan_deviation(x, stamps(500)))


def test_a_gap_of_years_is_named_before_memory_is_taken():
    t = stamps(100)
    t[40:] += 1.5e9
    with pytest.raises(ValueError, match=r"t: expected a record.*gap of 1.5e.09 s between samples 39 and 40"):
        allan_deviation(simulated(100, 1, white_noise=0.01), t)


def test_no_records():
    found = fit_noise(allan_deviation(torch.zeros(0, 300, 2, dtype=F64), stamps(300)))
    assert found.chi_square.shape == found.coefficient["white_noise"].shape == (0, 2)
