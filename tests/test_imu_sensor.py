"""The IMU with all that is wrong with it: against a twin that goes sample by sample, and its way back."""

import math

import numpy as np
import pytest
import torch
from batteries import generator
from scipy.spatial.transform import Rotation
from sensor_cases import BATCH, F32, F64, SPLIT, normal, parameters, spline, stamps

from torchspline import R3, SE3, SO3, BSpline, HermiteSpline, imu, use_kernels
from torchspline.imu.ideal import Scene, exposure

# ---------------------------------------------------------------------- the whole chain


STENCIL = np.arange(-3, 4) * 0.002
#: Central differences of sixth order, of the first and second derivative.
FIRST = np.array([-1 / 60, 3 / 20, -3 / 4, 0, 3 / 4, -3 / 20, 1 / 60]) / 0.002
SECOND = np.array([1 / 90, -3 / 20, 3 / 2, -49 / 18, 3 / 2, -3 / 20, 1 / 90]) / 0.002**2


def exposed_twin(trajectory, time, p):
    """Angular rate and specific force at one instant, from differences of poses in inertial space."""
    earth, mount = p["earth_rate"], Rotation.from_quat(np.roll(p["T_body_imu"][3:], -1))
    values = trajectory(torch.from_numpy(time + STENCIL)).numpy()
    spin = Rotation.from_rotvec(earth * (time + STENCIL)[:, None])
    position, body = spin.apply(values[:, :3]), spin * Rotation.from_quat(np.roll(values[:, 3:], -1, axis=1))
    sensor = body * mount
    now = sensor[3].inv()
    rate = FIRST @ (now * sensor).as_rotvec()
    forces = []
    for axis in range(3):
        point = position + body.apply(p["T_body_imu"][:3] + mount.apply(p["accelerometer_arms"][axis]))
        # Gravitation is gravity without the centrifugal force.
        gravitation = spin[3].apply(p["gravity"]) + np.cross(earth, np.cross(earth, point[3]))
        forces.append(now.apply(SECOND @ point - gravitation)[axis])
    return rate, np.array(forces)


def averaged_twin(trajectory, time, p, averaging, interval):
    nodes, weights = np.polynomial.legendre.leggauss(averaging) if averaging else ([1.0], [2.0])
    parts = [exposed_twin(trajectory, time + 0.5 * (node - 1.0) * interval, p) for node in nodes]
    return tuple(
        sum(0.5 * w * x for w, x in zip(weights, some, strict=True)) for some in zip(*parts, strict=True)
    )


def calibrated_twin(rate, force, p):
    """Row by row and column by column."""
    C = Rotation.from_quat(np.roll(p["gyroscope_rotation"], -1)).inv()
    rate_g, force_g = C.apply(rate), C.apply(force)
    gyro, accel = np.zeros(3), np.zeros(3)
    for i in range(3):
        gyro[i] = p["gyroscope_scale"][i] * rate_g[i] + p["g_sensitivity"][i] @ force_g
        accel[i] = p["accelerometer_scale"][i] * force[i]
    for k, (i, j) in enumerate(((1, 0), (2, 0), (2, 1))):
        gyro[i] += p["gyroscope_misalignment"][k] * rate_g[j]
        accel[i] += p["accelerometer_misalignment"][k] * force[j]
    return gyro, accel


def instant_twin(trajectory, stamp, p):
    start, stop = trajectory.domain
    mid = 0.5 * (start + stop)
    return mid + (stamp - p["time_offset"] - mid) / (1.0 + p["time_skew"])


def readings_twin(trajectory, times, p, averaging):
    """The chain as the docstring of `Imu` has it, one sample after the other."""
    interval = (times[-1] - times[0]) / (len(times) - 1)
    rows = []
    for stamp in times:
        exposed = averaged_twin(trajectory, instant_twin(trajectory, stamp, p), p, averaging, interval)
        gyro, accel = calibrated_twin(*exposed, p)
        rows.append((gyro + p["gyroscope_bias"], accel + p["accelerometer_bias"]))
    return np.array(rows).transpose(1, 0, 2)


def filtered_twin(x, times, bandwidth):
    """A filter of first order, sample by sample: the response to a ramp over each interval."""
    tau, rows = 1.0 / (2.0 * math.pi * bandwidth), [x[0]]
    for i in range(1, len(x)):
        h = times[i] - times[i - 1]
        slope, a = (x[i] - x[i - 1]) / h, math.exp(-h / tau)
        # y' = (u - y) / tau with u = x0 + slope s: the particular solution is u - slope tau.
        rows.append(x[i] - slope * tau + a * (rows[-1] - (x[i - 1] - slope * tau)))
    return np.array(rows)


