"""What is known of unknowns beforehand, or remembered of measurements that were dropped: Gaussians on unknowns."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchspline.fit.solving.model import Model, State
from torchspline.fit.solving.system import System
from torchspline.fit.variables import Variable
from torchspline.splines.bspline import BSpline
from torchspline.splines.local import LocalSpline

Array = NDArray[Any]


class Part(NamedTuple):
    """Of a prior: an unknown, which of its control points (all of a variable), and where they stood, `(C, P)`."""

    unknown: BSpline | Variable
    points: Array
    reference: torch.Tensor


class Prior:
    """`1/2 x^T H x + g^T x` of the steps x from reference values, all parts side by side.

    Args:
        information: H (n, n). slope: g (n,). constant: added to the cost.
    """

    def __init__(self, parts: list[Part], information: Array, slope: Array, constant: float = 0.0):
        self.parts, self.information, self.slope, self.constant = parts, information, slope, constant

    def bind(self, model: Model) -> "BoundPrior":
        """With the unknowns' columns."""
        return BoundPrior(self, model)


class BoundPrior:
    """A prior on the unknowns of a model."""

    def __init__(self, prior: Prior, model: Model):
        self.prior = prior
        self.columns = np.concatenate(
            [model.columns_of(p.unknown)[p.points].reshape(-1) for p in prior.parts]
        )

    def touched(self, state: State) -> Array:
        """Columns of the unknowns, one run."""
        return self.columns[None]

    def cost_of(self, numbers: Mapping[int, torch.Tensor], given: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """The cost as differentiable operations."""
        steps = []
        for part in self.prior.parts:
            now = numbers[id(part.unknown)]
            now = now.reshape(-1, now.shape[-1])[torch.from_numpy(np.asarray(part.points))]
            steps.append(_block_step(part, now).reshape(-1))
        x = torch.cat(steps)
        H, g = torch.from_numpy(self.prior.information), torch.from_numpy(self.prior.slope)
        return 0.5 * x @ H @ x + g @ x + self.prior.constant

    def add_to(self, system: System, state: State) -> None:
        """Add cost and normal equations; the steps' own Jacobians are those of the logarithm."""
        steps, jacobians = [], []
        for part in self.prior.parts:
            step, jacobian = steps_of(part, state)
            steps.append(step.reshape(-1))
            jacobians += list(jacobian)
        x, J = np.concatenate(steps), _block_diagonal(jacobians)
        H, g = self.prior.information, self.prior.slope
        system.cost += 0.5 * float(x @ H @ x) + float(g @ x) + self.prior.constant
        system.add_dense(self.columns, J.T @ H @ J, J.T @ (H @ x + g))


def _block_step(part: Part, now: torch.Tensor) -> torch.Tensor:
    """Tangents from the reference to `now` (C, D), differentiable."""
    unknown, reference = part.unknown, part.reference
    if isinstance(unknown, Variable) and unknown.sphere:
        basis = unknown.basis(reference)
        assert basis is not None
        back = basis.mT / reference.square().sum(-1)[:, None, None]
        return (back @ (now - reference).unsqueeze(-1)).squeeze(-1)
    if unknown.group is None:
        return now - reference
    return unknown.group.log(unknown.group.between(reference, now, validate=False), validate=False)


def steps_of(part: Part, state: State) -> tuple[Array, Array]:
    """Tangents from the reference to where the unknowns stand (C, D), and their Jacobians (C, D, D)."""
    unknown = part.unknown
    if isinstance(unknown, BSpline):
        # Pairs of a reference and where it stands now, as splines of two points: their logarithms are compiled.
        pairs = np.stack([part.reference.numpy(), state.points[id(unknown)][part.points]], axis=1)
        spline = LocalSpline(unknown.group.name, unknown.order, 1.0, 2)
        local = spline.at(pairs.reshape(-1, pairs.shape[-1]))
        return local.logs[::2], spline.pair_jacobians(local)[::2, 1]
    now = state.values[id(unknown)].reshape(-1, unknown.size)[part.points]
    step = _block_step(part, now)
    if unknown.sphere:
        # The change of the vector, seen from the basis at the reference.
        at_reference, at_now = unknown.basis(part.reference), unknown.basis(now)
        assert at_reference is not None
        assert at_now is not None
        jacobian = at_reference.mT @ at_now / part.reference.square().sum(-1)[:, None, None]
    elif unknown.group is None:
        jacobian = torch.eye(step.shape[-1], dtype=step.dtype).expand(len(step), -1, -1)
    else:
        jacobian = unknown.group.right_jacobian_inverse(step, validate=False)
    return step.numpy(), jacobian.numpy()


def _block_diagonal(blocks: list[Array]) -> Array:
    from scipy.linalg import block_diag

    return block_diag(*blocks)
