"""The keyframes of [H18]: its Table 1, and the poses of its Figures 5 and 6."""

import math

import torch
from torch import Tensor

from torchspline import SO3

DOUBLE = torch.float64

#: Table 1: rotation angle and axis, which need not have length one.
TABLE_1 = (
    (1.0, (1, 3, 0)),
    (1.9, (-1, 0, 0)),
    (0.0, (-2, 1, 0)),
    (-2.0, (3, 4, 0)),
    (-1.0, (-1, 4, 0)),
    (1.0, (2, 3, 0)),
)


def table_1() -> tuple[Tensor, Tensor]:
    """Quaternions (6, 4) and times: one key a second."""
    vectors = []
    for angle, axis in TABLE_1:
        direction = torch.tensor(axis, dtype=DOUBLE)
        vectors.append(angle * direction / direction.norm())
    return SO3.exp(torch.stack(vectors)), torch.arange(6, dtype=DOUBLE)


def about_x(angle: float, position: tuple[float, float, float]) -> Tensor:
    """A pose in the y-z plane."""
    q = [math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0]
    return torch.tensor([*position, *q], dtype=DOUBLE)


def figure_5() -> tuple[Tensor, Tensor]:
    """Two poses exactly pi apart, the short way about +x on purpose: the positive tie of the library."""
    poses = [about_x(-math.pi / 2, (0, 0, -1)), about_x(math.pi / 2, (0, 0, 1))]
    return torch.stack(poses), torch.tensor([0.0, 1.0], dtype=DOUBLE)


def figure_6() -> tuple[Tensor, Tensor]:
    """Four poses: those of Figure 5 at the ends."""
    poses = [
        about_x(-math.pi / 2, (0, 0, -1)),
        about_x(-math.pi / 2, (0, 0.8, -0.5)),
        about_x(-math.pi / 4, (0, 0, 0)),
        about_x(math.pi / 2, (0, 0, 1)),
    ]
    return torch.stack(poses), torch.arange(4, dtype=DOUBLE)
