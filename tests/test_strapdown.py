"""Increments and strapdown integration: what is synthesised comes back, with the right order in the interval."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from spline_cases import chain
from torch.autograd import gradcheck

from torchspline import R3, SE3, SO3, BSpline, product, use_kernels
from torchspline.imu import (
    STANDARD_GRAVITY,
    ImuReading,
    Increments,
    Navigation,
    compensate,
    increments,
    integrate_gyroscope,
    measure,
    sampled_increments,
    strapdown,
)

F32, F64 = torch.float32, torch.float64
MODES = pytest.mark.parametrize("mode", ["reference", "auto"])
MOUNT = torch.tensor([0.3, -0.2, 0.5, 1.6, -0.4, 0.8, 0.2], dtype=F64)
FAST_EARTH = (0.1, -0.2, 0.25)  # rad/s


def numbers(*shape, seed=0):
    return torch.randn(shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


def smooth(group=SE3, batch=(), seed=0):
    """Of order 6, with one segment: no knot disturbs orders of convergence."""
    steps = 0.7 * numbers(*batch, 5, 6, seed=seed)
    return BSpline(chain(group, steps, seed), group=group, order=6, dt=1.0, learnable=False)


def state(spline, t, index=0):
    motion = spline.kinematics(t)
    return Navigation(*(x[..., index, :] for x in (motion.rotation, motion.velocity, motion.position)))


def errors(spline, t, found):
    """Largest in angle, velocity and position."""
    motion = spline.kinematics(t)
    angle = SO3.log(SO3.between(motion.rotation, found.rotation))
    return [
        x.abs().max().item()
        for x in (angle, found.velocity - motion.velocity, found.position - motion.position)
    ]


@pytest.mark.parametrize("group", [SE3, product(R3, SO3)], ids=str)
@pytest.mark.parametrize("mounted", [False, True])
def test_compensated_increments_bring_the_trajectory_back(group, mounted):
    spline = smooth(group)
    sensor = spline.mounted(MOUNT) if mounted else spline
    t = 0.02 + 0.96 * (torch.arange(41, dtype=F64) / 40) ** 1.3
    made = increments(spline, t, T_body_imu=MOUNT if mounted else None)
    found = strapdown(made, t, state(sensor, t))
    angle, velocity, position = errors(sensor, t, found)
    assert angle < 1e-13
    assert velocity < 1e-12
    assert position < 2e-5


def naive(spline, t):
    """One sample held over each interval."""
    reading, h = measure(spline, t), t.diff()[:, None]
    return Increments(reading.gyroscope[:-1] * h, reading.accelerometer[:-1] * h)


METHODS = {
    # Orders of angle, velocity and position.
    "exact": (increments, (None, None, 3)),
    "compensated": (lambda s, t: compensate(increments(s, t, compensated=False), t), (4, 3, 3)),
    "plain": (lambda s, t: increments(s, t, compensated=False), (2, 1, 1)),
    "samples": (lambda s, t: sampled_increments(measure(s, t), t), (2, 2, 2)),
    "naive": (naive, (1, 1, 1)),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("even", [True, False])
def test_orders_in_the_interval(method, even):
    make, expected = METHODS[method]
    spline = smooth()
    found = []
    for count in (32, 64, 128):
        s = torch.arange(count + 1, dtype=F64) / count
        t = 0.02 + 0.96 * (s if even else s + 0.1 * torch.sin(3 * s))
        found.append(errors(spline, t, strapdown(make(spline, t), t, state(spline, t))))
    orders = np.log2(np.array(found[:-1]) / np.array(found[1:]))
    for i, order in enumerate(expected):
        if order is None:
            assert found[-1][i] < 1e-11
        else:
            assert orders[-1, i] > order - 0.15
            if method in ("plain", "naive"):
                assert orders[-1, i] < order + 0.5


@pytest.mark.parametrize("compensated", [True, False])
def test_coning_drifts_unless_it_is_compensated(compensated):
    """An axis that goes round a cone of half angle a at w turns, though it returns, at w (1 - cos a): closed form."""
    a, w, rate, turns = 0.05, 2 * math.pi * 10.0, 100.0, 20
    t = torch.arange(turns * 10 + 1, dtype=F64) / rate
    edges = w * t[:, None] * torch.tensor([[1.0]], dtype=F64)
    # Body rates of R = Exp(a [cos wt, sin wt, 0]): sin a w [-sin, cos, 0] turned, and the constant w (cos a - 1).
    exact = SO3.exp(a * torch.cat([edges.cos(), edges.sin(), 0 * edges], -1))
    z = w * (math.cos(a) - 1) / rate
    integrals = math.sin(a) * torch.cat([edges.cos(), edges.sin()], -1).diff(dim=0)
    integrals = torch.cat([integrals, torch.full((len(t) - 1, 1), z, dtype=F64)], -1)
    made = Increments(integrals, 0 * integrals)
    made = compensate(made, t) if compensated else made
    start = Navigation(exact[0], torch.zeros(3, dtype=F64), torch.zeros(3, dtype=F64))
    found = strapdown(made, t, start, gravity=(0.0, 0.0, 0.0))
    drift = SO3.log(SO3.between(exact[::10], found.rotation[::10]))[-1].norm().item()
    expected = w * (1 - math.cos(a)) * turns * 10 / rate
    if compensated:
        assert drift < 0.06 * expected
    else:  # what cannot be seen between samples 36 degrees apart, and is not compensated
        assert drift > 0.05 * expected


# ---------------------------------------------------------------------- on the turning earth


def test_readings_on_a_turning_earth_are_those_in_axes_that_do_not_turn():
    """R_i = E R, p_i = E p with E = Exp(rate t), by matrices of SciPy and differences of sixth order."""
    spline, rate = smooth(), np.array(FAST_EARTH)
    gravity = np.array([0.3, -0.2, -9.7])
    t, h = np.linspace(0.2, 0.8, 7), 0.01
    c1 = np.array([-1 / 60, 3 / 20, -3 / 4, 0, 3 / 4, -3 / 20, 1 / 60])
    c2 = np.array([1 / 90, -3 / 20, 3 / 2, -49 / 18, 3 / 2, -3 / 20, 1 / 90])

    def inertial(t):
        pose = spline(torch.from_numpy(t)).numpy()
        E = Rotation.from_rotvec(t[:, None] * rate)
        return E.apply(pose[:, :3]), E * Rotation.from_quat(np.roll(pose[:, 3:], -1, axis=1)), E

    p0, R0, E0 = inertial(t)
    steps = [inertial(t + (i - 3) * h) for i in range(7)]
    w = sum(c * (R0.inv() * s[1]).as_rotvec() for c, s in zip(c1, steps, strict=True)) / h
    a = sum(c * s[0] for c, s in zip(c2, steps, strict=True)) / h**2
    # Gravity of a scale at rest holds the centrifugal acceleration already, here that of the origin.
    gravitation = E0.apply(gravity + np.cross(rate, np.cross(rate, E0.inv().apply(p0))))
    f = R0.inv().apply(a - gravitation)
    short = 1e-3  # means over short intervals around t, plain integrals of what is read
    ends = torch.from_numpy(np.stack([t - short / 2, t + short / 2], -1)).flatten()
    made = increments(spline, ends, gravity=tuple(gravity), earth_rate=FAST_EARTH, compensated=False)
    assert np.abs(made.angle[::2].numpy() / short - w).max() < 1e-5
    assert np.abs(made.velocity[::2].numpy() / short - f).max() < 1e-4
    without = increments(spline, ends, gravity=tuple(gravity), compensated=False)
    assert (made.velocity - without.velocity)[::2].abs().max() > 0.2 * short


def test_compensated_increments_on_a_turning_earth_are_fine_integrals_put_together():
    """Those of 40 short intervals, chained, against one long one."""
    spline, mount = smooth(), MOUNT
    t = torch.linspace(0.1, 0.9, 201, dtype=F64)
    options = {"earth_rate": FAST_EARTH, "T_body_imu": mount}
    fine = compensate(increments(spline, t, compensated=False, **options), t)
    coarse = increments(spline, t[::40], **options)
    for k in range(5):
        q, v = SO3.identity(), torch.zeros(3, dtype=F64)
        for angle, gained in zip(*(x[40 * k : 40 * k + 40] for x in fine), strict=True):
            v = v + SO3.act(q, gained)
            q = SO3.compose(q, SO3.exp(angle))
        assert torch.allclose(SO3.log(q), coarse.angle[k], rtol=0, atol=1e-10)
        assert torch.allclose(v, coarse.velocity[k], rtol=0, atol=2e-7)


@pytest.mark.parametrize(("rate", "limit"), [(FAST_EARTH, 1e-4), ((0.0, 5e-5, 5e-5), 2e-8)])
def test_strapdown_on_a_turning_earth(rate, limit):
    spline = smooth()
    found = []
    for count in (50, 100):
        t = torch.linspace(0.02, 0.98, count + 1, dtype=F64)
        made = increments(spline, t, earth_rate=rate)
        found.append(errors(spline, t, strapdown(made, t, state(spline, t), earth_rate=rate)))
        assert found[-1][0] < 1e-13
    assert found[-1][1] < limit
    if limit > 1e-5:
        assert found[0][1] / found[1][1] > 3.5
        ignored = errors(spline, t, strapdown(made, t, state(spline, t)))
        assert ignored[0] > 0.1


# ---------------------------------------------------------------------- gyroscopes alone


@MODES
def test_gyroscopes_integrate_to_orientations(mode):
    spline = smooth()
    with use_kernels(mode):
        found = []
        for count in (50, 100):
            t = torch.linspace(0.02, 0.98, count + 1, dtype=F64)
            q = integrate_gyroscope(measure(spline, t).gyroscope, t, spline(t)[0, 3:])
            found.append(SO3.log(SO3.between(spline(t)[:, 3:], q)).abs().max().item())
    assert found[1] < 1e-3
    assert found[0] / found[1] == pytest.approx(4, rel=0.05)


@MODES
def test_steady_rates_and_shapes(mode):
    rate = torch.tensor([0.3, -1.0, 2.0], dtype=F64)
    t = torch.tensor([0.0, 0.5, 0.6, 3.0], dtype=F64)
    expected = SO3.exp(rate * t[:, None])
    with use_kernels(mode):
        found = integrate_gyroscope(rate.expand(4, 3), t)
        assert torch.allclose(SO3.log(SO3.between(found, expected)), torch.zeros(4, 3, dtype=F64), atol=1e-14)
        ns = integrate_gyroscope(rate.expand(4, 3), (t * 1e9).round().to(torch.int64) + 10**18)
        assert torch.allclose(ns, found, rtol=0, atol=1e-14)
        many = integrate_gyroscope(numbers(2, 3, 5, 3), t[-1] * torch.arange(5), SO3.identity(3))
        assert many.shape == (2, 3, 5, 4)
        alone = integrate_gyroscope(numbers(2, 3, 5, 3)[1, 2], t[-1] * torch.arange(5))
        assert torch.allclose(many[1, 2], alone, rtol=0, atol=1e-14)
        one = integrate_gyroscope(numbers(1, 3), t[:1], 5 * SO3.identity())
        assert torch.equal(one, SO3.identity(1))
        single = integrate_gyroscope(rate.expand(4, 3).to(F32), t)
        assert single.dtype == F32
        assert torch.allclose(single.double(), found, atol=1e-6)


@MODES
def test_transforms_and_compilation_of_gyroscope_integration(mode):
    w, t = numbers(2, 6, 3), 0.1 * torch.arange(6, dtype=F64)
    with use_kernels(mode):
        expected = integrate_gyroscope(w, t)
        mapped = torch.func.vmap(lambda x: integrate_gyroscope(x, t))(w)
        assert torch.allclose(mapped, expected, rtol=0, atol=1e-14)
        direction = numbers(2, 6, 3, seed=1)
        _, rate = torch.func.jvp(lambda x: integrate_gyroscope(x, t), (w,), (direction,))
        cotangent = numbers(2, 6, 4, seed=2)
        (back,) = torch.autograd.grad((integrate_gyroscope(w.requires_grad_(), t) * cotangent).sum(), w)
        assert (rate * cotangent).sum().item() == pytest.approx((back * direction).sum().item(), rel=1e-9)
        compiled = torch.compile(integrate_gyroscope, fullgraph=True, backend="eager")
        assert torch.allclose(compiled(w.detach(), t), expected, rtol=0, atol=1e-14)


# ---------------------------------------------------------------------- shapes, gradients


@MODES
def test_batches_equal_a_loop(mode):
    spline = smooth(batch=(2,))
    t = torch.stack([torch.linspace(0.1, 0.8, 6, dtype=F64), torch.linspace(0.2, 0.9, 6, dtype=F64)])
    rate = torch.tensor(FAST_EARTH, dtype=F64)
    with use_kernels(mode):
        for earth in (None, rate):
            made = increments(spline, t, earth_rate=earth)
            plain = increments(spline, t, earth_rate=earth, compensated=False)
            found = strapdown(made, t, state(spline, t), earth_rate=earth)
            for i in range(2):
                one = BSpline(spline.control_points[i], group=SE3, order=6, dt=1.0, learnable=False)
                alone = increments(one, t[i], earth_rate=earth)
                pairs = [*zip(alone, made, strict=True)]
                pairs += zip(increments(one, t[i], earth_rate=earth, compensated=False), plain, strict=True)
                pairs += zip(
                    compensate(Increments(*(x[i] for x in plain)), t[i]), compensate(plain, t), strict=True
                )
                pairs += zip(strapdown(alone, t[i], state(one, t[i]), earth_rate=earth), found, strict=True)
                for x, y in pairs:
                    y = y if y.shape == x.shape else y[i]
                    assert torch.allclose(x, y, rtol=0, atol=1e-11)


def test_nanoseconds_and_single_precision():
    spline = smooth()
    ns = BSpline(spline.control_points, group=SE3, order=6, dt_ns=10**9, t0_ns=10**18, learnable=False)
    t = torch.linspace(0.1, 0.9, 9, dtype=F64)
    stamps = (t * 1e9).round().to(torch.int64) + 10**18
    for compensated in (True, False):
        a, b = increments(spline, t, compensated=compensated), increments(ns, stamps, compensated=compensated)
        for x, y in zip(a, b, strict=True):
            assert torch.allclose(x, y, rtol=0, atol=3e-8)
    single = strapdown(
        Increments(*(x.to(F32) for x in a)), stamps, Navigation(*(x.to(F32) for x in state(spline, t)))
    )
    double = strapdown(a, stamps, state(spline, t))
    for x, y in zip(single, double, strict=True):
        assert x.dtype == F32
        assert torch.allclose(x.double(), y, atol=1e-5)


@MODES
@pytest.mark.parametrize("earth", [False, True])
def test_gradients(mode, earth):
    spline = smooth()
    t = torch.tensor([0.2, 0.35, 0.6], dtype=F64).requires_grad_()
    rate = torch.tensor(FAST_EARTH, dtype=F64).requires_grad_() if earth else None
    g = torch.tensor(STANDARD_GRAVITY, dtype=F64).requires_grad_()
    points = spline.control_points.clone().requires_grad_()
    extra = (rate,) if earth else ()

    def made(points, t, g, rate=None, compensated=True):
        moving = BSpline(points, group=SE3, order=6, dt=1.0)
        return tuple(increments(moving, t, g, earth_rate=rate, compensated=compensated))

    def integrated(angle, gained, t, g, q, v, p, rate=None):
        both = compensate(Increments(angle, gained), t)
        return tuple(strapdown(both, t, Navigation(q, v, p), g, rate))

    with use_kernels(mode):
        for compensated in (True, False) if mode == "reference" else ():
            assert gradcheck(
                lambda *x, c=compensated: made(*x, compensated=c), (points, t, g, *extra), atol=1e-5
            )
        start = [x.detach().clone().requires_grad_() for x in state(spline, t)]
        steps = [(0.1 * numbers(2, 3, seed=i)).requires_grad_() for i in range(2)]
        assert gradcheck(integrated, (*steps, t, g, *start, *extra), atol=1e-5)

        def sampled(w, f, t):
            return tuple(sampled_increments(ImuReading(w, f), t))

        readings = [numbers(3, 3, seed=i).requires_grad_() for i in range(2)]
        assert gradcheck(sampled, (*readings, t))
        assert gradcheck(integrate_gyroscope, (readings[0], t, start[0]))