@pytest.mark.parametrize("averaging", [0, 2])
def test_the_chain_is_that_of_the_twin(averaging):
    trajectory, t, p = spline(BATCH, order=6), stamps(7), parameters(BATCH)
    out = imu.Imu(**p, averaging=averaging)(trajectory, t)
    assert out.valid.all()
    assert torch.equal(out.gyroscope_bias, p["gyroscope_bias"][:, None].expand(BATCH, 7, 3))
    for item in range(BATCH):
        one = BSpline(trajectory.control_points[item], group=SPLIT, order=6, dt=0.1, t0=-0.2, learnable=False)
        own = {name: np.asarray(x[item]) for name, x in p.items()}
        gyro, accel = readings_twin(one, t.numpy(), own, averaging)
        np.testing.assert_allclose(out.gyroscope[item].numpy(), gyro, atol=1e-6)
        np.testing.assert_allclose(out.accelerometer[item].numpy(), accel, atol=1e-4)


def test_every_effect_at_once():
    trajectory, t, p = spline(order=6), stamps(9), parameters()
    densities = {
        "noise_density": (0.01, 0.02),
        "random_walk": (0.03, 0.04),
        "bias_sigma": (0.05, 0.06),
        "bias_time": (5.0, 6.0),
    }
    six = {name: torch.tensor([g] * 3 + [a] * 3, dtype=F64) for name, (g, a) in densities.items()}
    noise = {
        f"{s}_{n}": both[i]
        for n, both in densities.items()
        for i, s in enumerate(("gyroscope", "accelerometer"))
    }
    sensor = imu.Imu(
        **p, noise=imu.ImuNoise(**noise), rate=50.0, averaging=2, jitter=1e-3, drop_probability=0.3,
        gyroscope_filter=imu.LowPass(3.0), accelerometer_filter=imu.LowPass(4.0), gyroscope_range=1.0,
        accelerometer_range=12.0, gyroscope_resolution=0.01, accelerometer_resolution=0.05,
    )  # fmt: skip
    out = sensor(trajectory, t, generator=generator(5))

    again, shape = generator(5), (9, 6)  # in the order in which the sensor draws
    normals = imu.white_noise((9, 2), 1.0, 1.0, again, F32).to(F64)
    walk = imu.random_walk(shape, six["random_walk"], t, again, F64)
    driving = six["bias_sigma"] * (2.0 / six["bias_time"]).sqrt()
    walk = walk + imu.gauss_markov(shape, driving, six["bias_time"], t, again, F64)
    white = imu.white_noise(shape, six["noise_density"], 50.0, again, F64).numpy()
    bias = (walk + torch.cat([p["gyroscope_bias"], p["accelerometer_bias"]])).numpy()
    own = {name: x.numpy() for name, x in p.items()}
    times = [
        instant_twin(trajectory, float(s), own) + 1e-3 * float(n)
        for s, n in zip(t, normals[:, 0], strict=True)
    ]
    exposed = [averaged_twin(trajectory, time, own, 2, 0.02) for time in times]
    rate, force = (
        filtered_twin(np.array(x), times, f)
        for x, f in zip(zip(*exposed, strict=True), (3.0, 4.0), strict=True)
    )
    limit, step = np.repeat([1.0, 12.0], 3), np.repeat([0.01, 0.05], 3)
    clipped = 0
    for i in range(9):
        read = np.concatenate(calibrated_twin(rate[i], force[i], own)) + bias[i] + white[i]
        clipped += (np.abs(read) > limit).sum()
        read = np.round(np.clip(read, -limit, limit) / step) * step
        arrived = normals[i, 1] >= torch.special.ndtri(torch.tensor(0.3))
        assert bool(out.valid[i]) == bool(arrived)
        read = read if arrived else np.zeros(6)
        np.testing.assert_allclose(out.gyroscope[i].numpy(), read[:3], atol=1e-12)
        np.testing.assert_allclose(out.accelerometer[i].numpy(), read[3:], atol=1e-12)
    assert clipped > 5
    assert 0 < out.valid.sum() < 9
    np.testing.assert_allclose(out.instants.numpy(), times, atol=1e-15)
    np.testing.assert_allclose(
        torch.cat([out.gyroscope_bias, out.accelerometer_bias], -1).numpy(), bias, atol=1e-15
    )


def test_without_any_effect_it_is_measure():
    trajectory, t = spline(group=SE3), stamps()
    mount = parameters()["T_body_imu"]
    out, ideal = imu.Imu(T_body_imu=mount)(trajectory, t), imu.measure(trajectory, t, T_body_imu=mount)
    assert torch.allclose(out.gyroscope, ideal.gyroscope, rtol=0, atol=1e-13)
    assert torch.allclose(out.accelerometer, ideal.accelerometer, rtol=0, atol=1e-12)
    assert out.t is t
    assert torch.equal(out.instants, t)


def test_trajectories_of_every_kind():
    split = spline(order=6)
    knots = torch.linspace(-0.2, 0.7, 10, dtype=F64)[:-1]
    state = split.evaluate(knots)
    others = [
        HermiteSpline(state.value, state.velocity, state.acceleration, group=SPLIT, times=knots),
        split.mounted(SE3.identity(dtype=F64)),
    ]
    for other in others:
        out, ideal = imu.Imu(earth_rate=(0.1, 0.2, 0.3))(other, knots), imu.Imu()(split, knots)
        turned = SO3.act(SO3.inverse(state.value[:, 3:]), torch.tensor([0.1, 0.2, 0.3], dtype=F64))
        assert torch.allclose(out.gyroscope, ideal.gyroscope + turned, atol=1e-12)


