"""Trajectories and sensor parameters from measurements."""

from torchspline.fit.align import Alignment, align_imu
from torchspline.fit.poses import PoseFit, fit_poses

__all__ = ["Alignment", "PoseFit", "align_imu", "fit_poses"]
