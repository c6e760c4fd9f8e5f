"""Trajectories and sensor parameters from measurements."""

from torchspline.fit.align import Alignment, align_imu
from torchspline.fit.approximation import Approximation, Difference, approximate, compare
from torchspline.fit.losses import Cauchy, GemanMcClure, Huber, Loss
from torchspline.fit.online import SlidingWindow
from torchspline.fit.poses import PoseFit, fit_poses
from torchspline.fit.problem import Problem
from torchspline.fit.residual import Clock, Residual
from torchspline.fit.residuals import (
    Accelerometer,
    AngularAcceleration,
    BodyVelocity,
    Direction,
    Gyroscope,
    Orientation,
    Point,
    Pose,
    Position,
    RelativePose,
    ReprojectionEquidistant,
    ReprojectionRadtan,
    StateAcceleration,
    StateJerk,
    StateValue,
    StateVelocity,
    WorldVelocity,
)
from torchspline.fit.result import Result
from torchspline.fit.smoothness import smoothness
from torchspline.fit.together import BatchProblem, BatchResult
from torchspline.fit.variables import Variable

__all__ = [
    "Accelerometer",
    "Alignment",
    "AngularAcceleration",
    "Approximation",
    "BatchProblem",
    "BatchResult",
    "BodyVelocity",
    "Cauchy",
    "Clock",
    "Difference",
    "Direction",
    "GemanMcClure",
    "Gyroscope",
    "Huber",
    "Loss",
    "Orientation",
    "Point",
    "Pose",
    "PoseFit",
    "Position",
    "Problem",
    "RelativePose",
    "ReprojectionEquidistant",
    "ReprojectionRadtan",
    "Residual",
    "Result",
    "SlidingWindow",
    "StateAcceleration",
    "StateJerk",
    "StateValue",
    "StateVelocity",
    "Variable",
    "WorldVelocity",
    "align_imu",
    "approximate",
    "compare",
    "fit_poses",
    "smoothness",
]
