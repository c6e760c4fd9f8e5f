"""Noise of sensors: white, random walk, Gauss-Markov and flicker, from seeded generators.

Densities are those of Kalibr's `imu.yaml` and EuRoC's `sensor.yaml`: white noise per sqrt(Hz), random walks per sqrt(s)
of the walking quantity. Every process is exact at its samples whatever their spacing, and linear in its density, so
that gradients flow to densities (and correlation times) with the random numbers held fixed.
"""

import hashlib
import math
from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from torchspline import checks
from torchspline.imu import stamps
from torchspline.imu.scan import linear_recurrence
from torchspline.kernels import mode, threads

#: One generator for everything, or one for each row of the first dimension.
Generators = torch.Generator | Sequence[torch.Generator] | None

#: Ratio of neighbouring correlation times in flicker noise; the spectrum ripples by `4 exp(-pi^2 / log(ratio))`: 0.3 %.
_RATIO = 4.0
#: Shortest correlation time of flicker noise in intervals of its samples.
_SHORTEST = 0.6
#: The largest number below one.
_INSIDE = 1.0 - 2.0**-53
# Where the 624 words of the Mersenne twister stand in the state of a generator of PyTorch, in words of 8 bytes.
_STATE_WORDS, _STATE_SIZE = slice(3, 627), 5056


def item_generator(seed: int, index: int) -> torch.Generator:
    """The generator of item `index` of a data set with `seed`: the same on whichever worker and in whichever batch.

    All 19968 bits of its state come from SHAKE-256 of seed and index. `Generator.manual_seed` would not do: on the CPU
    it keeps 32 bits of the seed, so among 100,000 items two are likely to be equal.

    Args:
        seed: of the data set, at least 0. index: of the item, at least 0; both below 2^63.
    Raises:
        ValueError: not a whole number in this range.
    """
    for name, x in (("seed", seed), ("index", index)):
        checks.whole(name, x, 0)
        if x >= 2**63:
            raise ValueError(f"{name}: expected a whole number below 2^63, got {x}")
    digest = hashlib.shake_256(b"torchspline item %d %d" % (seed, index)).digest(4 * 624)
    generator = torch.Generator().manual_seed(0)
    state = generator.get_state()
    words = state.numpy().view(np.uint64)
    if words.nbytes != _STATE_SIZE:
        raise RuntimeError(f"PyTorch {torch.__version__} keeps the state of a generator in an unknown form")
    words[_STATE_WORDS] = np.frombuffer(digest, dtype="<u4")
    return generator.set_state(state)


def white_noise(
    shape: Sequence[int],
    density: float | Tensor,
    rate: float | Tensor,
    generator: Generators = None,
    dtype: torch.dtype | None = None,
) -> Tensor:
    """Independent normal numbers of standard deviation `density sqrt(rate)`.

    Args:
        shape: of the result, (*batch, N, C).
        density: unit / sqrt(Hz), the square root of the two-sided spectral density, as everywhere with IMUs
            (1 deg/s/sqrt(Hz) is 60 deg/sqrt(h)); a number, (C,), or what broadcasts to (*batch, 1, C).
        rate: samples per second that the sensor takes; dropping or shifting some of them changes nothing.
        generator: of the random numbers, or one for each row of the first dimension.
        dtype: of the result; None: that of `density` or `rate` if one is a tensor, else float64. In float32 no number
            exceeds 5.8 standard deviations.
    Differentiable in density and rate.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """
    shape, dtype = _shape(shape), _dtype(dtype, density, rate)
    tensors = {name: x for name, x in (("density", density), ("rate", rate)) if isinstance(x, Tensor)}
    name, like = next(iter(tensors.items()), ("rate", None))
    device = (name, torch.device("cpu") if like is None else like.device)
    density = _parameter("density", density, shape, dtype, device)
    rate = _parameter("rate", rate, shape, dtype, device, above=True)
    scale = density * rate.sqrt()
    return _scaled(_normals(shape, generator, dtype, scale.device), scale)


