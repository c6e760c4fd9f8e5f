"""What a trajectory can be turned into: each family from a source and the times of its knots.

A new family is a class here and a line in `FAMILIES`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchspline import checks
from torchspline.fit.approximation.control_points import control_points
from torchspline.fit.approximation.pieces import SMOOTH, Pieces, plain_name, scheme_of
from torchspline.fit.approximation.source import Source, remade
from torchspline.groups.group import R3, SO3, Group, product
from torchspline.splines.bspline import BSpline, SplitBSpline
from torchspline.splines.hermite import HermiteSpline
from torchspline.splines.interpolation import SCHEMES, KeyframeSpline, interpolate
from torchspline.splines.interpolation.bsplines import knots_of, with_phantoms
from torchspline.splines.nonuniform import NonuniformBSpline, signs_continued
from torchspline.splines.trajectory import Trajectory

#: Steps at most of a scheme that only nears its keys, towards keys whose curve meets the given one.
_NEARING = 30
#: Highest order that is chosen unasked.
_HIGHEST = 8


def order_for(source: Pieces) -> int:
    """Of a B-spline that follows such pieces: their own, where they have one."""
    return source.degree + 1 if source.degree is not None and 1 <= source.degree < _HIGHEST else 4


class Family(ABC):
    """One kind of result. Its options are checked when it is made.

    Args:
        group: that of the result. source: the pieces it shall follow.
    """

    #: Names of the options.
    options: ClassVar[tuple[str, ...]] = ()
    #: Whether knots stand at equal distances; else they go where they are needed.
    uniform: ClassVar[bool] = False
    #: Fewest pieces.
    least = 1

    group: Group

    @abstractmethod
    def count(self, breaks: Tensor, times: Tensor) -> int:
        """Control points, knots or keys over `breaks` (S + 1,) that come so many `times`."""

    @abstractmethod
    def build(self, source: Source, breaks: Tensor, times: Tensor) -> Trajectory:
        """The trajectory in float64 on the CPU."""

    @abstractmethod
    def represents(self, source: Source, breaks: Tensor, times: Tensor) -> bool:
        """Whether the source is of this kind: `build` then meets it to rounding."""

    @abstractmethod
    def same(self, trajectory: Trajectory) -> Trajectory | None:
        """A trajectory of the same group as one of this family if its numbers say as much, else None."""

    def times_at(self, smooth: Tensor) -> Tensor:
        """How often knots come where a source has so many continuous derivatives."""
        return torch.ones_like(smooth)


class UniformBSplines(Family):
    options = ("order",)
    uniform = True

    def __init__(self, group: Group, source: Pieces, order: int | None = None):
        self.order = order_for(source) if order is None else order
        checks.whole("order", self.order, least=2)
        self.group = group

    def count(self, breaks: Tensor, times: Tensor) -> int:
        return len(breaks) + self.order - 2

    def build(self, source: Source, breaks: Tensor, times: Tensor) -> Trajectory:
        segments, k = len(breaks) - 1, self.order
        i = torch.arange(1 - k, segments + k)
        if isinstance(source.start, int):
            dt = -(
                -(int(source.end) - source.start) // segments
            )  # the last knot may lie a little past the end
            knots = source.start + i * dt
            options: dict[str, Any] = {"dt_ns": dt, "t0_ns": source.start}
        else:
            width = (source.end - source.start) / segments
            knots = source.start + i.to(torch.float64) * width
            options = {"dt": width, "t0": source.start}
            knots[segments + k - 1] = source.end
        points = control_points(source, knots, k)
        return self._made(points, options)

    def _made(self, points: Tensor, options: dict[str, Any]) -> Trajectory:
        return BSpline(points, group=self.group, order=self.order, **options)

    def represents(self, source: Source, breaks: Tensor, times: Tensor) -> bool:
        return _b_spline_represents(source, breaks, times, self.order)

    def same(self, trajectory: Trajectory) -> Trajectory | None:
        if isinstance(trajectory, BSpline) and trajectory.order == self.order:
            return remade(trajectory)
        if isinstance(trajectory, NonuniformBSpline) and trajectory.order == self.order:
            return _as_uniform(trajectory)
        return None


class SplitBSplines(UniformBSplines):
    def __init__(self, group: Group, source: Pieces, order: int | None = None):
        if group != product(R3, SO3):
            raise ValueError(f"group: expected R3xSO3 with SplitBSpline, got {group}")
        super().__init__(group, source, order)

    def _made(self, points: Tensor, options: dict[str, Any]) -> Trajectory:
        return SplitBSpline(points, order=self.order, **options)

    def same(self, trajectory: Trajectory) -> Trajectory | None:
        copy = super().same(trajectory)
        if copy is None:
            return None
        assert isinstance(copy, BSpline)
        options = {"extrapolate": copy.extrapolate, "validate": copy.validate}
        clock = (
            {"dt": copy.dt, "t0": copy.t0}
            if copy.dt_ns is None
            else {"dt_ns": copy.dt_ns, "t0_ns": copy.t0_ns}
        )
        return SplitBSpline(copy.control_points.detach(), order=self.order, **clock, **options)


class NonuniformBSplines(Family):
    options = ("order",)

    def __init__(self, group: Group, source: Pieces, order: int | None = None):
        self.order = order_for(source) if order is None else order
        checks.whole("order", self.order, least=2)
        self.group = group

    def count(self, breaks: Tensor, times: Tensor) -> int:
        return int(times[1:-1].sum()) + self.order

    def build(self, source: Source, breaks: Tensor, times: Tensor) -> Trajectory:
        """Clamped: the domain's ends come order times, so that the curve starts and ends at a control point."""
        repeated = times.clone()
        repeated[0] = repeated[-1] = self.order
        knots = breaks.repeat_interleave(repeated)
        points = control_points(source, knots, self.order)
        return NonuniformBSpline(points, group=self.group, knots=knots, order=self.order)

    def represents(self, source: Source, breaks: Tensor, times: Tensor) -> bool:
        return _b_spline_represents(source, breaks, times, self.order)

    def times_at(self, smooth: Tensor) -> Tensor:
        return (self.order - 1 - smooth).clamp(1, self.order - 1)

    def same(self, trajectory: Trajectory) -> Trajectory | None:
        k = self.order
        if isinstance(trajectory, NonuniformBSpline) and trajectory.order == k:
            return remade(trajectory)
        if isinstance(trajectory, BSpline) and trajectory.order == k:
            i = torch.arange(1 - k, trajectory.control_points.shape[-2] + 1)
            start = trajectory.domain[0]
            if trajectory.dt_ns is not None:
                knots = start + i * trajectory.dt_ns
            else:
                assert trajectory.dt is not None
                knots = start + i.to(torch.float64) * float(trajectory.dt.detach())
            points = trajectory.control_points.detach()
            return NonuniformBSpline(
                points, group=self.group, knots=knots.to(points.device), order=k,
                extrapolate=trajectory.extrapolate, validate=trajectory.validate,
            )  # fmt: skip
        if not isinstance(trajectory, KeyframeSpline) or k != 4 or trajectory.way != "short":
            return None
        linear = not self.group.arithmetic.unit_blocks
        if scheme_of(trajectory) not in ("cumulative_bspline", *(("bspline",) if linear else ())):
            return None
        keys = signs_continued(trajectory.keyframes.detach(), self.group)
        return NonuniformBSpline(
            with_phantoms(self.group, keys), group=self.group, knots=knots_of(trajectory.times.detach()), order=4,
            extrapolate=trajectory.extrapolate, validate=trajectory.validate,
        )  # fmt: skip


