"""The baseline of [S20]: derivatives by the product rule on matrices, Jacobians by automatic differentiation.

`X = X_0 A_1 ... A_n` is differentiated term by term, O(k) matrix products for the first derivative of each of k factors
and O(k^2) for the second, and every residual forwards in each number of its k control points. The solver around it is
the library's own, so that only derivatives and Jacobians differ.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from torchspline.fit.solving.model import Model, State
from torchspline.fit.solving.system import Rows, System
from torchspline.fit.solving.terms import Term
from torchspline.groups import Group
from torchspline.splines.basis import cumulative_weights


class BaselineTerm:
    """Does what `Term` does, the slow way."""

    def __init__(self, term: Term, kind: str):
        self.term, self.kind = term, kind
        spline = term.model.trajectory
        self.group = Group(spline.name)
        self.residual = _residual_of(self.group, spline.order, kind, spline.spacing)

    def touched(self, state: State) -> np.ndarray:
        return self.term.touched(state)

    def add_to(self, system: System, state: State) -> None:
        model, places = self.term.model, self.term.places(state)
        spline = model.trajectory
        assert state.chain is not None
        points = torch.from_numpy(state.points[id(spline.module)])
        windows = points[torch.from_numpy(places.base[0])[:, None] + torch.arange(spline.order)]
        u, measured = torch.from_numpy(places.u[0]), torch.from_numpy(self.term.measured)
        still = torch.zeros(len(u), spline.order * spline.size, dtype=torch.float64)
        each = torch.vmap(torch.func.jacfwd(self.residual, has_aux=True))
        jacobian, residual = each(still, windows, u, measured)
        rows = torch.cat([jacobian, residual.unsqueeze(-1)], dim=-1).contiguous().numpy()
        system.cost += 0.5 * float(residual.square().sum())
        bases = np.zeros(
            (len(places.starts) - 1, 0), np.int64
        )  # these are control points, not local coordinates
        system.add(Rows(rows, places.starts, bases, places.columns, spline.order), state.chain)


def baseline(model: Model, terms: list[Term], kinds: list[str]) -> list[BaselineTerm]:
    assert len(terms) == len(kinds)
    return [BaselineTerm(term, kind) for term, kind in zip(terms, kinds, strict=True)]


def _residual_of(group: Group, order: int, kind: str, spacing: float) -> Callable[..., tuple[Tensor, Tensor]]:
    """The residual of one measurement from a step of its control points, as result and as auxiliary output."""

    def residual(step: Tensor, window: Tensor, u: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
        tangents = step.reshape(order, -1)
        moved = group.retract(window, tangents, side="right", validate=False)
        X, first, second = product_rule(group, moved, u, order, kind)
        if kind == "value":
            point = group.compose(
                _point(group, moved, u, order), group.inverse(measured, validate=False), validate=False
            )
            error = group.log(point, validate=False)
        else:
            inverse = torch.linalg.inv(X)
            velocity = inverse @ first
            rate = velocity if kind == "vel" else inverse @ second - velocity @ velocity
            error = vee(group, rate) / spacing ** (1 if kind == "vel" else 2) - measured
        return error, error

    return residual


def _steps(group: Group, points: Tensor) -> Tensor:
    return group.log(group.between(points[:-1], points[1:], validate=False), validate=False)


def _point(group: Group, points: Tensor, u: Tensor, order: int) -> Tensor:
    value = group.normalize(points[0], validate=False)
    for weight, d in zip(cumulative_weights(u, order, 0)[0], _steps(group, points), strict=True):
        value = group.compose(value, group.exp(weight * d, validate=False), validate=False)
    return value


def product_rule(
    group: Group, points: Tensor, u: Tensor, order: int, kind: str
) -> tuple[Tensor, Tensor, Tensor]:
    """X and its first two derivatives by u, as matrices."""
    weights = cumulative_weights(u, order, 2)
    factors, d_factors, dd_factors = [], [], []
    for j, d in enumerate(_steps(group, points)):
        hat = _hat(group, d)
        A = group.to_matrix(group.exp(weights[0][j] * d, validate=False), validate=False)
        dA = weights[1][j] * (A @ hat)
        factors.append(A)
        d_factors.append(dA)
        dd_factors.append(weights[1][j] * (dA @ hat) + weights[2][j] * (A @ hat))
    start = group.to_matrix(points[0], validate=False)

    def product(replaced: dict[int, Tensor]) -> Tensor:
        result = start
        for j, A in enumerate(factors):
            result = result @ replaced.get(j, A)
        return result

    count = len(factors)
    X = product({})
    first = sum((product({j: d_factors[j]}) for j in range(count)), torch.zeros_like(X))
    second = torch.zeros_like(X)
    if kind == "acc":
        for i in range(count):
            second = second + product({i: dd_factors[i]})
            for j in range(count):
                if i != j:
                    second = second + product({i: d_factors[i], j: d_factors[j]})
    return X, first, second


def _hat(group: Group, d: Tensor) -> Tensor:
    """The matrix of a tangent."""
    w = d[-3:]
    zero = torch.zeros_like(w[0])
    rows = [
        torch.stack([zero, -w[2], w[1]]),
        torch.stack([w[2], zero, -w[0]]),
        torch.stack([-w[1], w[0], zero]),
    ]
    rotation = torch.stack(rows)
    if group.tangent_size == 3:
        return rotation
    upper = torch.cat([rotation, d[:3].unsqueeze(-1)], dim=-1)
    return torch.cat([upper, torch.zeros_like(upper[:1])], dim=0)


def vee(group: Group, matrix: Tensor) -> Tensor:
    w = torch.stack([matrix[2, 1], matrix[0, 2], matrix[1, 0]])
    return w if group.tangent_size == 3 else torch.cat([matrix[:3, 3], w])
