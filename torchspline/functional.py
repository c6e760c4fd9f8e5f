"""Stateless forms of the splines: tensors in, tensors out."""

from torchspline.splines.bspline import bspline

__all__ = ["bspline"]
