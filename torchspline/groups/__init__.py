"""Tensor-facing Lie groups and conversions to other representations."""

from torchspline.groups import convert
from torchspline.groups.group import R3, SE3, SO3, Group, Rn, product

__all__ = ["R3", "SE3", "SO3", "Group", "Rn", "convert", "product"]
