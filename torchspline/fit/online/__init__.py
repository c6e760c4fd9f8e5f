"""Trajectories that grow while they are estimated."""

from torchspline.fit.online.window import SlidingWindow

__all__ = ["SlidingWindow"]
