"""Interpolation methods side by side: what the companion application of [H18] shows, in the browser."""

from torchspline.explore.explorer import METHODS, Curve, Explorer

__all__ = ["METHODS", "Curve", "Explorer"]
