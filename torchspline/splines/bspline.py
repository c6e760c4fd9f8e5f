"""Uniform cumulative B-splines on any Lie group, [S20]: the function and the module."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from torchspline import checks
from torchspline.arithmetic.recurrence import MAX_DERIVATIVES
from torchspline.groups.group import R3, SO3, Group, Side, product
from torchspline.kernels.mode import usable
from torchspline.splines.clock import EXTRAPOLATE, Extrapolate, check_float32, locate
from torchspline.splines.fused import fused_bspline, kernels_of, small
from torchspline.splines.jacobians import Jacobians, bspline_jacobians
from torchspline.splines.segments import past_the_end
from torchspline.splines.sweep import cumulative_bspline
from torchspline.splines.trajectory import State, Trajectory
from torchspline.units import unit_of


def bspline(
    control_points: Tensor,
    t: Tensor,
    *,
    group: Group,
    order: int = 4,
    dt: Tensor | float | None = None,
    t0: Tensor | float = 0.0,
    dt_ns: int | None = None,
    t0_ns: int | None = None,
    derivatives: int = 2,
    extrapolate: Extrapolate = "error",
    validate: bool = True,
) -> State:
    """Value and time derivatives of a uniform B-spline, [S20] Theorems 5.2, 5.3 and (75). O(order) per query.

    Args:
        control_points: `(*batch, M, P)` points of `group`, M >= order, float32 or float64. Quaternions may have any
            length and sign; neighbours are joined the short way round.
        t: seconds (float64, or float32 while its rounding stays below dt/1000), or int64 nanoseconds together with
            `t0_ns` and `dt_ns`. Shape `()`, `(N,)`, shared by the batch, or `(*batch, N)`; batches broadcast.
        order: k >= 2; the curve is C^(k-2), of degree k - 1 on R^n. Corrects [S20] 4.1, which says C^(k-1).
        dt, t0: knot spacing and start of the domain `[t0, t0 + (M - order + 1) dt]` in seconds, numbers or 0-dim
            tensors.
        derivatives: how many, 0 to 3.
        extrapolate: outside the domain "error"; "clamp": the end pose, zero derivatives; "linear": the end
            velocity kept.
        validate: look at values (finite numbers, quaternion lengths, times inside). Only done on the CPU in eager
            mode; elsewhere a time outside gives NaN. With False, times outside are undefined.
    Returns:
        State: `value` (*batch, N, P), quaternions unit and of continuous sign; `velocity`, `acceleration`, `jerk`
        (*batch, N, D), body frame, per second. A scalar time drops N.
    Differentiable in control points, float `t`, `dt` and `t0`, to any order; not at knots in derivatives that jump
    there, nor where neighbours are exactly pi apart.
    Raises:
        TypeError: wrong type or dtype. ValueError: wrong shape, device or value, or a time outside the domain.
    Examples:
        >>> import torch
        >>> from torchspline import SO3
        >>> t = torch.tensor([0.0, 0.25, 0.5], dtype=torch.float64)
        >>> state = bspline(SO3.random(8, dtype=torch.float64), t, group=SO3, order=4, dt=0.1)
        >>> state.value.shape, state.velocity.shape, state.jerk
        (torch.Size([3, 4]), torch.Size([3, 3]), None)
    """
    group = _as_group(group)
    _check_control_points(control_points, group, order)
    _check_derivatives(derivatives)
    checks.choice("extrapolate", extrapolate, EXTRAPOLATE)
    start, spacing = _knots(t, dt, t0, dt_ns, t0_ns)
    _check_times(t, control_points)

    segments = control_points.shape[-2] - order + 1
    control_points, times, shape = _align(control_points, t)

    def reference(control_points: Tensor, times: Tensor, start: Any, spacing: Any) -> tuple[Tensor, ...]:
        place = locate(times, start, spacing, segments, extrapolate, validate)
        # Extrapolating linearly needs the velocity even where only the value is asked for.
        needed = max(derivatives, 1) if extrapolate == "linear" else derivatives
        u = place.u.to(control_points.dtype)
        fields = cumulative_bspline(control_points, u, place.segment, group.name, order, needed)
        if place.beyond is not None:
            fields = past_the_end(group, fields, place.beyond.to(u.dtype), extrapolate)
        seconds = spacing * unit_of(times)
        return tuple(
            field if r == 0 else field / seconds**r for r, field in enumerate(fields[: derivatives + 1])
        )

    fields = None
    # Asked first: Dynamo cannot trace the context variable that `usable` reads.
    eager = not torch.compiler.is_compiling()
    if eager and small(group.name, order) and usable(control_points, times, start, spacing):
        kernels = kernels_of(group.name, order, derivatives, control_points.dtype, times.dtype == torch.int64)
        if validate:
            check_float32(times, spacing)
        # Kernels know no extrapolation: they refuse times outside, also where nobody asked for checks.
        refuse = validate or extrapolate != "error"
        fields = fused_bspline(control_points, times, start, spacing, kernels, segments, refuse, reference)
    if fields is None:  # no kernel serves this call, or it met a value for the checks or extrapolation below
        if validate:
            _check_values(control_points, group)
            if t.dtype != torch.int64:
                checks.finite("t", t)
        fields = reference(control_points, times, start, spacing)
    return State(*(_shaped(field, shape) for field in fields))


def _check_derivatives(derivatives: int) -> None:
    if type(derivatives) is not int or not 0 <= derivatives <= MAX_DERIVATIVES:
        raise ValueError(
            f"derivatives: expected a whole number from 0 to {MAX_DERIVATIVES}, got {derivatives!r}"
        )


def _shaped(field: Tensor, shape: tuple[int, ...]) -> Tensor:
    return field if field.shape[:-1] == shape else field.reshape(*shape, field.shape[-1])


def _as_group(group: Group) -> Group:
    checks.instance("group", group, Group, "a torchspline.Group such as torchspline.SE3")
    return group


def _check_control_points(control_points: Tensor, group: Group, order: int) -> None:
    checks.is_floating_tensor("control_points", control_points)
    checks.whole("order", order, least=2)
    if control_points.ndim < 2 or control_points.shape[-1] != group.point_size:
        raise ValueError(
            f"control_points: expected shape (..., M, {group.point_size}), M points of {group}, "
            f"got {tuple(control_points.shape)}"
        )
    if control_points.shape[-2] < order:
        raise ValueError(
            f"control_points: order {order} needs at least {order} control points, got {control_points.shape[-2]}"
        )


def _check_values(control_points: Tensor, group: Group) -> None:
    checks.finite("control_points", control_points)
    checks.quaternions("control_points", control_points, group.arithmetic.unit_blocks)


def _knots(t: Tensor, dt: Any, t0: Any, dt_ns: Any, t0_ns: Any) -> tuple[Any, Any]:
    """Start and spacing in the unit of the times."""
    if not isinstance(t, Tensor):
        raise TypeError(
            f"t: expected a torch.Tensor, got {type(t).__name__}; convert it with torch.as_tensor"
        )
    if dt_ns is not None or t0_ns is not None:
        if dt is not None or dt_ns is None:
            raise ValueError(
                "dt_ns, t0_ns: nanoseconds are used as a whole: expected dt_ns and no dt, "
                f"got dt_ns={dt_ns} and dt={dt}"
            )
        if isinstance(t0, Tensor) or t0 != 0:
            raise ValueError(f"t0: with dt_ns the start is expected as t0_ns, got t0={t0}")
        for name, x in (("dt_ns", dt_ns), ("t0_ns", 0 if t0_ns is None else t0_ns)):
            if isinstance(x, bool) or not isinstance(x, int):
                raise TypeError(f"{name}: expected a whole number of nanoseconds, got {x!r}")
        if t.dtype != torch.int64:
            raise TypeError(f"t: with dt_ns, times are int64 nanoseconds, got {t.dtype}")
        checks.positive("dt_ns", dt_ns)
        return t0_ns or 0, dt_ns
    if dt is None:
        raise ValueError("dt: expected the knot spacing, dt in seconds or dt_ns and t0_ns, got neither")
    if t.dtype == torch.int64:
        raise TypeError("t: int64 times are nanoseconds and go with dt_ns and t0_ns; got dt in seconds")
    checks.is_floating_tensor("t", t)
    return _seconds("t0", t0, t, checks.finite_number), _seconds("dt", dt, t, checks.positive)


def _seconds(name: str, x: Any, t: Tensor, check: Callable[[str, float], float]) -> Any:
    if isinstance(x, Tensor):
        checks.is_floating_tensor(name, x)
        if x.ndim != 0:
            raise ValueError(f"{name}: expected one number (a 0-dim tensor), got shape {tuple(x.shape)}")
        if x.device != t.device:
            raise ValueError(
                f"{name}: on device {x.device}, but t is on {t.device}; move one with .to(device)"
            )
        if (number := checks.seen_number(x)) is not None:
            check(name, number)
        return x if x.dtype == torch.float64 else x.to(torch.float64)
    if isinstance(x, bool) or not isinstance(x, (int, float)):
        raise TypeError(f"{name}: expected seconds as a number or a 0-dim tensor, got {type(x).__name__}")
    return check(name, float(x))


def _check_times(t: Tensor, control_points: Tensor) -> None:
    if t.device != control_points.device:
        raise ValueError(
            f"t: on device {t.device}, but control_points are on {control_points.device}; move one with .to(device)"
        )
    if t.ndim > 1:
        checks.broadcast(control_points=control_points.shape[:-2], t=t.shape[:-1])


def _align(control_points: Tensor, t: Tensor) -> tuple[Tensor, Tensor, tuple[int, ...]]:
    """Control points and times as the sweep wants them, and the shape of the results without components."""
    batch = control_points.shape[:-2]
    if t.ndim == 0:
        return control_points, t.reshape(1), tuple(batch)
    if t.ndim == 1:
        return control_points, t, (*batch, t.shape[0])
    if len(batch) == 0:  # one trajectory: a batch of times is just more times
        return control_points, t.reshape(-1), tuple(t.shape)
    common = torch.broadcast_shapes(batch, t.shape[:-1])
    expanded = control_points.expand(*common, *control_points.shape[-2:])
    return expanded, t.expand(*common, t.shape[-1]), (*common, t.shape[-1])


class BSpline(Trajectory):
    """A uniform cumulative B-spline as a layer: control points in, motion at any time out. See `bspline`.

    Args:
        control_points: `(*batch, M, P)`. A tensor that requires grad (a network's output, the caller's own leaf) is
            used as given, and so is a `Parameter`; any other is copied into a `Parameter`, or a buffer if not
            `learnable`.
        group, order, extrapolate, validate: as in `bspline`.
        dt, t0: seconds, kept in float64 through `.to(dtype)`; tensors that require grad are used as given.
        dt_ns, t0_ns: whole nanoseconds instead; times are then int64.
        learnable: whether control points that do not require grad become a `Parameter`.
    Examples:
        >>> import torch
        >>> from torchspline import SE3
        >>> spline = BSpline(SE3.identity(12, dtype=torch.float64), group=SE3, order=4, dt=0.1)
        >>> spline
        BSpline(SE3, order=4, batch=(), points=12, domain=[0.0, 0.9] s)
        >>> spline(torch.tensor(0.4)).tolist()
        [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    """

    _times = ("dt", "t0")

    def __init__(
        self,
        control_points: Tensor,
        *,
        group: Group,
        order: int = 4,
        dt: Tensor | float | None = None,
        t0: Tensor | float = 0.0,
        dt_ns: int | None = None,
        t0_ns: int | None = None,
        learnable: bool = True,
        extrapolate: Extrapolate = "error",
        validate: bool = True,
    ):
        super().__init__()
        self.group = _as_group(group)
        _check_control_points(control_points, group, order)
        _check_values(control_points, group)
        checks.choice("extrapolate", extrapolate, EXTRAPOLATE)
        self.order, self.extrapolate, self.validate = order, extrapolate, validate
        self.control_points: Tensor
        self._adopt("control_points", control_points, learnable)
        nanoseconds = dt_ns is not None or t0_ns is not None
        probe = torch.zeros(
            (), dtype=torch.int64 if nanoseconds else torch.float64, device=control_points.device
        )
        _knots(probe, dt, t0, dt_ns, t0_ns)  # the errors of the arguments, now rather than at the first call
        self.dt_ns, self.t0_ns = dt_ns, (t0_ns or 0) if nanoseconds else None
        self.dt: Tensor | None = None
        self.t0: Tensor | None = None
        if not nanoseconds:
            for name, x in (("dt", dt), ("t0", t0)):
                if not isinstance(x, nn.Parameter) and not (isinstance(x, Tensor) and x.requires_grad):
                    x = torch.as_tensor(x, dtype=torch.float64, device=control_points.device).clone()
                self._keep(name, x)

    def get_extra_state(self) -> Tensor:
        """Whole nanoseconds [t0, dt], zeros for seconds: plain numbers for `torch.compile`, but state all the same."""
        return torch.tensor([self.t0_ns or 0, self.dt_ns or 0], dtype=torch.int64)

    def set_extra_state(self, state: Tensor) -> None:
        """Called by `load_state_dict`."""
        t0_ns, dt_ns = state.tolist()
        self.t0_ns, self.dt_ns = (t0_ns, dt_ns) if dt_ns else (None, None)

    @property
    def domain(self) -> tuple[float, float] | tuple[int, int]:
        """First and last time: seconds, or nanoseconds if made with `dt_ns`."""
        segments = self.control_points.shape[-2] - self.order + 1
        if self.dt_ns is not None:
            assert self.t0_ns is not None
            return self.t0_ns, self.t0_ns + segments * self.dt_ns
        assert self.dt is not None
        assert self.t0 is not None
        t0, dt = float(self.t0.detach()), float(self.dt.detach())
        return t0, t0 + segments * dt

    def evaluate(self, t: Tensor, derivatives: int = 2) -> State:
        """Value and time derivatives at the times `t`; see `bspline` for shapes, frames, units and errors."""
        return bspline(
            self.control_points,
            t,
            group=self.group,
            order=self.order,
            dt=self.dt,
            t0=0.0 if self.t0 is None else self.t0,
            dt_ns=self.dt_ns,
            t0_ns=self.t0_ns,
            derivatives=derivatives,
            extrapolate=self.extrapolate,
            validate=self.validate,
        )

    def jacobians(self, t: Tensor, derivatives: int = 2, side: Side = "left") -> Jacobians:
        """Jacobians of the state with respect to each active control point and to time, [S20] Theorems 5.4-5.6.

        On R^1 with k = 4, in the middle of a segment, `value[0, :, 0, 0]` is the B-spline's weights
        `[1, 23, 23, 1] / 48`, and `velocity[0, :, 0, 0]` is `[-1, -5, 5, 1] / (8 dt)`. On SO3 with all control points
        equal, each of these numbers stands times the 3 x 3 identity.

        Args:
            t: as for `evaluate`, inside the domain. derivatives: 0 to 3.
            side: "left", [S20] (11), or "right": where the perturbation of control points stands, see `Jacobians`.
        Returns:
            Jacobians: for each derivative `(*batch, N, k, D, D)`, and `first`, `(*batch, N)`. A scalar time drops N.
            Plain numbers on the CPU, without a graph.
        Raises:
            TypeError, ValueError: as `evaluate`; also for control points that are not on the CPU.
        """
        _check_derivatives(derivatives)
        checks.choice("side", side, ("left", "right"))
        start, spacing = _knots(t, self.dt, 0.0 if self.t0 is None else self.t0, self.dt_ns, self.t0_ns)
        _check_times(t, self.control_points)
        if self.control_points.device.type != "cpu":
            raise ValueError(
                f"control_points: expected them on the CPU, got {self.control_points.device}; "
                "use .to('cpu').jacobians(...)"
            )
        _check_values(self.control_points, self.group)
        with torch.no_grad():
            points, times, shape = _align(self.control_points, t)
            if times.dtype != torch.int64:
                checks.finite("t", times)
            place = locate(times, start, spacing, points.shape[-2] - self.order + 1, "error", True)
            seconds = spacing * unit_of(times)
            result = bspline_jacobians(
                points, place.segment, place.u, self.group, self.order, float(seconds), derivatives, side
            )
        rank = len(points.shape[:-2]) + 1
        return Jacobians(*(None if x is None else x.reshape((*shape, *x.shape[rank:])) for x in result))  # type: ignore[arg-type]

    def extra_repr(self) -> str:
        unit = "s" if self.dt_ns is None else "ns"
        start, end = ("?", "?") if self.control_points.is_meta else self.domain
        batch, points = tuple(self.control_points.shape[:-2]), self.control_points.shape[-2]
        return f"{self.group}, order={self.order}, batch={batch}, points={points}, domain=[{start}, {end}] {unit}"


class SplitBSpline(BSpline):
    """A B-spline of split poses `[x, y, z, qw, qx, qy, qz]`: position in R3 and rotation in SO3, interpolated apart.

    [S20] finds no advantage in SE(3), and [H18] recommends the split: this is `BSpline` on the group `R3xSO3`.
    """

    def __init__(self, control_points: Tensor, **options: Any):
        super().__init__(control_points, group=product(R3, SO3), **options)
