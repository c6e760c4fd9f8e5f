"""Spline families on Lie groups."""

from torchspline.splines.bspline import BSpline, SplitBSpline
from torchspline.splines.trajectory import Kinematics, State, Trajectory

__all__ = ["BSpline", "Kinematics", "SplitBSpline", "State", "Trajectory"]
