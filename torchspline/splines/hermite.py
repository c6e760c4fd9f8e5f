"""Quintic Hermite splines on any Lie group, [E17]: value, velocity and acceleration given at every knot, C2.

Two curves between the same ends, the same on a commutative group:

* `coordinates="product"`, [E17] (59)-(81): `X_0 Exp(a_1 p_1) ... Exp(a_5 p_5)` with p_1 = Log(X_0^-1 X_1), p_2
  and p_3 the velocities, p_4 and p_5 the accelerations at the ends. Third order where the factors do not
  commute (a smooth motion sampled h apart is met to h^3, its velocity to h^2, its acceleration to h);
* `coordinates="logarithm"`: `X_0 Exp(phi)` with one quintic phi in the tangent space of X_0. Sixth order.

[E17] multiplies on the left and differentiates in the world frame; here products and rates are those of the body frame,
which is [E17] applied to the inverse motion. `frame="world"` is [E17] to the letter.
"""

from collections.abc import Sequence
from fractions import Fraction
from math import factorial
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchspline import checks
from torchspline.arithmetic import jet
from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.recurrence import MAX_DERIVATIVES, difference_reverse, forward, reverse
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector, add, plus, scale, times, zero
from torchspline.groups.components import join, split
from torchspline.groups.group import Group, Side
from torchspline.groups.operations import geodesics
from torchspline.splines.clock import Extrapolate
from torchspline.splines.segments import (
    check_knot_times,
    check_query,
    durations,
    evaluate_segments,
    locate_between,
    rows_at,
)
from torchspline.splines.sweep import continue_signs, first, second
from torchspline.splines.trajectory import State, Trajectory, to_body_frame, to_world_frame

Coordinates = Literal["product", "logarithm"]
Frame = Literal["body", "world"]

_HALF = Fraction(1, 2)
#: [E17] (60)-(65): a_1 ... a_5 by powers of u. Each is 1 in one of value, velocity and acceleration at one end,
#: 0 in the others: a_1 in the value at 1, a_2 and a_3 in the velocity at 0 and 1, a_4 and a_5 in the acceleration.
QUINTICS: tuple[tuple[Fraction | int, ...], ...] = (
    (0, 0, 0, 10, -15, 6),
    (0, 1, 0, -6, 8, -3),
    (0, 0, 0, -4, 7, -3),
    (0, 0, _HALF, -3 * _HALF, 3 * _HALF, -_HALF),
    (0, 0, 0, _HALF, -1, _HALF),
)


def _columns(derivatives: int) -> list[list[list[float]]]:
    table, rows = [], [list(map(Fraction, row)) for row in QUINTICS]
    for _ in range(derivatives + 1):
        table.append(rows)
        rows = [[*(n * c for n, c in enumerate(row) if n > 0), Fraction(0)] for row in rows]
    return [[[float(row[n]) for row in rows] for rows in table] for n in range(len(QUINTICS[0]))]


#: For each number of derivatives, coefficients by power of u, then by derivative, then by j.
_COLUMNS = [_columns(derivatives) for derivatives in range(MAX_DERIVATIVES + 1)]


def quintic_weights(u: Tensor, derivatives: int) -> Tensor:
    """a_1 ... a_5 and their derivatives by u: `(*u.shape, derivatives + 1, 5)`."""
    columns = torch.tensor(_COLUMNS[derivatives], dtype=u.dtype, device=u.device)
    u = u[..., None, None]
    value = columns[-1].expand(*u.shape[:-2], -1, -1)
    for column in reversed(columns[:-1].unbind(0)):
        value = value * u + column
    return value


class _Ends(NamedTuple):
    """Both ends of segments: unit points of consistent sign, and rates by u, in the body frame."""

    X0: Tensor
    X1: Tensor
    v0: Tensor
    v1: Tensor
    a0: Tensor
    a1: Tensor


def _ends(values: Tensor, velocities: Tensor, accelerations: Tensor, times: Tensor, group: Group) -> _Ends:
    algebra = group.arithmetic
    unit = algebra.normalize(split(values))
    between = algebra.between(first(unit), second(unit))
    points = join(continue_signs(algebra, unit, between), values)
    h = durations(times).to(values.dtype).unsqueeze(-1)
    pairs = []
    for x, factor in ((points, None), (velocities, h), (accelerations, h * h)):
        for side in (x[..., :-1, :], x[..., 1:, :]):
            pairs.append(side if factor is None else side * factor)
    return _Ends(*pairs)


