"""Trajectories and sensor parameters from measurements."""

from torchspline.fit.poses import PoseFit, fit_poses

__all__ = ["PoseFit", "fit_poses"]