def random_walk(
    shape: Sequence[int],
    density: float | Tensor,
    t: Tensor,
    generator: Generators = None,
    dtype: torch.dtype | None = None,
) -> Tensor:
    """Zero at the first time, then steps of variance `density^2 (t_k - t_{k-1})`.

    Args:
        shape: of the result, (*batch, N, C).
        density: unit / s / sqrt(Hz) = unit / sqrt(s); a number, (C,), or what broadcasts to (*batch, 1, C).
        t: seconds (float) or nanoseconds (int64), (N,) or what broadcasts to (*batch, N), nowhere decreasing.
        generator: of the random numbers, or one for each row of the first dimension.
        dtype: of the result; None: that of `density` if it is a tensor, else that of `t`, else float64.
    Differentiable in density and t.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """
    shape, dtype = _shape(shape), _dtype(dtype, density, t)
    intervals = _intervals(t, shape, dtype)
    density = _parameter("density", density, shape, dtype, ("t", t.device))
    steps = _normals(shape, generator, dtype, intervals.device)
    return _scaled(_scaled(steps, _root(intervals)).cumsum(-2), density)


def gauss_markov(
    shape: Sequence[int],
    density: float | Tensor,
    correlation_time: float | Tensor,
    t: Tensor,
    generator: Generators = None,
    dtype: torch.dtype | None = None,
) -> Tensor:
    """First-order Gauss-Markov process `db/dt = -b / T + density w`, stationary from the first time on.

    Exact between samples: `b_k = exp(-dt/T) b_{k-1} + s sqrt(1 - exp(-2 dt/T)) n_k` with the standard deviation
    `s = density sqrt(T / 2)`; who has s gives `density = s sqrt(2 / T)`. With T infinite, a random walk from zero.

    Args:
        shape: of the result, (*batch, N, C).
        density: of the driving noise, unit / sqrt(s); a number, (C,), or what broadcasts to (*batch, 1, C).
        correlation_time: T in s, above zero, infinite included; a number, (C,), or what broadcasts to (*batch, 1, C).
        t: seconds (float) or nanoseconds (int64), (N,) or what broadcasts to (*batch, N), nowhere decreasing.
        generator: of the random numbers, or one for each row of the first dimension.
        dtype: of the result; None: that of `density` or `correlation_time` if one is a tensor, else that of `t`, else
            float64.
    Differentiable in density, t and finite correlation times.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """
    shape, dtype = _shape(shape), _dtype(dtype, density, correlation_time, t)
    intervals = _intervals(t, shape, dtype)
    where = ("t", t.device)
    density = _parameter("density", density, shape, dtype, where)
    T = _parameter("correlation_time", correlation_time, shape, dtype, where, above=True, infinite=True)
    return density * _unit_gauss_markov(_normals(shape, generator, dtype, intervals.device), T, intervals)


