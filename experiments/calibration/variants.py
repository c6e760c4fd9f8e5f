"""The same calibration by other derivatives: product rule against recurrence, automatic against analytic Jacobians.

Residuals are the library's; what differs is where a state's rates come from and that every Jacobian, corner by corner,
is made by forward differentiation. The solver around them is the library's, so that only derivatives differ.
"""

from collections.abc import Callable
from itertools import pairwise
from time import perf_counter
from typing import Any

import numpy as np
import torch
from simulated.baseline import product_rule, vee
from torch import Tensor

from torchspline import BSpline
from torchspline.arithmetic.recurrence import forward
from torchspline.calibrate.problem import Layout
from torchspline.fit.solving.kernel import ResidualKernel
from torchspline.fit.solving.linearizer import Linearizer
from torchspline.fit.solving.model import State
from torchspline.fit.solving.solver import Options, minimise
from torchspline.fit.solving.system import Rows, System
from torchspline.fit.solving.terms import Term
from torchspline.fit.variables import Variable
from torchspline.groups import SO3, Group
from torchspline.groups.components import join, split
from torchspline.splines.basis import cumulative_weights

#: Measurements differentiated at a time.
CHUNK = 4096
States = Callable[[Tensor, Tensor], list[Tensor]]


def by_recurrence(group: Group, order: int, spacing: float, derivatives: int) -> States:
    """Value and rates of control points (k, P) at u, [S20] Theorems 5.2 and 5.3."""
    algebra = group.arithmetic

    def states(points: Tensor, u: Tensor) -> list[Tensor]:
        vectors = [algebra.normalize(split(p)) for p in points.unbind(0)]
        steps = [algebra.log(algebra.between(a, b)) for a, b in pairwise(vectors)]
        value, trace = forward(
            algebra, vectors[0], steps, cumulative_weights(u, order, derivatives), derivatives
        )
        rates = [join(rate, points[0, :0]) for rate in trace[-1].rates] if derivatives else []
        return [join(value, points[0, :0]), *(x / spacing ** (r + 1) for r, x in enumerate(rates))]

    return states


def by_product_rule(group: Group, order: int, spacing: float, derivatives: int) -> States:
    """The same from derivatives of the product of matrices, term by term: quadratic and cubic in the order."""
    split_pose = group.name == "R3xSO3"
    turning = SO3 if split_pose else group

    def states(points: Tensor, u: Tensor) -> list[Tensor]:
        rotating = points[:, 3:] if split_pose else points
        kind = ("vel", "vel", "acc")[derivatives]
        X, first, second = product_rule(turning, rotating, u, order, kind)
        inverse = torch.linalg.inv(X)
        velocity = inverse @ first
        rates = [vee(turning, velocity)]
        if derivatives == 2:
            rates.append(vee(turning, inverse @ second - velocity @ velocity))
        value = by_recurrence(group, order, spacing, 0)(points, u)[0]
        if split_pose:
            moved = _position(points[:, :3], u, order, derivatives)
            rates = [torch.cat([p, w]) for p, w in zip(moved, rates, strict=False)]
        return [value, *(x / spacing ** (r + 1) for r, x in enumerate(rates[:derivatives]))]

    return states


def _position(points: Tensor, u: Tensor, order: int, derivatives: int) -> list[Tensor]:
    steps = points.diff(dim=0)
    weights = cumulative_weights(u, order, max(derivatives, 1))
    return [torch.stack([w * d for w, d in zip(row, steps, strict=True)]).sum(0) for row in weights[1:]]


