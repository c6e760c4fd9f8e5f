"""Where an IMU sits on a body whose trajectory is known, how its clock runs, and what it adds to what it measures."""

from torchspline.fit.alignment.align import Alignment, align_imu

__all__ = ["Alignment", "align_imu"]