def flicker_noise(
    shape: Sequence[int],
    level: float | Tensor,
    t: Tensor,
    generator: Generators = None,
    dtype: torch.dtype | None = None,
    correlation_times: tuple[float, float] | None = None,
) -> Tensor:
    """Bias instability: a spectrum that falls as 1/f, from a sum of Gauss-Markov processes.

    Their correlation times are the shortest, four times that, and so on until the longest is reached, each of variance
    `level^2 log(4) / pi`. Well between `1 / (2 pi longest)` and `1 / (2 pi shortest)` the two-sided spectral density is
    `level^2 / (2 pi f)` within 0.3 % (IEEE Std 952), and the Allan deviation flat at `sqrt(2 log(2) / pi) level`, 0.664
    of the level. The shortest time that is chosen unless told holds the spectrum of what is sampled, with what is
    folded back from beyond half the rate, within 5 % up to a third of the rate.

    Args:
        shape: of the result, (*batch, N, C).
        level: the coefficient B of bias instability, in the unit of the signal; a number, (C,), or what broadcasts to
            (*batch, 1, C).
        t: seconds (float) or nanoseconds (int64), (N,) or what broadcasts to (*batch, N), nowhere decreasing.
        generator: of the random numbers, or one for each row of the first dimension.
        dtype: of the result; None: that of `level` if it is a tensor, else that of `t`, else float64.
        correlation_times: the shortest and the longest, s. None: 0.6 of the mean interval, and the duration, of each
            row of t.
    Differentiable in level and t.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """
    shape, dtype = _shape(shape), _dtype(dtype, level, t)
    intervals = _intervals(t, shape, dtype)
    level = _parameter("level", level, shape, dtype, ("t", t.device))
    if correlation_times is None:
        steps = max(shape[-2] - 1, 1)
        ratio = steps / _SHORTEST
        mean = intervals.detach().sum(-2, keepdim=True) / steps
        shortest = _SHORTEST * torch.where(mean > 0, mean, torch.ones_like(mean))
    else:
        first, last = _range(correlation_times)
        ratio = last / first
        shortest = torch.tensor(first, dtype=dtype, device=t.device)
    sigma = math.sqrt(math.log(_RATIO) / math.pi)
    noise = torch.zeros(shape, dtype=dtype, device=t.device)
    for i in range(1 + math.ceil(math.log(ratio) / math.log(_RATIO) - 1e-9)):
        T = shortest * _RATIO**i
        normals = _normals(shape, generator, dtype, t.device)
        noise = noise + (sigma * (2.0 / T).sqrt()) * _unit_gauss_markov(normals, T, intervals)
    return level * noise


# ---------------------------------------------------------------------- parts


def _unit_gauss_markov(normals: Tensor, T: Tensor, intervals: Tensor) -> Tensor:
    """The process of density one. Intervals (..., N, 1), the first of them zero."""
    ratio = intervals / T
    # s^2 (1 - exp(-2 dt/T)) = dt e(2 dt/T), e(x) = (1 - exp(-x)) / x: nothing to be infinite where T is.
    x = 2.0 * ratio
    tiny = x < 1e-30
    safe = torch.where(tiny, torch.ones_like(x), x)
    rise = torch.where(tiny, 1.0 - 0.5 * x, -torch.expm1(-safe) / safe)
    deviation = _root(intervals * rise)
    bounded = torch.isfinite(T)
    start = torch.where(
        bounded, torch.where(bounded, T, torch.ones_like(T)).mul(0.5).sqrt(), torch.zeros_like(T)
    )
    first = torch.arange(intervals.shape[-2], device=T.device)[:, None] == 0
    return linear_recurrence((-ratio).exp(), normals * torch.where(first, start, deviation))


def _scaled(x: Tensor, factor: Tensor) -> Tensor:
    """x times factor; in place where nobody can have seen x: such tensors are large."""
    alone = mode.plain(x, factor) and not (x.requires_grad or factor.requires_grad)
    return x.mul_(factor) if alone else x * factor


def _root(x: Tensor) -> Tensor:
    """Square root whose derivative at zero is zero: an interval of length zero adds nothing."""
    positive = x > 0
    return torch.where(positive, torch.where(positive, x, torch.ones_like(x)).sqrt(), torch.zeros_like(x))


def _normals(shape: torch.Size, generator: Generators, dtype: torch.dtype, device: torch.device) -> Tensor:
    x = torch.empty(shape, dtype=dtype, device=device)
    if generator is None or isinstance(generator, torch.Generator):
        _fill(x, generator)
        return x
    generators = list(generator) if isinstance(generator, Sequence) else [generator]
    for g in generators:
        if not isinstance(g, torch.Generator):
            raise TypeError(
                f"generator: expected a torch.Generator or a sequence of them, got {type(g).__name__}"
            )
    if len(shape) < 3 or len(generators) != shape[0]:
        raise ValueError(
            f"generator: expected one, or one for each row of the first dimension of {tuple(shape)}, "
            f"got {len(generators)}"
        )
    rows = [partial(_fill, row, g) for row, g in zip(x, generators, strict=True)]
    # One generator for several rows fills them in their order, which threads would not keep to.
    shared = len({id(g) for g in generators}) < len(generators)
    if shared or x.numel() < threads.SERIAL_BELOW or device.type != "cpu":
        for fill in rows:
            fill()
    else:
        threads.run(rows)
    return x