class HermiteSplines(Family):
    """Value, velocity and acceleration of the source at its knots."""

    options = ("coordinates",)

    def __init__(self, group: Group, source: Pieces, coordinates: str = "logarithm"):
        checks.choice("coordinates", coordinates, ("product", "logarithm"))
        self.group, self.coordinates = group, coordinates

    def count(self, breaks: Tensor, times: Tensor) -> int:
        return len(breaks)

    def build(self, source: Source, breaks: Tensor, times: Tensor) -> Trajectory:
        state = source.states(breaks)
        assert state.velocity is not None
        assert state.acceleration is not None
        return HermiteSpline(
            *state[:3], group=self.group, times=breaks, coordinates=self.coordinates  # type: ignore[arg-type]
        )  # fmt: skip

    def represents(self, source: Source, breaks: Tensor, times: Tensor) -> bool:
        found = source.pieces
        if not source.linear or found.degree is None or found.degree > 5 or bool((found.smooth < 2).any()):
            return False
        return _contains(breaks, found.breaks[1:-1][found.smooth < SMOOTH])

    def same(self, trajectory: Trajectory) -> Trajectory | None:
        alike = isinstance(trajectory, HermiteSpline) and trajectory.coordinates == self.coordinates
        return remade(trajectory) if alike else None


