"""Explicit Jacobians of a uniform B-spline with respect to the control points a query depends on.

The reverse sweep of `arithmetic/recurrence.py`, run for each row, is [S20] Theorems 5.4-5.6 for any group, transposed:
O(k) a query. Its result is in local coordinates; [S20] (47)-(49) for any group bring it to control points, and adjoints
to the side the perturbation is on.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchspline.arithmetic.recurrence import forward, tangent
from torchspline.arithmetic.registry import arithmetic
from torchspline.arithmetic.vector import Vector, zero
from torchspline.groups.components import join, split
from torchspline.groups.group import Group, Side
from torchspline.splines.basis import cumulative_weights
from torchspline.splines.local import Local, LocalSpline


class Jacobians(NamedTuple):
    """How a state moves with its k control points and with time; fields beyond the derivatives asked for are None.

    For each of `value`, `velocity`, `acceleration`, `jerk` a tensor (*batch, N, k, D, D): entry [..., j, r, c] is the
    change of component r when control point `first + j` moves by a small multiple of tangent direction c:
    `Exp(delta) X_j` on the left side, `X_j Exp(delta)` on the right. The rows of `value` are a tangent of the same
    side; those of the derivatives are plain changes, as derivatives are vectors of the body frame either way.
    """

    #: (*batch, N): the first control point a query depends on.
    first: Tensor
    value: Tensor
    velocity: Tensor | None
    acceleration: Tensor | None
    jerk: Tensor | None
    #: (*batch, N, 1 + derivatives, D): change with t, per second, of the value (tangent of its side) and the
    #: derivatives.
    time: Tensor


def bspline_jacobians(
    control_points: Tensor,
    segment: Tensor,
    u: Tensor,
    group: Group,
    order: int,
    spacing: float,
    derivatives: int,
    side: Side,
) -> Jacobians:
    """Of control points `(*batch, M, P)` at places `(*batch, N)`; `spacing` in seconds."""
    algebra, (*batch, M, P) = arithmetic(group.name), control_points.shape
    D, N, dtype = algebra.tangent_size, u.shape[-1], control_points.dtype
    spline = LocalSpline(group.name, order, spacing, M, dtype)
    local = spline.at(control_points.detach().contiguous().numpy().reshape(-1, P))
    trajectories = np.arange(len(local.unit) // M).reshape(-1, 1) * M
    base = (trajectories + segment.expand(*batch, N).reshape(-1, N).numpy()).reshape(-1)
    places = u.detach().to(dtype).expand(*batch, N).reshape(-1).contiguous().numpy()
    chain = spline.pair_jacobians(local)
    value, *_ = (torch.from_numpy(x) for x in spline.evaluate(local, base, places, 0))
    points = torch.from_numpy(local.unit)[torch.from_numpy(base)[:, None] + torch.arange(order)]

    fields: list[Tensor | None] = []
    for r in range(derivatives + 1):
        parts = tuple(part == r for part in range(r + 1))
        unit_rows = np.tile(np.eye(D, dtype=spline.real), (len(base), 1, 1))
        rows = spline.to_points(spline.rows(local, base, places, unit_rows, parts), chain, base)
        jacobian = torch.from_numpy(rows).reshape(-1, D, order, D).transpose(1, 2)
        if side == "left":
            back = group.inverse(points, validate=False)
            jacobian = jacobian @ group.adjoint(back, validate=False)
            if r == 0:
                jacobian = group.adjoint(value, validate=False).unsqueeze(1) @ jacobian
        fields.append(jacobian.reshape(*batch, N, order, D, D))
    time = _by_time(spline, local, base, places, derivatives)
    if side == "left":
        time[:, 0] = group.adjoint_act(value, time[:, 0], validate=False)
    fields += [None] * (4 - len(fields))
    first = segment.expand(*batch, N)
    return Jacobians(first, *fields, time.reshape(*batch, N, derivatives + 1, D))  # type: ignore[arg-type, call-arg]


def _by_time(spline: LocalSpline, local: Local, base: np.ndarray, u: np.ndarray, derivatives: int) -> Tensor:
    """The forward sweep of first variations with only the weights moving: it knows one derivative more."""
    at, logs = torch.from_numpy(base), torch.from_numpy(local.logs)
    steps: list[Vector] = [split(logs[at + j]) for j in range(spline.order - 1)]
    weights = cumulative_weights(torch.from_numpy(u), spline.order, derivatives + 1)
    group, start = spline.group, torch.from_numpy(local.unit)[at]
    used = weights[: derivatives + 1]
    _, sweep = forward(group, split(start), steps, used, derivatives, short=True)
    still = zero(group.tangent_size)
    moved, rates = tangent(group, steps, used, sweep, still, [still] * len(steps), weights[1:], short=True)
    changes = (join(x, start[:, :0]) / spline.spacing ** (r + 1) for r, x in enumerate((moved, *rates)))
    return torch.stack(list(changes), dim=1)
