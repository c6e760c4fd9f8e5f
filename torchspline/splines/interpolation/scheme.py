"""What an interpolation scheme has to say; a new one is a module beside this one and a line in `registry.py`."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from torch import Tensor

from torchspline.arithmetic import jet
from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.jet import Jet
from torchspline.arithmetic.vector import Vector
from torchspline.groups.components import join, split
from torchspline.groups.group import Group


@dataclass(frozen=True)
class Properties:
    """What holds for keys in general position; every field is verified numerically by the tests."""

    #: Whether the curve meets every key, or only comes near.
    interpolates: bool
    #: Number of derivatives by time that are continuous at keys; None: all, there is one segment.
    continuity: int | None
    #: How many keys before and after a segment's own two it depends on: local control; None: all of them.
    reach: int | None
    #: Derivatives by time available, one-sided where they jump.
    derivatives: int = 3


class Scheme(ABC):
    """A curve made of segments between keys. Keys come unit, in the signs that are meant: where neighbours lie on
    different sides of the double cover the long way round is."""

    properties: Properties
    #: Fewest keys.
    least = 2
    #: Options by name, their values, the default first.
    options: Mapping[str, tuple[str, ...]] = MappingProxyType({})

    def segments(self, times: Tensor) -> Tensor:
        """Times of the ends of segments, from those of the keys."""
        return times

    @abstractmethod
    def table(self, group: Group, keys: Tensor, times: Tensor, **options: str) -> Tensor:
        """What each segment needs, `(*batch, S, C)`, from keys (*batch, M, P) and times (M,)."""

    @abstractmethod
    def fields(self, group: Group, rows: Tensor, u: Tensor, derivatives: int) -> tuple[Tensor, ...]:
        """Value and rates by u, in [0, 1], from rows (*batch, n, C) of the table and u (n,) or (*batch, n)."""


class CurveScheme(Scheme):
    """A scheme that is written as group operations; power series for u give its rates."""

    @abstractmethod
    def point(self, group: GroupArithmetic, row: Vector, u: Jet) -> Vector:
        """The curve's stored numbers, of any length, as jets."""

    def fields(self, group: Group, rows: Tensor, u: Tensor, derivatives: int) -> tuple[Tensor, ...]:
        algebra = group.arithmetic
        u = u.expand(rows.shape[:-1])
        stored = self.point(algebra, split(rows), jet.variable(u, derivatives))
        value = algebra.normalize(jet.values(stored, 0))
        return tuple(join(x, rows) for x in (value, *jet.rates(algebra, stored, derivatives)))
