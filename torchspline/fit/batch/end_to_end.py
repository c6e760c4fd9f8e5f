"""Normal equations of a batch of trajectories, laid end to end in time, and from numbers of the unknowns to them.

Splines are one band of independent blocks; the variables of each trajectory are its own border, so that the borders of
all fit into as many columns as one has.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline.fit.residual import Residual
from torchspline.fit.solving.model import Model, Spline, State, Unknown, spacing_of
from torchspline.fit.solving.priors import Prior, steps_of
from torchspline.fit.solving.system import Rows
from torchspline.fit.solving.terms import Term
from torchspline.fit.variables import Variable
from torchspline.kernels.assemble import add_to_band
from torchspline.splines.bspline import BSpline

Array = NDArray[Any]
#: What a system has of each trajectory.
_BLOCKS = ("band", "border", "corner", "cost", "inner", "outer")


class Part(NamedTuple):
    """Of a batch: a residual, and of which trajectory each of its measurements is, (N,)."""

    residual: Residual
    which: Array


class EndToEnd(Spline):
    """The splines of a batch as one: that of trajectory b begins with control point b M.

    Args:
        stride: how far their control points are apart in time, so that those of each trajectory stay together, s.
    """

    def __init__(self, splines: BSpline, origin: float | int, stride: float):
        super().__init__(splines, origin)
        self.points, self.batch, self.stride = self.count, splines.control_points.shape[0], stride
        self.count *= self.batch  # `local` keeps the number of one: no logarithms from one to the next

    def place(self, tau: Array, which: Array | None = None) -> tuple[Array, Array, Array]:
        """As for one, in the spline of trajectory `which`."""
        assert which is not None
        base, u, outside = super().place(tau)
        return base + which * self.points, u, outside

    def times(self) -> Array:
        """The middle of what each control point influences."""
        points = np.arange(self.count) % self.points
        own = self.start + (points - 0.5 * (self.order - 2)) * self.spacing
        return own + self.stride * (np.arange(self.count) // self.points)


class BatchSystem:
    """Normal equations of B independent problems with n columns of splines and m of variables each.

    Args:
        columns: (B, m) of the model, those of the variables. held: (B, n + m), which unknowns stay as they are.
        width: as for `BandSystem`.
    """

    def __init__(self, model: Model, columns: Array, held: Array, width: int):
        from scipy.linalg import lapack  # as long to import as the rest of the library

        self._lapack = lapack
        self.model, self.B, self.m = model, *columns.shape
        self.n, self.held = model.band // self.B, held
        self.band, self.border = np.zeros((model.band, width)), np.zeros((model.band, self.m))
        self.corner, self.cost = np.zeros((self.B, self.m, self.m)), np.zeros(self.B)
        self.inner, self.outer = np.zeros(model.band), np.zeros((self.B, self.m))
        #: From columns of the model to those of one trajectory's border.
        self.own = np.zeros(model.total - model.band, np.int64)
        self.own[columns.reshape(-1) - model.band] = np.tile(np.arange(self.m), self.B)

    def add(self, rows: Rows, chain: Array, which: Array) -> None:
        """The rows of a chunk, of measurements of trajectories `which` (N,), ascending."""
        n, columns = self.model.band, rows.columns
        variables = np.flatnonzero((columns >= n).any(axis=0))
        stays = columns[:, variables] < 0
        own = np.where(stays, -1, self.own[np.where(stays, 0, columns[:, variables] - n)])
        shared = columns.copy()
        shared[:, variables] = np.where(own < 0, -1, n + own)
        # Sums over all trajectories, of which the part of the splines and the border keep them apart.
        right, corner = np.zeros(n + self.m), np.zeros((self.m, self.m))
        outside = add_to_band(
            self.model.trajectory.local.fused, *rows._replace(columns=shared).arguments(chain),
            self.band, self.border, corner, right,
        )  # fmt: skip
        assert not outside
        self.inner += right[:n]
        if len(variables):
            each = np.repeat(stays, np.diff(rows.starts), axis=0)
            J = np.where(each[:, None], 0.0, rows.rows[..., variables])
            products = np.einsum("nra,nrb->nab", J, np.concatenate([J, rows.rows[..., -1:]], axis=-1))
            sums = np.zeros((self.B, *products.shape[1:]))
            begin = np.flatnonzero(np.diff(which, prepend=-1))
            sums[which[begin]] = np.add.reduceat(products, begin)
            # One variable may stand in several columns.
            place = np.equal.outer(own.max(axis=0), np.arange(self.m)).astype(np.float64)
            self.corner += place.T @ sums[..., :-1] @ place
            self.outer += sums[..., -1] @ place

    def isolate(self) -> None:
        """Empty the equations of trajectories whose numbers overflowed: they would spread through the band's factor."""
        blocks = [getattr(self, name).reshape(self.B, -1) for name in _BLOCKS]
        bad = ~np.logical_and.reduce([np.isfinite(block).all(axis=1) for block in blocks])
        for block in blocks:
            block[bad] = 0.0
        self.cost[bad] = math.inf

    @property
    def right(self) -> Array:
        """`J^T r` (B, n + m)."""
        return np.concatenate([self.inner.reshape(self.B, -1), self.outer], axis=1)

    @property
    def diagonal(self) -> Array:
        """Of `J^T J` (B, n + m)."""
        corner = np.diagonal(self.corner, axis1=1, axis2=2)
        return np.concatenate([self.band[:, 0].reshape(self.B, -1), corner], axis=1)

    @property
    def slope(self) -> Array:
        """Squared gradient, every unknown in its own standard deviations, (B,)."""
        diagonal = self.diagonal
        squares = np.square(self.right)
        return np.divide(squares, diagonal, out=np.zeros_like(squares), where=diagonal > 0).sum(axis=1)

    def replace(self, other: "BatchSystem", where: Array) -> None:
        """Take the equations of some trajectories (B,) bool from another system."""
        for name in _BLOCKS:
            mine, its = (getattr(x, name) for x in (self, other))
            if mine.shape != its.shape:  # the bands are as wide as clocks made them
                width = max(mine.shape[1], its.shape[1])
                mine, its = (np.pad(x, ((0, 0), (0, width - x.shape[1]))) for x in (mine, its))
                setattr(self, name, mine)
            mine.reshape(self.B, -1)[where] = its.reshape(self.B, -1)[where]

    def factor(self, damping: Array) -> tuple[Array, Array, Array, Array]:
        """Of the damped equations: band factor, `A^-1 B`, Schur complements' Cholesky factors, and which failed."""
        B, n = self.B, self.n
        damping = damping + self.held  # whatever stays is decoupled: any pivot will do
        damped = self.band.copy()
        damped[:, 0] += damping[:, :n].reshape(-1)
        failed = np.zeros(B, bool)
        while True:
            chol, info = self._lapack.dpbtrf(damped.T, lower=1)
            if not info:
                break
            bad = (info - 1) // n  # that one is left out, the others go on
            failed[bad] = True
            damped[bad * n : (bad + 1) * n] = np.eye(1, damped.shape[1])
        follow = self._lapack.dpbtrs(chol, self.border, lower=1)[0] if self.m else self.border
        border, apart = self.border.reshape(B, n, self.m), follow.reshape(B, n, self.m)
        complement = self.corner - border.transpose(0, 2, 1) @ apart
        complement[:, np.arange(self.m), np.arange(self.m)] += damping[:, n:]
        factor, info = torch.linalg.cholesky_ex(torch.from_numpy(complement))
        return chol, apart, factor.numpy(), failed | (info.numpy() != 0)

    def step(self, damping: Array) -> tuple[Array, Array]:
        """Steps (B, n + m), and for which trajectories there is none."""
        B, n = self.B, self.n
        chol, apart, corner, failed = self.factor(damping)
        inner = self._lapack.dpbtrs(chol, self.inner, lower=1)[0].reshape(B, n)
        if self.m:
            left = self.outer - np.einsum("bnm,bn->bm", self.border.reshape(B, n, self.m), inner)
            solved = torch.cholesky_solve(torch.from_numpy(left)[..., None], torch.from_numpy(corner))
            outer = solved[..., 0].numpy()
            inner = inner - np.einsum("bnm,bm->bn", apart, outer)
            inner = np.concatenate([inner, outer], axis=1)
        failed |= ~np.isfinite(inner).all(axis=1)
        return np.where(failed[:, None], 0.0, -inner), failed


