"""Cumulative B-splines on any Lie group over any knot vector: repeated knots, knot insertion, gradients by knots.

The curve is that of [S20] Definition 5.1, with the cumulative sums of the general basis functions of Cox and
de Boor (in [H18] section 3) for the matrix of uniform ones.
"""

from typing import Any

import torch
from torch import Tensor, nn

from torchspline import checks
from torchspline.arithmetic import jet
from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.jet import Jet
from torchspline.arithmetic.recurrence import forward
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector, plus, times
from torchspline.groups.components import join, split
from torchspline.groups.group import Group
from torchspline.groups.operations import geodesics
from torchspline.splines.clock import Extrapolate
from torchspline.splines.segments import check_query, evaluate_segments
from torchspline.splines.sweep import continue_signs, first, second
from torchspline.splines.trajectory import State, Trajectory


def local_knots(knots: Tensor, order: int) -> Tensor:
    """For each segment between neighbouring knots of the domain the 2 (k - 1) knots its basis functions need, as places
    u within the segment: `(S, 2 (k - 1))`, float64. Those of an empty segment are of no use."""
    if knots.dtype != torch.int64:
        knots = knots.to(torch.float64)
    windows = knots.unfold(0, 2 * order - 2, 1)[1:-1] if order > 1 else knots[:, None]
    start, end = windows[:, order - 2 : order - 1], windows[:, order - 1 : order]
    duration = (end - start).to(torch.float64)
    return (windows - start).to(torch.float64) / torch.where(duration > 0, duration, 1.0)


def basis(local: Vector, u: Scalar) -> list[Scalar]:
    """The k basis functions of order k that are not zero on a segment, by the triangle of Cox and de Boor.

    Args:
        local: the 2 (k - 1) knots around the segment as places u: segment [0, 1] is that between the middle two.
        u: within the segment; a jet gives derivatives.
    """
    reach = len(local) // 2
    left = [u - local[reach - 1 - j] for j in range(reach)]
    right = [local[reach + j] - u for j in range(reach)]
    values: list[Scalar] = [1.0]
    for degree in range(1, reach + 1):
        saved: Scalar = 0.0
        for r in range(degree):
            span = local[reach + r] - local[reach - degree + r]
            share = values[r] * (1.0 / span)
            values[r] = plus(saved, times(right[r], share))
            saved = left[degree - 1 - r] * share
        values.append(saved)
    return values


def cumulative_basis(local: Vector, u: Scalar) -> list[Scalar]:
    """l_1 ... l_(k-1) of [S20] (21) for these knots: sums of the basis functions from j on."""
    sums: list[Scalar] = []
    total: Scalar = 0.0
    for value in reversed(basis(local, u)[1:]):
        total = plus(total, value)
        sums.append(total)
    return sums[::-1]


def cumulative_weights(local: Tensor, u: Tensor, derivatives: int) -> Tensor:
    """The same and its derivatives by u: `(*B, derivatives + 1, k - 1)` of local knots (*B, 2 (k - 1)) and u (*B)."""
    # Constants as jets too: the tracer of torch.compile knows no operation of a tensor with one.
    constants = tuple(jet.constant(x, derivatives) for x in split(local))
    sums = tuple(cumulative_basis(constants, jet.variable(u, derivatives)))
    like = u.unsqueeze(-1)
    return torch.stack([join(jet.values(sums, r), like) for r in range(derivatives + 1)], dim=-2)


def step_table(points: Tensor, local: Tensor, group: Group) -> Tensor:
    """For each segment its first control point, k - 1 differences of neighbours and 2 (k - 1) local knots in a row.

    Args:
        points: (*batch, M, P), unit; where neighbours lie on different sides the long way round is meant.
        local: (M - k + 1, 2 (k - 1)).
    """
    algebra, steps = group.arithmetic, local.shape[-1] // 2
    unit = split(points)
    differences = join(algebra.signed_log(algebra.between(first(unit), second(unit))), points[..., 1:, :])
    windows = differences.unfold(-2, steps, 1).movedim(-1, -2).flatten(-2)
    segments = windows.shape[-2]
    knots = local.to(points.dtype).expand(*points.shape[:-2], *local.shape)
    return torch.cat([points[..., :segments, :], windows, knots], dim=-1)


