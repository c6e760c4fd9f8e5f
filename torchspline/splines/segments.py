"""Curves made of segments between knots at given times, uniform or not: where a time falls, what extrapolation
means."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchspline import checks, units
from torchspline.arithmetic.recurrence import MAX_DERIVATIVES
from torchspline.groups.group import Group
from torchspline.splines.clock import EXTRAPOLATE, Extrapolate
from torchspline.splines.located import Components, located, rounding
from torchspline.splines.trajectory import State

#: From rows (*batch, n, C) of a table, u (n,) or (*batch, n) within [0, 1] and a number of derivatives to the value and
#: so many rates by u, each (*batch, n, ...).
Fields = Callable[[Tensor, Tensor, int], tuple[Tensor, ...]]


def durations(times: Tensor) -> Tensor:
    """Seconds between neighbouring `times`, float64.

    Knots in whole nanoseconds are subtracted as integers, so that an epoch costs no digits, and others in float64.
    """
    return units.seconds((times if times.dtype == torch.int64 else times.to(torch.float64)).diff())


class Place(NamedTuple):
    """Where times fall, each of the shape of the times; float64."""

    segment: Tensor
    u: Tensor
    #: Duration of the segment, s.
    duration: Tensor
    #: How far before the start (negative) or past the end a time lies, s; None if none may.
    beyond: Tensor | None


def check_knot_times(times: Any, count: int, what: str = "knots") -> None:
    """Times of `count` knots, `(count,)` seconds or int64 nanoseconds: an error unless finite and increasing."""
    checks.is_times("times", times)
    if times.shape != (count,):
        raise ValueError(
            f"times: expected shape ({count},), one time for each of the {what}, got {tuple(times.shape)}"
        )
    checks.finite("times", times)
    later = times.detach().diff() > 0
    if checks.values_visible(times) and checks.seen_true(later.all()) is False:
        i = int(later.int().argmin())
        raise ValueError(
            f"times: expected increasing times, got {times[i].item()} and then {times[i + 1].item()}; sort them and "
            "drop duplicates first"
        )


def check_query(
    t: Any,
    times: Tensor,
    derivatives: int,
    extrapolate: str,
    validate: bool,
    like: Tensor,
    **batch: torch.Size,
) -> None:
    """The arguments of an evaluation that do not concern the curve itself; `times` of its knots, for their unit."""
    if type(derivatives) is not int or not 0 <= derivatives <= MAX_DERIVATIVES:
        raise ValueError(
            f"derivatives: expected a whole number from 0 to {MAX_DERIVATIVES}, got {derivatives!r}"
        )
    checks.choice("extrapolate", extrapolate, EXTRAPOLATE)
    if isinstance(t, Tensor) and (t.dtype == torch.int64) != (times.dtype == torch.int64):
        expected = (
            "int64 nanoseconds, as the knots are"
            if times.dtype == torch.int64
            else "torch.float32 or torch.float64 seconds, as the knots are (nanoseconds go with int64 knots)"
        )
        raise TypeError(f"t: expected {expected}, got {t.dtype}")
    checks.is_times("t", t)
    if t.device != like.device:
        (name,) = batch
        raise ValueError(
            f"t: on device {t.device}, but {name} are on {like.device}; move one with .to(device)"
        )
    if t.ndim > 1:
        checks.broadcast(**batch, t=t.shape[:-1])
    if validate:
        checks.finite("t", t)


def locate_between(t: Tensor, times: Tensor, extrapolate: Extrapolate, validate: bool) -> Place:
    """Segment between neighbouring `times` (M,), which do not decrease, and place within it, computed before any
    rounding to float32.

    A knot belongs to the segment that it starts; the last one to the last segment. Where values cannot be seen (other
    devices, `vmap`, compilation) times outside give NaN instead of an error.
    """
    nanoseconds = times.dtype == torch.int64
    knots, s = (times, t) if nanoseconds else (times.to(torch.float64), t.to(torch.float64))
    knots = knots.contiguous()
    steps = knots.diff()
    if validate and not nanoseconds:
        _check_rounding(t, steps)
    # The last segment of some duration: knots may come more than once.
    last = (knots.detach() < knots.detach()[-1]).sum() - 1
    segment = torch.searchsorted(knots.detach(), s.detach().contiguous(), right=True) - 1
    segment = torch.minimum(segment.clamp_min(0), last)
    duration = steps[segment].to(torch.float64)
    u = (s - knots[segment]).to(torch.float64) / duration
    if nanoseconds:
        duration = duration * units.NANOSECOND
    # A few rounding errors beyond the ends belong to the domain.
    ends = knots.detach()
    slack = 0 if nanoseconds else rounding(t.dtype) * (ends.abs().amax() + ends[-1] - ends[0])
    outside = ~((s.detach() >= ends[0] - slack) & (s.detach() <= ends[-1] + slack))
    if extrapolate != "error":
        inside = torch.where(outside, u.clamp(0.0, 1.0), u)
        return Place(segment, inside, duration, (u - inside) * duration)
    if validate and not _refuse(outside, t, knots):
        u = torch.where(outside, torch.nan, u)
    return Place(segment, u, duration, None)


def _check_rounding(t: Tensor, steps: Tensor) -> None:
    if t.dtype != torch.float32 or t.numel() == 0 or not checks.values_visible(t):
        return
    rounding = torch.finfo(torch.float32).eps * t.detach().abs().amax()
    shortest = torch.where(steps.detach() > 0, steps.detach(), torch.inf).amin()
    if checks.seen_true(rounding.to(torch.float64) > 1e-3 * shortest):
        raise ValueError(
            f"t: float32 rounds times near {t.detach().abs().amax().item():.6g} s to {rounding.item():.1e} s, more "
            f"than a thousandth of the shortest segment, {shortest.item():g} s; pass float64 times or times relative "
            "to a nearer origin"
        )


def _refuse(outside: Tensor, t: Tensor, knots: Tensor) -> bool:
    """An error if a time is outside; else whether values could be seen at all."""
    seen = checks.seen_true(outside.any()) if checks.values_visible(t, outside) else None
    if not seen:
        return seen is not None
    first = t.detach()[outside].flatten()[0].item()
    start, stop = knots.detach()[0].item(), knots.detach()[-1].item()
    unit = "ns" if t.dtype == torch.int64 else "s"
    raise ValueError(
        f"t: {int(outside.sum())} of {outside.numel()} times lie outside the domain [{start}, {stop}] {unit}, "
        f"the first is {first!r}; choose times inside, or extrapolate='clamp' or 'linear'"
    )


def rows_at(table: Tensor, segment: Tensor) -> Tensor:
    """Rows of `table` (*batch, L, C) at `segment` (n,) or (*batch, n): `(*batch, n, C)`."""
    if segment.ndim == 1:
        return table.index_select(-2, segment)
    return table.gather(-2, segment.unsqueeze(-1).expand(*segment.shape, table.shape[-1]))


def align(t: Tensor, batch: torch.Size) -> tuple[Tensor, torch.Size, tuple[int, ...]]:
    """Times (n,) or (*common, n), the batch that tables have to be expanded to, and the shape of the results."""
    if t.ndim == 0:
        return t.reshape(1), batch, tuple(batch)
    if t.ndim == 1:
        return t, batch, (*batch, t.shape[0])
    if len(batch) == 0:  # one trajectory: a batch of times is just more times
        return t.reshape(-1), batch, tuple(t.shape)
    common = torch.broadcast_shapes(batch, t.shape[:-1])
    return t.expand(*common, t.shape[-1]), common, (*common, t.shape[-1])


def evaluate_segments(
    table: Tensor,
    fields: Fields,
    group: Group,
    t: Tensor,
    times: Tensor,
    derivatives: int,
    extrapolate: Extrapolate,
    validate: bool,
    components: Components | None = None,
) -> State:
    """Value and rates per second of a curve made of segments.

    Args:
        table: (*batch, M - 1, C), what determines each segment. fields: the curve from that.
        times: (M,) seconds or int64 nanoseconds, as `t`, of the M - 1 segments.
        components: the same as `fields` on components, for loops that may be compiled.
    """
    if components is not None:
        found = located(components, group, table, t, times, derivatives)
        if found is not None:
            return State(*found)
    dtype = table.dtype
    aligned, common, shape = align(t, table.shape[:-2])
    place = locate_between(aligned, times, extrapolate, validate)
    rows = rows_at(table.expand(*common, *table.shape[-2:]), place.segment)
    needed = max(derivatives, 1) if extrapolate == "linear" else derivatives
    duration = place.duration.to(dtype).unsqueeze(-1)
    by_u = fields(rows, place.u.to(dtype), needed)
    per_second = tuple(field if r == 0 else field / duration**r for r, field in enumerate(by_u))
    if place.beyond is not None:
        per_second = past_the_end(group, per_second, place.beyond.to(dtype), extrapolate)
    return State(*(f.reshape(*shape, f.shape[-1]) for f in per_second[: derivatives + 1]))


def past_the_end(
    group: Group, fields: tuple[Tensor, ...], beyond: Tensor, extrapolate: Extrapolate
) -> tuple[Tensor, ...]:
    """Past an end: hold the pose, or keep the velocity there. `beyond` in the unit of time of the rates."""
    value, *rates = fields
    excess = beyond.unsqueeze(-1)
    outside = excess != 0
    held = []
    if extrapolate == "linear":
        drift = group.exp(excess * rates[0], validate=False)
        value = group.compose(value, drift, validate=False)
        held = [rates[0]]
    return value, *held, *(torch.where(outside, 0.0, rate) for rate in rates[len(held) :])
