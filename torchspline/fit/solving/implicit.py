"""The solution of a problem as a differentiable function of what went into it.

At the optimum x of a cost C(x, theta) the gradient by x vanishes, and stays zero as theta moves:
`dx/dtheta = -C_xx^-1 C_xtheta`. Backward, a cotangent v of x is first turned into `C_xx^-1 v`, by conjugate gradients
on the exact Hessian with the Gauss-Newton factor of the solution as preconditioner (exact at once where residuals are
zero), and then multiplied by the mixed derivative, which automatic differentiation of the reference gives.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchspline.fit.solving.kernel import ResidualKernel
from torchspline.fit.solving.linearizer import Linearizer
from torchspline.fit.solving.model import Model, State
from torchspline.fit.solving.system import Factor, SingularError, System
from torchspline.fit.variables import Variable
from torchspline.groups.components import join, split

#: Conjugate gradients stop at this relative residual, or after so many steps.
_ACCURACY, _STEPS = 1e-13, 100

Numbers = dict[int, Tensor]


def differentiable(linearizer: Linearizer, state: State, system: System) -> Numbers:
    """Numbers of all unknowns at the solution, by `id`, as functions of the tensors with gradients that residuals hold.

    Raises:
        ValueError: nothing requires grad; the solution is not determined.
    """
    for term in linearizer.measured:
        if not isinstance(term.kernel, ResidualKernel):
            raise ValueError(
                f"differentiable: {term.residual.name} sums up its measurements and has no automatic derivatives; "
                "use the residual of a single measurement, such as ReprojectionRadtan"
            )
    tensors = _inputs(linearizer)
    if not tensors:
        raise ValueError(
            "differentiable: none of the measurements, times, standard deviations or known arguments requires grad"
        )
    model = linearizer.model
    try:
        factor = system.factor(np.zeros(model.total))
    except SingularError:
        raise ValueError(
            "differentiable: the measurements do not determine all unknowns, see result.observability; "
            "add measurements or priors"
        ) from None
    keys = [id(s.module) for s in model.splines] + [id(v) for v in model.variables]
    with torch.enable_grad():
        numbers = _Optimum.apply(linearizer, state, factor, *tensors)
    return dict(zip(keys, numbers, strict=True))


def _inputs(linearizer: Linearizer) -> list[Tensor]:
    """The tensors that require grad among what residuals were made of, each once."""
    found: dict[int, Tensor] = {}
    for term in linearizer.measured:
        residual = term.residual
        arguments = [x for x in residual.arguments.values() if isinstance(x, Tensor)]
        for x in (residual.t, residual.measured, residual.weighting[1], residual.clock.late, *arguments):
            if x is not None and x.requires_grad:
                found[id(x)] = x
    return list(found.values())


class _Optimum(torch.autograd.Function):
    """Unknowns at the solution, from the tensors that the problem was made of."""

    @staticmethod
    def forward(
        ctx: Any, linearizer: Linearizer, state: State, factor: Factor, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.linearizer, ctx.state, ctx.factor = linearizer, state, factor
        ctx.ids = [id(x) for x in tensors]
        ctx.save_for_backward(*tensors)
        return tuple(x.clone() for x in _numbers(linearizer.model, state).values())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        linearizer, state = ctx.linearizer, ctx.state
        model: Model = linearizer.model
        v = _tangential(model, state, cotangents)
        with torch.enable_grad():
            given = {
                key: x.detach().requires_grad_(x.requires_grad)
                for key, x in zip(ctx.ids, ctx.saved_tensors, strict=True)
            }
            step = torch.zeros(model.total, dtype=torch.float64, requires_grad=True)
            cost = _cost(linearizer, _moved(model, state, step), given)
            (slope,) = torch.autograd.grad(cost, step, create_graph=True)
            adjoint = _solve(slope, step, ctx.factor, v)
            gradients = torch.autograd.grad(-(slope @ adjoint), list(given.values()), allow_unused=True)
        return None, None, None, *gradients


def _numbers(model: Model, state: State) -> Numbers:
    points = {key: torch.from_numpy(x) for key, x in state.points.items()}
    return points | dict(state.values)


def _tangential(model: Model, state: State, cotangents: tuple[Tensor, ...]) -> Tensor:
    """From cotangents of stored numbers to those of the unknowns' columns."""
    result = torch.zeros(model.total, dtype=torch.float64)
    owners: list[Any] = [*model.splines, *model.variables]
    for owner, value, g in zip(owners, _numbers(model, state).values(), cotangents, strict=True):
        unknown = owner if isinstance(owner, Variable) else owner.module
        columns = torch.from_numpy(model.columns_of(unknown))
        if unknown.group is not None:
            algebra = unknown.group.arithmetic
            body = join(algebra.pull(split(value), split(g)), g)
        else:
            body, basis = g, unknown.basis(value)
            if basis is not None:
                body = (g.reshape(-1, 1, 3) @ basis).squeeze(1)
        there = columns >= 0
        result[columns[there]] += body.reshape(columns.shape)[there]
    return result


def _moved(model: Model, state: State, step: Tensor) -> Numbers:
    """All numbers after a step, differentiably."""
    padded = torch.cat([step, step.new_zeros(1)])
    moved = {}
    owners: list[Any] = [*model.splines, *model.variables]
    for owner, (key, value) in zip(owners, _numbers(model, state).items(), strict=True):
        unknown = owner if isinstance(owner, Variable) else owner.module
        own = padded[torch.from_numpy(model.columns_of(unknown))]
        if isinstance(unknown, Variable):
            moved[key] = unknown.retract(value, own)
        else:
            moved[key] = unknown.group.retract(value, own, side="right", validate=False)
    return moved


def _solve(slope: Tensor, step: Tensor, factor: Factor, v: Tensor) -> Tensor:
    """`C_xx^-1 v` by preconditioned conjugate gradients."""

    def hessian(x: Tensor) -> Tensor:
        return torch.autograd.grad(slope, step, x, retain_graph=True)[0]

    def precondition(x: Tensor) -> Tensor:
        return torch.from_numpy(factor.solve(x.numpy()))

    x = precondition(v)
    residual = v - hessian(x)
    z = precondition(residual)
    direction, gain = z, residual @ z
    scale = float((v @ precondition(v)).abs().sqrt())
    for _ in range(_STEPS):
        if float(gain.abs().sqrt()) <= _ACCURACY * scale:
            break
        image = hessian(direction)
        length = gain / (direction @ image)
        x, residual = x + length * direction, residual - length * image
        z = precondition(residual)
        gain, before = residual @ z, gain
        direction = z + (gain / before) * direction
    return x


def _cost(linearizer: Linearizer, numbers: Numbers, given: Numbers) -> Tensor:
    total = torch.zeros((), dtype=torch.float64)
    for term in linearizer.terms:
        total = total + term.cost_of(numbers, given)
    return total
