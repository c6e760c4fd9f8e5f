"""Stateless forms of the splines: tensors in, tensors out."""

from torchspline.splines.bspline import bspline
from torchspline.splines.geodesics import geodesic_product
from torchspline.splines.hermite import hermite
from torchspline.splines.interpolation import interpolate
from torchspline.splines.nonuniform import nonuniform_bspline

__all__ = ["bspline", "geodesic_product", "hermite", "interpolate", "nonuniform_bspline"]
