"""How much a trajectory may bend: the integral of a squared derivative, as a residual."""

import numpy as np
import torch
from torch import Tensor

from torchspline import checks
from torchspline.fit.residual import Residual
from torchspline.fit.residuals.state import StateAcceleration, StateJerk, StateVelocity
from torchspline.splines.bspline import BSpline
from torchspline.units import NANOSECOND

_KINDS: tuple[type[Residual], ...] = (StateVelocity, StateAcceleration, StateJerk)


def smoothness(
    trajectory: BSpline,
    *,
    derivative: int = 2,
    sigma: Tensor | float,
    nodes: int | None = None,
    name: str = "smoothness",
) -> Residual:
    """A residual whose cost is half the integral over the domain of `|derivative of the state|^2 / sigma^2`.

    By Gauss-Legendre quadrature in each segment: exact in R^n with the default number of nodes, and up to the curvature
    of the group elsewhere.

    Args:
        trajectory: the one of the problem it will be added to.
        derivative: 1, 2 or 3: velocity, acceleration or jerk as `State` has them, in the body frame; less than the
            order of the trajectory.
        sigma: the square root of the spectral density of white noise that would drive this derivative, its unit times
            sqrt(s): a number, or (D,) for each component of the tangent.
        nodes: of the quadrature in each segment; by default `order - derivative`.
    Returns:
        Residual: `StateVelocity`, `StateAcceleration` or `StateJerk`, for `Problem.add`.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """
    checks.instance("trajectory", trajectory, BSpline, "a BSpline")
    most = min(len(_KINDS), trajectory.order - 1)
    checks.whole("derivative", derivative, least=1)
    if derivative > most:
        raise ValueError(
            f"derivative: expected at most {most} for a spline of order {trajectory.order}, got {derivative}"
        )
    if not isinstance(sigma, Tensor):
        sigma = torch.tensor(checks.positive("sigma", sigma), dtype=torch.float64)
    checks.is_floating_tensor("sigma", sigma)
    size = trajectory.group.tangent_size
    if tuple(sigma.shape) not in ((), (size,)):
        raise ValueError(f"sigma: expected a number or shape ({size},), got {tuple(sigma.shape)}")
    if nodes is not None:
        checks.whole("nodes", nodes, least=1)
    places, weights = np.polynomial.legendre.leggauss(nodes or trajectory.order - derivative)
    segments = trajectory.control_points.shape[-2] - trajectory.order + 1
    u = (np.arange(segments)[:, None] + 0.5 * (places + 1.0)).reshape(-1)
    start, end = trajectory.domain
    if trajectory.dt_ns is not None:
        t = torch.from_numpy(np.rint(u * trajectory.dt_ns).astype(np.int64)) + int(start)
        spacing = trajectory.dt_ns * NANOSECOND
    else:
        spacing = (end - start) / segments
        t = torch.from_numpy(start + u * spacing)
    share = np.sqrt(np.tile(weights, segments) * 0.5 * spacing)
    measured = torch.zeros(len(u), size, dtype=torch.float64)
    factors = sigma.to(torch.float64) / torch.from_numpy(share)[:, None]
    residual = _KINDS[derivative - 1](t, measured, sigma=factors, name=name)
    residual.bind(trajectory.group)
    return residual
