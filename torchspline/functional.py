"""Stateless forms of the splines: tensors in, tensors out."""

from torchspline.splines.bspline import bspline
from torchspline.splines.hermite import hermite

__all__ = ["bspline", "hermite"]
