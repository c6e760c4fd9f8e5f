"""How noisy sensors really were: standard deviations from residuals, one factor for each sensor."""

import torch

from torchspline.calibrate.images import ImageBlock
from torchspline.fit.residual import Residual
from torchspline.fit.result import Result


def sigma_of(residual: Residual) -> float:
    """The standard deviation that all numbers of a sensor have."""
    if isinstance(residual, ImageBlock):
        return residual.pixels
    _, sigma = residual.weighting
    assert sigma is not None
    return float(sigma.reshape(-1)[0])


def rescale(residual: Residual, factor: float) -> None:
    """Multiply it."""
    if isinstance(residual, ImageBlock):
        residual.pixels *= factor
    else:
        kind, sigma = residual.weighting
        assert sigma is not None
        residual.weighting = kind, sigma * factor


def noise_factors(result: Result, residuals: list[Residual]) -> dict[str, float]:
    """By how much the standard deviation of each sensor should be multiplied, by the residual's name.

    The root of the weighted sum of squares over the redundancy [Foerstner 1979]: a spline with many control points
    follows part of the noise, so that residuals alone look better than the sensor is. Robust losses weigh outliers
    down here, too.
    """
    factors = {}
    for residual in residuals:
        squared = result.residuals[residual.name].square().sum(1) / sigma_of(residual) ** 2
        if residual.loss is not None:
            squared = squared * residual.loss.weight(squared)
        count = result.redundancy[residual.name]
        if count > 0:
            factors[residual.name] = float((squared.sum() / count).sqrt())
    return {name: x for name, x in factors.items() if x > 0 and torch.isfinite(torch.tensor(x))}
