"""What a residual is: a measurement of a trajectory, and how it moves with what it depends on.

A residual is written once, on tuples of components (`arithmetic/`), as a function and its hand-derived reverse; from
those two come the compiled loop, the reference on tensors, the rows of the Jacobian (the reverse of each unit vector)
and the graph that a differentiable optimum needs. A new residual is one file in `residuals/` and its name in their
`__init__`; the tests then compare its reverse with automatic differentiation unasked.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from torchspline import checks
from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.motion import MOTIONS
from torchspline.arithmetic.recurrence import MAX_DERIVATIVES
from torchspline.arithmetic.registry import arithmetic
from torchspline.arithmetic.vector import Vector
from torchspline.fit.losses import Loss
from torchspline.fit.variables import Variable
from torchspline.groups.group import Group
from torchspline.splines.bspline import BSpline

_WEIGHTS = ("sigma", "covariance", "information")
#: What may stand for an unknown: the unknown itself, a spline of it over time, or its known value.
Argument = Variable | BSpline | Tensor


class Slot(NamedTuple):
    """An argument of a residual besides the trajectory."""

    #: Numbers that store it.
    size: int
    #: The group it is a point of, whose body cotangents `reverse` gives; None for plain numbers.
    group: str | None
    #: What stands in for it if it is not given; None if it has to be.
    default: tuple[float, ...] | None


#: How a sensor sits on the body: its pose or rotation (sensor to body) and its position, by default those of the body.
POSE_IN_BODY = Slot(7, "SE3", (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
ROTATION_IN_BODY = Slot(4, "SO3", (1.0, 0.0, 0.0, 0.0))
LEVER_ARM = Slot(3, None, (0.0, 0.0, 0.0))


class Moment(NamedTuple):
    """The trajectory at one time: value, and as many rates as the residual asked for. Or cotangents of these, that of
    the value of a body tangent."""

    value: Vector
    rates: tuple[Vector, ...]


#: The arguments of a residual by slot, points of groups unit; and their cotangents, those of points body tangents.
Given = Mapping[str, Vector]
Cotangents = dict[str, Vector]


@dataclass(frozen=True, eq=False)
class Clock:
    """How the stamps of a sensor relate to the time of the trajectory.

    `t_sensor = t + offset + skew (t - mid) + delay late`. Measurements that the unknowns move out of the trajectory's
    domain take no part while they are there.

    Args:
        offset, skew: unknowns of one number each, s and s/s; in a `BatchProblem` one for each trajectory, (B, 1).
        mid: time of the trajectory at which the skew turns, in the unit of its times; by default the middle of its
            domain.
        delay: an unknown of one number, s, such as the line delay of a rolling shutter. late: by how many delays the
            stamp of each measurement comes late, (N,): minus the line it was seen on, if images bear the stamp of their
            first line, since later lines are exposed after it.
    Raises:
        TypeError, ValueError: a wrong type or shape, or one of `delay` and `late` without the other.
    """

    offset: Variable | None = None
    skew: Variable | None = None
    mid: float | int | None = None
    delay: Variable | None = None
    late: Tensor | None = None

    def __post_init__(self) -> None:
        for name in ("offset", "skew", "delay"):
            x = getattr(self, name)
            if x is None:
                continue
            checks.instance(name, x, Variable, "a torchspline.fit.Variable")
            if x.group is not None or x.size != 1:
                raise ValueError(f"{name}: expected a Variable of one number, shape (1,), got {x!r}")
        if self.mid is not None:
            checks.finite_number("mid", self.mid)
        if (self.delay is None) != (self.late is None):
            missing, there = ("delay", "late") if self.delay is None else ("late", "delay")
            raise ValueError(f"{missing}: got None; expected delay and late together, and {there} is there")
        if self.late is not None:
            checks.is_floating_tensor("late", self.late)
            if self.late.ndim != 1:
                raise ValueError(f"late: expected shape (N,), got {tuple(self.late.shape)}")
            checks.finite("late", self.late)

    @property
    def unknowns(self) -> tuple[Variable, ...]:
        """Offset, skew and delay, those that there are."""
        return tuple(x for x in (self.offset, self.skew, self.delay) if x is not None)


class Residual(ABC):
    """Measurements of one kind, N of them with R numbers each.

    Args:
        t: (N,) times, in seconds or int64 nanoseconds as the trajectory's; for residuals between two times (2, N).
        measured: (N, measured_size).
        sigma: standard deviation of what `evaluate` returns: a number, (R,), (N, 1) or (N, R).
        covariance: instead of sigma, (R, R) or (N, R, R).
        information: instead of both, the inverse of a covariance.
        loss: a robust loss, see `losses.py`.
        clock: how the sensor's times relate to those of the trajectory.
        name: what results call it; the default is the class's name.
        arguments: for each of `slots` a `Variable`, a spline of it, or its value, (n,) or (N, n) if each measurement
            has its own; what has a default may be missing.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """

    #: Numbers of a residual and of a measurement; None where the group decides, see `sizes`.
    rows: ClassVar[int | None]
    measured_size: ClassVar[int | None]
    #: How many rates it needs, and at how many times it looks at the trajectory.
    derivatives: ClassVar[int]
    moments: ClassVar[int] = 1
    #: Ranges of the components of what is measured that are quaternions.
    measured_signs: ClassVar[tuple[tuple[int, int], ...]] = ()
    slots: ClassVar[Mapping[str, Slot]] = {}
    #: Whether its loops are compiled; with very many operations tensors are quicker than waiting for that.
    compiled: ClassVar[bool] = True
    #: The `Term` that binds it to a problem, where that is not the common one.
    term: ClassVar[Any] = None

    def __init__(
        self,
        t: Tensor,
        measured: Tensor,
        *,
        sigma: Tensor | float | None = None,
        covariance: Tensor | None = None,
        information: Tensor | None = None,
        loss: Loss | None = None,
        clock: Clock | None = None,
        name: str | None = None,
        **arguments: Argument,
    ):
        self.name = name or type(self).__name__
        _check_measured(t, measured, self.moments)
        self.t, self.measured = t, measured
        if loss is not None:
            checks.instance("loss", loss, Loss, "a robust loss such as torchspline.fit.Huber(1.0)")
        if clock is not None:
            checks.instance("clock", clock, Clock, "a torchspline.fit.Clock")
            _check_clock(clock, t, len(measured), self.derivatives)
        self.loss, self.clock = loss, clock or Clock()
        self._weights = sigma, covariance, information
        self.weighting: tuple[str, Tensor | None] = ("sigma", None)
        if self.rows is not None and self.measured_size is not None:
            self._check_sizes(self.rows, self.measured_size, self.measured_signs)
        for slot in arguments:
            if slot not in self.slots:
                raise TypeError(
                    f"{slot}: {type(self).__name__} takes no such argument; it takes "
                    f"{', '.join(self.slots) or 'none besides the measurement'}"
                )
        # In the order of the slots, however they were given: one kernel for each set of them.
        self.arguments = {
            slot: _argument(slot, arguments[slot], kind, len(measured))
            for slot, kind in self.slots.items()
            if slot in arguments
        }
        for slot, (_, _, default) in self.slots.items():
            if slot not in arguments and default is None:
                raise TypeError(
                    f"{slot}: {type(self).__name__} needs a Variable, a spline or its value, got none"
                )

    def _check_sizes(self, rows: int, measured_size: int, signs: Sequence[tuple[int, int]]) -> None:
        count = self.measured.shape[0]
        if self.measured.shape[1] != measured_size:
            raise ValueError(
                f"measured: expected shape ({count}, {measured_size}), got {tuple(self.measured.shape)}"
            )
        checks.quaternions("measured", self.measured, signs)
        self.weighting = weighting_of(*self._weights, rows, count)

    def bind(self, group: Group) -> None:
        """Check that the residual makes sense on trajectories of this group; called by `Problem.add`."""
        self.check_group(group)
        rows, measured_size = self.sizes(group.arithmetic)
        if self.rows is None or self.measured_size is None:
            self._check_sizes(
                rows, measured_size, group.arithmetic.sign_blocks if measured_size == group.point_size else ()
            )

    @classmethod
    def sizes(cls, group: GroupArithmetic) -> tuple[int, int]:
        """`rows` and `measured_size` on a group."""
        assert cls.rows is not None
        assert cls.measured_size is not None
        return cls.rows, cls.measured_size

    @classmethod
    def check_group(cls, group: Group) -> None:
        """An error if the residual makes no sense on trajectories of this group; by default it needs a rigid body."""
        needs(cls.__name__, group, rotates=True, moves=True)

    @abstractmethod
    def evaluate(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Given, measured: Vector
    ) -> Vector:
        """The residual, R components, not weighted. `given` holds points of groups as unit ones."""

    @abstractmethod
    def reverse(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Given, measured: Vector, g: Vector
    ) -> tuple[list[Moment], Cotangents]:
        """Cotangents of what the residual depends on, from its own: a moment for each of `at`, and those of `given`."""

    def __len__(self) -> int:
        return self.measured.shape[0]

    def __repr__(self) -> str:
        return f"{self.name}({len(self)} measurements)"


def needs(name: str, group: Group, rotates: bool = False, moves: bool = False) -> None:
    """An error unless trajectories of the group are motions that rotate, or move, or both."""
    mechanics = MOTIONS.get(group.name)
    if mechanics is None or (rotates and not mechanics.rotates) or (moves and not mechanics.moves):
        fitting = [n for n, m in MOTIONS.items() if (m.rotates or not rotates) and (m.moves or not moves)]
        raise ValueError(f"{name}: expected a trajectory in {', '.join(fitting)}, got {group}")


def _check_measured(t: Tensor, measured: Tensor, moments: int) -> None:
    if not isinstance(t, Tensor):
        raise TypeError(
            f"t: expected a torch.Tensor, got {type(t).__name__}; convert it with torch.as_tensor"
        )
    if t.dtype not in (torch.float64, torch.int64):
        raise TypeError(f"t: expected float64 seconds or int64 nanoseconds, got {t.dtype}")
    checks.is_floating_tensor("measured", measured)
    expected = "(N,)" if moments == 1 else f"({moments}, N)"
    if t.ndim != (1 if moments == 1 else 2) or (moments > 1 and t.shape[0] != moments):
        raise ValueError(f"t: expected shape {expected}, got {tuple(t.shape)}")
    if measured.ndim != 2 or measured.shape[0] != t.shape[-1]:
        raise ValueError(
            f"measured: expected shape (N, ...) with N = {t.shape[-1]} times, got {tuple(measured.shape)}"
        )
    if t.dtype != torch.int64:
        checks.finite("t", t)
    checks.finite("measured", measured)


def weighting_of(
    sigma: Any, covariance: Tensor | None, information: Tensor | None, rows: int, count: int
) -> tuple[str, Tensor | None]:
    """Which of the three was given, checked, and its tensor; ("sigma", None) stands for one."""
    given = [(n, x) for n, x in (("covariance", covariance), ("information", information)) if x is not None]
    if len(given) + (sigma is not None) > 1:
        raise ValueError("sigma, covariance, information: expected one of them, got several")
    if not given:
        if sigma is None:
            return "sigma", None
        if not isinstance(sigma, Tensor):
            sigma = torch.tensor(checks.positive("sigma", sigma), dtype=torch.float64)
        checks.is_floating_tensor("sigma", sigma)
        checks.finite("sigma", sigma)
        if tuple(sigma.shape) not in ((), (rows,), (count, 1), (count, rows)):
            raise ValueError(
                f"sigma: expected a number or shape ({rows},), ({count}, 1) or ({count}, {rows}), "
                f"got {tuple(sigma.shape)}"
            )
        if not bool((sigma.detach() > 0).all()):
            raise ValueError(
                "sigma: expected standard deviations above zero; leave measurements out, or give them a large one"
            )
        return "sigma", sigma
    name, x = given[0]
    checks.is_floating_tensor(name, x)
    if tuple(x.shape) not in ((rows, rows), (count, rows, rows)):
        raise ValueError(
            f"{name}: expected shape ({rows}, {rows}) or ({count}, {rows}, {rows}), got {tuple(x.shape)}"
        )
    checks.finite(name, x)
    matrix = x.detach().to(torch.float64)
    scale = matrix.abs().amax(dim=(-1, -2), keepdim=True)
    if bool(((matrix - matrix.mT).abs() > 1e-9 * scale).any()):
        raise ValueError(f"{name}: expected symmetric matrices")
    failed = torch.linalg.cholesky_ex(matrix).info != 0
    if bool(failed.any()):
        where = torch.nonzero(failed.reshape(-1))[0].item()
        raise ValueError(f"{name}: expected positive definite matrices, the one at index {where} is not")
    return name, x


def set_weighting(residual: Residual, kind: str, x: Tensor | None) -> None:
    """Give a residual another weight, one that `weighting_of` would find good."""
    residual.weighting = kind, x
    sigma, covariance, information = (x if kind == name else None for name in _WEIGHTS)
    residual._weights = sigma, covariance, information


def square_root_information(weighting: tuple[str, Tensor | None]) -> Tensor | None:
    """W with W^T W the information: None for one, factors (...,) or (..., R), or matrices (..., R, R)."""
    kind, x = weighting
    if x is None:
        return None
    x = x.to(torch.float64)
    if kind == "sigma":
        return 1.0 / x
    if kind == "information":
        return torch.linalg.cholesky(x).mT
    factor = torch.linalg.cholesky(x)
    return torch.linalg.solve_triangular(
        factor, torch.eye(x.shape[-1], dtype=x.dtype).expand_as(x), upper=False
    )


def _check_clock(clock: Clock, t: Tensor, count: int, derivatives: int) -> None:
    if t.dtype == torch.int64 and isinstance(clock.mid, float):
        raise TypeError(f"clock: with int64 times, mid is a whole number of nanoseconds, got {clock.mid!r}")
    if clock.late is not None and clock.late.shape != (count,):
        raise ValueError(f"clock: expected late of shape ({count},), got {tuple(clock.late.shape)}")
    if clock.unknowns and derivatives >= MAX_DERIVATIVES:
        raise ValueError(
            f"clock: a residual of the derivative number {derivatives} moves with time by the next one, which splines "
            "do not give; got unknowns of time, expected none"
        )


def _argument(name: str, x: Any, slot: Slot, count: int) -> Argument:
    if isinstance(x, Variable):
        group = x.group.name if x.group is not None else None
        if x.size != slot.size or group != slot.group:
            raise ValueError(
                f"{name}: expected a Variable of {slot.group or f'{slot.size} numbers'}, got {x!r}"
            )
    elif isinstance(x, BSpline):
        if slot.group is not None or x.group.name != f"R{slot.size}":
            raise ValueError(
                f"{name}: expected a spline in R{slot.size}, got one in {x.group} of shape "
                f"{tuple(x.control_points.shape)}"
            )
    elif isinstance(x, Tensor):
        checks.is_floating_tensor(name, x)
        if x.shape not in ((slot.size,), (count, slot.size)):
            raise ValueError(
                f"{name}: expected shape ({slot.size},) or ({count}, {slot.size}), got {tuple(x.shape)}"
            )
        checks.finite(name, x)
        if slot.group is not None:
            checks.quaternions(name, x, arithmetic(slot.group).sign_blocks)
    else:
        raise TypeError(f"{name}: expected a Variable, a BSpline or a tensor, got {type(x).__name__}")
    return x
