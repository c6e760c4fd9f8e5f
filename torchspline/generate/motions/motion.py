"""What every kind of random motion answers, and what they are built from."""

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cache
from typing import ClassVar

import torch
from torch import Tensor

from torchspline.generate.distributions import Distribution, Parameter
from torchspline.groups import R3, SO3
from torchspline.imu.scan import rotation_products
from torchspline.kernels.mode import use_kernels
from torchspline.splines.bspline import bspline

#: Of the splines that motions are made of: C4, so that the jerk of a motion is smooth.
ORDER = 6
#: Highest frequency of a motion times the knot spacing: a spline of order 6 keeps sinc(0.1)^6 = 90 % of it there.
MOST_CYCLES_PER_KNOT = 0.1
STANDARD_GRAVITY = 9.80665


class Motion(ABC):
    """A family of random motions, as the poses that the control points of a split B-spline take.

    To add one, write a module with a subclass and name it in `motions/__init__.py`.
    """

    name: ClassVar[str]
    parameters: ClassVar[Mapping[str, Parameter]]

    @abstractmethod
    def poses(
        self, tau: Tensor, spacing: float, drawn: Mapping[str, Tensor], generator: torch.Generator
    ) -> Tensor:
        """Poses `[x, y, z, qw, qx, qy, qz]`, body to world, (B, M, 7): z of the world points up.

        Args:
            tau: time as the motion counts it, (B, M) s: 0 while it rests, slower while it starts.
            spacing: of the control points in real time, s.
            drawn: a value of each parameter for each item, (B,).
        """

    @abstractmethod
    def highest_frequency(self, drawn: Mapping[str, Tensor]) -> Tensor:
        """Hz, above which there is hardly anything, (B,)."""

    @classmethod
    def check(cls, path: str, chosen: Mapping[str, Distribution], spacing: float) -> None:
        """That the knots are close enough for the fastest motion that can be drawn."""
        ends = [chosen[name].support for name in cls.parameters]
        corners = torch.tensor(list(itertools.product(*ends)), dtype=torch.float64)
        drawn = dict(zip(cls.parameters, corners.unbind(-1), strict=True))
        highest = cls().highest_frequency(drawn).max().item()
        if highest * spacing > MOST_CYCLES_PER_KNOT * (1 + 1e-9):
            raise ValueError(
                f"{path}: frequencies reach {highest:.4g} Hz, but knots {spacing:g} s apart carry "
                f"{MOST_CYCLES_PER_KNOT / spacing:.4g} Hz; "
                f"expected a slower motion or a knot_spacing of at most {MOST_CYCLES_PER_KNOT / highest:.3g} s"
            )


def smooth_curve(tau: Tensor, bandwidth: Tensor, generator: torch.Generator, rate: int) -> Tensor:
    """A stationary random curve in R^3, (B, M, 3), whose `rate`-th derivative has an RMS of one in each axis.

    A B-spline of order 6 with independent normal control points 1 / (2 bandwidth) apart: the power of its
    curve at f Hz is that of sinc^12(f / (2 bandwidth)), 24 dB down at the bandwidth.

    Args:
        tau: s, (B, M). bandwidth: Hz, (B,).
    """
    u = tau * (2.0 * bandwidth)[:, None]
    count = math.ceil(u.max().item()) + ORDER
    points = torch.randn(len(u), count, 3, generator=generator, dtype=torch.float64)
    # The reference: compiling loops for this one call takes longer than all calls of a data set.
    with use_kernels("reference"):
        curve = bspline(points, u, group=R3, order=ORDER, dt=1.0, derivatives=0).value
    return curve / (_derivative_rms(rate) * (2.0 * bandwidth[:, None, None]) ** rate)


@cache
def _derivative_rms(rate: int) -> float:
    """RMS of a derivative of the B-spline of order 6 with independent unit normal control points a unit apart.

    Integral over frequency of (2 pi f)^(2 rate) sinc^12(f).
    """
    f = torch.linspace(0.0, 20.0, 200_001, dtype=torch.float64)
    power = (2 * math.pi * f).pow(2 * rate) * torch.sinc(f).pow(2 * ORDER)
    return math.sqrt(2.0 * torch.trapezoid(power, f).item())


def turned(rates: Tensor, tau: Tensor, start: Tensor) -> Tensor:
    """Rotations (B, M, 4) of a body that starts at `start` (B, 4) and turns at `rates` (B, M, 3) rad/s, body frame.

    Trapezoids over the steps of `tau`.
    """
    middle = 0.5 * (rates[:, 1:] + rates[:, :-1]) * tau.diff(dim=1)[..., None]
    return rotation_products(start, SO3.exp(middle, validate=False))


def differences(x: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """First and second derivative of samples (B, M, D), central differences, ends repeated."""
    first = (x[:, 2:] - x[:, :-2]) / (2 * spacing)
    second = (x[:, 2:] - 2 * x[:, 1:-1] + x[:, :-2]) / spacing**2
    return _with_ends(first), _with_ends(second)


def _with_ends(x: Tensor) -> Tensor:
    return torch.cat([x[:, :1], x, x[:, -1:]], dim=1)


def facing(forward: Tensor, up: Tensor) -> Tensor:
    """Rotations (..., 4) whose z axis is along `up` and whose x axis is as near to `forward` as it can be."""
    z = torch.nn.functional.normalize(up, dim=-1)
    y = torch.nn.functional.normalize(torch.linalg.cross(z, forward), dim=-1)
    x = torch.linalg.cross(y, z)
    return SO3.from_matrix(torch.stack([x, y, z], dim=-1))


def around_z(angle: Tensor) -> Tensor:
    """Unit vectors (..., 3) in the horizontal plane."""
    return torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1)


def uniform(generator: torch.Generator, *shape: int) -> Tensor:
    """Angles from 0 to 2 pi."""
    return 2 * math.pi * torch.rand(*shape, generator=generator, dtype=torch.float64)
