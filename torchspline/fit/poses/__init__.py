"""Splines through measured poses, their knot spacing found from the data."""

from torchspline.fit.poses.fit import PoseFit, fit_poses

__all__ = ["PoseFit", "fit_poses"]