def step_fields(group: Group, rows: Tensor, u: Tensor, derivatives: int, steps: int) -> tuple[Tensor, ...]:
    """Value and rates by u from rows of `step_table`."""
    start, moves, local = rows.split([group.point_size, steps * group.tangent_size, 2 * steps], dim=-1)
    weights = cumulative_weights(local, u.expand(local.shape[:-1]), derivatives)
    return geodesics(group.name, start, moves.unflatten(-1, (steps, group.tangent_size)), weights)


def step_components(group: GroupArithmetic, row: Vector, u: Scalar, derivatives: int) -> list[Vector]:
    """The same on the components of one row."""
    size, tangent = group.point_size, group.tangent_size
    steps = (len(row) - size) // (tangent + 2)
    moves = [row[size + j * tangent : size + (j + 1) * tangent] for j in range(steps)]
    local = tuple(Jet(knot, *(0.0,) * derivatives) for knot in row[size + steps * tangent :])
    sums = tuple(cumulative_basis(local, jet.variable(u, derivatives)))
    weights = [jet.values(sums, r) for r in range(derivatives + 1)]
    value, trace = forward(group, row[:size], moves, weights, derivatives)
    return [value, *trace[-1].rates]


def signs_continued(points: Tensor, group: Group) -> Tensor:
    """Unit, each quaternion on the side of its predecessor."""
    algebra = group.arithmetic
    unit = algebra.normalize(split(points))
    return join(continue_signs(algebra, unit, algebra.between(first(unit), second(unit))), points)


def nonuniform_bspline(
    control_points: Tensor,
    t: Tensor,
    *,
    group: Group,
    knots: Tensor,
    order: int = 4,
    derivatives: int = 2,
    extrapolate: Extrapolate = "error",
    validate: bool = True,
) -> State:
    """Value and time derivatives of a cumulative B-spline over a knot vector. O(order^2) per query.

    Args:
        control_points: `(*batch, M, P)` points of `group`, M >= order, as in `bspline`.
        t: `()`, `(N,)` or `(*batch, N)` in `[knots[order - 1], knots[M]]`: seconds, or int64 nanoseconds if the knots
            are.
        knots: `(M + order,)` seconds or int64 nanoseconds, not decreasing; inside the domain a knot that comes m times
            makes the curve C^(order - 1 - m), one that comes order times breaks it. At the ends of the domain `order`
            equal knots make the curve start or end at the end control point.
        order: k >= 2.
        derivatives, extrapolate, validate: as in `bspline`.
    Returns:
        State: as of `bspline`. At a knot the derivatives from the right, at the last one from the left.
    Differentiable in control points, float `t` and knots, to any order; not in repeated knots, where curves of
    different smoothness meet.
    Raises:
        TypeError: wrong type or dtype. ValueError: wrong shape, device or value, or a time outside the domain.
    """
    checks.instance("group", group, Group, "a torchspline.Group such as torchspline.SE3")
    checks.whole("order", order, least=2)
    checks.points("control_points", control_points, group, least=order, look=validate)
    _check_knots(knots, control_points, order)
    check_query(
        t, knots, derivatives, extrapolate, validate, control_points, control_points=control_points.shape[:-2]
    )
    table = step_table(signs_continued(control_points, group), local_knots(knots, order), group)
    domain = knots[order - 1 : control_points.shape[-2] + 1]

    def fields(rows: Tensor, u: Tensor, needed: int) -> tuple[Tensor, ...]:
        return step_fields(group, rows, u, needed, order - 1)

    return evaluate_segments(
        table, fields, group, t, domain, derivatives, extrapolate, validate, step_components
    )


def _check_knots(knots: Any, control_points: Tensor, order: int) -> None:
    checks.is_times("knots", knots)
    count = control_points.shape[-2]
    if knots.shape != (count + order,):
        raise ValueError(
            f"knots: expected shape ({count + order},), order more than control points, got {tuple(knots.shape)}"
        )
    if knots.device != control_points.device:
        raise ValueError(
            f"knots: on device {knots.device}, but control_points are on {control_points.device}; move one with "
            ".to(device)"
        )
    checks.finite("knots", knots)
    if not checks.values_visible(knots):
        return
    steps = knots.detach().diff()
    if checks.seen_true((steps >= 0).all()) is False:
        i = int((steps < 0).int().argmax())
        raise ValueError(
            f"knots: expected knots that do not decrease, got {knots[i].item()} and then {knots[i + 1].item()}"
        )
    inner = knots.detach()[order - 1 : count + 1]
    if checks.seen_true(inner[-1] > inner[0]) is False:
        raise ValueError(
            f"knots: expected a domain of some duration, got {inner[0].item()} to {inner[-1].item()}"
        )
    many = knots.detach()[order:] == knots.detach()[:-order]
    if checks.seen_true(many.any()):
        raise ValueError(
            f"knots: expected each knot at most {order} times (the order), got {knots[many.int().argmax()].item()} "
            "more often"
        )


