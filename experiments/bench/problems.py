"""What the contenders compute: splines of given size, the same numbers for everybody."""

import importlib
from dataclasses import dataclass
from functools import cache, lru_cache
from types import ModuleType

import torch
from torch import Tensor

from torchspline import Group, use_kernels

DT = 0.1  # seconds between knots
PEERS = {"pypose": "PyPose", "roma": "roma", "jax": "JAX", "jaxlie": "jaxlie"}


class UnavailableError(Exception):
    """A contender cannot take part; says why."""


@cache
def peer(module: str) -> ModuleType:
    """An optional library."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        reason = f"{PEERS[module]} cannot be imported ({error}); pip install 'torchspline[bench]'"
        raise UnavailableError(reason) from None


@dataclass(frozen=True)
class Problem:
    """A uniform B-spline, queried.

    Args:
        queries: times of each trajectory; all trajectories of a batch share them.
        batch: trajectories, 0 for one without a batch dimension.
        backward: whether the gradients of control points and times are wanted, too.
        ordered: whether the times are sorted.
        threads: for contenders that let themselves be told.
    """

    queries: int
    points: int = 1000
    group: str = "SO3"
    order: int = 4
    derivatives: int = 2
    batch: int = 0
    dtype: str = "float64"
    backward: bool = False
    ordered: bool = True
    threads: int = 1

    @property
    def total(self) -> int:
        return self.queries * max(self.batch, 1)

    @property
    def real(self) -> torch.dtype:
        return getattr(torch, self.dtype)

    @property
    def segments(self) -> int:
        return self.points - self.order + 1

    @property
    def sizes(self) -> list[int]:
        """Numbers a query has in the value and in each derivative."""
        group = Group(self.group)
        return [group.point_size, *[group.tangent_size] * self.derivatives]

    def control_points(self) -> Tensor:
        """`(M, P)` or `(batch, M, P)`: neighbours about half a radian apart, quaternions of continuous sign."""
        points = _control_points(self.group, self.points, self.batch).to(self.real)
        return points.detach() if self.batch else points[0].detach()

    def times(self) -> Tensor:
        """`(N,)`, seconds, over the whole domain."""
        return _times(self.queries, self.segments, self.ordered).detach()

    def cotangents(self) -> list[Tensor]:
        """One for the value and each derivative; derivatives are large, and weigh less."""
        generator = torch.Generator().manual_seed(1)
        batch = (self.batch,) if self.batch else ()
        return [
            DT**r * torch.randn(*batch, self.queries, size, generator=generator, dtype=self.real)
            for r, size in enumerate(self.sizes)
        ]


# The last few, since all contenders want the same; nobody writes to them.
@lru_cache(4)
def _control_points(group_name: str, points: int, batch: int) -> Tensor:
    group = Group(group_name)
    trajectory = torch.arange(max(batch, 1), dtype=torch.float64).reshape(-1, 1, 1)
    place = torch.arange(points, dtype=torch.float64).reshape(-1, 1)
    axis = torch.arange(group.tangent_size, dtype=torch.float64)
    tangents = 1.4 * torch.sin((0.2 + 0.03 * axis) * place + axis + 0.7 * trajectory)
    with use_kernels("reference"):
        return group.exp(tangents)


@lru_cache(2)
def _times(queries: int, segments: int, ordered: bool) -> Tensor:
    generator = torch.Generator().manual_seed(queries)
    times = segments * DT * torch.rand(queries, generator=generator, dtype=torch.float64)
    return times.sort().values if ordered else times
