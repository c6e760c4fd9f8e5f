"""torchspline: continuous-time motion as a PyTorch layer."""

from torchspline.groups import R3, SE3, SO3, Group, Rn, product

__all__ = ["R3", "SE3", "SO3", "Group", "Rn", "product"]