def _fill(x: Tensor, generator: torch.Generator | None) -> None:
    if x.dtype == torch.float32:
        x.normal_(generator=generator)
        return
    # By the inverse of the error function: twice as fast as `normal_`, which takes float64 one by one. The ends, where
    # it is infinite, come up once in 2^53 draws.
    x.uniform_(-1.0, 1.0, generator=generator).clamp_(-_INSIDE, _INSIDE).erfinv_().mul_(math.sqrt(2.0))


def _range(correlation_times: tuple[float, float]) -> tuple[float, float]:
    try:
        shortest, longest = correlation_times
    except (TypeError, ValueError):
        raise TypeError(
            f"correlation_times: expected the shortest and the longest in s, got {correlation_times!r}"
        ) from None
    for x in (shortest, longest):
        checks.positive("correlation_times", x)
    if not math.isfinite(longest / shortest):
        raise ValueError(f"correlation_times: expected a ratio that is a number, got {correlation_times}")
    if longest < shortest:
        raise ValueError(
            f"correlation_times: expected the shortest and then the longest, got {correlation_times}"
        )
    return shortest, longest


def _shape(shape: Sequence[int]) -> torch.Size:
    if isinstance(shape, (str, bytes)) or not isinstance(shape, Sequence):
        raise TypeError(f"shape: expected whole numbers (*batch, N, C), got {type(shape).__name__}")
    for size in shape:
        checks.whole("shape", size, 0)
    if len(shape) < 2:
        raise ValueError(f"shape: expected (*batch, N, C), samples and channels last, got {tuple(shape)}")
    return torch.Size(shape)


def _dtype(dtype: torch.dtype | None, *like: object) -> torch.dtype:
    """What was asked for, else that of the first floating tensor."""
    if dtype is None:
        floating = [x.dtype for x in like if isinstance(x, Tensor) and x.is_floating_point()]
        return floating[0] if floating else torch.float64
    if dtype not in (torch.float32, torch.float64):
        raise TypeError(f"dtype: expected torch.float32 or torch.float64, got {dtype}")
    return dtype


def _parameter(
    name: str,
    x: float | Tensor,
    shape: torch.Size,
    dtype: torch.dtype,
    device: tuple[str, torch.device],
    above: bool = False,
    infinite: bool = False,
) -> Tensor:
    """A tensor that broadcasts to (*batch, 1, C), on the device of the argument named; not negative, or above zero."""
    if isinstance(x, Tensor):
        checks.is_floating_tensor(name, x)
        if x.device != device[1]:
            raise ValueError(
                f"{name}: on device {x.device}, but {device[0]} is on {device[1]}; move one with .to(device)"
            )
    else:
        checks.number(name, x)
        x = torch.tensor(float(x), dtype=dtype, device=device[1])
    try:
        fits = torch.broadcast_shapes(x.shape, (*shape[:-2], 1, shape[-1])) == (*shape[:-2], 1, shape[-1])
    except RuntimeError:
        fits = False
    if not fits:
        raise ValueError(
            f"{name}: expected a number, ({shape[-1]},) or what broadcasts to {(*shape[:-2], 1, shape[-1])}, "
            f"got {tuple(x.shape)}"
        )
    if not infinite:
        checks.finite(name, x)
    # Compared so that NaN is refused, too.
    good = x.detach() > 0 if above else x.detach() >= 0
    if checks.values_visible(x) and checks.seen_true(good.all()) is False:
        least = "above zero" if above else "of at least zero"
        raise ValueError(f"{name}: expected numbers {least}, got {x.detach()[~good].flatten()[0].item()}")
    return x.to(dtype)


def _intervals(t: Tensor, shape: torch.Size, dtype: torch.dtype) -> Tensor:
    """(..., N, 1) seconds since the sample before, 0 for the first."""
    seconds = stamps.intervals(t, shape[:-1], dtype, repeated=True)
    first = seconds.new_zeros((*seconds.shape[:-1], min(1, shape[-2])))
    return torch.cat([first, seconds], -1)[..., None]
