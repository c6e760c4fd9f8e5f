"""Explicit Jacobians of a uniform B-spline with respect to the control points a query depends on.

The reverse sweep of `arithmetic/recurrence.py`, run for each row, is [S20] Theorems 5.4-5.6 for any group, transposed:
O(k) a query. Its result is in local coordinates; [S20] (47)-(49) for any group bring it to control points, and adjoints
to the side the perturbation is on.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchspline.arithmetic.recurrence import MAX_DERIVATIVES, forward, tangent
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
    chain, value = spline.pair_jacobians(local), spline.evaluate(local, base, places, 0)[0]
    start = np.tile(np.eye(D, dtype=spline.real), (len(local.unit), 1, 1))
    unit_rows = np.tile(np.eye(D, dtype=spline.real), (len(base), 1, 1))
    rows_of_value = unit_rows
    if side == "left":
        # Exp(delta) X = X Exp(Ad_X^-1 delta), and the other way round for the value's own tangent.
        start = (
            group.adjoint(group.inverse(torch.from_numpy(local.unit)), validate=False).contiguous().numpy()
        )
        chain = np.ascontiguousarray(chain @ np.stack([start, np.roll(start, -1, axis=0)], axis=1))
        rows_of_value = group.adjoint(torch.from_numpy(value), validate=False).contiguous().numpy()

    fields: list[Tensor | None] = []
    for r in range(derivatives + 1):
        parts = tuple(part == r for part in range(r + 1))
        rows = spline.rows(local, base, places, unit_rows if r else rows_of_value, parts)
        jacobian = torch.from_numpy(spline.to_points(rows, chain, start, base))
        fields.append(jacobian.reshape(*batch, N, order, D, D))
    time = _by_time(spline, local, base, places, derivatives)
    if side == "left":
        time[:, 0] = group.adjoint_act(torch.from_numpy(value), time[:, 0], validate=False)
    fields += [None] * (4 - len(fields))
    first = segment.expand(*batch, N)
    return Jacobians(first, *fields, time.reshape(*batch, N, derivatives + 1, D))  # type: ignore[arg-type, call-arg]


def _by_time(spline: LocalSpline, local: Local, base: np.ndarray, u: np.ndarray, derivatives: int) -> Tensor:
    """Each derivative changes at the rate of the next; for that of the jerk, the forward sweep of first variations with
    only the weights moving, which knows one derivative more."""
    if derivatives < MAX_DERIVATIVES:
        rates_of_time = spline.evaluate(local, base, u, derivatives + 1)[1:]
        return torch.from_numpy(np.stack(rates_of_time, axis=1))
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
