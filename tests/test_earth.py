"""The earth: published numbers, and potentials differentiated."""

import math

import mpmath
import pytest
import torch

from torchspline.imu import earth

F32, F64 = torch.float32, torch.float64


def degrees(*x):
    return torch.deg2rad(torch.tensor(x, dtype=F64))


def test_rotation_of_the_earth():
    """15.041 degrees an hour about an axis that stands at the latitude's elevation in the north."""
    rate = earth.earth_rate(degrees(0.0, 45.0, 90.0, -90.0))
    per_hour = torch.rad2deg(rate) * 3600
    assert per_hour.norm(dim=-1).tolist() == pytest.approx([15.041067] * 4, abs=1e-6)
    expected = torch.tensor([[0.0, 1, 0], [0, 0.5**0.5, 0.5**0.5], [0, 0, 1], [0, 0, -1]], dtype=F64)
    assert torch.allclose(per_hour / 15.041067, expected, atol=1e-7)
    assert earth.earth_rate(0.3).shape == (3,)


def test_normal_gravity_on_the_ellipsoid_as_published():
    g = earth.normal_gravity(degrees(0.0, 45.0, 90.0, -90.0))
    assert (g[:, :2] == 0).all()
    # NIMA TR8350.2, and Moritz' series for latitude 45 of the neighbouring GRS 80 (9.806199203).
    assert (-g[:, 2]).tolist() == pytest.approx(
        [9.7803253359, 9.8061977, 9.8321849378, 9.8321849378], abs=1e-7
    )
    latitude = torch.linspace(-math.pi / 2, math.pi / 2, 20001, dtype=F64)
    e2 = earth.FLATTENING * (2 - earth.FLATTENING)
    area = latitude.cos() / (1 - e2 * latitude.sin().square()).square()
    mean = (earth.normal_gravity(latitude).norm(dim=-1) * area).sum() / area.sum()
    assert mean.item() == pytest.approx(9.7976432222, abs=1e-8)


def normal_potential(x, z):
    """Heiskanen and Moritz (2-62), in ellipsoidal coordinates, of a point at distance x from the axis."""
    mp = mpmath.mp
    a, f, w, GM = (
        mp.mpf(6378137),
        1 / mp.mpf("298.257223563"),
        mp.mpf("7.292115e-5"),
        mp.mpf("3.986004418e14"),
    )
    b = a * (1 - f)
    E2 = a * a - b * b
    r2 = x * x + z * z
    u = mp.sqrt((r2 - E2 + mp.sqrt((r2 - E2) ** 2 + 4 * E2 * z * z)) / 2)
    sin2 = (z / u) ** 2
    E = mp.sqrt(E2)

    def q(u):
        return ((1 + 3 * u * u / E2) * mp.atan(E / u) - 3 * u / E) / 2

    rotating = w * w * x * x / 2
    return GM / E * mp.atan(E / u) + w * w * a * a / 2 * q(u) / q(b) * (sin2 - mp.mpf(1) / 3) + rotating


@pytest.mark.parametrize("latitude", [0.3, -0.8, 1.4])
@pytest.mark.parametrize("height", [-400.0, 0.0, 1000.0, 9000.0])
def test_normal_gravity_is_the_gradient_of_the_normal_potential(latitude, height):
    with mpmath.workdps(40):
        s, c = mpmath.sin(latitude), mpmath.cos(latitude)
        a, f = mpmath.mpf(6378137), 1 / mpmath.mpf("298.257223563")
        N = a / mpmath.sqrt(1 - f * (2 - f) * s * s)
        x, z = (N + height) * c, (N * (1 - f) ** 2 + height) * s
        gradient = (
            mpmath.diff(normal_potential, (x, z), (1, 0)),
            mpmath.diff(normal_potential, (x, z), (0, 1)),
        )
        size = float(mpmath.hypot(*gradient))
    assert -earth.normal_gravity(latitude, height)[2].item() == pytest.approx(
        size, abs=1e-6 * max(height, 1000.0) / 1e4
    )


