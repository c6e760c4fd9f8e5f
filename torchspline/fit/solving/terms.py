"""One residual inside a problem: its measurements in order of time, and its part of the normal equations."""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from torchspline.fit.residual import Residual, square_root_information
from torchspline.fit.solving.kernel import ResidualKernel, kernel_of
from torchspline.fit.solving.model import Model, Spline, State, seconds
from torchspline.fit.solving.system import Rows, System
from torchspline.fit.variables import Variable
from torchspline.splines.bspline import BSpline, bspline
from torchspline.splines.trajectory import State as SplineState
from torchspline.units import seconds_since

Array = NDArray[Any]
#: Measurements linearised at a time: their rows stay in the cache and memory stays bounded.
CHUNK = 8192


class Places(NamedTuple):
    """Where measurements lie on the splines, and the runs of those that touch the same unknowns."""

    #: For each moment.
    base: list[Array]
    u: list[Array]
    #: For each argument that is a spline.
    own_base: dict[str, Array]
    own_u: dict[str, Array]
    outside: Array
    starts: Array
    #: (runs, moments), or (runs, 0) for a trajectory that stays, and (runs, columns of the rows).
    bases: Array
    columns: Array
    #: Trajectory times (moments, N) and how they move with each unknown of the clock.
    rates: list[tuple[Variable, Array]]


class Kernel(Protocol):
    """What a term has to know of the kind of its residual."""

    #: Slots in which the residual was given arguments, and numbers of a residual.
    order: list[str]
    rows: int
    #: For each moment which parts of its state (value, velocity, ...) the residual depends on.
    parts: list[tuple[bool, ...]]


class Differential(NamedTuple):
    """Residuals (N, R) of a chunk and how they move."""

    residual: Array
    #: The weighted residual, the weights that its Jacobian takes, too, and the cost of each measurement.
    error: Array
    weight: Array | None
    costs: Array
    #: Cotangents (N, R, C) of the states at each moment and of the arguments, not weighted.
    moments: list[Array]
    slots: list[Array]


