"""From one family of trajectories to another: exactly where that is possible, else by a fit that says how good it
is."""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchspline import checks
from torchspline.fit.approximation.compare import (
    Difference,
    check_groups,
    compare,
    grid,
    profile,
    summary,
    union,
)
from torchspline.fit.approximation.families import FAMILIES, Family, nearest, rounding
from torchspline.fit.approximation.pieces import uniform_breaks
from torchspline.fit.approximation.source import Source, plain
from torchspline.groups.group import R3, SO3, Group, product
from torchspline.kernels.mode import use_kernels
from torchspline.splines.bspline import SplitBSpline
from torchspline.splines.interpolation import SCHEMES, SURVEY, KeyframeSpline
from torchspline.splines.trajectory import Trajectory

#: Equal steps in a stretch between knots at which errors are measured.
_SAMPLES = 8
#: Pieces that are off by less than this share of the worst wait.
_WORST = 0.1


class Approximation(NamedTuple):
    """What `approximate` made."""

    #: Of the family asked for; dtype and device of the one approximated, extrapolating as it does.
    trajectory: Trajectory
    #: Whether both are the same curve, so that `error` is nothing but rounding.
    exact: bool
    #: How far it lies from the one approximated, see `compare`.
    error: Difference


def approximate(
    trajectory: Trajectory,
    *,
    family: type[Trajectory],
    tolerance: float | tuple[float, float] | None = None,
    knots: int | Tensor | None = None,
    group: Group | None = None,
    max_points: int = 10_000,
    **options: Any,
) -> Approximation:
    """The same motion as a trajectory of another family.

    Exact, whatever the group: between uniform and non-uniform B-splines of one order (the latter over uniform knots);
    between the scheme "geodesic" and B-splines of order 2; from "cumulative_bspline" (CuBsp, SpFus, ScFus) to a
    non-uniform B-spline of order 4; between SE3 and DualQuaternion, but for schemes that blend stored numbers; and for
    frames mounted on a B-spline in SO3, SE3 or DualQuaternion. On R^n all that are piecewise polynomials, where
    degree and knots allow it: from a B-spline to one over finer knots or, non-uniform, of higher order; from a
    Hermite spline to a non-uniform B-spline of order 6 with threefold knots; from a B-spline of order 4 to 6 to a
    Hermite spline. Else B-splines are fitted (least squares over time, on a group by repeated linear fits in the
    tangent space), and Hermite and keyframe splines take what they need at their knots.

    A smooth motion is met to the order of a B-spline on R^n, but to third order at most where its factors do not
    commute (measured, whatever the control points); a Hermite spline in logarithmic coordinates is of sixth order.
    From SE3 to R3xSO3 over the same knots rotations are met to rounding, as they are B-splines in SO3 in both, unless
    neighbouring control points are more than a radian apart; positions, which SE3 couples to them, are fitted.

    Args:
        trajectory: any; batches share the knots, and all of them count.
        family: `BSpline`, `SplitBSpline`, `NonuniformBSpline`, `HermiteSpline` or `KeyframeSpline`.
        tolerance: largest distance in position [m] and rotation [rad], or one number for both; knots are added until it
            is kept: twice as many where they are uniform, else where it is exceeded, first where the given pieces meet
            and as often as they jump there. None: the knots stay as they are.
        knots: to begin with, or to stay with: how many equal pieces, or, for families that are not uniform, the
            times (S + 1,) where pieces meet, from the first to the last time, in its unit. None: those of `trajectory`,
            or, where there is a tolerance to keep, two pieces.
        group: of the result; None: that of `trajectory`, or of a family or method that names one. Poses go from any of
            SE3, R3xSO3 and DualQuaternion to any other.
        max_points: most control points, knots or keys.
        options: of the family: `order` (B-splines; else as the given pieces have it), `coordinates` (Hermite splines;
            else "logarithm"), `method` (keyframes, needed), `way`, `ends`.
    Returns:
        Approximation: of Parameters of its own, without a graph. In nanoseconds a uniform result may end some
        nanoseconds later.
    Raises:
        TypeError, ValueError: a wrong type or value; a tolerance that is not kept with `max_points`.
    """
    checks.instance("trajectory", trajectory, Trajectory, "a Trajectory")
    if family not in FAMILIES:
        expected = ", ".join(kind.__name__ for kind in FAMILIES)
        raise ValueError(
            f"family: expected one of {expected}, got {getattr(family, '__name__', repr(family))}"
        )
    limits = _limits(tolerance)
    checks.whole("max_points", max_points, least=2)
    result_group = _group_of(trajectory, family, group, options)
    given = plain(trajectory, result_group)
    source = Source(given, result_group)
    makes: Any = FAMILIES[family]
    for name in options:
        if name not in makes.options:
            raise ValueError(f"{name}: expected an option of {family.__name__}, {makes.options}, got {name}")
    if "order" in options:
        checks.whole("order", options["order"], least=2)
    target: Family = makes(result_group, source.pieces, **options)
    breaks = _breaks(source, target, knots, limits is not None)

    # Compiling loops for every group and order that a fit meets would take longer than the fit.
    with use_kernels("reference"):
        return _made(trajectory, source, target, breaks, limits, max_points, knots is None)