class KeyframeSplines(Family):
    """Keys that the source passes, or, for schemes that only near their keys, that make the curve pass it there."""

    options = ("method", "ends", "way")

    def __init__(
        self, group: Group, source: Pieces, method: str | None = None, way: str = "short", **options: str
    ):
        if method is None:
            raise ValueError("method: expected one with KeyframeSpline, such as 'squad', got None")
        self.method, self.group, self.scheme = method, group, plain_name(method)
        if self.scheme in ("bezier", "bernstein"):
            raise ValueError(f"method: expected a scheme with pieces between its keys, got {method!r}")
        checks.choice("way", way, ("short", "signs"))
        self.chosen: dict[str, Any] = {"way": way, **options}
        # The other errors of method and options are those of the family itself.
        count = max(SCHEMES[self.scheme].least, 2) if self.scheme else 2
        KeyframeSpline(method, group.identity(count), torch.arange(float(count)), group=group, **self.chosen)
        self.least = count - 1

    def count(self, breaks: Tensor, times: Tensor) -> int:
        return len(breaks)

    def build(self, source: Source, breaks: Tensor, times: Tensor) -> Trajectory:
        goal = source.values(breaks)
        keys = goal
        group, made = self.group, self._made(keys, breaks)
        if made.properties.interpolates:
            return made
        solve = _at_keys(breaks)
        for _ in range(_NEARING):
            with torch.no_grad():
                back = group.inverse(made(breaks), validate=False)
                miss = group.log(group.compose(goal, back, validate=False), validate=False)
                keys = group.retract(keys, solve(miss), validate=False)
            made = self._made(keys, breaks)
            if float(miss.abs().amax()) < 1e-14 * max(float(goal.abs().amax()), 1.0):
                break
        return made

    def _made(self, keys: Tensor, breaks: Tensor) -> KeyframeSpline:
        return KeyframeSpline(self.method, keys, breaks, group=self.group, **self.chosen)

    def represents(self, source: Source, breaks: Tensor, times: Tensor) -> bool:
        if self.scheme not in (("geodesic", "linear") if source.linear else ("geodesic",)):
            return False
        return _straight(source, self.group) and _contains(breaks, source.pieces.breaks)

    def same(self, trajectory: Trajectory) -> Trajectory | None:
        if not isinstance(trajectory, KeyframeSpline) or scheme_of(trajectory) != self.scheme:
            return None
        chosen = {**trajectory.options, "way": trajectory.way}
        alike = all(chosen.get(name) == value for name, value in self.chosen.items())
        return remade(trajectory, method=self.method) if alike else None


