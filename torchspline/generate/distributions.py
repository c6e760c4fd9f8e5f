"""Distributions that a configuration may name: `0.5`, `{uniform: [a, b]}`, `{normal: [mean, deviation]}`, ..."""

import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor


class Distribution(ABC):
    """Independent float64 numbers from a seeded generator."""

    @abstractmethod
    def sample(self, shape: Sequence[int], generator: torch.Generator) -> Tensor:
        """Numbers of the given shape."""

    @property
    @abstractmethod
    def support(self) -> tuple[float, float]:
        """The smallest and the largest number there can be."""


@dataclass(frozen=True)
class Constant(Distribution):
    value: float

    def sample(self, shape: Sequence[int], generator: torch.Generator) -> Tensor:
        return torch.full(tuple(shape), self.value, dtype=torch.float64)

    @property
    def support(self) -> tuple[float, float]:
        return self.value, self.value


@dataclass(frozen=True)
class Uniform(Distribution):
    least: float
    most: float

    def __post_init__(self) -> None:
        if not self.least <= self.most:
            raise ValueError(f"expected [least, most] in this order, got [{self.least}, {self.most}]")

    def sample(self, shape: Sequence[int], generator: torch.Generator) -> Tensor:
        share = torch.rand(tuple(shape), generator=generator, dtype=torch.float64)
        return self.least + (self.most - self.least) * share

    @property
    def support(self) -> tuple[float, float]:
        return self.least, self.most


@dataclass(frozen=True)
class LogUniform(Distribution):
    """Its logarithm is uniform: every decade is as likely as any other."""

    least: float
    most: float

    def __post_init__(self) -> None:
        if not 0.0 < self.least <= self.most:
            raise ValueError(
                f"expected [least, most] in this order and above zero, got [{self.least}, {self.most}]"
            )

    def sample(self, shape: Sequence[int], generator: torch.Generator) -> Tensor:
        share = torch.rand(tuple(shape), generator=generator, dtype=torch.float64)
        low, high = math.log(self.least), math.log(self.most)
        # exp(log(x)) is off by a rounding error: the ends are promised.
        return (low + (high - low) * share).exp().clamp(self.least, self.most)

    @property
    def support(self) -> tuple[float, float]:
        return self.least, self.most


@dataclass(frozen=True)
class Normal(Distribution):
    mean: float
    deviation: float

    def __post_init__(self) -> None:
        if not self.deviation >= 0.0:
            raise ValueError(
                f"expected [mean, standard deviation], the latter zero or more, got {self.deviation}"
            )

    def sample(self, shape: Sequence[int], generator: torch.Generator) -> Tensor:
        return self.mean + self.deviation * torch.randn(
            tuple(shape), generator=generator, dtype=torch.float64
        )

    @property
    def support(self) -> tuple[float, float]:
        # PyTorch makes normal numbers of 53 random bits: they end at sqrt(2 * 53 log 2) = 8.6.
        return self.mean - 9.0 * self.deviation, self.mean + 9.0 * self.deviation


class Choice(Distribution):
    """One of several numbers, each as likely as any other."""

    def __init__(self, *values: float):
        if not values:
            raise ValueError("expected at least one number, got none")
        self.values = values

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Choice) and self.values == other.values

    def __hash__(self) -> int:
        return hash(self.values)

    def sample(self, shape: Sequence[int], generator: torch.Generator) -> Tensor:
        which = torch.randint(len(self.values), tuple(shape), generator=generator)
        return torch.tensor(self.values, dtype=torch.float64)[which]

    @property
    def support(self) -> tuple[float, float]:
        return min(self.values), max(self.values)


_KINDS: dict[str, tuple[type[Distribution], int | None]] = {
    "uniform": (Uniform, 2),
    "log_uniform": (LogUniform, 2),
    "normal": (Normal, 2),
    "choice": (Choice, None),
}


class Parameter(NamedTuple):
    """A quantity that can be randomised: its unit, what it is drawn from unless told otherwise, its range.

    Of a quantity of several components (`size`), each is drawn on its own.
    """

    unit: str
    default: Distribution
    least: float = 0.0
    most: float = math.inf
    size: int | None = None
    meaning: str = ""

    def draw(self, distribution: Distribution, count: int, generator: torch.Generator) -> Tensor:
        """(count,) or (count, size)."""
        return distribution.sample((count,) if self.size is None else (count, self.size), generator)


def distribution_of(path: str, value: Any, parameter: Parameter) -> Distribution:
    """What a configuration says at the key `path` (such as "motions.drone.bandwidth"), within the parameter's range.

    Raises:
        TypeError, ValueError: with the key, what was expected and what came.
    """
    if isinstance(value, Mapping):
        if len(value) != 1 or (kind := next(iter(value))) not in _KINDS:
            raise ValueError(
                f"{path}: expected a number or one distribution out of {', '.join(_KINDS)}, got {dict(value)!r}"
            )
        make, count = _KINDS[kind]
        numbers = value[kind]
        here = f"{path}.{kind}"
        if not isinstance(numbers, Sequence) or isinstance(numbers, str):
            raise TypeError(f"{here}: expected a list of numbers, got {numbers!r}")
        for x in numbers:
            number_at(here, x)
        if count is not None and len(numbers) != count:
            raise ValueError(f"{here}: expected {count} numbers, got {len(numbers)}")
        try:
            found = make(*map(float, numbers))
        except ValueError as error:
            raise ValueError(f"{here}: {error}") from None
    else:
        found = Constant(number_at(path, value))
    low, high = found.support
    if low < parameter.least or high > parameter.most:
        raise ValueError(
            f"{path}: expected values from {parameter.least:g} to {parameter.most:g} {parameter.unit}".rstrip()
            + f", got {found} with values from {low:g} to {high:g}"
        )
    return found


def number_at(path: str, value: Any) -> float:
    """A finite number in a configuration; YAML 1.1 reads `1e-3`, without a point, as text."""
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            value = float(value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{path}: expected a number, got {value!r}")
    if not math.isfinite(value):
        raise ValueError(f"{path}: expected a finite number, got {value}")
    return float(value)