class Term:
    """A residual bound to the unknowns of a problem.

    Args:
        which: for trajectories laid end to end, of which one each measurement is, (N,).
    """

    def __init__(
        self,
        residual: Residual,
        model: Model,
        origin: float | int,
        index: dict[str, Array],
        which: Array | None = None,
    ):
        self.residual, self.model, self.origin = residual, model, origin
        kind = type(residual)
        tau = seconds_since(residual.t.detach().cpu().reshape(kind.moments, -1), origin).numpy()
        self.order = np.argsort(tau[0], kind="stable") if which is None else np.lexsort((tau[0], which))
        self.which = None if which is None else which[self.order]
        self.tau = np.ascontiguousarray(tau[:, self.order])
        mid, length = residual.clock.mid, model.trajectory.segments * model.trajectory.spacing
        self.mid = 0.5 * length if mid is None else seconds(mid, origin)
        self.measured = residual.measured.detach().cpu().to(torch.float64).numpy()[self.order]
        self.index = {slot: x[self.order] for slot, x in index.items()}
        #: Known arguments of which each measurement has its own.
        self.each = {
            slot for slot, x in residual.arguments.items() if isinstance(x, torch.Tensor) and x.ndim == 2
        }
        given = tuple(
            (slot, isinstance(x, BSpline) or slot in index or slot in self.each)
            for slot, x in residual.arguments.items()
        )
        self.kernel = self._kernel(given)
        self.weights = self._weights()
        self.clock = [v for v in residual.clock.unknowns if id(v) in model.columns]
        self.splines = {
            slot: next(s for s in model.splines if s.module is x)
            for slot, x in residual.arguments.items()
            if isinstance(x, BSpline)
        }
        self.movable = [
            slot
            for slot in self.kernel.order
            if isinstance(x := residual.arguments[slot], Variable) and id(x) in model.columns
        ]
        #: Whether the whole trajectory stays.
        self.held = not bool((model.columns[id(model.trajectory.module)] >= 0).any())
        self._places: Places | None = None

    def __len__(self) -> int:
        return len(self.order)

    def _kernel(self, given: tuple[tuple[str, bool], ...]) -> Kernel:
        return kernel_of(type(self.residual), self.model.trajectory.name, given)

    @property
    def numbers(self) -> int:
        """How many numbers were measured."""
        return len(self) * self.kernel.rows

    def _weights(self) -> Array | None:
        """Square roots of the information: None, (N or 1, R or 1), or (N or 1, R, R)."""
        root = square_root_information(self.residual.weighting)
        if root is None:
            return None
        weights = root.detach().cpu().numpy()
        rows = self.kernel.rows
        if weights.ndim < 2 or (weights.shape == (rows, rows) and self.residual.weighting[0] != "sigma"):
            return weights.reshape(1, *(weights.shape or (1,)))
        return weights[self.order]

    # ------------------------------------------------------------------ where

    def places(self, state: State) -> Places:
        """Computed once where the clock is known."""
        if self._places is not None:
            return self._places
        tau, rates = self._times(state)
        trajectory = self.model.trajectory
        base, u, outside = map(list, zip(*(trajectory.place(t, self.which) for t in tau), strict=True))
        own_base, own_u, keys = {}, {}, [*base]
        for slot, spline in self.splines.items():
            own_base[slot], own_u[slot], _ = spline.place(self.tau[0], self.which)
            keys.append(own_base[slot])
        keys += self.index.values()
        starts = _runs(keys, len(self))
        first = starts[:-1]
        # A trajectory that stays as it is has no part in the equations.
        moving = [] if self.held else base
        columns = [np.empty((len(first), 0), np.int64)]
        columns += [
            self.model.columns[id(trajectory.module)][b[first, None] + np.arange(trajectory.order)]
            for b in moving
        ]
        for slot, spline in self.splines.items():
            windows = own_base[slot][first, None] + np.arange(spline.order)
            columns.append(self.model.columns[id(spline.module)][windows])
        for slot in self.movable:
            own = self.model.columns[id(self.residual.arguments[slot])]
            rows = self.index[slot][first] if slot in self.index else np.zeros(len(first), np.int64)
            columns.append(own[rows])
        whose = np.zeros(len(first), np.int64) if self.which is None else self.which[first]
        columns += [self.model.columns[id(v)][whose] for v in self.clock]
        blocks = [c.reshape(len(first), math.prod(c.shape[1:])) for c in columns]
        bases = (
            np.stack([b[first] for b in moving], axis=1) if moving else np.empty((len(first), 0), np.int64)
        )
        places = Places(
            base, u, own_base, own_u, np.logical_or.reduce(outside), starts,
            np.ascontiguousarray(bases),
            np.ascontiguousarray(np.concatenate(blocks, axis=1)),
            rates,
        )  # fmt: skip
        if not self.clock:
            self._places = places
        return places

    def _times(self, state: State) -> tuple[Array, list[tuple[Variable, Array]]]:
        """Times of the trajectory, and how they move with the unknowns of the clock."""
        clock = self.residual.clock
        whose = 0 if self.which is None else torch.from_numpy(self.which)
        numbers = {id(v): state.values[id(v)].reshape(-1)[whose] for v in clock.unknowns}
        tau = self.clocked(
            torch.from_numpy(self.tau), numbers, lambda late: late[torch.from_numpy(self.order)]
        ).numpy()
        rate = 1.0 if clock.skew is None else 1.0 + numbers[id(clock.skew)].numpy()
        rates: list[tuple[Variable, Array]] = []
        for part in ("offset", "skew", "delay"):  # by their names: one variable may be several of them
            v = getattr(clock, part)
            if v is None or id(v) not in self.model.columns:
                continue
            if part == "offset":
                rates.append((v, np.broadcast_to(-1.0 / rate, tau.shape)))
            elif part == "skew":
                rates.append((v, -(tau - self.mid) / rate))
            else:
                assert clock.late is not None
                late = clock.late.detach().cpu().to(torch.float64).numpy()[self.order]
                rates.append((v, np.broadcast_to(-late / rate, tau.shape)))
        return tau, rates

    def clocked(
        self,
        sensor: torch.Tensor,
        numbers: dict[int, torch.Tensor],
        of: Callable[[torch.Tensor], torch.Tensor],
    ) -> torch.Tensor:
        """Times of the trajectory from those of the sensor, seconds; `of` puts `late` in their order."""
        clock = self.residual.clock
        shift = sensor - self.mid
        if clock.offset is not None:
            shift = shift - numbers[id(clock.offset)]
        if clock.delay is not None:
            assert clock.late is not None
            shift = shift - numbers[id(clock.delay)] * of(clock.late).to(torch.float64)
        if clock.skew is not None:
            shift = shift / (1.0 + numbers[id(clock.skew)])
        return self.mid + shift

    # ------------------------------------------------------------------ what

    def touched(self, state: State) -> Array:
        """Columns of the unknowns of each run."""
        return self.places(state).columns

    def add_to(self, system: System, state: State) -> None:
        """Add cost and normal equations."""
        system.add_all(self.linearize(state), state)

    def linearize(self, state: State) -> Iterator[tuple[float, Rows, Array]]:
        """Cost, rows of the Jacobian, and residuals (unweighted, in order of time), chunk by chunk."""
        for _, costs, rows, residual in self.chunks(state):
            yield float(costs.sum()), rows, residual

    def chunks(self, state: State) -> Iterator[tuple[slice, Array, Rows, Array]]:
        """The same with the cost of each measurement, and which they are in order of time."""
        places, span = self.places(state), self.model.trajectory.order
        for begin, stop, first, last in _chunks(places.starts, CHUNK):
            costs, rows, residual = self._chunk(state, places, slice(begin, stop))
            starts = places.starts[first : last + 1] - begin
            part = Rows(rows, starts, places.bases[first:last], places.columns[first:last], span)
            yield slice(begin, stop), costs, part, residual

    def _chunk(self, state: State, places: Places, part: slice) -> tuple[Array, Array, Array]:
        kernel, spline, local = self.kernel, self.model.trajectory, state.local
        assert local is not None
        derivatives = type(self.residual).derivatives + (1 if self.clock else 0)
        base, u = [b[part] for b in places.base], [x[part] for x in places.u]
        states = [spline.local.evaluate(local, b, x, derivatives) for b, x in zip(base, u, strict=True)]
        found = self._differentiate(state, places, part, states)
        residual, error, weight, costs = found.residual, found.error, found.weight, found.costs
        moments, slots = found.moments, found.slots
        times = [
            sum(np.einsum("nrc,nc->nr", g, _pick(s[1:], parts)) * rate[m, part][:, None]
                for m, (g, s, parts) in enumerate(zip(moments, states, kernel.parts, strict=True)))
            for _, rate in places.rates
        ]  # fmt: skip
        width = places.columns.shape[1] + 1
        N, R = residual.shape
        rows = np.empty((N, R, width))
        rows[..., -1] = error
        at = 0
        for g, b, x, parts in zip(moments, base, u, kernel.parts, strict=True):
            if self.held:
                break
            spline.local.rows(local, b, x, _apply(weight, g), parts, rows, at)
            at += spline.local.width
        for slot, own in self.splines.items():
            g = _apply(weight, slots[kernel.order.index(slot)])
            block = own.blending(places.own_u[slot][part])[:, None, :, None] * g[:, :, None, :]
            rows[..., at : at + own.order * own.size] = block.reshape(N, R, -1)
            at += own.order * own.size
        for slot in self.movable:
            variable = self.residual.arguments[slot]
            assert isinstance(variable, Variable)
            g = _apply(weight, slots[kernel.order.index(slot)])
            basis = variable.basis(state.values[id(variable)])
            if basis is not None:
                each = basis.numpy()[self.index[slot][part]] if slot in self.index else basis.numpy()
                g = g @ each
            rows[..., at : at + variable.dimension] = g
            at += variable.dimension
        for column in times:
            rows[..., at] = _apply(weight, column[..., None])[..., 0]
            at += 1
        return costs, rows, residual

    def _differentiate(
        self, state: State, places: Places, part: slice, states: list[list[Array]]
    ) -> "Differential":
        """Residuals, and how they move with states and arguments."""
        kernel, kept = self.kernel, type(self.residual).derivatives + 1
        assert isinstance(kernel, ResidualKernel)
        arrays = [x for s in states for x in s[:kept]] + [self.measured[part]]
        arrays += [self._argument(slot, state, places, part) for slot in kernel.order]
        residual, *cotangents = kernel.linearize(arrays, self.model.trajectory.local.fused)
        error, weight, costs = self._weigh(residual, part, places.outside[part])
        return Differential(
            residual, error, weight, costs, cotangents[: len(states)], cotangents[len(states) :]
        )

    def residuals(self, state: State) -> Array:
        """Of all measurements, (N, R) in the order in which they were given, not weighted."""
        chunks = [residual for *_, residual in self.linearize(state)]
        rows = np.concatenate([np.empty((0, self.kernel.rows)), *chunks])
        result = np.empty_like(rows)
        result[self.order] = rows
        return result

    def cost_of(self, numbers: Mapping[int, torch.Tensor], given: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """The cost as differentiable operations of the numbers of unknowns and of what the residual was made of."""
        residual, trajectory = self.residual, self.model.trajectory

        def of(x: torch.Tensor) -> torch.Tensor:
            return given.get(id(x), x)

        sensor = seconds_since(of(residual.t), self.origin).reshape(type(residual).moments, -1)
        tau = self.clocked(sensor, {key: x[0] for key, x in numbers.items() if x.ndim == 1}, of)
        vectors: list[torch.Tensor] = []
        for moment in tau:
            state = self._on_spline(trajectory, numbers, moment, type(residual).derivatives)
            vectors += [x for x in state if x is not None]
        vectors.append(of(residual.measured).to(torch.float64))
        for slot in self.kernel.order:
            x = residual.arguments[slot]
            if isinstance(x, BSpline):
                spline = self.splines[slot]
                vectors.append(self._on_spline(spline, numbers, sensor[0] - spline.start, 0).value)
                continue
            own = numbers[id(x)] if isinstance(x, Variable) else of(x).to(torch.float64)
            if slot in self.index:
                back = np.empty_like(self.order)
                back[self.order] = np.arange(len(back))
                own = own[torch.from_numpy(self.index[slot][back])]
            vectors.append(own)
        assert isinstance(self.kernel, ResidualKernel)
        error = self.kernel.on_tensors(*vectors)
        kind, weights = residual.weighting
        root = square_root_information((kind, None if weights is None else of(weights)))
        if root is not None:
            matrix = kind != "sigma"
            error = (root @ error.unsqueeze(-1)).squeeze(-1) if matrix else root * error
        squared = error.square().sum(-1)
        end = trajectory.segments * trajectory.spacing
        inside = ((tau.detach() >= -1e-9 * end) & (tau.detach() <= end * (1 + 1e-9))).all(0)
        rho = squared if residual.loss is None else residual.loss.rho(squared)
        return 0.5 * torch.where(inside, rho, 0.0).sum()

    @staticmethod
    def _on_spline(
        spline: Spline, numbers: Mapping[int, torch.Tensor], t: torch.Tensor, derivatives: int
    ) -> SplineState:
        """State of a spline at seconds from its start."""
        module = spline.module
        return bspline(
            numbers[id(module)], t, group=module.group, order=spline.order, dt=spline.spacing,
            derivatives=derivatives, extrapolate="clamp", validate=False,
        )  # fmt: skip

    def _argument(self, slot: str, state: State, places: Places, part: slice) -> Array:
        """Numbers of an argument: one for all measurements, or one each."""
        x = self.residual.arguments[slot]
        if isinstance(x, BSpline):
            spline = self.splines[slot]
            points = state.points[id(x)][places.own_base[slot][part, None] + np.arange(spline.order)]
            return np.einsum("nk,nkd->nd", spline.blending(places.own_u[slot][part]), points)
        value = (
            state.values[id(x)].numpy()
            if isinstance(x, Variable)
            else x.detach().cpu().to(torch.float64).numpy()
        )
        if slot in self.each:
            return value[self.order[part]]
        return value[self.index[slot][part]] if slot in self.index else value.reshape(-1)

    def _weigh(self, residual: Array, part: slice, outside: Array) -> tuple[Array, Array | None, Array]:
        """Weighted residual, the weights its Jacobian takes as well, and the cost of each measurement."""
        weight = self.weights
        if weight is not None and weight.shape[0] > 1:
            weight = weight[part]
        error = residual if weight is None else _apply(weight, residual[..., None])[..., 0]
        squared = np.einsum("nr,nr->n", error, error)
        loss = self.residual.loss
        if loss is None and not outside.any():
            return error, weight, 0.5 * squared
        s = torch.from_numpy(squared)
        rho, slope = (
            (squared, np.ones_like(squared))
            if loss is None
            else (loss.rho(s).numpy(), loss.weight(s).numpy())
        )
        inside = ~outside
        root = (np.sqrt(slope) * inside)[:, None]
        if weight is None or weight.ndim == 2:
            weight = root if weight is None else weight * root
        else:
            weight = weight * root[..., None]
        return error * root, weight, 0.5 * rho * inside


def _apply(weight: Array | None, g: Array) -> Array:
    """W g for rows g (N, R, C) and W as in `Term._weights`."""
    if weight is None:
        return g
    return weight[..., None] * g if weight.ndim == 2 else weight @ g


def _pick(rates: list[Array], parts: tuple[bool, ...]) -> Array:
    """The rates of the parts of a state that a residual depends on, side by side."""
    return np.concatenate([rate for rate, part in zip(rates, parts, strict=False) if part], axis=1)


def _runs(keys: list[Array], count: int) -> Array:
    """Where a run begins of measurements that agree in all keys, and `count`."""
    change = np.zeros(max(count - 1, 0), bool)
    for key in keys:
        change |= key[1:] != key[:-1]
    inner = np.flatnonzero(change) + 1
    return np.concatenate([np.zeros(min(count, 1), np.int64), inner, [count]]).astype(np.int64)


def _chunks(starts: Array, size: int) -> Iterator[tuple[int, int, int, int]]:
    """Whole runs of about `size` measurements at a time: first and last measurement, first and last run."""
    first, runs = 0, len(starts) - 1
    while first < runs:
        last = int(np.searchsorted(starts, starts[first] + size, side="right")) - 1
        last = min(max(last, first + 1), runs)
        yield int(starts[first]), int(starts[last]), first, last
        first = last