def _table(ends: _Ends, group: Group, coordinates: Coordinates) -> Tensor:
    """For every segment the start and five tangents: `(..., P + 5 D)`."""
    algebra = group.arithmetic
    X0, X1, v0, v1, a0, a1 = ends
    step = group.log(group.between(X0, X1, validate=False), validate=False)
    if coordinates == "logarithm":
        # phi' = J_r^-1(phi) w at the end, and phi'' its derivative along phi' with w' = a.
        p, w, a = split(step), split(v1), split(a1)
        slope = algebra.right_jacobian_inverse(p, w, short=True)
        moving = tuple(map(jet.Jet, p, slope)), tuple(map(jet.Jet, w, a))
        v1 = join(slope, step)
        a1 = join(jet.values(algebra.right_jacobian_inverse(*moving, short=True), 1), step)
    return torch.cat([X0, step, v0, v1, a0, a1], dim=-1)


def _fields(
    rows: Tensor, u: Tensor, group: Group, coordinates: Coordinates, derivatives: int
) -> tuple[Tensor, ...]:
    """Value and rates by u from rows (..., P + 5 D) of the table; u broadcasts."""
    start, steps = rows[..., : group.point_size], rows[..., group.point_size :]
    weights = quintic_weights(u, derivatives)
    if coordinates == "product":
        return geodesics(group.name, start, steps.unflatten(-1, (5, group.tangent_size)), weights)
    algebra = group.arithmetic
    tangents = [split(x) for x in steps.split(group.tangent_size, dim=-1)]
    by_row = [row.unbind(-1) for row in weights.unbind(-2)]
    found = _logarithm(algebra, split(start), tangents, by_row, derivatives)
    return tuple(join(field, rows) for field in found)


def _product_components(group: GroupArithmetic, row: Vector, u: Scalar, derivatives: int) -> list[Vector]:
    """The same on the components of one row, for `coordinates="product"`."""
    start, tangents = _parts(group, row)
    value, trace = forward(group, start, tangents, _quintics(u, derivatives), derivatives)
    return [value, *trace[-1].rates]


def _logarithm_components(group: GroupArithmetic, row: Vector, u: Scalar, derivatives: int) -> list[Vector]:
    """Likewise for `coordinates="logarithm"`."""
    start, tangents = _parts(group, row)
    return _logarithm(group, start, tangents, _quintics(u, derivatives), derivatives)


def _parts(group: GroupArithmetic, row: Vector) -> tuple[Vector, list[Vector]]:
    size, tangent = group.point_size, group.tangent_size
    return row[:size], [row[i : i + tangent] for i in range(size, len(row), tangent)]


def _quintics(u: Scalar, derivatives: int) -> list[list[Scalar]]:
    """a_1 ... a_5 and their derivatives at one u."""
    rows: list[list[Scalar]] = []
    for r in range(derivatives + 1):
        row: list[Scalar] = []
        for j in range(len(QUINTICS)):
            value: Scalar = 0.0
            for column in reversed(_COLUMNS[derivatives]):
                value = plus(times(value, u), column[r][j])
            row.append(value)
        rows.append(row)
    return rows


def _logarithm(
    group: GroupArithmetic,
    start: Vector,
    tangents: Sequence[Vector],
    weights: Sequence[Sequence[Scalar]],
    derivatives: int,
) -> list[Vector]:
    """`start Exp(phi)` and its rates, phi the sum of the tangents with these weights."""
    taylor = []
    for r, row in enumerate(weights):
        terms = (scale(a * (1.0 / factorial(r)), p) for a, p in zip(row, tangents, strict=True))
        taylor.append(add(*terms))
    x = tuple(map(jet.Jet, *taylor))
    value = group.compose(start, group.exp(jet.values(x, 0)))
    return [value, *jet.logarithmic_rates(group, x, derivatives)]


_COMPONENTS = {"product": _product_components, "logarithm": _logarithm_components}


def _from_world(
    values: Tensor, velocities: Tensor, accelerations: Tensor, group: Group
) -> tuple[Tensor, ...]:
    """The inverse motion, whose body-frame rates are the world-frame rates of this one, negated."""
    return group.inverse(values, validate=False), -velocities, -accelerations


