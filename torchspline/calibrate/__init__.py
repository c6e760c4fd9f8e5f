"""Calibration of cameras and IMUs that are mounted together, from what they measured in front of a board."""

from torchspline.calibrate.board import BoardPoses, board_poses
from torchspline.calibrate.estimate import Calibration, calibrate
from torchspline.calibrate.reading import read_corners, read_recording
from torchspline.calibrate.recording import Corners, Recording
from torchspline.calibrate.results import write_calibration
from torchspline.calibrate.start import Start, find_start
from torchspline.io.camera import Camera

__all__ = [
    "BoardPoses",
    "Calibration",
    "Camera",
    "Corners",
    "Recording",
    "Start",
    "board_poses",
    "calibrate",
    "find_start",
    "read_corners",
    "read_recording",
    "write_calibration",
]