def _at_keys(times: Tensor) -> Callable[[Tensor], Tensor]:
    """How cubic B-splines over keys at these times must change them so that the curve changes there as asked for.

    A key counts at its own time and at its neighbours': keys that are 1 in every third place tell the three apart.
    """
    from scipy.linalg import solve_banded  # as long to import as the rest of the library

    i = torch.arange(len(times))
    thirds = torch.nn.functional.one_hot(i % 3, 3).to(torch.float64)
    weights = interpolate("bspline", thirds, times, times, 0, group=R3).value
    band = torch.zeros(3, len(times), dtype=torch.float64)
    for row, offset in enumerate((1, 0, -1)):  # the column `offset` after the diagonal
        column = i + offset
        inside = (column >= 0) & (column < len(times))
        band[row, column[inside]] = weights[i[inside], column[inside] % 3]

    def solve(changes: Tensor) -> Tensor:
        columns = changes.movedim(-2, 0)
        solved = solve_banded(
            (1, 1), band.numpy(), columns.reshape(len(times), -1).numpy(), check_finite=False
        )
        return torch.from_numpy(solved).reshape(columns.shape).movedim(0, -2)

    return solve


FAMILIES: dict[type[Trajectory], type[Family]] = {
    BSpline: UniformBSplines,
    SplitBSpline: SplitBSplines,
    NonuniformBSpline: NonuniformBSplines,
    HermiteSpline: HermiteSplines,
    KeyframeSpline: KeyframeSplines,
}


def _straight(source: Source, group: Group) -> bool:
    """Whether its pieces are geodesics of `group`."""
    found, own = source.pieces, source.trajectory.group
    if source.linear:
        return found.degree is not None and found.degree <= 1
    return found.geodesic and (own == group or "R3xSO3" not in (own.name, group.name))


def _b_spline_represents(source: Source, breaks: Tensor, times: Tensor, order: int) -> bool:
    found = source.pieces
    followed = source.linear and found.degree is not None and found.degree < order
    if not followed and not (order == 2 and _straight(source, source.group)):
        return False
    needed = (order - 1 - found.smooth).clamp_min(0)
    at = found.breaks[1:-1]
    return _contains(breaks, at[needed > 0]) and all(
        _contains(breaks[times >= n], at[needed >= n]) for n in needed.unique().tolist()
    )


def _contains(breaks: Tensor, others: Tensor) -> bool:
    """Whether all `others` are among the breaks, up to rounding."""
    return len(others) == 0 or (
        len(breaks) > 0 and bool((nearest(breaks, others)[1] <= rounding(breaks)).all())
    )


def rounding(breaks: Tensor) -> float:
    """Times this near are the same."""
    if breaks.dtype == torch.int64:
        return 0.0
    return 1e-12 * float(breaks[-1] - breaks[0]) + 8.0 * torch.finfo(torch.float64).eps * float(
        breaks.abs().amax()
    )


def nearest(breaks: Tensor, others: Tensor) -> tuple[Tensor, Tensor]:
    """For each of `others` which break is nearest, and how far away."""
    after = torch.searchsorted(breaks, others.contiguous()).clamp(0, len(breaks) - 1)
    before = (after - 1).clamp_min(0)
    which = torch.where((others - breaks[before]).abs() <= (breaks[after] - others).abs(), before, after)
    return which, (breaks[which] - others).abs()


def _as_uniform(trajectory: NonuniformBSpline) -> Trajectory | None:
    """One over knots at equal distances, the outer ones too."""
    knots, order = trajectory.knots.detach(), trajectory.order
    start, end = trajectory.domain
    segments = trajectory.control_points.shape[-2] - order + 1
    i = torch.arange(1 - order, segments + order, device=knots.device).to(knots.dtype)
    width = (end - start) / segments
    options: dict[str, Any] = {"dt": width, "t0": start}
    if isinstance(start, int):
        width = (int(end) - start) // segments
        options = {"dt_ns": width, "t0_ns": start}
    if bool(((start + i * width - knots).abs() > rounding(knots)).any()):
        return None
    return BSpline(
        trajectory.control_points.detach(), group=trajectory.group, order=order,
        extrapolate=trajectory.extrapolate, validate=trajectory.validate, **options,
    )  # fmt: skip
