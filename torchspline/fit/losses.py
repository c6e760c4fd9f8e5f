"""Robust losses: how much a residual of many standard deviations may cost.

Each is a function rho of s, the squared length of a weighted residual, with rho(0) = 0 and rho'(0) = 1, so that half
the sum of rho is the cost. Least squares weighs residuals by rho'(s), which grows smaller the farther out they lie.
"""

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from torchspline import checks


class Loss(ABC):
    """Args: scale: the length of a weighted residual, in standard deviations, from which on it counts as far out."""

    def __init__(self, scale: float):
        self.scale = checks.positive("scale", scale)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.scale:g})"

    @abstractmethod
    def rho(self, s: Tensor) -> Tensor:
        """rho(s)."""

    @abstractmethod
    def weight(self, s: Tensor) -> Tensor:
        """rho'(s)."""


class Huber(Loss):
    """Grows like the length itself beyond `scale`: outliers keep a constant pull. Convex."""

    def rho(self, s: Tensor) -> Tensor:
        c = self.scale
        return torch.where(s <= c * c, s, 2.0 * c * s.clamp_min(c * c).sqrt() - c * c)

    def weight(self, s: Tensor) -> Tensor:
        c = self.scale
        return torch.where(s <= c * c, 1.0, c / s.clamp_min(c * c).sqrt())


class Cauchy(Loss):
    """Grows like the logarithm: outliers hardly pull."""

    def rho(self, s: Tensor) -> Tensor:
        c2 = self.scale**2
        return c2 * torch.log1p(s / c2)

    def weight(self, s: Tensor) -> Tensor:
        return 1.0 / (1.0 + s / self.scale**2)


class GemanMcClure(Loss):
    """Bounded: far outliers do not pull at all."""

    def rho(self, s: Tensor) -> Tensor:
        return s / (1.0 + s / self.scale**2)

    def weight(self, s: Tensor) -> Tensor:
        return 1.0 / (1.0 + s / self.scale**2).square()
