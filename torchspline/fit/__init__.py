"""Trajectories and sensor parameters from measurements."""

from torchspline.fit import residuals
from torchspline.fit.alignment import Alignment, align_imu
from torchspline.fit.approximation import Approximation, Difference, approximate, compare
from torchspline.fit.batch import BatchProblem, BatchResult
from torchspline.fit.losses import Cauchy, GemanMcClure, Huber, Loss
from torchspline.fit.online import SlidingWindow
from torchspline.fit.poses import PoseFit, fit_poses
from torchspline.fit.problem import Problem
from torchspline.fit.residual import Clock, Residual
from torchspline.fit.residuals import *  # noqa: F403
from torchspline.fit.result import Result
from torchspline.fit.smoothness import smoothness
from torchspline.fit.variables import Variable

__all__ = [
    "Alignment",
    "Approximation",
    "BatchProblem",
    "BatchResult",
    "Cauchy",
    "Clock",
    "Difference",
    "GemanMcClure",
    "Huber",
    "Loss",
    "PoseFit",
    "Problem",
    "Residual",
    "Result",
    "SlidingWindow",
    "Variable",
    "align_imu",
    "approximate",
    "compare",
    "fit_poses",
    "smoothness",
]
__all__ += residuals.__all__
