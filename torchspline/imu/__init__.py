"""Inertial measurement units on trajectories."""

from torchspline.imu import earth
from torchspline.imu.allan import AllanDeviation, NoiseEstimate, allan_deviation, fit_noise
from torchspline.imu.ambient import AmbientReadings, Barometer, Magnetometer
from torchspline.imu.filters import LowPass
from torchspline.imu.increments import Increments, compensate, increments, sampled_increments
from torchspline.imu.noise import flicker_noise, gauss_markov, item_generator, random_walk, white_noise
from torchspline.imu.parameters import ImuNoise
from torchspline.imu.sensor import Imu, Readings
from torchspline.imu.strapdown import Navigation, integrate_gyroscope, strapdown
from torchspline.imu.synthesis import STANDARD_GRAVITY, ImuReading, measure

__all__ = [
    "STANDARD_GRAVITY",
    "AllanDeviation",
    "AmbientReadings",
    "Barometer",
    "Imu",
    "ImuNoise",
    "ImuReading",
    "Increments",
    "LowPass",
    "Magnetometer",
    "Navigation",
    "NoiseEstimate",
    "Readings",
    "allan_deviation",
    "compensate",
    "earth",
    "fit_noise",
    "flicker_noise",
    "gauss_markov",
    "increments",
    "integrate_gyroscope",
    "item_generator",
    "measure",
    "random_walk",
    "sampled_increments",
    "strapdown",
    "white_noise",
]
