"""IMUs of random quality."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchspline.generate.distributions import Constant, Distribution, Parameter
from torchspline.groups import SE3, SO3
from torchspline.imu import Imu, ImuNoise
from torchspline.splines import Trajectory

_ZERO, _ONE = Constant(0.0), Constant(1.0)
_ANY = -float("inf")

#: What can be randomised of an IMU: the arguments of `imu.Imu` and `imu.ImuNoise` under their names. Unless told
#: otherwise it is perfect; effects that nobody names are not computed.
SENSOR_PARAMETERS: dict[str, Parameter] = {
    "gyroscope_noise_density": Parameter("rad/s/sqrt(Hz)", _ZERO),
    "accelerometer_noise_density": Parameter("m/s^2/sqrt(Hz)", _ZERO),
    "gyroscope_random_walk": Parameter("rad/s^2/sqrt(Hz)", _ZERO),
    "accelerometer_random_walk": Parameter("m/s^3/sqrt(Hz)", _ZERO),
    "gyroscope_bias_sigma": Parameter("rad/s", _ZERO),
    "accelerometer_bias_sigma": Parameter("m/s^2", _ZERO),
    "gyroscope_bias_time": Parameter("s", Constant(1000.0), least=1e-6),
    "accelerometer_bias_time": Parameter("s", Constant(1000.0), least=1e-6),
    "gyroscope_bias_instability": Parameter("rad/s", _ZERO),
    "accelerometer_bias_instability": Parameter("m/s^2", _ZERO),
    "gyroscope_bias": Parameter("rad/s", _ZERO, _ANY, size=3),
    "accelerometer_bias": Parameter("m/s^2", _ZERO, _ANY, size=3),
    "gyroscope_scale": Parameter("", _ONE, least=1e-3, size=3),
    "accelerometer_scale": Parameter("", _ONE, least=1e-3, size=3),
    "gyroscope_misalignment": Parameter("", _ZERO, _ANY, size=3),
    "accelerometer_misalignment": Parameter("", _ZERO, _ANY, size=3),
    "gyroscope_rotation": Parameter("rad", _ZERO, _ANY, size=3, meaning="a rotation vector"),
    "g_sensitivity": Parameter("rad/s per m/s^2", _ZERO, _ANY, size=9, meaning="row by row"),
    "lever_arm": Parameter("m", _ZERO, _ANY, size=3, meaning="of the IMU in the body"),
    "accelerometer_arms": Parameter("m", _ZERO, _ANY, size=9, meaning="axis by axis"),
    "time_offset": Parameter("s", _ZERO, least=-1.0, most=1.0),
    "time_skew": Parameter("s/s", _ZERO, least=-0.1, most=0.1),
    "jitter": Parameter("s", _ZERO, most=0.1),
    "drop_probability": Parameter("", _ZERO, most=0.99),
    "gyroscope_range": Parameter("rad/s", Constant(float("inf")), least=1e-3),
    "accelerometer_range": Parameter("m/s^2", Constant(float("inf")), least=1e-3),
    "gyroscope_resolution": Parameter("rad/s", _ZERO, least=1e-9),
    "accelerometer_resolution": Parameter("m/s^2", _ZERO, least=1e-9),
}
_NOISE = frozenset(ImuNoise.__dataclass_fields__)
_EACH_AXIS = _NOISE | {name for name in SENSOR_PARAMETERS if name.endswith(("_range", "_resolution"))}


def draw_sensor(
    chosen: Mapping[str, Distribution], count: int, generator: torch.Generator
) -> dict[str, Tensor]:
    """Of each parameter that is chosen (count,) or (count, size)."""
    return {name: SENSOR_PARAMETERS[name].draw(d, count, generator) for name, d in chosen.items()}


def simulate(
    trajectory: Trajectory, t: Tensor, rate: float, drawn: Mapping[str, Tensor], generator: torch.Generator
) -> dict[str, Tensor]:
    """Readings of an IMU on each trajectory of a batch, and what they should have been.

    Args:
        trajectory: a batch of B. t: stamps (N,), s. rate: Hz. drawn: see `draw_sensor`.
    Returns:
        Columns, each (B, N, ...); see `GeneratedDataset`.
    """
    given: dict[str, Any] = {}
    noise: dict[str, Any] = {}
    for name, x in drawn.items():
        if name in _EACH_AXIS:
            x = x[:, None].expand(-1, 3)
        elif name == "gyroscope_rotation":
            x = SO3.exp(x)
        elif SENSOR_PARAMETERS[name].size == 9:
            x = x.unflatten(-1, (3, 3))
        elif name == "lever_arm":
            name, x = "T_body_imu", torch.cat([x, SE3.identity(len(x))[:, 3:]], dim=-1)
        (noise if name in _NOISE else given)[name] = x
    perfect = Imu(T_body_imu=given.get("T_body_imu"), rate=rate)(trajectory, t)
    made = Imu(noise=ImuNoise(**noise) if noise else None, rate=rate, **given)(trajectory, t, generator)
    columns = {
        "gyroscope": made.gyroscope,
        "accelerometer": made.accelerometer,
        "angular_velocity": perfect.gyroscope,
        "specific_force": perfect.accelerometer,
        "gyroscope_bias": made.gyroscope_bias,
        "accelerometer_bias": made.accelerometer_bias,
    }
    if "drop_probability" in drawn:
        columns["valid"] = made.valid.to(torch.uint8)
    return columns
