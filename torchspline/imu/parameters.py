"""The noise of an IMU in the units people have."""

import math
from dataclasses import dataclass, fields, replace
from typing import Any

from torch import Tensor

from torchspline import checks
from torchspline.imu.parts import above_zero, tensor_of

_DEGREE = math.pi / 180.0
_HOUR = 3600.0
_MICRO_G = 9.80665e-6


@dataclass(frozen=True, eq=False)
class ImuNoise:
    """Densities of an IMU's noise, in the units of Kalibr's `imu.yaml` and EuRoC's `sensor.yaml`; 0: there is none.

    Each is a number, (3,) numbers, or (*batch, 3) for IMUs of a batch; a tensor that requires grad is used as given.

    Attributes:
        gyroscope_noise_density, accelerometer_noise_density: white noise, rad/s/sqrt(Hz) and m/s^2/sqrt(Hz). A sample
            has the standard deviation density * sqrt(rate).
        gyroscope_random_walk, accelerometer_random_walk: of the bias, rad/s^2/sqrt(Hz) and m/s^3/sqrt(Hz). Over dt it
            moves by density * sqrt(dt).
        gyroscope_bias_sigma, accelerometer_bias_sigma: standard deviation of a Gauss-Markov bias, rad/s and m/s^2.
        gyroscope_bias_time, accelerometer_bias_time: its correlation time, s.
        gyroscope_bias_instability, accelerometer_bias_instability: flicker noise, the coefficient B of IEEE Std 952,
            rad/s and m/s^2; the flat part of an Allan deviation lies at 0.664 B.
    """

    gyroscope_noise_density: float | Tensor = 0.0
    accelerometer_noise_density: float | Tensor = 0.0
    gyroscope_random_walk: float | Tensor = 0.0
    accelerometer_random_walk: float | Tensor = 0.0
    gyroscope_bias_sigma: float | Tensor = 0.0
    accelerometer_bias_sigma: float | Tensor = 0.0
    gyroscope_bias_time: float | Tensor = 1000.0
    accelerometer_bias_time: float | Tensor = 1000.0
    gyroscope_bias_instability: float | Tensor = 0.0
    accelerometer_bias_instability: float | Tensor = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            x = tensor_of(field.name, getattr(self, field.name), (3,), "one for each axis")
            if x is None:
                raise TypeError(f"{field.name}: expected a number or a tensor, got None; 0 means none")
            above_zero(field.name, x, zero_too=not field.name.endswith("_time"))
            if not isinstance(getattr(self, field.name), (int, float, Tensor)):  # a sequence
                object.__setattr__(self, field.name, x)

    @classmethod
    def from_datasheet(
        cls,
        *,
        angle_random_walk: float = 0.0,
        velocity_random_walk: float = 0.0,
        gyroscope_noise: float = 0.0,
        accelerometer_noise: float = 0.0,
        gyroscope_bias_instability: float = 0.0,
        accelerometer_bias_instability: float = 0.0,
        rate_random_walk: float = 0.0,
        acceleration_random_walk: float = 0.0,
    ) -> "ImuNoise":
        """From the units of data sheets.

        Args:
            angle_random_walk: deg/sqrt(h); or gyroscope_noise: deg/s/sqrt(Hz). The two are one quantity: give one.
            velocity_random_walk: m/s/sqrt(h); or accelerometer_noise: ug/sqrt(Hz), ug of 9.80665e-6 m/s^2.
            gyroscope_bias_instability: deg/h; accelerometer_bias_instability: ug. Both as the bottom of an Allan
                deviation, which is 0.664 times the coefficient B.
            rate_random_walk: deg/h/sqrt(h); acceleration_random_walk: m/s^2/sqrt(h).
        Raises:
            TypeError, ValueError: no number, one below zero, or both names of one quantity.
        """
        given = {name: x for name, x in locals().items() if name != "cls"}
        for name, x in given.items():
            if isinstance(x, bool) or not isinstance(x, (int, float)):
                raise TypeError(f"{name}: expected a number, got {type(x).__name__}")
            if not (math.isfinite(x) and x >= 0):
                raise ValueError(f"{name}: expected a finite number of at least zero, got {x}")
        for one, other in (
            ("angle_random_walk", "gyroscope_noise"),
            ("velocity_random_walk", "accelerometer_noise"),
        ):
            if given[one] and given[other]:
                raise ValueError(
                    f"{one}: got {given[one]} and {other}={given[other]}; they are one quantity: give one"
                )
        bottom = math.sqrt(2.0 * math.log(2.0) / math.pi)
        return cls(
            gyroscope_noise_density=angle_random_walk * _DEGREE / math.sqrt(_HOUR)
            + gyroscope_noise * _DEGREE,
            accelerometer_noise_density=velocity_random_walk / math.sqrt(_HOUR)
            + accelerometer_noise * _MICRO_G,
            gyroscope_random_walk=rate_random_walk * _DEGREE / _HOUR / math.sqrt(_HOUR),
            accelerometer_random_walk=acceleration_random_walk / math.sqrt(_HOUR),
            gyroscope_bias_instability=gyroscope_bias_instability * _DEGREE / _HOUR / bottom,
            accelerometer_bias_instability=accelerometer_bias_instability * _MICRO_G / bottom,
        )

    def inflated(self, factor: float) -> "ImuNoise":
        """All of it `factor` times as large (correlation times stay), as estimators often want it to be told."""
        checks.positive("factor", factor)
        changes: dict[str, Any] = {
            field.name: getattr(self, field.name) * factor
            for field in fields(self)
            if not field.name.endswith("_time")
        }
        return replace(self, **changes)
