"""Robots: trajectories of links from splines of joints, sensors on links, splines of joints from encoders."""

from torchspline.robot.model import LinkTrajectory, OverLimit, Robot
from torchspline.robot.readers import Joint

__all__ = ["Joint", "LinkTrajectory", "OverLimit", "Robot"]
