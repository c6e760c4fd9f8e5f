"""Allan deviation of a record at rest, and the noise parameters it tells.

Symbols and conventions are those of IEEE Std 952 and of NIST Special Publication 1065 [Riley 2008].
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline import checks
from torchspline.imu import stamps

Array = NDArray[np.float64]

#: What a fit may consist of, and its slope in a plot of the deviation.
COMPONENTS = ("white_noise", "bias_instability", "random_walk", "quantization")
#: Clusters in a decade, unless they are given, and the share of a record that the longest takes.
_PER_DECADE, _LONGEST = 10, 0.25
#: How far from a multiple of the sample interval stamps may lie apart, in intervals.
_JITTER = 0.35
#: Samples that are missing for each that is there, at most: memory goes with both.
_SPARSEST = 100
#: Frequencies of the integrals behind covariances, log-spaced.
_FREQUENCIES = 4000
_ROUNDS = 4


class AllanDeviation(NamedTuple):
    """Overlapping Allan deviation: `deviation` (*batch, K, C), unit of the record, over cluster times `tau` (K,) s.

    `clusters` (K,) samples in each, `terms` (*batch, K, C) differences that went into it, `degrees` (*batch, K, C)
    equivalent degrees of freedom, `interval` between samples in s.
    """

    tau: Tensor
    deviation: Tensor
    clusters: Tensor
    terms: Tensor
    degrees: Tensor
    interval: float

    def bounds(self, confidence: float = 0.683) -> tuple[Tensor, Tensor]:
        """Lower and upper bound of each deviation, (*batch, K, C), from the chi-squared distribution.

        Args:
            confidence: probability that the truth lies between them, between 0 and 1.
        Raises:
            TypeError, ValueError: no such probability.
        """
        checks.number("confidence", confidence)
        if not 0.0 < confidence < 1.0:
            raise ValueError(f"confidence: expected a probability between 0 and 1, got {confidence}")
        from scipy.special import gammaincinv  # late, as it takes long to import

        half = 0.5 * self.degrees.numpy()
        tails = 0.5 - 0.5 * confidence, 0.5 + 0.5 * confidence
        upper, lower = (
            self.deviation * torch.from_numpy(np.sqrt(half / gammaincinv(half, p))) for p in tails
        )
        return lower, upper


class NoiseEstimate(NamedTuple):
    """What `fit_noise` finds, by the names of `COMPONENTS`: `coefficient` and standard deviation `std`, (*batch, C).

    `white_noise` unit/sqrt(Hz), the density of `white_noise`; `bias_instability` unit, the level of `flicker_noise`;
    `random_walk` unit/sqrt(s), the density of `random_walk`; `quantization` unit s. Zero is a coefficient that the
    record does not need; its `std` is then what it might have been without being noticed. `chi_square` (*batch, C) with
    `degrees` of freedom says whether the components explain the record.
    """

    coefficient: dict[str, Tensor]
    std: dict[str, Tensor]
    chi_square: Tensor
    degrees: int


def allan_deviation(x: Tensor, t: Tensor, clusters: Sequence[int] | None = None) -> AllanDeviation:
    """Overlapping Allan deviation of evenly sampled rates, [Riley 2008], by cumulative sums: O(N) a cluster size.

    Missing samples, NaN or left out, belong to no cluster: differences that would contain one are left out. Degrees of
    freedom are those of white noise, flicker or random walk, [Riley 2008], whichever the slope of the curve is nearest
    to.

    Args:
        x: record at rest, float32 or float64, (*batch, N, C); sums are taken in float64.
        t: increasing times, seconds (float) or nanoseconds (int64), (N,): multiples of one interval, with jitter below
            a third of it.
        clusters: numbers of samples in a cluster; None: ten a decade up to a quarter of the record, as far as two of
            them fit between gaps.
    Returns:
        AllanDeviation: in float64 on the CPU.
    Raises:
        TypeError, ValueError: a wrong type, shape or value, times that are not multiples of an interval, a record or
            pieces of it too short for a cluster.
    """
    checks.is_floating_tensor("x", x)
    if x.ndim < 2 or x.shape[-2] < 3:
        raise ValueError(f"x: expected shape (*batch, N, C) with at least 3 samples, got {tuple(x.shape)}")
    if torch.isinf(x).any():
        raise ValueError("x: expected finite numbers, or NaN for missing ones, got inf")
    if isinstance(t, Tensor) and t.ndim != 1:
        raise ValueError(f"t: expected shape ({x.shape[-2]},), the same times for all, got {tuple(t.shape)}")
    steps = stamps.intervals(t, (x.shape[-2],), torch.float64, device=x.device).cpu()
    interval, index = _grid(steps)
    count = int(index[-1]) + 1
    sizes = _cluster_sizes(clusters, count)

    values = x.detach().to("cpu", torch.float64)
    values = values - values.nanmean(-2, keepdim=True)
    known = ~values.isnan()
    shape = (*x.shape[:-2], count + 1, x.shape[-1])
    sums, gaps = torch.zeros(shape, dtype=torch.float64), torch.zeros(shape, dtype=torch.int64)
    sums[..., 1 + index, :] = values.nan_to_num(0.0)
    gaps[..., 1:, :] = 1
    gaps[..., 1 + index, :] = (~known).to(torch.int64)
    sums, gaps = sums.cumsum(-2), gaps.cumsum(-2)
    whole = bool((gaps[..., -1, :] == 0).all())

    variances, terms = [], []
    for size in sizes:
        two = 2 * size
        difference = (sums[..., two:, :] - 2.0 * sums[..., size:-size, :] + sums[..., :-two, :]) / size
        if whole:
            terms.append(torch.full_like(sums[..., 0, :], difference.shape[-2]))
        else:
            complete = gaps[..., two:, :] == gaps[..., :-two, :]
            terms.append(complete.sum(-2).to(torch.float64))
            difference = difference * complete
        variances.append(0.5 * difference.square().sum(-2) / terms[-1])
    used, variance = torch.stack(terms, -2), torch.stack(variances, -2)
    missing = (used == 0).any(-1).reshape(-1, len(sizes)).any(0)
    if clusters is None and not bool(missing.all()):  # of those not asked for, the ones that fit
        used, variance = used[..., ~missing, :], variance[..., ~missing, :]
        sizes = [m for m, gone in zip(sizes, missing.tolist(), strict=True) if not gone]
    elif bool(missing.any()):
        least = sizes[missing.tolist().index(True)]
        raise ValueError(
            "clusters: expected sizes of which two fit between gaps of the record, "
            f"got {least} samples, {least * interval:g} s"
        )
    m = torch.tensor(sizes, dtype=torch.float64)
    degrees = _degrees(variance, used, m)
    return AllanDeviation(m * interval, variance.sqrt(), torch.tensor(sizes), used, degrees, interval)


def fit_noise(
    allan: AllanDeviation,
    components: Sequence[str] = COMPONENTS[:3],
    tau: tuple[float, float] | None = None,
) -> NoiseEstimate:
    """White noise, bias instability, random walk (and quantization) in an Allan deviation, with standard deviations.

    The variance is linear in the squares of the coefficients: `3 Q^2 / tau^2 + N^2 / tau + 2 log(2) / pi B^2 +
    K^2 tau / 3` (IEEE Std 952, annex C; sampled random walks exactly). Non-negative generalised least squares, with
    weights from covariances that follow from the spectrum of the fit itself: variances of different tau share the
    samples, so counting them as independent would promise far too much. Standard deviations hold where a coefficient is
    several of them.

    Args:
        allan: of a record. components: names of COMPONENTS.
        tau: shortest and longest cluster time used, s; None: all of them.
    Returns:
        NoiseEstimate
    Raises:
        TypeError, ValueError: no Allan deviation, unknown names, or fewer cluster times than components.
    """
    checks.instance("allan", allan, AllanDeviation, "an AllanDeviation")
    names = list(components) if not isinstance(components, str) else [components]
    for name in names:
        checks.choice("components", name, COMPONENTS)
    if not names or len(set(names)) < len(names):
        raise ValueError(f"components: expected different names, at least one, got {components!r}")
    used = _within(allan, tau)
    if len(used) <= len(names):
        raise ValueError(
            f"tau: expected a range with more cluster times than components ({len(names)}), got {len(used)}"
        )
    smallest = allan.deviation[..., used, :]
    if not bool((smallest.square() > 0).all()):
        where = torch.nonzero(smallest.square() == 0)[0].tolist()
        raise ValueError(
            f"allan: expected deviations above zero, got {smallest[tuple(where)].item()} over "
            f"{allan.tau[used][where[-2]].item():g} s in channel {where[-1]}: a record that is constant, or whose "
            "resolution hides its noise; leave that channel, or those cluster times (tau), out"
        )
    m, dt = allan.clusters[used].numpy().astype(np.float64), allan.interval
    f = np.geomspace(0.02 / (m[-1] * dt), 0.5 / dt, _FREQUENCIES)
    transfer = _transfer(f, m, dt)
    batch = allan.deviation.shape[:-2]
    rows = [
        _fit(names, m, dt, f, transfer, y, n)
        for y, n in zip(
            allan.deviation[..., used, :].square().transpose(-1, -2).reshape(-1, len(used)).numpy(),
            allan.terms[..., used, :].transpose(-1, -2).reshape(-1, len(used)).numpy(),
            strict=True,
        )
    ]
    shape = (*batch, allan.deviation.shape[-1])
    value, std = (
        torch.from_numpy(np.array([row[i] for row in rows], dtype=np.float64)).reshape(*shape, len(names))
        for i in (0, 1)
    )
    return NoiseEstimate(
        {name: value[..., i] for i, name in enumerate(names)},
        {name: std[..., i] for i, name in enumerate(names)},
        torch.tensor([row[2] for row in rows], dtype=torch.float64).reshape(shape),
        len(used) - len(names),
    )


def allan_variance(name: str, clusters: Array, interval: float) -> Array:
    """Allan variance of a component of coefficient one over clusters of so many samples, `interval` s apart."""
    m, tau = clusters, clusters * interval
    match name:
        case "white_noise":
            return 1.0 / tau
        case "bias_instability":
            return np.full_like(tau, 2.0 * math.log(2.0) / math.pi)
        case "random_walk":
            # The sum over a triangle of steps; tau / 3 for many samples.
            return interval * (2.0 * m * m + 1.0) / (6.0 * m)
        case _:
            return 3.0 / (tau * tau)


# ---------------------------------------------------------------------- parts


def _spectrum(name: str, f: Array, dt: float) -> Array:
    """Two-sided spectral density of a component of coefficient one, of samples `dt` apart."""
    turn = 2.0 * np.sin(math.pi * f * dt) / dt
    match name:
        case "white_noise":
            return np.ones_like(f)
        case "bias_instability":
            return 1.0 / (2.0 * math.pi * f)
        case "random_walk":
            return 1.0 / turn**2
        case _:
            # Differences of rounding errors of the integral, of variance Q^2 each.
            return dt * turn**2


def _transfer(f: Array, m: Array, dt: float) -> Array:
    """(K, F): the Allan variance is the integral of this times the two-sided density over both signs of f."""
    x = math.pi * f * dt
    return 2.0 * np.sin(m[:, None] * x) ** 4 / (m[:, None] * np.sin(x)) ** 2


def _fit(
    names: list[str], m: Array, dt: float, f: Array, transfer: Array, y: Array, terms: Array
) -> tuple[Array, Array, float]:
    """Coefficients, their standard deviations, chi-squared, of one channel."""
    from scipy.optimize import nnls  # late: it takes longer to import than this to run

    design = np.stack([allan_variance(name, m, dt) for name in names], 1)
    spectra = np.stack([_spectrum(name, f, dt) for name in names], 1)
    # Covariance: 2 / duration times the integral of W_i W_j S^2; in log f, twice for both signs.
    duration, step = np.maximum(terms[:, None], terms) * dt, 4.0 * math.log(f[1] / f[0])
    squares, _ = nnls(design / y[:, None], np.ones_like(y))
    covariance = np.diag(y * y)
    for _ in range(_ROUNDS):
        model = design @ squares
        power = spectra @ squares
        covariance = (transfer * (step * f * power * power)) @ transfer.T / duration
        # Scaled by the model, and kept from being singular where neighbours are the same up to rounding.
        covariance = covariance / np.outer(model, model) + 1e-9 * np.eye(len(m))
        lower = np.linalg.cholesky(covariance)
        A, b = (np.linalg.solve(lower, x) for x in (design / model[:, None], y / model))
        scale = np.linalg.norm(A, axis=0)
        squares = nnls(A / scale, b)[0] / scale
    information = (A / scale).T @ (A / scale)
    spread = np.sqrt(np.diag(np.linalg.inv(information))) / scale
    residual = b - A @ squares
    value = np.sqrt(squares)
    # Of a square root: delta / (2 value), but not beyond the coefficient that such a square alone would have.
    std = spread / np.maximum(2.0 * value, np.sqrt(spread))
    return value, std, float(residual @ residual)


def _grid(steps: Tensor) -> tuple[float, Tensor]:
    """Interval of samples and the number of each on a grid of such intervals, from the time between neighbours."""
    # The mean of single steps: jitter of single stamps, which a median keeps, cancels in it.
    single = steps[steps < 1.5 * steps.median()].mean()
    multiples = (steps / single).round()
    if multiples.sum() > _SPARSEST * len(steps):
        at = int(steps.argmax())
        raise ValueError(
            f"t: expected a record of which more than one sample in {_SPARSEST} is there, got a gap of "
            f"{steps[at].item():g} s between samples {at} and {at + 1}; cut it there"
        )
    off = (steps / single - multiples).abs()
    if bool((off > _JITTER).any()) or bool((multiples < 1).any()):
        at = int(torch.nonzero((off > _JITTER) | (multiples < 1))[0])
        raise ValueError(
            f"t: expected times that are multiples of one interval apart, here {single.item():g} s, "
            f"got {steps[at].item():g} s between samples {at} and {at + 1}; resample the record"
        )
    index = torch.cat([torch.zeros(1, dtype=torch.int64), multiples.to(torch.int64).cumsum(0)])
    return (steps.sum() / index[-1]).item(), index


def _cluster_sizes(clusters: Sequence[int] | None, count: int) -> list[int]:
    if clusters is None:
        longest = max(1, int(_LONGEST * count))
        points = max(2, round(_PER_DECADE * math.log10(longest)) + 1)
        return sorted({int(x) for x in np.rint(np.geomspace(1, longest, points))})
    if isinstance(clusters, (str, bytes)) or not isinstance(clusters, Sequence):
        raise TypeError(f"clusters: expected a sequence of whole numbers, got {type(clusters).__name__}")
    for m in clusters:
        checks.whole("clusters", m, 1)
        if 2 * m > count:
            raise ValueError(f"clusters: expected sizes of at most half the {count} samples, got {m}")
    if not clusters:
        raise ValueError("clusters: expected at least one size, got none")
    return sorted({int(m) for m in clusters})


def _degrees(variance: Tensor, terms: Tensor, m: Tensor) -> Tensor:
    """Formulas of [Riley 2008], with as many samples as the differences that were used would need without gaps."""
    m = m[:, None]
    N = terms + 2.0 * m  # phases: one more than samples
    white = (1.5 * (N - 1) / m - 2.0 * (N - 2) / N) * (4.0 * m * m / (4.0 * m * m + 5.0))
    flicker = torch.where(m == 1, 2.0 * (N - 2) ** 2 / (2.3 * N - 4.9), 1.25 * N * N / (m * (N + 3.0 * m)))
    walk = (N - 2) / m * ((N - 1) ** 2 - 3.0 * m * (N - 1) + 4.0 * m * m) / (N - 3).clamp(min=1.0) ** 2
    if len(m) < 2:
        return white.clamp(min=1.0)
    x, y = m[:, 0].log(), variance.clamp(min=1e-300).log()
    slope = torch.gradient(y, spacing=(x,), dim=-2)[0]
    nearest = torch.where(slope < -0.5, white, torch.where(slope < 0.5, flicker, walk))
    return nearest.clamp(min=1.0)


def _within(allan: AllanDeviation, tau: tuple[float, float] | None) -> list[int]:
    if tau is None:
        return list(range(len(allan.tau)))
    try:
        shortest, longest = tau
    except (TypeError, ValueError):
        raise TypeError(
            f"tau: expected the shortest and the longest cluster time in s, got {tau!r}"
        ) from None
    for x in (shortest, longest):
        checks.positive("tau", x)
    return torch.nonzero((allan.tau >= shortest) & (allan.tau <= longest)).flatten().tolist()