# ---------------------------------------------------------------------- the way back


@pytest.mark.parametrize("batch", [(), (BATCH,)])
def test_correct_undoes_the_calibration(batch):
    p, trajectory, t = parameters(*batch), spline(*batch), stamps()
    linear = {name: x for name, x in p.items() if "time" not in name and "rotation" not in name}
    linear["gyroscope_rotation"] = p["gyroscope_rotation"]
    placed = {name: linear[name] for name in ("T_body_imu", "accelerometer_arms", "gravity", "earth_rate")}
    sensor, ideal = imu.Imu(**linear), imu.Imu(**placed)(trajectory, t)
    out = sensor(trajectory, t)
    assert (out.gyroscope - ideal.gyroscope).abs().max() > 0.1
    back = sensor.correct(out)
    assert torch.allclose(back.gyroscope, ideal.gyroscope, rtol=0, atol=1e-12)
    assert torch.allclose(back.accelerometer, ideal.accelerometer, rtol=0, atol=1e-11)


def test_correct_with_the_true_biases():
    walking = imu.ImuNoise(gyroscope_random_walk=0.1, accelerometer_bias_sigma=0.3)
    drift = BSpline(normal(8, 3), group=R3, dt=0.3, t0=-0.3)
    sensor = imu.Imu(noise=walking, gyroscope_bias=drift, g_sensitivity=parameters()["g_sensitivity"])
    trajectory, t = spline(), stamps()
    out, ideal = sensor(trajectory, t, generator=generator(0)), imu.Imu()(trajectory, t)
    assert (out.gyroscope_bias - drift(t)).abs().max() > 0.01
    assert (out.gyroscope_bias - drift(t))[0].abs().max() == 0.0
    back = sensor.correct(out, out.gyroscope_bias, out.accelerometer_bias)
    assert torch.allclose(back.gyroscope, ideal.gyroscope, atol=1e-12)
    assert torch.allclose(back.accelerometer, ideal.accelerometer, atol=1e-12)


# ---------------------------------------------------------------------- converter


def test_range_and_resolution():
    trajectory, t = spline(), stamps(101)
    free = imu.Imu()(trajectory, t)
    sensor = imu.Imu(gyroscope_range=2.0, accelerometer_resolution=(0.5, 0.25, 0.125))
    out = sensor(trajectory, t)
    assert (free.gyroscope.abs() > 2.0).any()
    assert torch.equal(out.gyroscope, free.gyroscope.clamp(-2.0, 2.0))
    steps = torch.tensor([0.5, 0.25, 0.125], dtype=F64)
    assert torch.equal(out.accelerometer / steps, (free.accelerometer / steps).round())
    assert ((out.accelerometer - free.accelerometer).abs() <= 0.5 * steps + 1e-12).all()


# ---------------------------------------------------------------------- compiled loops


@pytest.mark.parametrize("kind", ["state", "kinematics"])
def test_the_loop_equals_the_reference(kind):
    if kind == "state":
        trajectory = spline(BATCH)
    else:
        keys = spline(BATCH).evaluate(stamps(8))
        trajectory = HermiteSpline(keys.value, keys.velocity, keys.acceleration, group=SPLIT, times=stamps(8))
        trajectory.kinematics = trajectory.kinematics  # of this one
    p, t = parameters(BATCH), stamps()
    scene = Scene(
        p["gravity"], SE3.normalize(p["T_body_imu"]), p["accelerometer_arms"].flatten(-2), p["earth_rate"]
    )
    with use_kernels("reference"):
        expected = exposure(trajectory, t, scene)
        shared = exposure(trajectory, t, Scene(*(x[0] for x in scene)))
    with use_kernels("auto"), torch.no_grad():
        assert torch.allclose(exposure(trajectory, t, scene), expected, rtol=0, atol=1e-12)
        one = Scene(*(x[0] for x in scene))
        assert torch.allclose(exposure(trajectory, t, one), shared, rtol=0, atol=1e-12)


# ---------------------------------------------------------------------- increments


@pytest.mark.parametrize("averaging", [0, 3])
def test_increments_are_those_of_the_motion(averaging):
    trajectory = spline(BATCH, order=6, count=20)
    mount, errors = parameters()["T_body_imu"], []
    sensor = imu.Imu(T_body_imu=mount, averaging=averaging)
    for count in (40, 80):
        t = torch.linspace(0.0, 1.0, count + 1, dtype=F64)
        found = sensor.increments(sensor(trajectory, t), t)
        exact = imu.increments(trajectory, t, T_body_imu=mount)
        # The first readings of an IMU that averages belong to the interval before, their neighbours to the edges.
        errors.append([(a - b)[:, 2:-2].abs().max().item() for a, b in zip(found, exact, strict=True)])
        sizes = [x.abs().max().item() for x in exact]
    for coarse, fine, size in zip(*errors, sizes, strict=True):
        assert fine < 1e-2 * size
        assert coarse / fine > 6.0  # of third order at least
