"""Robots: trajectories of links from splines of joints, sensors on links, splines of joints from encoders."""

from torchspline.robot.encoders import JointFit, fit_joints
from torchspline.robot.model import LinkTrajectory, OverLimit, Robot
from torchspline.robot.readers import Joint

__all__ = ["Joint", "JointFit", "LinkTrajectory", "OverLimit", "Robot", "fit_joints"]