class BatchLinearizer:
    """From numbers of the unknowns to the normal equations of all trajectories.

    Args:
        splines: the trajectories first. frozen: by the `id` of an unknown, which of its control points `(B, M)` or rows
            `(B,)` stay.
    """

    def __init__(
        self,
        splines: Sequence[BSpline],
        variables: Sequence[Variable],
        parts: Sequence[Part],
        priors: Sequence[Prior],
        frozen: dict[int, Array],
    ):
        origin = splines[0].domain[0]
        singles = [Spline(x, origin) for x in splines]
        times = np.concatenate([x.times()[[0, -1]] for x in singles])
        stride = 2.0 * float(np.ptp(times)) + max(map(spacing_of, splines))
        laid = [EndToEnd(x, origin, stride) for x in splines]
        self.splines, self.variables, self.priors = laid, list(variables), list(priors)
        self.B = laid[0].batch
        self.model = Model(list(laid), self.variables, {})
        self._n = self.model.band // self.B
        each = [self.model.columns[id(v)] for v in self.variables]
        #: Of the border of each trajectory, (B, m), and of all its unknowns which stay as they are.
        self._columns = np.concatenate([np.zeros((self.B, 0), np.int64), *each], axis=1)
        ends = np.cumsum([v.dimension for v in self.variables])
        #: Of each variable within the border.
        self._border = {
            id(v): np.arange(end - v.dimension, end) for v, end in zip(self.variables, ends, strict=True)
        }
        self.held = self._hold(frozen)
        self._terms = [
            Term(residual, self.model, origin, self._index(residual, which), which)
            for residual, which in parts
        ]

    def _index(self, residual: Residual, which: Array) -> dict[str, Array]:
        return {slot: which for slot, x in residual.arguments.items() if isinstance(x, Variable)}

    def _hold(self, frozen: dict[int, Array]) -> Array:
        """Take the columns of what stays from the model; which they are, (B, n + m).

        They remain where they are, so that all trajectories have as many.
        """
        held = np.zeros(self.model.total, bool)
        for key, stays in frozen.items():
            columns = self.model.columns[key]
            held[columns[stays.reshape(-1)]] = True
            columns[stays.reshape(-1)] = -1
        border = held[self._columns]
        return np.concatenate([held[: self.model.band].reshape(self.B, -1), border], axis=1)

    def state(self) -> State:
        """The numbers as they stand in the modules."""
        points = {}
        for spline in self.splines:
            own = spline.module.group.normalize(spline.module.control_points.detach().to(torch.float64))
            points[id(spline.module)] = np.ascontiguousarray(own.reshape(-1, own.shape[-1]).numpy())
        values = {id(v): v.points(v.value) for v in self.variables}
        return self.model.prepared(points, values)

    def moved(self, state: State, step: Array) -> State:
        """All unknowns moved by steps (B, n + m)."""
        full = np.empty(self.model.total)
        full[: self.model.band] = step[:, : self._n].reshape(-1)
        full[self._columns] = step[:, self._n :]
        return self.model.moved(state, full)

    def mixed(self, state: State, candidate: State, where: Array) -> State:
        """The candidate for some trajectories (B,) bool, the state for the others; without what follows from points."""
        points = {
            key: np.where(np.repeat(where, len(x) // self.B)[:, None], candidate.points[key], x)
            for key, x in state.points.items()
        }
        chosen = torch.from_numpy(where)[:, None]
        values = {k: torch.where(chosen, candidate.values[k], x) for k, x in state.values.items()}
        return State(points, values)

    def store(self, state: State) -> None:
        """Write the numbers of what may move back; the rest keeps its own, quaternions of any length included."""
        unknowns: list[tuple[Unknown, Tensor, Tensor]] = [
            (s.module, s.module.control_points, torch.from_numpy(state.points[id(s.module)]))
            for s in self.splines
        ]
        unknowns += [(v, v.value, state.values[id(v)]) for v in self.variables]
        for unknown, target, found in unknowns:
            moves = torch.from_numpy(self.model.columns_of(unknown)[:, 0] >= 0).reshape(target.shape[:-1])
            own = torch.where(moves[..., None], found.reshape(target.shape).to(target), target)
            if isinstance(unknown, Variable):
                unknown.value = own
            else:
                target.copy_(own)

    def __call__(self, state: State) -> BatchSystem:
        assert state.chain is not None
        widths = [1]
        for term in self._terms:
            columns = term.touched(state)
            inner = (columns >= 0) & (columns < self.model.band)
            low = np.where(inner, columns, self.model.total).min(axis=1, initial=self.model.total)
            high = np.where(inner, columns, -1).max(axis=1, initial=-1)
            widths.append(int((high - low).max(initial=0)) + 1)
        system = BatchSystem(self.model, self._columns, self.held, min(max(widths), max(self._n, 1)))
        for term in self._terms:
            assert term.which is not None
            for part, costs, rows, _ in term.chunks(state):
                system.add(rows, state.chain, term.which[part])
                system.cost += np.bincount(term.which[part], costs, minlength=self.B)
        for prior in self.priors:
            self._add_prior(prior, system, state)
        system.isolate()
        return system

    def _add_prior(self, prior: Prior, system: BatchSystem, state: State) -> None:
        (part,) = prior.parts
        x, J = steps_of(part, state)
        D = x.shape[1]
        H = prior.information[:D, :D]  # the same for each row
        system.cost += 0.5 * np.einsum("bi,ij,bj->b", x, H, x)
        assert isinstance(part.unknown, Variable)
        J = np.where((self.model.columns_of(part.unknown) < 0)[:, :1, None], 0.0, J)  # those that stay
        own = self._border[id(part.unknown)]
        system.corner[:, own[:, None], own] += J.transpose(0, 2, 1) @ H @ J
        system.outer[:, own] += np.einsum("bji,jk,bk->bi", J, H, x)

    def covariances(self, system: BatchSystem) -> dict[int, Tensor]:
        """Of the rows of each variable, by its `id`; NaN where the data leave it open, 0 of what stays."""
        if not system.m:
            return {}
        *_, corner, failed = system.factor(np.zeros((system.B, system.n + system.m)))
        corner[failed] = np.eye(system.m)  # a failed factor may have zeros on its diagonal
        inverse = torch.cholesky_inverse(torch.from_numpy(corner))
        inverse[torch.from_numpy(failed)] = math.nan
        held, found = torch.from_numpy(self.held[:, system.n :]), {}
        for variable in self.variables:
            own = self._border[id(variable)]
            stays = held[:, own]
            block = inverse[:, own[:, None], own]
            found[id(variable)] = torch.where(stays[:, :, None] | stays[:, None, :], 0.0, block)
        return found
