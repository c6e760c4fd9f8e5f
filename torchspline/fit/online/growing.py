"""Splines that grow at their end and are finished at their start, for estimation while measurements arrive."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline import checks
from torchspline.fit.solving.bends import Walk
from torchspline.fit.solving.model import Model
from torchspline.groups.group import Group
from torchspline.splines.bspline import BSpline
from torchspline.splines.local import LocalSpline
from torchspline.units import NANOSECOND

Array = NDArray[Any]
#: Control points that one call may append: more is a time in the wrong unit or of another clock.
_MOST_AT_ONCE = 100_000


class Growing:
    """Control points of a uniform B-spline, with room for more.

    Args:
        points: (M, P), float64. dt, t0: knot spacing and start, s, or whole ns.
        pace: whether control points that are appended keep the pace of the last two, or stay where the last one is.
    """

    def __init__(
        self, points: Tensor, group: Group, order: int, dt: float | int, t0: float | int, pace: bool = True
    ):
        self.group, self.order, self.dt, self.t0, self._pace = group, order, dt, t0, pace
        self.spacing: float = dt * NANOSECOND if isinstance(dt, int) else dt
        self.points = points
        #: How many there are, and the first that still moves.
        self.count, self.first = len(points), 0
        self._local = LocalSpline(group.name, order, self.spacing, 2)

    def part(self, first: int, last: int, more: Tensor | None = None) -> BSpline:
        """Some of the control points as a spline of their own, a copy."""
        points = self.points[first:last] if more is None else torch.cat([self.points[first:last], more])
        options: dict[str, Any] = {"dt": self.dt, "t0": self.knot(first)}
        if isinstance(self.dt, int):
            options = {"dt_ns": self.dt, "t0_ns": self.knot(first)}
        return BSpline(points, group=self.group, order=self.order, learnable=False, **options)

    def knot(self, segment: int) -> float | int:
        """Where a segment begins."""
        return self.t0 + segment * self.dt

    def end(self, count: int) -> float | int:
        """Of the domain of what still moves with so many control points in all, by the arithmetic of `BSpline`."""
        return self.knot(self.first) + (count - self.first - self.order + 1) * self.dt

    def beyond(self, name: str, t: float | int) -> Tensor | None:
        """Control points that are missing to reach a time, None if there are enough.

        Raises:
            ValueError: so many that the time cannot be meant.
        """
        end = self.end(self.count)
        if t <= end:
            return None
        count = -int((end - t) // self.dt)
        while count <= _MOST_AT_ONCE and self.end(self.count + count) < t:  # rounding, at times of an epoch
            count += 1
        if count > _MOST_AT_ONCE:
            raise ValueError(
                f"{name}: {t!r} lies {count} control points after the end {end!r}, expected at most {_MOST_AT_ONCE} "
                "at once; check its unit and its clock"
            )
        if not self._pace:
            return self.points[self.count - 1].expand(count, -1)
        last = self.points[self.count - 2 : self.count].numpy()
        step = self._local.at(last).logs[:1]
        ahead = np.arange(1, count + 1, dtype=np.float64)[:, None] * step
        return torch.from_numpy(self._local.retract(np.tile(last[1], (count, 1)), ahead))

    def append(self, more: Tensor | None) -> None:
        """Control points at the end."""
        if more is None:
            return
        needed = self.count + len(more)
        if needed > len(self.points):  # twice as much: appending costs the same however many there are
            room = torch.zeros(2 * needed, self.points.shape[1], dtype=torch.float64)
            room[: self.count] = self.points[: self.count]
            self.points = room
        self.points[self.count : needed] = more
        self.count = needed


class Wandering(Growing):
    """A spline in R^n that residuals depend on, such as a bias that wanders. Its module is moved, and grows.

    Args:
        sigma: (n,) standard deviation of its change in a second. A random walk from control point to control point ties
            those together that no measurement sees.
        dt: of the trajectory, whose kind of time it has to have.
    Raises:
        TypeError, ValueError: no such spline.
    """

    def __init__(self, module: BSpline, sigma: Array, dt: float | int):
        check_wandering(module)
        own: float | int = module.dt_ns if module.dt_ns is not None else float(module.dt.detach())  # type: ignore[union-attr]
        if type(own) is not type(dt):
            raise TypeError(
                "variable: expected a spline with the window's kind of time, "
                f"{'dt_ns' if isinstance(dt, int) else 'dt'}, got {'dt_ns' if isinstance(own, int) else 'dt'}"
            )
        points = module.control_points.detach().clone()
        super().__init__(points, module.group, module.order, own, module.domain[0], pace=False)
        self.module = module
        self.walk(sigma)
        #: How many of them measurements have come up to; 0 before the first.
        self.used = 0

    @property
    def active(self) -> BSpline:
        """What still moves, a copy."""
        return self.part(self.first, self.used)

    def walk(self, sigma: Array) -> None:
        """By how much it changes in a second, (n,)."""
        self.weight = 1.0 / (sigma * self.spacing**0.5)

    def begin(self, t: float | int) -> None:
        """Leave control points alone that matter only before a time, unless measurements have come up to them."""
        if not self.used:
            self.first = max(min(int((t - self.t0) // self.dt), self.count - self.order), 0)

    def reach(self, t: float | int) -> None:
        """Use control points up to a time."""
        segments = -int((self.t0 - t) // self.dt)
        while self.end(segments + self.order - 1) < t:
            segments += 1
        self.used = min(max(self.used, self.first + self.order, segments + self.order - 1), self.count)

    def moved(self, active: BSpline) -> None:
        """Take over what became of `active`, also in the module."""
        self.points[self.first : self.used] = active.control_points.detach()
        points, old = self.points[: self.count], self.module.control_points
        # A view: its cost does not depend on the length.
        self.module.control_points = (
            torch.nn.Parameter(points, requires_grad=old.requires_grad)
            if isinstance(old, torch.nn.Parameter)
            else points
        )

    def steps(self, model: Model, spline: BSpline, last: int | None = None) -> Walk:
        """The random walk of a part of it that is among the unknowns of a model; see `Walk`."""
        return Walk(model, spline, self.weight, last)


def check_wandering(spline: BSpline) -> None:
    """An error unless it is a spline in R^n, float64, without a batch, on the CPU."""
    points = spline.control_points
    if points.device.type != "cpu":
        raise ValueError(
            f"variable: expected a spline on the CPU, got {points.device}; move it with .to('cpu')"
        )
    if spline.group.name != f"R{spline.group.point_size}" or points.ndim != 2:
        raise ValueError(
            f"variable: expected a spline in R^n without a batch, got one in {spline.group} with control points of "
            f"shape {tuple(points.shape)}"
        )
    if points.dtype != torch.float64:
        raise TypeError(f"variable: expected a spline of float64 control points, got {points.dtype}")
    checks.finite("variable", points)