def test_the_dipole_is_the_gradient_of_its_potential():
    """-grad V with V = a (a/r)^2 (g10 sin + (g11 cos + h11 sin) cos), written in Cartesian coordinates."""
    latitude, longitude = degrees(-70.0, 10.0, 47.4), degrees(0.0, -100.0, 8.5)
    height = torch.tensor([0.0, 5e5, 400.0], dtype=F64)
    radius = earth._REFERENCE_RADIUS + height
    up = torch.stack([latitude.cos() * longitude.cos(), latitude.cos() * longitude.sin(), latitude.sin()], -1)
    position = (radius[:, None] * up).requires_grad_()
    g10, g11, h11 = earth._DIPOLE
    moment = torch.tensor([g11, h11, g10], dtype=F64)
    potential = earth._REFERENCE_RADIUS**3 * (position @ moment) / position.norm(dim=-1) ** 3
    (gradient,) = torch.autograd.grad(potential.sum(), position)
    east = torch.stack([-longitude.sin(), longitude.cos(), 0 * longitude], -1)
    north = torch.linalg.cross(up, east)
    expected = torch.stack([-(gradient * axis).sum(-1) for axis in (east, north, up)], -1) * 1e-3
    assert torch.allclose(earth.dipole_field(latitude, longitude, height), expected, rtol=1e-10, atol=1e-10)


def test_the_dipole_is_where_it_was_in_2020():
    """Geomagnetic north pole at 80.65 N, 72.68 W, where the field points down; 7.71e22 A m^2."""
    g10, g11, h11 = earth._DIPOLE
    assert math.degrees(math.atan2(-h11, -g11)) == pytest.approx(-72.68, abs=0.02)
    assert math.degrees(math.atan2(-g10, math.hypot(g11, h11))) == pytest.approx(
        80.65, abs=0.1
    )  # geodetic; that of a sphere here
    pole = earth.dipole_field(*degrees(80.59, -72.68))
    assert pole[:2].norm() < 0.02
    assert -pole[2].item() == pytest.approx(2 * 29.806, abs=0.01)
    moment = 0.5e-6 * pole.norm().item() * earth._REFERENCE_RADIUS**3 * 1e7
    assert moment == pytest.approx(7.71e22, rel=1e-3)
    zurich = earth.dipole_field(*degrees(47.4, 8.5))  # in truth 21.6 north, 47.9 uT in all, mostly down
    assert zurich[1] > 15
    assert zurich[2] < -35
    assert zurich.norm().item() == pytest.approx(47.9, rel=0.1)


@pytest.mark.parametrize(
    ("height", "pressure"),
    # U.S. Standard Atmosphere 1976, table I, geometric height (the same atmosphere below 20 km).
    [(-1000.0, 1.1393e5), (0.0, 101325.0), (1000.0, 8.9876e4), (5000.0, 5.4048e4), (10000.0, 2.6500e4),
     (15000.0, 1.2112e4), (20000.0, 5.5293e3)],
)  # fmt: skip
def test_pressure_as_published(height, pressure):
    assert earth.standard_pressure(height).item() == pytest.approx(pressure, rel=3e-5)


def test_pressure_carries_the_air_above():
    """dp/dh = -density g = -p g / (R T): -12.01 Pa/m at sea level."""
    h = torch.linspace(-400, 15000, 9, dtype=F64).requires_grad_()
    assert torch.autograd.gradcheck(earth.standard_pressure, h)
    zero = torch.zeros((), dtype=F64, requires_grad=True)
    (slope,) = torch.autograd.grad(earth.standard_pressure(zero), zero)
    assert slope.item() == pytest.approx(-101325 * 9.80665 / (287.05287 * 288.15), rel=1e-9)


def test_shapes_dtypes_and_gradients():
    latitude = degrees(10.0, 50.0).requires_grad_()
    height = torch.tensor([[100.0], [2000.0], [5.0]], dtype=F64, requires_grad=True)
    assert earth.normal_gravity(latitude, height).shape == (3, 2, 3)
    assert torch.autograd.gradcheck(earth.normal_gravity, (latitude, height))
    assert torch.autograd.gradcheck(lambda x: earth.dipole_field(x, 0.3, 10.0), latitude)
    single = earth.dipole_field(latitude.detach().to(F32), 0.3)
    assert single.dtype == F32
    assert torch.allclose(single.double(), earth.dipole_field(latitude, 0.3), rtol=1e-5)
    assert earth.standard_pressure(100.0).dtype == F64
