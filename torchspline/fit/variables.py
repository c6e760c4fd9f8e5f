"""Unknowns besides the trajectory: biases, gravity, extrinsics, time offsets, landmarks."""

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline import checks
from torchspline.groups.group import Group

Array = NDArray[Any]


class Variable:
    """An unknown of a least-squares problem, or several of a kind, such as all landmarks of a map.

    Args:
        name: what results and reports call it; unique within a problem.
        value: where to start, `(n,)`, or `(L, n)` for L unknowns of which each measurement sees one. Solving
            replaces it.
        group: the group it is a point of; None for plain numbers.
        sphere: whether the length of `value` is known and only its direction is not, as for gravity. Two degrees of
            freedom.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """

    def __init__(self, name: str, value: Tensor, *, group: Group | None = None, sphere: bool = False):
        checks.instance("name", name, str, "a name")
        checks.is_floating_tensor("value", value)
        if value.ndim not in (1, 2) or value.shape[-1] == 0:
            raise ValueError(f"value: expected shape (n,) or (L, n), got {tuple(value.shape)}")
        if group is not None:
            checks.instance("group", group, Group, "a torchspline.Group such as torchspline.SE3")
            checks.point("value", value, group, f"a point of {group}")
        checks.finite("value", value)
        if sphere:
            if group is not None or value.shape[-1] != 3:
                raise ValueError(
                    f"sphere: expected a value of three numbers and no group, got {tuple(value.shape)}, group {group}"
                )
            if not bool((value.detach().norm(dim=-1) > 0).all()):
                raise ValueError("value: expected a length above zero of a direction on a sphere, got 0")
        self.name, self.group, self.sphere = name, group, sphere
        self.value = value.detach().to("cpu", torch.float64).clone()
        #: Numbers that store one of them, and its degrees of freedom.
        self.size = value.shape[-1]
        self.dimension = group.tangent_size if group is not None else 2 if sphere else self.size

    def __repr__(self) -> str:
        kind = "sphere" if self.sphere else str(self.group or f"R{self.size}")
        return f"Variable({self.name!r}, {kind}, {self.value.tolist()})"

    # ------------------------------------------------------------------ what the solver does with one

    def points(self, value: Tensor) -> Tensor:
        """Unit representatives."""
        return value if self.group is None else self.group.normalize(value)

    def basis(self, value: Tensor) -> Tensor | None:
        """`(L, 3, 2)`: how a vector on the sphere moves with its two degrees of freedom; None where cotangents are
        already of those."""
        if not self.sphere:
            return None
        rows = value.reshape(-1, 3)
        axis = torch.nn.functional.one_hot(rows.abs().argmin(dim=-1), 3).to(rows)
        first = torch.linalg.cross(rows, axis)
        first = first / first.norm(dim=-1, keepdim=True)
        second = torch.linalg.cross(rows, first) / rows.norm(dim=-1, keepdim=True)
        return torch.stack([first, second], dim=-1) * rows.norm(dim=-1)[:, None, None]

    def retract(self, value: Tensor, step: Tensor) -> Tensor:
        """The value moved by a step `(L, dimension)` or `(dimension,)`."""
        step = step.reshape(*value.shape[:-1], self.dimension)
        if self.group is not None:
            return self.group.normalize(self.group.retract(value, step, side="right", validate=False))
        if self.sphere:
            basis = self.basis(value)
            assert basis is not None
            moved = value + (basis.reshape(*value.shape[:-1], 3, 2) @ step.unsqueeze(-1)).squeeze(-1)
            return moved * (value.norm(dim=-1, keepdim=True) / moved.norm(dim=-1, keepdim=True))
        return value + step
