"""Trajectories and sensor parameters from measurements."""

from torchspline.fit.online import SlidingWindow
from torchspline.fit.poses import PoseFit, fit_poses
from torchspline.fit.together import BatchProblem, BatchResult

__all__ = ["BatchProblem", "BatchResult", "PoseFit", "SlidingWindow", "fit_poses"]