def hermite(
    values: Tensor,
    velocities: Tensor,
    accelerations: Tensor,
    t: Tensor,
    *,
    group: Group,
    times: Tensor,
    coordinates: Coordinates = "product",
    frame: Frame = "body",
    derivatives: int = 2,
    extrapolate: Extrapolate = "error",
    validate: bool = True,
) -> State:
    """Value and time derivatives of a quintic Hermite spline, [E17] section 5. O(1) per query.

    Args:
        values: `(*batch, M, P)` points of `group` at the knots, M >= 2; quaternions of any length and sign,
            neighbours are joined the short way round.
        velocities, accelerations: `(*batch, M, D)` at the knots, per second and per second squared.
        t: `()`, `(N,)` or `(*batch, N)` within the knots: int64 nanoseconds if their times are, else seconds, float32
            only while its rounding stays below a thousandth of the shortest segment.
        times: `(M,)` seconds or int64 nanoseconds of the knots, increasing, uniform or not.
        coordinates: "product", the product of geodesics of [E17] (59), third order; "logarithm", one quintic in the
            logarithm, sixth order. See the module.
        frame: of velocities and accelerations at the knots, and of the product: "body" or, as in [E17], "world".
        derivatives, extrapolate, validate: as in `bspline`.
    Returns:
        State: as of `bspline`; rates are in the body frame whatever `frame` is.
    Differentiable in values, velocities, accelerations, times and float `t`, to any order; derivatives above the second
    jump at knots.
    Raises:
        TypeError: wrong type or dtype. ValueError: wrong shape, device or value, or a time outside the domain.
    Examples:
        >>> import torch
        >>> from torchspline import R3
        >>> zero = torch.zeros(2, 3, dtype=torch.float64)
        >>> ends = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
        >>> times = torch.tensor([0.0, 2.0], dtype=torch.float64)
        >>> middle = torch.tensor(1.0, dtype=torch.float64)
        >>> hermite(ends, zero, zero, middle, group=R3, times=times).value.tolist()  # at rest at both ends
        [0.5, 0.0, 0.0]
    """
    checks.instance("group", group, Group, "a torchspline.Group such as torchspline.SE3")
    _check_knots(values, velocities, accelerations, times, group, coordinates, frame, validate)
    check_query(t, times, derivatives, extrapolate, validate, values, values=values.shape[:-2])
    knots = (values, velocities, accelerations)
    state = _evaluate(knots, t, group, times, coordinates, frame, derivatives, extrapolate, validate)
    return to_body_frame(state, group) if frame == "world" else state


def _evaluate(
    knots: tuple[Tensor, Tensor, Tensor],
    t: Tensor,
    group: Group,
    times: Tensor,
    coordinates: Coordinates,
    frame: Frame,
    derivatives: int,
    extrapolate: Extrapolate,
    validate: bool,
) -> State:
    """The state with rates in `frame`."""
    if frame == "world":
        knots = _from_world(*knots, group)  # type: ignore[assignment]
    table = _table(_ends(*knots, times, group), group, coordinates)

    def fields(rows: Tensor, u: Tensor, needed: int) -> tuple[Tensor, ...]:
        return _fields(rows, u, group, coordinates, needed)

    state = evaluate_segments(
        table, fields, group, t, times, derivatives, extrapolate, validate, _COMPONENTS[coordinates]
    )
    if frame == "body":
        return state
    value = group.inverse(state.value, validate=False)
    return State(value, *(None if r is None else -r for r in state[1:]))


def _check_knots(
    values: Tensor,
    velocities: Tensor,
    accelerations: Tensor,
    times: Tensor,
    group: Group,
    coordinates: str,
    frame: str,
    validate: bool,
) -> None:
    checks.choice("coordinates", coordinates, ("product", "logarithm"))
    checks.choice("frame", frame, ("body", "world"))
    checks.points("values", values, group, least=2, look=validate)
    for name, x in (("velocities", velocities), ("accelerations", accelerations)):
        checks.is_floating_tensor(name, x)
        expected = (*values.shape[:-1], group.tangent_size)
        if x.shape != expected:
            raise ValueError(
                f"{name}: expected shape {expected}, tangents of {group} at the knots, got {tuple(x.shape)}"
            )
        checks.same_kind(values=values, **{name: x})
        if validate:
            checks.finite(name, x)
    check_knot_times(times, values.shape[-2])
    if times.device != values.device:
        raise ValueError(
            f"times: on device {times.device}, but values are on {values.device}; move one with .to(device)"
        )


