"""Inertial measurement units on trajectories."""

from torchspline.imu.filters import LowPass
from torchspline.imu.noise import flicker_noise, gauss_markov, item_generator, random_walk, white_noise
from torchspline.imu.parameters import ImuNoise
from torchspline.imu.sensor import Imu, Readings
from torchspline.imu.synthesis import STANDARD_GRAVITY, ImuReading, measure

__all__ = [
    "STANDARD_GRAVITY",
    "Imu",
    "ImuNoise",
    "ImuReading",
    "LowPass",
    "Readings",
    "flicker_noise",
    "gauss_markov",
    "item_generator",
    "measure",
    "random_walk",
    "white_noise",
]
