"""Calibration of cameras and IMUs that are mounted together, from what they measured in front of a board."""

from torchspline.calibrate.reading import read_corners, read_recording
from torchspline.calibrate.recording import Corners, ImuNoise, Recording
from torchspline.io.camera import Camera

__all__ = [
    "Camera",
    "Corners",
    "ImuNoise",
    "Recording",
    "read_corners",
    "read_recording",
]