def _made(
    trajectory: Trajectory,
    source: Source,
    target: Family,
    breaks: Tensor,
    limits: tuple[float, float] | None,
    max_points: int,
    free: bool,
) -> Approximation:
    """Of checked arguments; `free`: nobody said which knots to use."""
    given = source.trajectory
    same = target.same(given) if free and given.group == source.group else None
    if same is not None:
        return Approximation(same, True, compare(same, trajectory))
    if limits is None:
        times = _times(source, target, breaks)
        _check_count(target.count(breaks, times), max_points, "knots")
        made = target.build(source, breaks, times)
        exact = target.represents(source, breaks, times)
    else:
        made, exact = _kept(source, target, breaks, limits, max_points, free)
    made = _like(made, source, trajectory)
    return Approximation(made, exact, compare(made, trajectory))


def _limits(tolerance: Any) -> tuple[float, float] | None:
    if tolerance is None:
        return None
    pair = tolerance if isinstance(tolerance, tuple) else (tolerance, tolerance)
    if len(pair) != 2:
        raise ValueError(
            f"tolerance: expected one number or two, for position [m] and rotation [rad], got {tolerance!r}"
        )
    return checks.positive("tolerance", pair[0]), checks.positive("tolerance", pair[1])


def _group_of(
    trajectory: Trajectory, family: type[Trajectory], group: Group | None, options: dict[str, Any]
) -> Group:
    if group is not None:
        checks.instance("group", group, Group, "a torchspline.Group such as torchspline.SE3")
    method = options.get("method") if family is KeyframeSpline else None
    named = {} if method in SCHEMES else {name.lower(): named.group for name, named in SURVEY.items()}
    own = named.get(str(method).lower())
    found = group or trajectory.group
    if group is None and family is SplitBSpline:
        found = product(R3, SO3)
    if group is None and own is not None and own != "Rn":
        found = Group(own)
    check_groups(trajectory.group, found, "group" if group is not None or own is None else "method")
    return found


