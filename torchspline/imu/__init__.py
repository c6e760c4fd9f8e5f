"""Inertial measurement units on trajectories."""

from torchspline.imu.synthesis import STANDARD_GRAVITY, ImuReading, measure

__all__ = ["STANDARD_GRAVITY", "ImuReading", "measure"]
