"""Spline families on Lie groups."""

from torchspline.splines.bspline import BSpline, SplitBSpline
from torchspline.splines.hermite import Differentials, HermiteSpline
from torchspline.splines.interpolation import KeyframeSpline
from torchspline.splines.keyframes import consistent_signs, initial_control_points, phantom_points
from torchspline.splines.nonuniform import NonuniformBSpline
from torchspline.splines.trajectory import Kinematics, State, Trajectory

__all__ = [
    "BSpline",
    "Differentials",
    "HermiteSpline",
    "KeyframeSpline",
    "Kinematics",
    "NonuniformBSpline",
    "SplitBSpline",
    "State",
    "Trajectory",
    "consistent_signs",
    "initial_control_points",
    "phantom_points",
]