def _breaks(source: Source, target: Family, knots: Any, refined: bool) -> Tensor:
    if knots is None:
        if not refined:
            count = max(len(source.pieces.breaks) - 1, target.least)
            fits = not target.uniform and count == len(source.pieces.breaks) - 1
            return source.pieces.breaks if fits else uniform_breaks(source.start, source.end, count)
        return uniform_breaks(source.start, source.end, max(2, target.least))
    if not isinstance(knots, Tensor):
        checks.whole("knots", knots, least=target.least)
        return uniform_breaks(source.start, source.end, knots)
    if target.uniform:
        raise ValueError(
            "knots: expected how many pieces a uniform B-spline shall have, got a tensor of times"
        )
    whole = isinstance(source.start, int)
    if (knots.dtype == torch.int64) != whole:
        raise TypeError(
            f"knots: expected {'int64 nanoseconds' if whole else 'torch.float64 seconds'}, as the times of the "
            f"trajectory are, got {knots.dtype}"
        )
    checks.is_times("knots", knots)
    knots = knots.detach().cpu().to(source.pieces.breaks.dtype)
    if knots.ndim != 1 or len(knots) < target.least + 1:
        raise ValueError(f"knots: expected shape (S + 1,), S >= {target.least}, got {tuple(knots.shape)}")
    checks.finite("knots", knots)
    ends = (knots[0].item(), knots[-1].item())
    off = max(abs(a - b) for a, b in zip(ends, (source.start, source.end), strict=True))
    if bool((knots.diff() <= 0).any()) or off > rounding(source.pieces.breaks):
        raise ValueError(
            f"knots: expected times that increase from {source.start} to {source.end}, as the domain does, got "
            f"{ends[0]} to {ends[1]}" + (", not increasing" if bool((knots.diff() <= 0).any()) else "")
        )
    knots[0], knots[-1] = source.start, source.end
    return knots


def _times(source: Source, target: Family, breaks: Tensor) -> Tensor:
    """How often each break comes, from how smooth the source is where they coincide."""
    times = torch.ones(len(breaks), dtype=torch.int64)
    inner = source.pieces.breaks[1:-1]
    if len(inner):
        which, off = nearest(breaks, inner)
        here = off <= rounding(breaks)
        times[which[here]] = target.times_at(source.pieces.smooth[here])
    return times


def _check_count(count: int, max_points: int, name: str) -> None:
    if count > max_points:
        raise ValueError(
            f"{name}: expected no more than max_points={max_points} control points, knots or keys, got {count}"
        )


def _kept(
    source: Source,
    target: Family,
    breaks: Tensor,
    limits: tuple[float, float],
    max_points: int,
    free: bool,
) -> tuple[Trajectory, bool]:
    """The trajectory within the limits, and whether it is exact.

    Args:
        free: whether nobody said which knots to begin with.
    """
    if free:
        own = source.pieces.breaks
        own = uniform_breaks(source.start, source.end, len(own) - 1) if target.uniform else own
        times = _times(source, target, own)
        if target.count(own, times) <= max_points and target.represents(source, own, times):
            return target.build(source, own, times), True
    times = torch.ones(len(breaks), dtype=torch.int64)
    tried: list[tuple[int, float]] = []
    excess, error = math.inf, None
    while target.count(breaks, times) <= max_points:
        made = target.build(source, breaks, times)
        error, worst = _errors(made, source, breaks, limits)
        excess = float(worst.amax())
        tried.append((len(breaks) - 1, excess))
        if excess <= 1.0:
            exact = target.represents(source, breaks, times)
            if target.uniform and not exact:
                made = _fewer(source, target, made, tried, limits)
            return made, exact
        if target.uniform:
            breaks = uniform_breaks(source.start, source.end, 2 * (len(breaks) - 1))
            times = torch.ones(len(breaks), dtype=torch.int64)
            continue
        # What is off where a motion is fast ripples into pieces that need no knots of their own: the worst come first.
        finer = _refined(source, target, breaks, times, worst > max(1.0, _WORST * excess))
        if len(finer[0]) == len(breaks) and bool((finer[1] == times).all()):
            break
        breaks, times = finer
    reached = (
        "" if error is None else f": with {tried[-1][0]} pieces the largest differences are {_told(error)}"
    )
    raise ValueError(
        f"tolerance: expected one that is kept with max_points={max_points}, got {limits[0]:g} (position) and "
        f"{limits[1]:g} rad{reached}; allow more points or a larger tolerance"
    )


def _told(error: Difference) -> str:
    parts = []
    if error.position_max is not None:
        parts.append(f"{error.position_max:.3g} (position)")
    if error.rotation_max is not None:
        parts.append(f"{error.rotation_max:.3g} rad")
    return " and ".join(parts)