class Differentials(NamedTuple):
    """Jacobians of a Hermite spline at N times by the knots at the ends of their segments.

    Rates are per second; values, of knots and of the spline, move by tangents of the `side` asked for.
    """

    #: (*batch, N): segment i lies between knots i and i + 1.
    segment: Tensor
    #: (*batch, N, 3, 6, D, D): value, velocity and acceleration of the spline by X_i, X_(i+1), v_i, v_(i+1), a_i and
    #: a_(i+1) of the knots; rows belong to the output, columns to the parameter.
    jacobian: Tensor


class HermiteSpline(Trajectory):
    """A quintic Hermite spline as a layer: value, velocity and acceleration at knots in, motion at any time out.

    Args:
        values: `(*batch, M, P)`; velocities, accelerations: `(*batch, M, D)`; see `hermite`. Tensors that
            require grad and Parameters are used as given, others copied into Parameters, or buffers if not
            `learnable`.
        group, coordinates, frame, extrapolate, validate: as in `hermite`.
        times: `(M,)` seconds, kept in float64, or int64 nanoseconds; a tensor that requires grad is used as given.
        learnable: whether tensors that do not require grad become Parameters; never the times.
    """

    _times = ("times",)

    def __init__(
        self,
        values: Tensor,
        velocities: Tensor,
        accelerations: Tensor,
        *,
        group: Group,
        times: Tensor,
        coordinates: Coordinates = "product",
        frame: Frame = "body",
        learnable: bool = True,
        extrapolate: Extrapolate = "error",
        validate: bool = True,
    ):
        super().__init__()
        checks.instance("group", group, Group, "a torchspline.Group such as torchspline.SE3")
        _check_knots(values, velocities, accelerations, times, group, coordinates, frame, True)
        checks.choice("extrapolate", extrapolate, ("error", "clamp", "linear"))
        self.group, self.coordinates, self.frame = group, coordinates, frame
        self.extrapolate, self.validate = extrapolate, validate
        self.values: Tensor
        self.velocities: Tensor
        self.accelerations: Tensor
        self.times: Tensor
        self._adopt("values", values, learnable)
        self._adopt("velocities", velocities, learnable)
        self._adopt("accelerations", accelerations, learnable)
        self._adopt_seconds("times", times)

    @property
    def domain(self) -> tuple[float, float] | tuple[int, int]:
        """First and last knot: seconds, or nanoseconds where their times are int64."""
        return self.times[0].item(), self.times[-1].item()

    def evaluate(self, t: Tensor, derivatives: int = 2, frame: Frame = "body") -> State:
        """Value and time derivatives at the times `t`, see `hermite`; rates in the body frame, or in the world frame
        (`dX/dt X^-1` and its derivatives, as in [E17] (33), (36))."""
        checks.choice("frame", frame, ("body", "world"))
        check_query(
            t,
            self.times,
            derivatives,
            self.extrapolate,
            self.validate,
            self.values,
            values=self.values.shape[:-2],
        )
        state = _evaluate(
            self._knots, t, self.group, self.times, self.coordinates, self.frame, derivatives, self.extrapolate,
            self.validate,
        )  # fmt: skip
        if frame == self.frame:
            return state
        return (to_world_frame if frame == "world" else to_body_frame)(state, self.group)

    @property
    def _knots(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.values, self.velocities, self.accelerations

    def differentials(self, t: Tensor, side: Side = "left") -> Differentials:
        """Jacobians of value, velocity and acceleration by the knots, [E17] (39)-(52) and (93)-(100), correcting its
        (95), (96), which say C for B. O(1) per query, no graph.

        Args:
            t: `(N,)` or `(*batch, N)` inside the domain, in the unit of the knots.
            side: of perturbations of values, at the knots and of the result: `X <- Exp(delta) X` ("left") or
                `X Exp(delta)`. Rates, of knots and results, are those in the spline's own `frame`.
        Raises:
            ValueError: a time outside the domain.
        """
        checks.choice("side", side, ("left", "right"))
        check_query(t, self.times, 2, "error", True, self.values, values=self.values.shape[:-2])
        group, knots, times = self.group, self._knots, self.times.detach()
        knots = tuple(x.detach() for x in knots)  # type: ignore[assignment]
        if self.frame == "world":
            knots = _from_world(*knots, group)  # type: ignore[assignment]
        t = t.detach().reshape(-1) if t.ndim == 0 or knots[0].ndim == 2 else t.detach()
        place = locate_between(t, times, "error", True)
        u, h = (x.to(knots[0].dtype) for x in (place.u, place.duration))
        ends = _Ends(*(rows_at(x, place.segment) for x in _ends(*knots, times, group)))
        of = _product_differentials if self.coordinates == "product" else _logarithm_differentials
        jacobian = of(ends, u.expand(ends.X0.shape[:-1]), group)
        jacobian = jacobian * _units(h.expand(ends.X0.shape[:-1]))[..., None, None]
        natural = "right" if self.frame == "body" else "left"
        if side != natural:
            value = _fields(_table(ends, group, self.coordinates), u, group, self.coordinates, 0)[0]
            jacobian = _other_side(jacobian, ends, value, group)
        return Differentials(place.segment.expand(ends.X0.shape[:-1]), jacobian)


def _units(h: Tensor) -> Tensor:
    """From rates by u to rates per second, of results (3) and knots (6): `(..., 3, 6)`."""
    one = torch.ones_like(h)
    out, into = torch.stack([one, 1 / h, 1 / h**2], -1), torch.stack([one, one, h, h, h**2, h**2], -1)
    return out[..., :, None] * into[..., None, :]


def _other_side(jacobian: Tensor, ends: _Ends, value: Tensor, group: Group) -> Tensor:
    """From perturbations `X Exp(delta)` to `Exp(delta) X`, of the motion or of its inverse."""
    blocks = jacobian.clone()
    for i, X in enumerate((ends.X0, ends.X1)):
        back = group.adjoint(group.inverse(X, validate=False), validate=False)
        blocks[..., i, :, :] = jacobian[..., i, :, :] @ back[..., None, :, :]
    blocks[..., 0, :, :, :] = group.adjoint(value, validate=False)[..., None, :, :] @ blocks[..., 0, :, :, :]
    return blocks


def _product_differentials(ends: _Ends, u: Tensor, group: Group) -> Tensor:
    """One reverse sweep for the unit cotangents of each output, `(..., 3, 6, D, D)`, by u, on the right."""
    algebra, size = group.arithmetic, group.tangent_size
    table = _table(ends, group, "product").unsqueeze(-2)  # a dimension for the rows
    start, steps = split(table[..., : group.point_size]), table[..., group.point_size :]
    d = [split(x) for x in steps.split(size, dim=-1)]
    weights = [row.unsqueeze(-2).unbind(-1) for row in quintic_weights(u, 2).unbind(-2)]
    _, trace = forward(algebra, start, d, weights, 2)
    like = steps.new_empty(*steps.shape[:-2], size, size)
    rows = split(torch.eye(size, dtype=u.dtype, device=u.device).expand_as(like))
    none: Vector = zero(size)
    outputs = []
    for r in range(3):
        cotangents = [rows if r == i else none for i in range(3)]
        start_g, steps_g, _ = reverse(algebra, d, weights, trace, cotangents[0], cotangents[1:])
        to_first, to_second = difference_reverse(algebra, d[0], steps_g[0])
        blocks = [add(start_g, to_first), to_second, *steps_g[1:]]
        outputs.append(torch.stack([join(b, like) for b in blocks], dim=-3))
    return torch.stack(outputs, dim=-4)


def _logarithm_differentials(ends: _Ends, u: Tensor, group: Group) -> Tensor:
    """By forward mode, all queries at once."""
    size = group.tangent_size
    origin = torch.zeros(6, size, dtype=u.dtype, device=u.device)

    def fields(delta: Tensor) -> tuple[Tensor, ...]:
        moved = [
            group.retract(X, d, side="right", validate=False)
            for X, d in zip(ends[:2], delta[:2], strict=True)
        ]
        rates = [x + d for x, d in zip(ends[2:], delta[2:], strict=True)]
        return _fields(_table(_Ends(*moved, *rates), group, "logarithm"), u, group, "logarithm", 2)

    value = fields(origin)[0]

    def outputs(delta: Tensor) -> Tensor:
        moved, *rates = fields(delta)
        step = group.log(group.between(value, moved, validate=False), validate=False)
        return torch.stack([step, *rates], dim=-2)

    return torch.func.jacfwd(outputs)(origin).movedim(-2, -3)