class NonuniformBSpline(Trajectory):
    """A cumulative B-spline over a knot vector as a layer. See `nonuniform_bspline`.

    Args:
        control_points: `(*batch, M, P)`; tensors that require grad and Parameters are used as given, others
            copied into a Parameter, or a buffer if not `learnable`.
        group, order, extrapolate, validate: as in `nonuniform_bspline`.
        knots: `(M + order,)` seconds, kept in float64, or int64 nanoseconds; a tensor that requires grad is used as
            given.
        learnable: whether control points that do not require grad become a Parameter; never the knots.
    """

    _times = ("knots",)

    def __init__(
        self,
        control_points: Tensor,
        *,
        group: Group,
        knots: Tensor,
        order: int = 4,
        learnable: bool = True,
        extrapolate: Extrapolate = "error",
        validate: bool = True,
    ):
        super().__init__()
        checks.instance("group", group, Group, "a torchspline.Group such as torchspline.SE3")
        checks.whole("order", order, least=2)
        checks.points("control_points", control_points, group, least=order)
        _check_knots(knots, control_points, order)
        checks.choice("extrapolate", extrapolate, ("error", "clamp", "linear"))
        self.group, self.order = group, order
        self.extrapolate, self.validate = extrapolate, validate
        self.control_points: Tensor
        self.knots: Tensor
        self._adopt("control_points", control_points, learnable)
        self._adopt_seconds("knots", knots)

    @property
    def domain(self) -> tuple[float, float] | tuple[int, int]:
        """First and last time: seconds, or nanoseconds where the knots are int64."""
        return self.knots[self.order - 1].item(), self.knots[self.control_points.shape[-2]].item()

    def evaluate(self, t: Tensor, derivatives: int = 2) -> State:
        """Value and time derivatives at the times `t`, see `nonuniform_bspline`."""
        return nonuniform_bspline(
            self.control_points, t, group=self.group, knots=self.knots, order=self.order,
            derivatives=derivatives, extrapolate=self.extrapolate, validate=self.validate,
        )  # fmt: skip

    def insert_knot(self, time: float | int) -> "NonuniformBSpline":
        """The spline with one more knot, and control point, at `time` inside the domain (Boehm's knot insertion).

        On a commutative group the curve stays as it is; on others it stays outside `order - 1` segments around, and
        inside moves by as much as the factors do not commute (`fit.approximate` fits it again there).

        Args:
            time: in the unit of the knots; a whole number where they are nanoseconds.

        Raises:
            ValueError: a time outside the domain, or one at which there are already `order - 1` knots.
        """
        k, knots = self.order, self.knots.detach()
        checks.finite_number("time", time)
        if knots.dtype == torch.int64 and not isinstance(time, int):
            raise TypeError(f"time: expected a whole number of nanoseconds, as the knots are, got {time!r}")
        start, end = self.domain
        if not start <= time <= end:
            unit = "ns" if knots.dtype == torch.int64 else "s"
            raise ValueError(f"time: expected one inside the domain [{start}, {end}] {unit}, got {time!r}")
        there = int((knots == time).sum())
        if there >= k - 1:
            raise ValueError(
                f"time: expected a knot that comes less than {k - 1} times, got {time!r}, which comes {there}"
            )
        m = int(torch.searchsorted(knots, torch.tensor(time, dtype=knots.dtype), right=True)) - 1
        points = signs_continued(self.control_points.detach(), self.group)
        # Point i moves towards its successor by the share of its support that lies before the new knot.
        i = torch.arange(m - k + 2, m - there + 1)
        share = (time - knots[i]).to(torch.float64) / (knots[i + k - 1] - knots[i]).to(torch.float64)
        moved = self.group.interpolate(points[..., i - 1, :], points[..., i, :], share.to(points.dtype))
        new = torch.cat([points[..., : m - k + 2, :], moved, points[..., m - there :, :]], dim=-2)
        added = torch.cat([knots[: m + 1], knots.new_tensor([time]), knots[m + 1 :]])
        return NonuniformBSpline(
            new, group=self.group, knots=added, order=k, learnable=isinstance(self.control_points, nn.Parameter),
            extrapolate=self.extrapolate, validate=self.validate,
        )  # fmt: skip
