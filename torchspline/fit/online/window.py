"""A trajectory that grows while it is estimated: what is older than a window is summarised and not touched again."""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline import checks
from torchspline.fit.online.marginal import marginalised, normal_equations, random_walk
from torchspline.fit.online.streams import Stream, trajectory_times, variables_of
from torchspline.fit.problem import Problem, include_unknowns
from torchspline.fit.residual import Residual
from torchspline.fit.result import Result
from torchspline.fit.solving.bends import Bends
from torchspline.fit.solving.model import Model, Spline
from torchspline.fit.solving.priors import Part, Prior
from torchspline.fit.solving.solver import Options, minimise
from torchspline.fit.solving.terms import Term
from torchspline.fit.variables import Variable
from torchspline.groups.group import Group
from torchspline.splines.bspline import BSpline
from torchspline.splines.local import LocalSpline
from torchspline.units import NANOSECOND

Array = NDArray[Any]
#: Control points that one call may append: more is a time in the wrong unit or of another clock.
_MOST_AT_ONCE = 100_000


class SlidingWindow:
    """Estimates a B-spline as measurements arrive; the cost of an update does not depend on how long it has been going.

        window = SlidingWindow(pose, group=SE3, dt=0.1, window=5.0)
        bias = Variable("gyro_bias", torch.zeros(3, dtype=torch.float64))
        for packet in sensor:
            window.add(Gyroscope(packet.t, packet.gyro, sigma=1e-3, bias=bias))
            window.update()
            now = window.trajectory.kinematics(packet.t[-1])

    Each update is a least-squares fit of the control points of the last `window` seconds and of all variables.
    Control points that leave the window keep the value they then have; the measurements of them become a Gaussian on
    the control points and variables that are left, by a Schur complement at the estimate of that moment. For linear
    problems nothing is lost by that. Measurements of one kind, arguments, weight and clock are kept together,
    however many calls they came in.

    Args:
        start: a pose `(P,)` to start from, or control points `(M, P)`, at least `order`.
        group, order: of the spline. dt, t0: knot spacing and start, s; or dt_ns, t0_ns, whole ns, and int64 times.
        window: how far back from the latest time measurements are welcome and estimates change, s.
        smoothness: standard deviation of the change of velocity (body frame; m/s, rad/s) from one knot to the next,
            a number or `(D,)`. It bridges stretches without measurements; the default leaves others as they are.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """

    def __init__(
        self,
        start: Tensor,
        *,
        group: Group,
        order: int = 4,
        dt: float | None = None,
        t0: float = 0.0,
        dt_ns: int | None = None,
        t0_ns: int | None = None,
        window: float = 5.0,
        smoothness: Tensor | float = 100.0,
    ):
        checks.instance("group", group, Group, "a torchspline.Group such as torchspline.SE3")
        checks.whole("order", order, least=2)
        checks.is_floating_tensor("start", start)
        if start.ndim == 1:
            start = start.expand(order, -1)
        if start.ndim != 2 or start.shape[-1] != group.point_size or len(start) < order:
            raise ValueError(
                f"start: expected shape ({group.point_size},), a point of {group}, or (M, {group.point_size}), at "
                f"least {order} control points, got {tuple(start.shape)}"
            )
        if start.device.type != "cpu":
            raise ValueError(f"start: expected it on the CPU, got {start.device}; move it with .to('cpu')")
        checks.points("start", start, group, order)
        clock: dict[str, Any] = {"dt": dt, "t0": t0, "dt_ns": dt_ns, "t0_ns": t0_ns}
        spline = BSpline(start.detach(), group=group, order=order, learnable=False, **clock)
        self.group, self.order = group, order
        self._t0 = spline.domain[0]
        #: Knot spacing in the unit of the times, and in seconds.
        self._dt: float | int = float(dt) if dt is not None else dt_ns or 0
        self._spacing = self._dt if dt is not None else self._dt * NANOSECOND
        self._segments = max(math.ceil(checks.positive("window", window) / self._spacing - 1e-9), 2)
        sigma = _per_component("smoothness", smoothness, group.tangent_size)
        self._stiffness = 1.0 / (self._spacing * sigma)
        self._local = LocalSpline(group.name, order, self._spacing, 2)
        #: All control points there are, with room for more, their number, and the first that still moves.
        self._points = group.normalize(start.detach().to("cpu", torch.float64))
        self._count, self._first = len(start), 0
        self._streams: list[Stream] = []
        self._variables: dict[str, Variable] = {}
        #: What was added beforehand or remembered; parts of the trajectory are of `_anchor`.
        self._priors: list[Prior] = []
        self._anchor = self.active
        self._walks: dict[Variable, Array] = {}

    def __repr__(self) -> str:
        start, end = self.active.domain
        return (
            f"SlidingWindow({self.group}, {self._count} control points, {sum(map(len, self._residuals()))} "
            f"measurements in [{start}, {end}])"
        )

    # ------------------------------------------------------------------ what there is

    @property
    def trajectory(self) -> BSpline:
        """All there is so far, a copy. Its cost grows with the length: see `active` for the latest part."""
        return self._spline(0, self._count)

    @property
    def active(self) -> BSpline:
        """What still moves, a copy."""
        return self._spline(self._first, self._count)

    @property
    def variables(self) -> dict[str, Variable]:
        """Unknowns besides the trajectory, by name."""
        return dict(self._variables)

    @property
    def measurements(self) -> int:
        """Numbers of measurements that are still there; the others were summarised."""
        return sum(map(len, self._residuals()))

    def _residuals(self) -> list[Residual]:
        return [stream.residual for stream in self._streams]

    def _spline(self, first: int, last: int, more: Tensor | None = None) -> BSpline:
        points = self._points[first:last]
        if more is not None:
            points = torch.cat([points, more])
        options: dict[str, Any] = {"dt": self._dt, "t0": self._knot(first)}
        if isinstance(self._dt, int):
            options = {"dt_ns": self._dt, "t0_ns": self._knot(first)}
        return BSpline(points, group=self.group, order=self.order, learnable=False, **options)

    def _knot(self, segment: int) -> float | int:
        """Where a segment begins."""
        return self._t0 + segment * self._dt

    # ------------------------------------------------------------------ what arrives

    def add(self, residual: Residual, **index: Tensor) -> None:
        """Add measurements; control points are appended to reach the latest of them.

        Args:
            residual: its times are at or after the start of `active`, in any order. Unknown arguments are variables.
            index: as for `Problem.add`.
        Raises:
            TypeError, ValueError: it does not fit the trajectory; times before the window.
        """
        checks.instance("residual", residual, Residual, "a residual such as torchspline.fit.Gyroscope")
        for slot, x in residual.arguments.items():
            if isinstance(x, BSpline):
                raise ValueError(
                    f"{slot}: expected a Variable or a tensor, got a BSpline; online, what changes over time is a "
                    "Variable with a random_walk"
                )
        more = None
        if len(residual) and (residual.t.dtype == torch.int64) == isinstance(self._dt, int):
            origin = self._knot(self._first)
            tau = trajectory_times(residual, origin)
            self._check_late(residual, tau)
            last = residual.t.max().item()
            if residual.clock.unknowns:
                last = self._unit(origin, float(tau.max()))
            more = self._beyond("t", last)
        # A problem of its own tells what is wrong before anything changes.
        probe = Problem(self._spline(self._first, self._count, more))
        include_unknowns(probe, list(self._variables.values()))
        probe.add(residual, **index)
        self._append(more)
        self._variables.update({v.name: v for v in variables_of(residual)})
        # A copy of the measurements: buffers that packets arrive in may be used again.
        stream = Stream(residual, dict(index)).select(torch.ones(len(residual), dtype=torch.bool))
        for i, other in enumerate(self._streams):
            joined = other.join(stream)
            if joined is not None:
                self._streams[i] = joined
                return
        self._streams.append(stream)

    def _check_late(self, residual: Residual, tau: Array) -> None:
        start = self._knot(self._first)
        late = torch.from_numpy((tau < 0).any(axis=0))
        if not residual.clock.unknowns:
            late = (residual.t < start).reshape(type(residual).moments, -1).any(dim=0)
        elif self._first == 0:  # nothing is lost yet, and the clock may still turn out otherwise
            return
        if bool(late.any()):
            first = residual.t[..., late].flatten()[0].item()
            raise ValueError(
                f"t: {int(late.sum())} of {late.numel()} times of {residual.name} lie before the window, which starts "
                f"at {start!r}, the first is {first!r}; older parts of the trajectory are finished: add measurements "
                "sooner, or choose a longer window"
            )

    def _unit(self, origin: float | int, seconds: float) -> float | int:
        return origin + (math.ceil(seconds / NANOSECOND) if isinstance(self._dt, int) else seconds)

    def add_prior(
        self,
        variable: Variable,
        *,
        sigma: Tensor | float | None = None,
        covariance: Tensor | None = None,
        information: Tensor | None = None,
    ) -> None:
        """Say beforehand how far a variable may be from where it stands now; see `Problem.add_prior`."""
        probe = Problem(self._anchor)
        include_unknowns(probe, list(self._variables.values()))
        probe.add_prior(variable, sigma=sigma, covariance=covariance, information=information)
        self._variables[variable.name] = variable
        self._priors += probe.priors

    def random_walk(self, variable: Variable, sigma: Tensor | float) -> None:
        """Let a variable change over time: what was remembered of it grows old.

        It is one value within the window, and steps where control points leave it.

        Args:
            sigma: standard deviation of its change in a second, a number or `(dimension,)`, in its unit per root
                second.
        Raises:
            TypeError, ValueError: a wrong type, shape or value.
        """
        checks.instance("variable", variable, Variable, "a torchspline.fit.Variable")
        count = variable.value.shape[:-1].numel()
        self._walks[variable] = np.tile(_per_component("sigma", sigma, variable.dimension), (count, 1))

    def extend(self, t: float | int) -> None:
        """Append control points up to a time: the last step from one to the next is repeated.

        Args:
            t: s, or whole ns if made with `dt_ns`.
        Raises:
            TypeError, ValueError: no such number, or one too far ahead to be meant.
        """
        if isinstance(self._dt, int):
            if isinstance(t, bool) or not isinstance(t, int):
                raise TypeError(f"t: expected a whole number of nanoseconds, got {t!r}")
        else:
            checks.finite_number("t", t)
        self._append(self._beyond("t", t))

    def _beyond(self, name: str, t: float | int) -> Tensor | None:
        """Control points it takes to reach a time, None if there are enough."""
        end = self._end(self._count)
        if t <= end:
            return None
        count = -int((end - t) // self._dt)
        while count <= _MOST_AT_ONCE and self._end(self._count + count) < t:  # rounding, at times of an epoch
            count += 1
        if count > _MOST_AT_ONCE:
            raise ValueError(
                f"{name}: {t!r} lies {count} control points after the end {end!r}, expected at most {_MOST_AT_ONCE} "
                "at once; check its unit and its clock"
            )
        last = self._points[self._count - 2 : self._count].numpy()
        step = self._local.at(last).logs[:1]
        ahead = np.arange(1, count + 1, dtype=np.float64)[:, None] * step
        return torch.from_numpy(self._local.retract(np.tile(last[1], (count, 1)), ahead))

    def _end(self, count: int) -> float | int:
        """Of the domain of `active` with so many control points in all, by the arithmetic of `BSpline.domain`."""
        return self._knot(self._first) + (count - self._first - self.order + 1) * self._dt

    def _append(self, more: Tensor | None) -> None:
        if more is None:
            return
        needed = self._count + len(more)
        if needed > len(self._points):  # twice as much: appending costs the same however many there are
            room = torch.zeros(2 * needed, self._points.shape[1], dtype=torch.float64)
            room[: self._count] = self._points[: self._count]
            self._points = room
        self._points[self._count : needed] = more
        self._count = needed

    # ------------------------------------------------------------------ estimating

    def update(
        self,
        *,
        max_iterations: int = 5,
        cost_tolerance: float = 1e-6,
        gradient_tolerance: float = 1e-6,
        damping: float = 1e-5,
    ) -> Result:
        """Fit what is in the window to all that was measured, then let go of what is older.

        Args:
            max_iterations, cost_tolerance, gradient_tolerance, damping: as for `Problem.solve`.
        Returns:
            Result, of the control points that were in the window: times of its `trajectory_covariance` lie there.
        Raises:
            ValueError: nothing was measured yet, a wrong option, a cost that is not finite.
        """
        options = Options.checked(max_iterations, cost_tolerance, gradient_tolerance, damping)
        if not self._streams and not self._priors:
            raise ValueError("update: nothing was measured yet; add residuals with add(...)")
        self._follow_clocks()
        spline = self.active
        with torch.no_grad():
            problem = Problem(spline)
            for stream in self._streams:
                problem.add(stream.residual, **stream.which)
            for prior in self._priors_on(spline):
                include_unknowns(problem, [part.unknown for part in prior.parts])
                problem.priors.append(prior)
            linearizer = problem.prepare()
            linearizer.terms.append(Bends(linearizer.model, self._stiffness))
            model = linearizer.model
            state, system, trace = minimise(model, model.state(), linearizer, options, lambda _: None)
            model.store(state)
            self._points[self._first : self._count] = spline.control_points
            result = Result(linearizer, state, system, trace)
            excess = self._count - self._first - self.order + 1 - self._segments
            if excess > 0:
                self._let_go(excess)
        return result

    def _follow_clocks(self) -> None:
        """Append control points for measurements that their clocks moved beyond the end."""
        origin = self._knot(self._first)
        for residual in self._residuals():
            if residual.clock.unknowns and len(residual):
                last = float(trajectory_times(residual, origin).max())
                self._append(self._beyond("clock", self._unit(origin, last)))

    def _priors_on(self, spline: BSpline) -> list[Prior]:
        """With a copy of the window's first control points as their unknowns."""
        return [
            Prior(
                [p._replace(unknown=spline) if p.unknown is self._anchor else p for p in prior.parts],
                prior.information,
                prior.slope,
                prior.constant,
            )
            for prior in self._priors
        ]

    def _let_go(self, excess: int) -> None:
        """Control points stop moving; what was measured of them becomes a Gaussian on those that they met."""
        kept, gone = self._divide(excess)
        # Only control points that what goes has to do with take part: cost does not depend on the window, either.
        reach = max([excess + self.order, *(last for _, last in gone)])
        for prior in self._priors:
            reach = max([reach, *(int(p.points.max()) + 1 for p in prior.parts if p.unknown is self._anchor)])
        part = self._spline(self._first, min(self._first + reach, self._count))
        priors = self._priors_on(part)
        variables = {id(v): v for stream, _ in gone for v in variables_of(stream.residual)}
        variables.update(
            {id(p.unknown): p.unknown for q in priors for p in q.parts if isinstance(p.unknown, Variable)}
        )
        origin = part.domain[0]
        model = Model([Spline(part, origin)], list(variables.values()), {})
        terms = [
            Term(s.residual, model, origin, {slot: i.numpy() for slot, i in s.which.items()}) for s, _ in gone
        ]
        bends = Bends(model, self._stiffness, last=excess)
        H, g = normal_equations(
            model, [*terms, bends, *(prior.bind(model) for prior in priors)], model.state()
        )
        now, keep = np.arange(len(g)), []
        parts: list[Part] = []
        columns = model.columns[id(part)]
        # Control points beyond what anything that goes has touched are none of the prior's business.
        touched = [j for j in range(excess, len(columns)) if np.any(H[columns[j]])]
        self._first += excess
        self._anchor = self.active
        if touched:
            points = np.array(touched)
            parts.append(Part(self._anchor, points - excess, part.control_points.detach()[points].clone()))
            keep.append(columns[points].reshape(-1))
        for variable in variables.values():
            own = model.columns[id(variable)]
            parts.append(Part(variable, np.arange(len(own)), _rows(variable)))
            if variable in self._walks:
                variance = np.square(self._walks[variable]).reshape(-1) * (excess * self._spacing)
                H, g, now[own.reshape(-1)] = random_walk(H, g, own.reshape(-1), variance)
            keep.append(own.reshape(-1))
        order = np.concatenate(keep).astype(np.int64) if keep else np.zeros(0, np.int64)
        self._priors = [Prior(parts, *marginalised(H, g, now[order]))] if keep else []
        self._streams = kept

    def _divide(self, excess: int) -> tuple[list[Stream], list[tuple[Stream, int]]]:
        """Measurements that stay, and those of control points that go, with the end of the control points they meet."""
        origin, start = self._knot(self._first), self._knot(self._first + excess)
        model = Spline(self.active, origin)
        kept, gone = [], []
        for stream in self._streams:
            residual = stream.residual
            base, *_ = model.place(trajectory_times(residual, origin))
            old = torch.from_numpy((base < excess).any(axis=0))
            if not residual.clock.unknowns:  # as the window will see it, whatever the rounding of either
                old |= (residual.t < start).reshape(base.shape).any(dim=0)
            if bool(old.any()):
                gone.append((stream.select(old), int(base[:, old.numpy()].max()) + self.order))
            if not bool(old.all()):
                kept.append(stream.select(~old))
        return kept, gone


def _rows(variable: Variable) -> Tensor:
    return variable.points(variable.value).reshape(-1, variable.size).clone()


def _per_component(name: str, x: Tensor | float, size: int) -> Array:
    """Standard deviations `(size,)`, from a number or one for each component."""
    if not isinstance(x, Tensor):
        return np.full(size, checks.positive(name, x))
    checks.is_floating_tensor(name, x)
    if x.shape not in ((), (size,)):
        raise ValueError(f"{name}: expected a number or shape ({size},), got {tuple(x.shape)}")
    checks.finite(name, x)
    if not bool((x.detach() > 0).all()):
        raise ValueError(f"{name}: expected numbers above zero, got {x.tolist()}")
    return x.detach().cpu().to(torch.float64).expand(size).numpy()
