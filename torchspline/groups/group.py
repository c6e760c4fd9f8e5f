"""Lie groups on tensors: batched, broadcasting, in the dtype and on the device of their arguments."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchspline import checks
from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.registry import arithmetic
from torchspline.groups.components import join, split
from torchspline.groups.operations import run

Side = Literal["left", "right"]


@dataclass(frozen=True)
class Group:
    """A Lie group by name: "SO3", "SE3", "DualQuaternion", "SO2", "SE2", `"R<n>"`, or a product such as "R3xSO3".

    Points are tensors `(..., point_size)`, tangents `(..., tangent_size)`, [v, omega] in m and rad; leading dimensions
    broadcast. Every method is differentiable in its tensors to any order, forwards and backwards; `log`,
    `interpolate` and what is built on them jump where a rotation is by exactly pi. Quaternions are [w, x, y, z] and may
    have any length from 1e-15 to 1e15: no function depends on it, and gradients are orthogonal to them. Methods
    raise `TypeError` for a wrong dtype or type and `ValueError` for a wrong shape, device or value (values are
    looked at on the CPU only).
    Examples:
        >>> import torch
        >>> start, end = SE3.identity(), torch.tensor([1.0, 0, 0, 0, 0, 0, 1], dtype=torch.float64)
        >>> SE3.log(SE3.between(start, end))[3:].norm().item()  # half a turn
        3.141592653589793
        >>> SE3.interpolate(start, end, torch.tensor(0.5, dtype=torch.float64)).shape
        torch.Size([7])
        >>> product(R3, SO3).tangent_size
        6
    """

    name: str

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise TypeError(f"group: expected a name such as 'SO3', got {type(self.name).__name__}")
        arithmetic(self.name)

    @property
    def arithmetic(self) -> GroupArithmetic:
        return arithmetic(self.name)

    @property
    def point_size(self) -> int:
        """Numbers that store a point."""
        return self.arithmetic.point_size

    @property
    def tangent_size(self) -> int:
        """Dimension of the tangent space."""
        return self.arithmetic.tangent_size

    def __str__(self) -> str:
        return self.name

    # ------------------------------------------------------------------ making points

    def identity(
        self, *batch: int, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
    ) -> Tensor:
        """The neutral element, `(*batch, point_size)`."""
        _new(batch, dtype)
        element = torch.tensor(self.arithmetic.identity(), dtype=dtype, device=device)
        return element.expand(*batch, self.point_size).clone()

    def random(
        self,
        *batch: int,
        generator: torch.Generator | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Random points `(*batch, point_size)`: rotations uniform, translations standard normal."""
        _new(batch, dtype)
        if generator is not None:
            checks.instance("generator", generator, torch.Generator, "a torch.Generator")
        numbers = torch.randn(*batch, self.point_size, generator=generator, dtype=dtype, device=device)
        return join(self.arithmetic.sample(split(numbers)), numbers)

    def from_matrix(self, matrix: Tensor) -> Tensor:
        """Points `(..., point_size)` of (homogeneous) matrices `(..., n, n)`; differentiable at half-turns too.

        Raises:
            ValueError: a rotation block is off by more than 1e-3.
        """
        size = self.arithmetic.matrix_size
        checks.is_floating_tensor("matrix", matrix)
        if matrix.ndim < 2 or matrix.shape[-2:] != (size, size):
            raise ValueError(
                f"matrix: expected shape (..., {size}, {size}) for {self}, got {tuple(matrix.shape)}"
            )
        checks.finite("matrix", matrix)
        rows = tuple(split(row.unsqueeze(-2)) for row in matrix.unbind(-2))
        points = join(self.arithmetic.from_matrix(rows), matrix[..., :1, :]).squeeze(-2)
        back = self.to_matrix(points.detach(), validate=False)
        checks.close_matrices("matrix", matrix, back, 1e-3)
        return points

    # ------------------------------------------------------------------ operations with curvature

    def exp(self, tangent: Tensor, *, validate: bool = True) -> Tensor:
        """Exp: tangents `(..., tangent_size)` to points, [S20] (1). Any angle; smooth everywhere."""
        return self._operate("exp", validate, tangent=(tangent, "tangent"))

    def log(self, point: Tensor, *, validate: bool = True) -> Tensor:
        """Log: the shortest tangent whose `exp` is the point, [S20] (2).

        At a rotation by exactly pi both ways round are as short; the first non-zero component is then positive,
        and the gradient is that of this side.
        """
        return self._operate("log", validate, point=(point, "point"))

    def compose(self, left: Tensor, right: Tensor, *, validate: bool = True) -> Tensor:
        """The product `left right`: with poses, first `right` then `left` acts on a point."""
        return self._operate("compose", validate, left=(left, "point"), right=(right, "point"))

    def inverse(self, point: Tensor, *, validate: bool = True) -> Tensor:
        """The inverse element."""
        return self._operate("inverse", validate, point=(point, "point"))

    def act(self, point: Tensor, vector: Tensor, *, validate: bool = True) -> Tensor:
        """`point` applied to vectors `(..., act_size)`: SO3 rotates, SE3 rotates and shifts, R^n shifts.

        A direct product acts on the vectors of its factors side by side: `R3xSO3` takes six numbers.
        """
        return self._operate("act", validate, point=(point, "point"), vector=(vector, "vector"))

    def interpolate(self, start: Tensor, end: Tensor, s: Tensor | float, *, validate: bool = True) -> Tensor:
        """The geodesic `start Exp(s Log(start^-1 end))`, [H18] (14); beyond 0 and 1 it goes on.

        Args:
            s: a number, or a tensor whose shape broadcasts with the batch shape of the points.
        """
        self._accept(validate, start=(start, "point"), end=(end, "point"))
        weight = self._weight("s", s, validate, start=start, end=end)
        return run("interpolate", self.name, start, end, weight)

    # ------------------------------------------------------------------ compositions of these

    def power(self, point: Tensor, exponent: Tensor | float, *, validate: bool = True) -> Tensor:
        """`Exp(exponent Log(point))`: -1 is the inverse, 0.5 the square root on the shortest geodesic, [H18] (24).

        Args:
            exponent: a number, or a tensor whose shape broadcasts with the batch shape of the points.
        """
        self._accept(validate, point=(point, "point"))
        weight = self._weight("exponent", exponent, validate, point=point)
        one = point.new_tensor(self.arithmetic.identity())
        return run("interpolate", self.name, one, point, weight)

    def between(self, start: Tensor, end: Tensor, *, validate: bool = True) -> Tensor:
        """`start^-1 end`, the end as seen from the start."""
        self._accept(validate, start=(start, "point"), end=(end, "point"))
        return run("compose", self.name, run("inverse", self.name, start), end)

    def retract(
        self, point: Tensor, tangent: Tensor, *, side: Side = "left", validate: bool = True
    ) -> Tensor:
        """A step from `point`: `Exp(tangent) point` (left, [S20] (11)) or `point Exp(tangent)` (right)."""
        checks.choice("side", side, ("left", "right"))
        self._accept(validate, point=(point, "point"), tangent=(tangent, "tangent"))
        step = run("exp", self.name, tangent)
        pair = (step, point) if side == "left" else (point, step)
        return run("compose", self.name, *pair)

    # ------------------------------------------------------------------ linear maps
    # Components get a dimension of their own (`unsqueeze`): with none at all, as inside `vmap`, PyTorch's forward
    # mode makes float64 of the float32 product of a number and a tensor.

    def normalize(self, point: Tensor, *, validate: bool = True) -> Tensor:
        """The unit representative: quaternions are scaled to length one, their sign stays."""
        self._accept(validate, point=(point, "point"))
        stored = point.unsqueeze(-2)
        return join(self.arithmetic.normalize(split(stored)), stored).squeeze(-2)

    def adjoint(self, point: Tensor, *, validate: bool = True) -> Tensor:
        """The matrix of Ad_X, [S20] (3), (4): `X Exp(v) = Exp(Ad_X v) X`. `(..., D, D)`."""
        self._accept(validate, point=(point, "point"))
        X = self.arithmetic.normalize(split(point.unsqueeze(-2)))
        return self._matrix(lambda v: self.arithmetic.adjoint(X, v), point)

    def adjoint_act(self, point: Tensor, tangent: Tensor, *, validate: bool = True) -> Tensor:
        """Ad_X v without forming the matrix."""
        self._accept(validate, point=(point, "point"), tangent=(tangent, "tangent"))
        batch = torch.broadcast_shapes(point.shape[:-1], tangent.shape[:-1])
        v = tangent.expand(*batch, self.tangent_size).unsqueeze(-2)
        X = self.arithmetic.normalize(split(point.unsqueeze(-2)))
        return join(self.arithmetic.adjoint(X, split(v)), v).squeeze(-2)

    def bracket(self, a: Tensor, b: Tensor, *, validate: bool = True) -> Tensor:
        """The Lie bracket `[a, b] = ad_a b` of tangents; corrects [S20] (6), which should read V W - W V."""
        self._accept(validate, a=(a, "tangent"), b=(b, "tangent"))
        a, b = torch.broadcast_tensors(a, b)
        return join(self.arithmetic.bracket(split(a), split(b)), a)

    def left_jacobian(self, tangent: Tensor, *, validate: bool = True) -> Tensor:
        """J_l `(..., D, D)`: `Exp(x + v) = Exp(J_l(x) v) Exp(x)` to first order."""
        return self._jacobian("left_jacobian", tangent, validate)

    def right_jacobian(self, tangent: Tensor, *, validate: bool = True) -> Tensor:
        """J_r `(..., D, D)`, [S20] (8), (10), (72): `Exp(x + v) = Exp(x) Exp(J_r(x) v)` to first order."""
        return self._jacobian("right_jacobian", tangent, validate)

    def left_jacobian_inverse(self, tangent: Tensor, *, validate: bool = True) -> Tensor:
        """J_l^-1 `(..., D, D)`; infinite where the angle is a multiple of 2 pi other than 0."""
        return self._jacobian("left_jacobian_inverse", tangent, validate)

    def right_jacobian_inverse(self, tangent: Tensor, *, validate: bool = True) -> Tensor:
        """J_r^-1 `(..., D, D)`, [S20] (9), (73); infinite where the angle is a multiple of 2 pi other than 0."""
        return self._jacobian("right_jacobian_inverse", tangent, validate)

    def to_matrix(self, point: Tensor, *, validate: bool = True) -> Tensor:
        """The matrix: 3x3 for SO3, homogeneous 4x4 for SE3, block diagonal for products."""
        self._accept(validate, point=(point, "point"))
        stored = point.unsqueeze(-2)
        rows = self.arithmetic.to_matrix(self.arithmetic.normalize(split(stored)))
        return torch.cat([join(row, stored) for row in rows], dim=-2)

    # ------------------------------------------------------------------ helpers

    def _weight(self, name: str, s: Tensor | float, validate: bool, **points: Tensor) -> Tensor:
        """The argument `name`, a number for each point, with a dimension for the components."""
        first_name, first = next(iter(points.items()))
        if not isinstance(s, Tensor):
            checks.number(name, s)
            s = torch.as_tensor(s, dtype=first.dtype, device=first.device)
        checks.is_floating_tensor(name, s)
        checks.same_kind(**{first_name: first, name: s})
        checks.broadcast(**{n: x.shape[:-1] for n, x in points.items()}, **{name: s.shape})
        if validate:
            checks.finite(name, s)
        return s.unsqueeze(-1)

    def _jacobian(self, kind: str, tangent: Tensor, validate: bool) -> Tensor:
        self._accept(validate, tangent=(tangent, "tangent"))
        x = split(tangent.unsqueeze(-2))
        return self._matrix(lambda v: getattr(self.arithmetic, kind)(x, v), tangent)

    def _matrix(self, linear, like: Tensor) -> Tensor:
        """The matrix of a linear map of tangents: its action on all unit vectors at once, as columns."""
        size = self.tangent_size
        unit_vectors = torch.eye(size, dtype=like.dtype, device=like.device)
        unit_vectors = unit_vectors.expand(*like.shape[:-1], size, size)
        return join(linear(split(unit_vectors)), unit_vectors).mT

    def _operate(self, operation: str, validate: bool, **arguments: tuple[Tensor, str]) -> Tensor:
        self._accept(False, **arguments)
        check = (lambda: self._check_values(arguments)) if validate else None
        return run(operation, self.name, *(x for x, _ in arguments.values()), check=check)

    def _accept(self, validate: bool, **arguments: tuple[Tensor, str]) -> None:
        """Check type, dtype, shape, device and, unless told not to, values of the named arguments."""
        sizes = {
            "point": (self.point_size, f"a point of {self}"),
            "tangent": (self.tangent_size, f"a tangent of {self}"),
            "vector": (self.arithmetic.act_size, f"a vector that {self} acts on"),
        }
        for name, (x, kind) in arguments.items():
            checks.is_floating_tensor(name, x)
            checks.has_last(name, x, *sizes[kind])
        checks.same_kind(**{name: x for name, (x, _) in arguments.items()})
        checks.broadcast(**{name: x.shape[:-1] for name, (x, _) in arguments.items()})
        if validate:
            self._check_values(arguments)

    def _check_values(self, arguments: dict[str, tuple[Tensor, str]]) -> None:
        for name, (x, kind) in arguments.items():
            checks.finite(name, x)
            if kind == "point":
                checks.quaternions(name, x, self.arithmetic.unit_blocks)


def _new(batch: tuple[int, ...], dtype: torch.dtype) -> None:
    """Check what new points shall be like."""
    for size in batch:
        checks.whole("batch", size, least=0)
    if dtype not in (torch.float32, torch.float64):
        raise TypeError(f"dtype: expected torch.float32 or torch.float64, got {dtype}")


SO2 = Group("SO2")
SE2 = Group("SE2")
SO3 = Group("SO3")
SE3 = Group("SE3")
DualQuaternion = Group("DualQuaternion")
R3 = Group("R3")


def Rn(size: int) -> Group:
    """R^n under addition."""
    checks.whole("size", size, least=1)
    return Group(f"R{size}")


def product(*groups: Group) -> Group:
    """The direct product; `product(R3, SO3)` is the split pose."""
    if len(groups) < 2:
        raise ValueError(f"groups: expected at least two, got {len(groups)}")
    for group in groups:
        checks.instance("groups", group, Group, "torchspline.Groups such as torchspline.SO3")
    return Group("x".join(group.name for group in groups))
