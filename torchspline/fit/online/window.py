"""A trajectory that grows while it is estimated: what is older than a window is summarised and not touched again."""

import copy
import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline import checks
from torchspline.fit.online.growing import Growing, Wandering, check_wandering
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
from torchspline.units import NANOSECOND, seconds_since

Array = NDArray[Any]


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

    What changes over time, such as a bias, is a variable, or a spline in R^n of which the window moves as much as of
    the trajectory; `random_walk` says how much it changes.

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
        #: Knot spacing in the unit of the times, and in seconds.
        self._dt: float | int = float(dt) if dt is not None else dt_ns or 0
        points = group.normalize(start.detach().to("cpu", torch.float64))
        self._grown = Growing(points, group, order, self._dt, spline.domain[0])
        self._spacing = self._grown.spacing
        self._segments = max(math.ceil(checks.positive("window", window) / self._spacing - 1e-9), 2)
        sigma = _per_component("smoothness", smoothness, group.tangent_size)
        self._stiffness = 1.0 / (self._spacing * sigma)
        self._streams: list[Stream] = []
        self._variables: dict[str, Variable] = {}
        #: What was added beforehand or remembered; parts of the trajectory are of `_anchor`, those of other splines of
        #: their modules.
        self._priors: list[Prior] = []
        self._anchor = self.active
        self._walks: dict[Variable, Array] = {}
        self._wandering: dict[BSpline, Wandering] = {}

    def __repr__(self) -> str:
        start, end = self.active.domain
        return (
            f"SlidingWindow({self.group}, {self._grown.count} control points, {sum(map(len, self._residuals()))} "
            f"measurements in [{start}, {end}])"
        )

    # ------------------------------------------------------------------ what there is

    @property
    def trajectory(self) -> BSpline:
        """All there is so far, a copy. Its cost grows with the length: see `active` for the latest part."""
        return self._grown.part(0, self._grown.count)

    @property
    def active(self) -> BSpline:
        """What still moves, a copy."""
        return self._grown.part(self._first, self._grown.count)

    @property
    def _first(self) -> int:
        """Control point that still moves."""
        return self._grown.first

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

    # ------------------------------------------------------------------ what arrives

    def add(self, residual: Residual, **index: Tensor) -> None:
        """Add measurements; control points are appended to reach the latest of them.

        Args:
            residual: its times are at or after the start of `active`, in any order. Unknown arguments are variables, or
                splines whose `random_walk` was declared: they grow as well.
            index: as for `Problem.add`.
        Raises:
            TypeError, ValueError: it does not fit the trajectory; times before the window.
        """
        checks.instance("residual", residual, Residual, "a residual such as torchspline.fit.Gyroscope")
        for slot, x in residual.arguments.items():
            if isinstance(x, BSpline) and x not in self._wandering:
                raise ValueError(
                    f"{slot}: expected a spline whose random walk is known, which ties its control points together, "
                    "got a BSpline without; call window.random_walk(spline, sigma) before"
                )
        more: Tensor | None = None
        wandering: dict[Wandering, Tensor | None] = dict.fromkeys(self._wandering_of(residual))
        latest = None
        if len(residual) and (residual.t.dtype == torch.int64) == isinstance(self._dt, int):
            origin = self._grown.knot(self._first)
            tau = trajectory_times(residual, origin)
            self._check_late(residual, tau)
            latest = last = residual.t.max().item()
            if residual.clock.unknowns:
                last = self._unit(origin, float(tau.max()))
            more = self._grown.beyond("t", last)
            wandering = {x: x.beyond("t", latest) for x in wandering}
        # A problem of its own tells what is wrong before anything changes.
        probe = Problem(self._grown.part(self._first, self._grown.count, more))
        include_unknowns(probe, list(self._variables.values()))
        parts = {x.module: x.part(x.first, x.count, ahead) for x, ahead in wandering.items()}
        probe.add(_bound(residual, parts), **index)
        self._grown.append(more)
        for own, ahead in wandering.items():
            own.append(ahead)
            if latest is not None:
                # A window earlier, as clocks may turn out otherwise.
                own.begin(self._grown.knot(self._first) - self._segments * self._dt)
                own.reach(latest)
        self._variables.update({v.name: v for v in variables_of(residual)})
        # A copy of the measurements: buffers that packets arrive in may be used again.
        stream = Stream(residual, dict(index)).select(torch.ones(len(residual), dtype=torch.bool))
        for i, other in enumerate(self._streams):
            joined = other.join(stream)
            if joined is not None:
                self._streams[i] = joined
                return
        self._streams.append(stream)

    def _wandering_of(self, residual: Residual) -> list[Wandering]:
        return [self._wandering[x] for x in residual.arguments.values() if isinstance(x, BSpline)]

    def _in_use(self) -> list[Wandering]:
        """Splines that something was measured of."""
        return [x for x in self._wandering.values() if x.used]

    def _check_late(self, residual: Residual, tau: Array) -> None:
        start = self._grown.knot(self._first)
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

    def random_walk(self, variable: Variable | BSpline, sigma: Tensor | float) -> None:
        """Let a variable change over time: what was remembered of it grows old.

        A `Variable` is one value within the window, and steps where control points leave it. A spline in R^n changes
        within the window: it steps from control point to control point. Control points are appended to it as
        measurements come that depend on it, where its last one stands, and are moved in place by every update; those
        that leave the window, or lie before it by more than its length, stay as they are.

        Args:
            variable: or a spline, float64, whose domain begins before the measurements.
            sigma: standard deviation of its change in a second, a number or `(dimension,)`, in its unit per root
                second.
        Raises:
            TypeError, ValueError: a wrong type, shape or value.
        """
        if isinstance(variable, BSpline):
            check_wandering(variable)
            deviations = _per_component("sigma", sigma, variable.group.tangent_size)
            if variable in self._wandering:
                self._wandering[variable].walk(deviations)
            else:
                self._wandering[variable] = Wandering(variable, deviations, self._dt)
            return
        checks.instance("variable", variable, Variable, "a torchspline.fit.Variable or a BSpline")
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
        self._grown.append(self._grown.beyond("t", t))

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
            Result, of the control points that were in the window, of the trajectory as of other splines: times of its
            `trajectory_covariance` lie there.
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
            wandering = self._in_use()
            parts = {x.module: x.active for x in wandering}
            for stream in self._streams:
                problem.add(_bound(stream.residual, parts), **stream.which)
            for prior in self._priors_on({self._anchor: spline, **parts}):
                include_unknowns(problem, [part.unknown for part in prior.parts])
                problem.priors.append(prior)
            linearizer = problem.prepare()
            linearizer.terms.append(Bends(linearizer.model, self._stiffness))
            model = linearizer.model
            linearizer.terms += [x.steps(model, parts[x.module]) for x in wandering]
            state, system, trace = minimise(model, model.state(), linearizer, options, lambda _: None)
            model.store(state)
            self._grown.points[self._first : self._grown.count] = spline.control_points
            for x in wandering:
                x.moved(parts[x.module])
                # The result knows the spline by the caller's module.
                model.columns[id(x.module)] = model.columns[id(parts[x.module])]
            result = Result(linearizer, state, system, trace)
            excess = self._grown.count - self._first - self.order + 1 - self._segments
            if excess > 0:
                self._let_go(excess)
        return result

    def _follow_clocks(self) -> None:
        """Append control points for measurements that their clocks moved beyond the end."""
        origin = self._grown.knot(self._first)
        for residual in self._residuals():
            if residual.clock.unknowns and len(residual):
                last = float(trajectory_times(residual, origin).max())
                self._grown.append(self._grown.beyond("clock", self._unit(origin, last)))

    def _priors_on(self, parts: dict[BSpline, BSpline]) -> list[Prior]:
        """With what stands for the window's splines in a problem as their unknowns."""
        return [
            Prior(
                [
                    p._replace(unknown=parts[p.unknown]) if isinstance(p.unknown, BSpline) else p
                    for p in prior.parts
                ],
                prior.information,
                prior.slope,
                prior.constant,
            )
            for prior in self._priors
        ]

    def _let_go(self, excess: int) -> None:
        """Control points stop moving; what was measured of them becomes a Gaussian on those that they met."""
        kept, gone = self._divide(excess)
        leaving = [_Leaving(self._anchor, self._grown, excess, self._grown.count)]
        leaving += [_Leaving(x.module, x, self._left(x, excess, kept), x.used) for x in self._in_use()]
        parts = {x.key: x.grown.part(x.grown.first, self._reach(x, gone)) for x in leaving}
        priors = self._priors_on(parts)
        variables = {id(v): v for stream in gone for v in variables_of(stream.residual)}
        variables.update(
            {id(p.unknown): p.unknown for q in priors for p in q.parts if isinstance(p.unknown, Variable)}
        )
        origin = self._grown.knot(self._first)
        model = Model([Spline(x, origin) for x in parts.values()], list(variables.values()), {})
        terms = [
            Term(_bound(s.residual, parts), model, origin, {slot: i.numpy() for slot, i in s.which.items()})
            for s in gone
        ]
        bends = Bends(model, self._stiffness, last=excess)
        walks = [
            x.grown.steps(model, parts[x.key], x.leave) for x in leaving if isinstance(x.grown, Wandering)
        ]
        H, g = normal_equations(
            model, [*terms, bends, *walks, *(prior.bind(model) for prior in priors)], model.state()
        )
        now, keep = np.arange(len(g)), []
        remembered: list[Part] = []
        for x in leaving:
            x.grown.first += x.leave
        self._anchor = self.active
        for x in leaving:
            columns, part = model.columns[id(parts[x.key])], parts[x.key].control_points.detach()
            # Control points beyond what anything that goes has touched are none of the prior's business.
            touched = [j for j in range(x.leave, len(columns)) if np.any(H[columns[j]])]
            if touched:
                points = np.array(touched)
                key = self._anchor if x.grown is self._grown else x.key
                remembered.append(Part(key, points - x.leave, part[points].clone()))
                keep.append(columns[points].reshape(-1))
        for variable in variables.values():
            own = model.columns[id(variable)]
            remembered.append(Part(variable, np.arange(len(own)), _rows(variable)))
            if variable in self._walks:
                variance = np.square(self._walks[variable]).reshape(-1) * (excess * self._spacing)
                H, g, now[own.reshape(-1)] = random_walk(H, g, own.reshape(-1), variance)
            keep.append(own.reshape(-1))
        order = np.concatenate(keep).astype(np.int64) if keep else np.zeros(0, np.int64)
        self._priors = [Prior(remembered, *marginalised(H, g, now[order]))] if keep else []
        self._streams = kept

    def _divide(self, excess: int) -> tuple[list[Stream], list[Stream]]:
        """Measurements that stay, and those of control points of the trajectory that go."""
        start = self._grown.knot(self._first + excess)
        kept, gone = [], []
        for stream in self._streams:
            residual = stream.residual
            base = self._places(residual, self._anchor)
            old = torch.from_numpy((base < excess).any(axis=0))
            if not residual.clock.unknowns:  # as the window will see it, whatever the rounding of either
                old |= (residual.t < start).reshape(base.shape).any(dim=0)
            if bool(old.any()):
                gone.append(stream.select(old))
            if not bool(old.all()):
                kept.append(stream.select(~old))
        return kept, gone

    def _left(self, x: Wandering, excess: int, kept: list[Stream]) -> int:
        """How many control points of a spline lie before the window once control points of the trajectory are gone."""
        start = self._grown.knot(self._first + excess)
        left = min(int((start - x.knot(x.first)) // x.dt), x.used - x.first - x.order)
        # Clocks may let measurements that stay see an earlier part.
        places = [self._places(stream.residual, x.module) for stream in kept]
        return max(min([left, *(int(p.min()) for p in places if p.size)]), 0)

    def _reach(self, x: "_Leaving", gone: list[Stream]) -> int:
        """Up to which control point what goes has to do with a spline: cost does not depend on the window."""
        order = x.grown.order
        last = [x.leave + order]
        places = [self._places(stream.residual, x.key) for stream in gone]
        last += [int(p.max()) + order for p in places if p.size]
        last += [int(p.points.max()) + 1 for q in self._priors for p in q.parts if p.unknown is x.key]
        return min(x.grown.first + max(last), x.end)

    def _places(self, residual: Residual, key: BSpline) -> Array:
        """First control points, from the one that still moves, that measurements see of a spline; none if it is not
        among the arguments."""
        origin = self._grown.knot(self._first)
        if key is self._anchor:
            return Spline(self.active, origin).place(trajectory_times(residual, origin))[0]
        if not any(x is key for x in residual.arguments.values()):
            return np.zeros(0, np.int64)
        t = residual.t.detach().cpu().reshape(type(residual).moments, -1)[0]
        return Spline(self._wandering[key].active, origin).place(seconds_since(t, origin).numpy())[0]


class _Leaving(NamedTuple):
    """Of a spline of the window: what stands for it in priors, how many control points leave, and where it ends."""

    key: BSpline
    grown: Growing
    leave: int
    end: int


def _bound(residual: Residual, parts: dict[BSpline, BSpline]) -> Residual:
    """With parts of the splines that it depends on in their place."""
    if not any(isinstance(x, BSpline) for x in residual.arguments.values()):
        return residual
    new = copy.copy(residual)
    new.arguments = {
        slot: parts[x] if isinstance(x, BSpline) else x for slot, x in residual.arguments.items()
    }
    return new


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
