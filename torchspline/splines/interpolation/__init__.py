"""Interpolation of keyframes, [H18]: one function and one module for all schemes."""

from torchspline.splines.interpolation.interpolate import KeyframeSpline, interpolate
from torchspline.splines.interpolation.registry import SCHEMES, SURVEY
from torchspline.splines.interpolation.scheme import Properties

__all__ = ["SCHEMES", "SURVEY", "KeyframeSpline", "Properties", "interpolate"]