class AutomaticTerm(Term):
    """A term whose rows come the slow way."""

    def __init__(self, term: Term, states: Callable[..., States]):
        vars(self).update(vars(term))  # bound already
        spline, kind = term.model.trajectory, type(term.residual)
        self.group = Group(spline.name)
        self.states = states(self.group, spline.order, spline.spacing, kind.derivatives)

    def add_to(self, system: System, state: State) -> None:
        places = self.places(state)
        assert state.chain is not None
        spline = self.model.trajectory
        points = torch.from_numpy(state.points[id(spline.module)])
        windows = torch.from_numpy(places.base[0])[:, None] + torch.arange(spline.order)
        u, measured = torch.from_numpy(places.u[0]), torch.from_numpy(self.measured)
        function, size, each = self._function(state)
        own = [torch.from_numpy(x.detach().numpy()[self.order]) for x in each]
        vectorised = torch.vmap(torch.func.jacfwd(function, has_aux=True))
        rows = []
        for part in torch.arange(len(u)).split(CHUNK):
            still = torch.zeros(len(part), size, dtype=torch.float64)
            J, r = vectorised(still, points[windows[part]], u[part], measured[part], [x[part] for x in own])
            slice_ = slice(int(part[0]), int(part[-1]) + 1)
            error, weight, costs = self._weigh(r.numpy(), slice_, places.outside[slice_])
            system.cost += float(costs.sum())
            weighted = J.numpy() if weight is None else weight[..., None] * J.numpy()
            rows.append(np.concatenate([weighted, error[..., None]], axis=-1))
        bases = np.zeros((len(places.starts) - 1, 0), np.int64)  # these are control points already
        system.add(
            Rows(
                np.ascontiguousarray(np.concatenate(rows)), places.starts, bases, places.columns, spline.order
            ),
            state.chain,
        )

    def _function(self, state: State) -> tuple[Callable[..., tuple[Tensor, Tensor]], int, list[Tensor]]:
        """The residual of one measurement from a step of all it depends on; how long that is; arguments of each."""
        spline, kernel = self.model.trajectory, self.kernel
        assert isinstance(kernel, ResidualKernel)
        arguments = self.residual.arguments
        inner = spline.order * spline.size
        moves: dict[str, tuple[int, Callable[[Tensor], Tensor]]] = {}
        at = inner
        for slot in self.movable:
            variable = arguments[slot]
            assert isinstance(variable, Variable)
            moves[slot] = at, _mover(variable, state.values[id(variable)])
            at += variable.dimension
        clocked, size = bool(self.clock), at + len(self.clock)
        each = [x for slot in kernel.order if slot in self.each and isinstance(x := arguments[slot], Tensor)]

        def residual(
            step: Tensor, window: Tensor, u: Tensor, measured: Tensor, own: list[Tensor]
        ) -> tuple[Tensor, Tensor]:
            moved = self.group.retract(
                window, step[:inner].reshape(spline.order, -1), side="right", validate=False
            )
            # The only unknown of a clock here is its offset.
            place = u - step[-1] / spline.spacing if clocked else u
            vectors, given = [*self.states(moved, place), measured], iter(own)
            for slot in kernel.order:
                x = arguments[slot]
                if slot in self.each:
                    vectors.append(next(given))
                elif slot in moves:
                    start, move = moves[slot]
                    vectors.append(move(step[start:]))
                else:
                    assert not isinstance(x, BSpline)
                    vectors.append(state.values[id(x)] if isinstance(x, Variable) else x)
            error = kernel.on_tensors(*vectors)
            return error, error

        return residual, size, each


def _mover(variable: Variable, value: Tensor) -> Callable[[Tensor], Tensor]:
    """From a step, of which the first numbers are the variable's, to the moved value."""
    basis = variable.basis(value)

    def move(step: Tensor) -> Tensor:
        own = step[: variable.dimension]
        if basis is not None:
            moved = value + basis[0] @ own
            return moved * (value.norm() / moved.norm())
        if variable.group is not None:
            return variable.group.retract(value, own, side="right", validate=False)
        return value + own

    return move


def solve_automatically(layout: Layout, states: Callable[..., States], **options: Any) -> dict[str, Any]:
    """The solution of a problem (of single corners) by automatic Jacobians; it moves the layout's unknowns."""
    begin = perf_counter()
    with torch.no_grad():
        linearizer = layout.problem.prepare()
        terms = [AutomaticTerm(term, states) for term in linearizer.terms if isinstance(term, Term)]
        slow = Linearizer(linearizer.model, terms)
        model = linearizer.model
        state, _, trace = minimise(model, model.state(), slow, Options(**options), lambda trace: None)
        model.store(state)
    return {"seconds": perf_counter() - begin, "evaluations": trace.evaluations, "cost": trace.cost[-1]}
