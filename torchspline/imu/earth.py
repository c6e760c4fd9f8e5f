"""The earth around a sensor: its rotation, gravity, magnetic field and pressure, in a local frame east-north-up.

Such a frame is fixed to the earth: x points east, y north, z up along the normal of the ellipsoid. Latitudes are
geodetic and in radians; numbers may be tensors of any shape, and everything is differentiable.
"""

import math

import torch
from torch import Tensor

from torchspline import checks

#: WGS-84 (NIMA TR8350.2): angular velocity rad/s, semi-major axis m, flattening, GM m^3/s^2, normal gravity m/s^2 at
#: the equator and at the poles.
ROTATION_RATE = 7.292115e-5
SEMI_MAJOR_AXIS = 6378137.0
FLATTENING = 1.0 / 298.257223563
_GM = 3.986004418e14
_AT_EQUATOR, _AT_POLE = 9.7803253359, 9.8321849378

#: Dipole coefficients g10, g11, h11 of the IGRF-13 field of 2020, nT, and the radius they refer to, m.
_DIPOLE = (-29404.8, -1450.9, 4652.5)
_REFERENCE_RADIUS = 6371200.0

#: International standard atmosphere (ISO 2533): pressure Pa and temperature K at sea level, lapse rate K/m up to the
#: tropopause (geopotential m), gravity over the gas constant of air K/m, and the radius in geopotential height, m.
_SEA_LEVEL_PRESSURE, _SEA_LEVEL_TEMPERATURE, _LAPSE = 101325.0, 288.15, 0.0065
_TROPOPAUSE, _EXPONENT = 11000.0, 9.80665 / 287.05287
_GEOPOTENTIAL_RADIUS = 6356766.0
#: Geometric heights between which the two lowest layers of the atmosphere lie, m.
LOWEST, HIGHEST = -5000.0, 20000.0


def earth_rate(latitude: float | Tensor) -> Tensor:
    """Angular velocity of the earth in axes east-north-up, (..., 3) rad/s: `rate [0, cos(latitude), sin(latitude)]`.

    Args:
        latitude: geodetic, rad.
    Raises:
        TypeError, ValueError: no number, or no latitude.
    """
    latitude = _latitude(latitude)
    north, up = latitude.cos(), latitude.sin()
    return ROTATION_RATE * torch.stack([torch.zeros_like(north), north, up], -1)


def normal_gravity(latitude: float | Tensor, height: float | Tensor = 0.0) -> Tensor:
    """Normal gravity of WGS-84 as an acceleration in axes east-north-up, (..., 3) m/s^2, the centrifugal one included.

    Somigliana's formula on the ellipsoid, and its expansion to second order in height above it (Heiskanen and Moritz
    (2-123)): within 1e-6 m/s^2 below 10 km. Real gravity differs by about 5e-4 m/s^2.

    Args:
        latitude: geodetic, rad. height: above the ellipsoid, m.
    Raises:
        TypeError, ValueError: no number, or no latitude.
    """
    latitude, height = _together(latitude=_latitude(latitude), height=_number("height", height))
    a, f = SEMI_MAJOR_AXIS, FLATTENING
    b = a * (1.0 - f)
    s2 = latitude.sin().square()
    k = b * _AT_POLE / (a * _AT_EQUATOR) - 1.0
    surface = _AT_EQUATOR * (1.0 + k * s2) / (1.0 - f * (2.0 - f) * s2).sqrt()
    m = ROTATION_RATE**2 * a * a * b / _GM
    h = height / a
    size = surface * (1.0 - 2.0 * (1.0 + f + m - 2.0 * f * s2) * h + 3.0 * h.square())
    none = torch.zeros_like(size)
    return torch.stack([none, none, -size], -1)


def dipole_field(latitude: float | Tensor, longitude: float | Tensor, height: float | Tensor = 0.0) -> Tensor:
    """Magnetic field of the earth's tilted dipole in axes east-north-up, (..., 3) microtesla, of the year 2020.

    The field itself differs by up to a third; where that matters, use a measured one. Latitude counts as geocentric,
    which is nothing beside that.

    Args:
        latitude, longitude: rad. height: above the mean radius of 6371.2 km, m.
    Raises:
        TypeError, ValueError: no number, or no latitude.
    """
    latitude, longitude, height = _together(
        latitude=_latitude(latitude),
        longitude=_number("longitude", longitude),
        height=_number("height", height),
    )
    g10, g11, h11 = (1e-3 * x for x in _DIPOLE)
    shrunk = (_REFERENCE_RADIUS / (_REFERENCE_RADIUS + height)) ** 3
    sin, cos = latitude.sin(), latitude.cos()
    tilt = g11 * longitude.cos() + h11 * longitude.sin()
    east = g11 * longitude.sin() - h11 * longitude.cos()
    return shrunk[..., None] * torch.stack([east, tilt * sin - g10 * cos, 2.0 * (g10 * sin + tilt * cos)], -1)


def standard_pressure(height: float | Tensor) -> Tensor:
    """Pressure of the international standard atmosphere (ISO 2533), Pa, same shape as `height`.

    Args:
        height: geometric, above mean sea level, m, from -5000 to 20000.
    Raises:
        TypeError, ValueError: no number, or a height outside the two lowest layers.
    """
    height = _number("height", height)
    outside = (height.detach() < LOWEST) | (height.detach() > HIGHEST)
    if checks.values_visible(height) and checks.seen_true(outside.any()):
        came = height.detach()[outside].flatten()[0].item()
        raise ValueError(f"height: expected metres from {LOWEST:g} to {HIGHEST:g}, got {came:g}")
    geopotential = _GEOPOTENTIAL_RADIUS * height / (_GEOPOTENTIAL_RADIUS + height)
    below = geopotential.clamp(max=_TROPOPAUSE)
    temperature = 1.0 - _LAPSE / _SEA_LEVEL_TEMPERATURE * below
    above = (geopotential - below) / (_SEA_LEVEL_TEMPERATURE - _LAPSE * _TROPOPAUSE)
    return _SEA_LEVEL_PRESSURE * temperature ** (_EXPONENT / _LAPSE) * (-_EXPONENT * above).exp()


def _number(name: str, x: float | Tensor) -> Tensor:
    if not isinstance(x, Tensor):
        checks.number(name, x)
        x = torch.tensor(float(x), dtype=torch.float64)
    checks.is_floating_tensor(name, x)
    checks.finite(name, x)
    return x


def _latitude(x: float | Tensor) -> Tensor:
    x = _number("latitude", x)
    # A rounding error of float32 beyond the pole is at the pole.
    beyond = x.detach().abs() > math.pi / 2 * (1.0 + 1e-6)
    if checks.values_visible(x) and checks.seen_true(beyond.any()):
        came = x.detach()[beyond].flatten()[0].item()
        raise ValueError(
            f"latitude: expected radians from -pi/2 to pi/2, got {came:g}; convert degrees with math.radians"
        )
    return x


def _together(**numbers: Tensor) -> list[Tensor]:
    """Broadcast; numbers without dimensions follow the others in dtype and device."""
    like = max(numbers.values(), key=lambda x: x.ndim)
    alike = {name: x.to(like) if x.ndim == 0 else x for name, x in numbers.items()}
    checks.same_kind(**alike)
    checks.broadcast(**{name: x.shape for name, x in alike.items()})
    return list(torch.broadcast_tensors(*alike.values()))
