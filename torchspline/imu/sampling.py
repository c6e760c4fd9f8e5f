"""When a sensor really samples: its clock, the jitter of its sampling, the samples that get lost."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchspline import checks, units
from torchspline.imu.noise import Generators, white_noise
from torchspline.imu.parts import above_zero, drawing_device, keep, tensor_of
from torchspline.splines.trajectory import Trajectory


class Instants(NamedTuple):
    """`t` (N,) or (*batch, N): when samples were taken, in the trajectory's time and unit; `valid`: which arrived."""

    t: Tensor
    valid: Tensor


class Sampling(nn.Module):
    """How the stamps of a sensor relate to the instants at which it samples a trajectory.

    `stamp = t + offset + skew (t - mid)`, mid the middle of the trajectory's domain, as `fit.Clock` has it; the instant
    then misses t by jitter that the stamp does not tell, and some samples never arrive.

    Args:
        time_offset: s, by which stamps are late; a number or (*batch,).
        time_skew: s/s; a number or (*batch,).
        jitter: s, standard deviation, independent from sample to sample and from one of a batch to the next.
        drop_probability: of each sample to be lost, likewise independently; at least 0, below 1.
    """

    time_offset: Tensor | None
    time_skew: Tensor | None
    jitter: Tensor | None
    drop_probability: Tensor | None

    def __init__(
        self,
        time_offset: Tensor | float = 0.0,
        time_skew: Tensor | float = 0.0,
        jitter: Tensor | float = 0.0,
        drop_probability: Tensor | float = 0.0,
    ):
        super().__init__()
        given = {
            "time_offset": time_offset,
            "time_skew": time_skew,
            "jitter": jitter,
            "drop_probability": drop_probability,
        }
        for name, x in given.items():
            if x is None:
                raise TypeError(f"{name}: expected a number or a tensor (*batch,), got None; 0 means none")
            # A plain zero is known to have no effect; a tensor may become something else.
            number = isinstance(x, (int, float)) and not isinstance(x, bool) and x == 0
            keep(self, name, None if number else tensor_of(name, x, (), "a number or (*batch,)"))
        for name in ("jitter", "drop_probability"):
            above_zero(name, getattr(self, name), zero_too=True)
        for name, kept in (("time_skew", self.time_skew), ("drop_probability", self.drop_probability)):
            if kept is None or not checks.values_visible(kept):
                continue
            largest = kept.detach().abs().amax()
            if checks.seen_true(largest < 1.0) is False:
                raise ValueError(f"{name}: expected numbers below 1, got {largest.item():g}")

    @property
    def random(self) -> bool:
        """Whether it draws random numbers."""
        return self.jitter is not None or self.drop_probability is not None

    def forward(
        self,
        trajectory: Trajectory,
        t: Tensor,
        generator: Generators = None,
        batch: Sequence[int] = (),
    ) -> Instants:
        """Instants of the samples with stamps `t` (N,) or (*batch, N), seconds or int64 nanoseconds.

        Jitter does not reach beyond a domain whose trajectory refuses times outside. Each sensor of the `batch` has
        jitter and losses of its own.
        """
        own = {n: x.shape for n, x in (*self._parameters.items(), *self._buffers.items()) if x is not None}
        checks.broadcast(t=t.shape[:-1], **own)
        late: Tensor | None = None
        if self.time_skew is not None:
            start, stop = trajectory.domain
            since = units.seconds_since(t, 0.5 * (start + stop))
            skew = _column(self.time_skew)
            offset = 0.0 if self.time_offset is None else _column(self.time_offset)
            late = since - (since - offset) / (1.0 + skew)
        elif self.time_offset is not None:
            late = _column(self.time_offset)
        at = t if late is None else shifted(t, -late)
        valid = torch.ones((), dtype=torch.bool, device=t.device).expand(at.shape)
        if not self.random:
            return Instants(at, valid)
        batch = checks.broadcast(batch=batch, t=at.shape[:-1], **own)
        if isinstance(generator, Sequence) and not batch:
            batch = torch.Size([len(generator)])
        # Two columns whatever is used, so that one effect does not change the random numbers of another.
        one = torch.ones((), device=drawing_device(generator, t.device))
        normals = white_noise((*batch, t.shape[-1], 2), one, one, generator, torch.float32).to(t.device)
        if self.jitter is not None:
            at = excursion(trajectory, at, normals[..., 0].to(torch.float64) * _column(self.jitter))
        if self.drop_probability is not None:
            # A normal number lies below the quantile with just this probability.
            valid = normals[..., 1] >= torch.special.ndtri(_column(self.drop_probability))
        return Instants(at, valid)


def _column(x: Tensor) -> Tensor:
    """(*batch,) to go with (*batch, N), in double precision."""
    x = x.to(torch.float64)
    return x if x.ndim == 0 else x.unsqueeze(-1)


def shifted(t: Tensor, by: Tensor) -> Tensor:
    """Times `by` seconds later; nanoseconds stay whole, and therefore pass no gradient."""
    if t.dtype != torch.int64:
        return t.to(torch.float64) + by
    if torch.is_grad_enabled() and by.requires_grad:
        raise TypeError(
            "t: expected torch.float64 seconds where time_offset, time_skew or jitter requires grad, got "
            "torch.int64; whole nanoseconds have no gradient"
        )
    return t + units.nanoseconds(by)


def in_order(instants: Tensor) -> Tensor:
    """The instants themselves, which a filter needs to increase, as jitter may not let them."""
    steps = instants.detach().diff(dim=-1)
    if checks.values_visible(steps) and steps.numel() and checks.seen_true((steps > 0).all()) is False:
        least = steps.min().item() * units.unit_of(steps)
        raise ValueError(
            "jitter: expected instants that increase, as stamps do, where a filter follows, got two "
            f"{least:g} s apart; choose one well below the interval of stamps, and these increasing"
        )
    return instants


def excursion(trajectory: Trajectory, t: Tensor, by: Tensor) -> Tensor:
    """Times `by` seconds later, kept inside the domain where t is and where nothing lies beyond."""
    moved = shifted(t, by)
    if getattr(trajectory, "extrapolate", "error") != "error":
        return moved
    start, stop = trajectory.domain
    # Where t itself is outside it stays there, for the trajectory to refuse.
    return torch.minimum(torch.maximum(moved, t.clamp(max=start)), t.clamp(min=stop))
