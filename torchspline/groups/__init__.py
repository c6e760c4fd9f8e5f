"""Tensor-facing Lie groups and conversions to other representations."""

from torchspline.groups import convert
from torchspline.groups.group import R3, SE2, SE3, SO2, SO3, DualQuaternion, Group, Rn, product

__all__ = ["R3", "SE2", "SE3", "SO2", "SO3", "DualQuaternion", "Group", "Rn", "convert", "product"]
