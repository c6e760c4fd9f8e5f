"""From one family of trajectories to another, and how far two trajectories lie apart."""

from torchspline.fit.approximation.approximate import Approximation, approximate
from torchspline.fit.approximation.compare import Difference, compare

__all__ = ["Approximation", "Difference", "approximate", "compare"]