def _errors(
    made: Trajectory, source: Source, breaks: Tensor, limits: tuple[float, float]
) -> tuple[Difference, Tensor]:
    """How far it is off, and for each piece how many times the limit that is."""
    t = grid(union(breaks, source.pieces.breaks, source.start, source.end), _SAMPLES)
    rotation, position = profile(made, source.trajectory, t)
    # Where two pieces meet the miss is that of both: a long one beside a short one may be to blame for it.
    after, before = (
        (torch.searchsorted(breaks, t, right=right) - 1).clamp(0, len(breaks) - 2) for right in (True, False)
    )
    worst = torch.zeros(len(breaks) - 1, dtype=torch.float64)
    for x, limit in ((position, limits[0]), (rotation, limits[1])):
        if x is not None:
            x = x.flatten(0, -2).amax(0) if x.ndim > 1 else x
            shares = (x / limit).nan_to_num(nan=torch.inf)
            worst.scatter_reduce_(0, after, shares, "amax").scatter_reduce_(0, before, shares, "amax")
    return summary(rotation, position), worst


def _fewer(
    source: Source,
    target: Family,
    made: Trajectory,
    tried: list[tuple[int, float]],
    limits: tuple[float, float],
) -> Trajectory:
    """Between the last two counts that were tried, the one at which the error, falling as a power, meets the limit."""
    if len(tried) < 2:
        return made
    (few, far), (many, near) = tried[-2:]
    falls = math.log(far / max(near, 1e-300)) / math.log(many / few)
    count = math.ceil(1.05 * few * far ** (1.0 / falls))
    if not few < count < many:
        return made
    breaks = uniform_breaks(source.start, source.end, count)
    other = target.build(source, breaks, torch.ones(len(breaks), dtype=torch.int64))
    return other if float(_errors(other, source, breaks, limits)[1].amax()) <= 1.0 else made


def _refined(
    source: Source, target: Family, breaks: Tensor, times: Tensor, exceeded: Tensor
) -> tuple[Tensor, Tensor]:
    """More knots in the pieces (S,) that are off by too much.

    A piece is cut where pieces of the source meet within it, at the one nearest its middle; where none do, knots at its
    ends come as often as the source jumps there; where that is done, it is cut in the middle.
    """
    start, end = breaks[:-1], breaks[1:]
    whole = breaks.dtype == torch.int64
    middle = start + (end - start) // 2 if whole else start + 0.5 * (end - start)
    cut, meets = middle, torch.zeros_like(exceeded)
    inner = source.pieces.breaks[1:-1]
    needed = torch.ones_like(times)
    if len(inner):
        near = inner[nearest(inner, middle)[0]]
        margin = 0 if whole else 1e-6 * (end - start)
        meets = (near > start + margin) & (near < end - margin)
        cut = torch.where(meets, near, middle)
        needed = _times(source, target, breaks)
    lacking = exceeded & ~meets
    short = needed > times
    raised = short & (torch.nn.functional.pad(lacking, (0, 1)) | torch.nn.functional.pad(lacking, (1, 0)))
    waits = lacking & (raised[:-1] | raised[1:])
    least = 1 if whole else max(1e-12 * (source.end - source.start), rounding(breaks))
    added = cut[exceeded & ~waits & (end - start > least)]
    times = torch.where(raised, needed, times)
    breaks, order = torch.cat([breaks, added]).sort()
    return breaks, torch.cat([times, torch.ones_like(added, dtype=torch.int64)])[order]


def _like(made: Trajectory, source: Source, given: Trajectory) -> Trajectory:
    """In dtype and on the device of the trajectory it stands for."""
    if hasattr(given, "extrapolate"):
        made.extrapolate = given.extrapolate
    with torch.no_grad():
        dtype = given(source.pieces.breaks[:1].to(source.device)).dtype
    return made.to(dtype).to(source.device)
