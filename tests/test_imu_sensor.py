"""The IMU with all that is wrong with it: against a twin that goes sample by sample, and one effect at a time."""

import math

import numpy as np
import pytest
import torch
from batteries import generator, tangents
from scipy.spatial.transform import Rotation
from spline_cases import chain
from torch import nn

from torchspline import R3, SE3, SO3, BSpline, HermiteSpline, SplitBSpline, imu, product, use_kernels
from torchspline.imu.ideal import Scene, exposure

F32, F64 = torch.float32, torch.float64
SPLIT = product(R3, SO3)
GRAVITY = (0.3, -0.2, -9.7)
BATCH = 2


def normal(*shape, scale=1.0, seed=0):
    return scale * torch.randn(shape, generator=generator(seed), dtype=F64)


def spline(*batch, group=SPLIT, order=5, count=14, dt=0.1, seed=0, **options):
    """Neighbours about 0.3 rad and 0.3 m apart; the domain starts at -0.2 s."""
    total = (count - 1) * int(torch.Size(batch).numel())
    steps = 0.3 * tangents(group, [1.0], each=total, seed=seed).reshape(*batch, count - 1, 6)
    points = chain(group, steps, seed)
    return BSpline(points, group=group, order=order, dt=dt, t0=-0.2, learnable=False, **options)


def stamps(count=21):
    return torch.linspace(0.0, 0.6, count, dtype=F64)


def parameters(*batch):
    """Every deterministic effect, large enough to be seen."""
    return {
        "gyroscope_bias": normal(*batch, 3, scale=0.1, seed=1),
        "accelerometer_bias": normal(*batch, 3, scale=0.5, seed=2),
        "gyroscope_scale": 1.0 + normal(*batch, 3, scale=0.1, seed=3),
        "accelerometer_scale": 1.0 + normal(*batch, 3, scale=0.1, seed=4),
        "gyroscope_misalignment": normal(*batch, 3, scale=0.1, seed=5),
        "accelerometer_misalignment": normal(*batch, 3, scale=0.1, seed=6),
        "gyroscope_rotation": normal(*batch, 4, seed=7),
        "g_sensitivity": normal(*batch, 3, 3, scale=0.01, seed=8),
        "T_body_imu": torch.cat([normal(*batch, 3, scale=0.3, seed=9), normal(*batch, 4, seed=10)], -1),
        "accelerometer_arms": normal(*batch, 3, 3, scale=0.2, seed=11),
        "gravity": torch.tensor(GRAVITY, dtype=F64).expand(*batch, 3).clone(),
        "earth_rate": normal(*batch, 3, scale=0.2, seed=12),
        "time_offset": normal(*batch, scale=0.01, seed=13),
        "time_skew": normal(*batch, scale=0.01, seed=14),
    }


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


# ---------------------------------------------------------------------- gradients


@pytest.mark.parametrize("name", [*parameters(), "control_points", "t"])
def test_gradients_of_every_parameter(name):
    trajectory, t, p = spline(BATCH), stamps(3), parameters(BATCH)
    low_pass = imu.LowPass(3.0, 2)
    points = trajectory.control_points.detach()

    def run(x):
        moved = points + x if name == "control_points" else points
        moved = BSpline(moved, group=SPLIT, order=5, dt=0.1, t0=-0.2, learnable=False)
        given = {**p, **({name: x} if name in p else {})}
        sensor = imu.Imu(
            **given, averaging=2, rate=50.0, gyroscope_filter=low_pass, accelerometer_filter=low_pass
        )
        out = sensor(moved, t + x if name == "t" else t)
        return out.gyroscope, out.accelerometer

    x = {"control_points": torch.zeros_like(points), "t": torch.zeros(3, dtype=F64), **p}[name]
    assert torch.autograd.gradcheck(run, (x.clone().requires_grad_(),), fast_mode=True, check_forward_ad=True)


def test_gradients_of_the_noise():
    trajectory, t = spline(BATCH), stamps(5)
    names = (
        "gyroscope_noise_density",
        "accelerometer_random_walk",
        "gyroscope_bias_sigma",
        "accelerometer_bias_time",
    )
    base = {"gyroscope_bias_time": 2.0, "accelerometer_bias_sigma": 0.2}

    def run(*densities):
        sensor = imu.Imu(noise=imu.ImuNoise(**base, **dict(zip(names, densities, strict=True))), rate=100.0)
        out = sensor(trajectory, t, generator=generator(3))
        return out.gyroscope, out.accelerometer, out.gyroscope_bias

    inputs = [torch.full((3,), 0.5, dtype=F64, requires_grad=True) for _ in names]
    assert torch.autograd.gradcheck(run, inputs, fast_mode=True, check_forward_ad=True)


def test_what_is_learnt_is_among_the_parameters():
    bias, density = nn.Parameter(torch.zeros(3, dtype=F64)), nn.Parameter(torch.full((3,), 0.1, dtype=F64))
    sensor = imu.Imu(
        gyroscope_bias=bias,
        noise=imu.ImuNoise(gyroscope_noise_density=density, accelerometer_random_walk=0.2),
        time_offset=nn.Parameter(torch.tensor(0.0, dtype=F64)),
        accelerometer_filter=imu.LowPass(nn.Parameter(torch.tensor(20.0, dtype=F64))),
    )
    assert {name for name, _ in sensor.named_parameters()} == {
        "gyroscope_bias", "gyroscope_noise_density", "sampling.time_offset", "accelerometer_filter.bandwidth"
    }  # fmt: skip
    assert sensor.noise.gyroscope_noise_density is density
    assert sensor.noise.accelerometer_random_walk == 0.2
    assert imu.Imu().noise is None
    trajectory = spline(extrapolate="linear")
    truth = imu.Imu(gyroscope_bias=(0.1, -0.2, 0.3), time_offset=0.01)(trajectory, stamps())
    learner = imu.Imu(gyroscope_bias=bias, time_offset=sensor.sampling.time_offset)
    optimizer = torch.optim.LBFGS(learner.parameters(), max_iter=40, line_search_fn="strong_wolfe")

    def loss():
        optimizer.zero_grad()
        cost = (learner(trajectory, stamps()).gyroscope - truth.gyroscope).square().sum()
        cost.backward()
        return cost

    optimizer.step(loss)
    assert torch.allclose(bias.detach(), torch.tensor([0.1, -0.2, 0.3], dtype=F64), atol=1e-4)
    assert abs(float(learner.sampling.time_offset.detach()) - 0.01) < 1e-5


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


# ---------------------------------------------------------------------- noise and its numbers


def noisy(**more):
    noise = imu.ImuNoise(0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 5.0, 6.0)
    return imu.Imu(noise=noise, jitter=1e-3, drop_probability=0.2, rate=100.0, **more)


def test_an_item_is_the_same_in_any_batch():
    trajectory, t, sensor = spline(4), stamps(), noisy()
    whole = sensor(trajectory, t, generator=[imu.item_generator(7, i) for i in range(4)])
    part = BSpline(trajectory.control_points[2:], group=SPLIT, order=5, dt=0.1, t0=-0.2)
    again = sensor(part, t, generator=[imu.item_generator(7, i) for i in (2, 3)])
    for a, b in zip(whole, again, strict=True):
        assert torch.equal(a if a is t else a[2:], b)
    assert not torch.equal(whole.gyroscope[0], whole.gyroscope[1])
    repeat = sensor(trajectory, t, generator=[imu.item_generator(8, i) for i in range(4)])
    assert not torch.equal(whole.gyroscope, repeat.gyroscope)


def test_one_motion_and_a_generator_for_each_item():
    out = noisy()(spline(), stamps(), generator=[imu.item_generator(0, i) for i in range(3)])
    assert out.gyroscope.shape == (3, 21, 3)
    assert out.valid.shape == out.instants.shape == (3, 21)
    assert out.gyroscope_bias.shape == (3, 21, 3)


def test_noise_has_its_densities():
    still = SplitBSpline(SE3.identity(6, dtype=F64), dt=1.0, learnable=False)
    t = torch.linspace(0.0, 3.0, 3001, dtype=F64)
    density = torch.tensor([0.01, 0.02, 0.03], dtype=F64)
    white = imu.Imu(noise=imu.ImuNoise(density, 0.1))(still, t, generator=generator(0))
    ideal = imu.Imu()(still, t)
    count = 3 * len(t)
    # The mean interval is a millisecond, and a standard deviation of n numbers is known to 1 / sqrt(2 n).
    assert torch.allclose(white.gyroscope.std(0), density * math.sqrt(1000), rtol=5 / math.sqrt(2 * len(t)))
    deviation = (white.accelerometer - ideal.accelerometer).std()
    assert abs(deviation / (0.1 * math.sqrt(1000)) - 1) < 5 / math.sqrt(2 * count)
    assert white.gyroscope_bias.abs().max() == 0.0
    walk = imu.Imu(noise=imu.ImuNoise(0.0, 0.0, 0.5))(still, t, generator=generator(0))
    steps = walk.gyroscope_bias.diff(dim=0)
    assert abs(steps.std() / (0.5 * math.sqrt(1e-3)) - 1) < 5 / math.sqrt(2 * count)
    assert torch.equal(walk.gyroscope, walk.gyroscope_bias)
    slow = imu.Imu(noise=imu.ImuNoise(0.0, 0.0, gyroscope_bias_instability=0.5))(
        still, t, generator=generator(0)
    )
    assert slow.gyroscope_bias.std() > 0.1
    assert slow.accelerometer_bias.abs().max() == 0.0


def test_densities_of_a_batch_and_single_precision():
    noise = imu.ImuNoise(torch.tensor([[0.0] * 3, [1.0] * 3]), 0.1)
    out = imu.Imu(noise=noise, dtype=F32)(spline(2), stamps(), generator=generator(0))
    assert out.gyroscope.dtype == out.accelerometer_bias.dtype == F32
    ideal = imu.Imu(dtype=F32)(spline(2), stamps())
    assert torch.equal(out.gyroscope[0], ideal.gyroscope[0])
    assert (out.gyroscope[1] - ideal.gyroscope[1]).abs().max() > 1.0


# ---------------------------------------------------------------------- sampling


def test_clocks_of_a_batch_in_seconds_and_nanoseconds():
    offset = torch.tensor([0.01, -0.02], dtype=F64)
    trajectory, t = spline(), stamps()
    out = imu.Imu(time_offset=offset, time_skew=1e-3)(trajectory, t)
    start, stop = trajectory.domain
    mid = 0.5 * (start + stop)
    again = out.instants + offset[:, None] + 1e-3 * (out.instants - mid)
    assert torch.allclose(again, t.expand(2, -1), rtol=0, atol=1e-15)
    whole = BSpline(
        trajectory.control_points.detach(),
        group=SPLIT,
        order=5,
        dt_ns=10**8,
        t0_ns=-2 * 10**8,
        learnable=False,
    )
    t_ns = (t * 1e9).round().to(torch.int64)
    exact = imu.Imu(time_offset=offset, time_skew=1e-3)(whole, t_ns)
    assert exact.instants.dtype == torch.int64
    assert (exact.instants - out.instants * 1e9).abs().max() <= 1.0
    assert torch.allclose(exact.accelerometer, out.accelerometer, atol=1e-5)


def test_jitter_stays_inside_and_drops_are_marked():
    trajectory = spline()
    start, stop = trajectory.domain
    t = torch.linspace(start, stop, 4001, dtype=F64)
    out = imu.Imu(jitter=1e-3, drop_probability=0.25)(trajectory, t, generator=generator(0))
    late = out.instants - t
    assert abs(late[10:-10].std() / 1e-3 - 1) < 5 / math.sqrt(8000)
    assert start <= out.instants.min() <= out.instants.max() <= stop
    share = out.valid.to(F64).mean()
    assert abs(share - 0.75) < 5 * math.sqrt(0.25 * 0.75 / 4001)
    there = imu.Imu()(trajectory, out.instants)
    assert torch.allclose(out.gyroscope[out.valid], there.gyroscope[out.valid], atol=1e-12)
    assert (out.gyroscope[~out.valid] == 0.0).all()
    with pytest.raises(ValueError, match="outside the domain"):
        imu.Imu(jitter=1e-3)(trajectory, t + 0.01)


def test_a_single_stamp():
    trajectory, t = spline(2), stamps()
    sensor = imu.Imu(noise=imu.ImuNoise(0.1), rate=100.0, averaging=2, gyroscope_filter=imu.LowPass(10.0))
    one = sensor(trajectory, t[3], generator=generator(0))
    assert one.gyroscope.shape == one.accelerometer_bias.shape == (2, 3)
    assert one.valid.shape == (2,)
    assert one.instants.shape == ()


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


def test_gradients_of_the_range():
    trajectory, t = spline(), stamps(5)
    limit = torch.tensor([1.0, 0.5, 2.0], dtype=F64, requires_grad=True)

    def run(x):
        return imu.Imu(gyroscope_range=x)(trajectory, t).gyroscope

    assert (run(limit) == limit).any()
    assert torch.autograd.gradcheck(run, (limit,))


def test_gradients_pass_the_converter_straight_where_it_does_not_clip():
    bias = torch.zeros(3, dtype=F64, requires_grad=True)
    trajectory, t = spline(), stamps()
    out = imu.Imu(gyroscope_bias=bias, gyroscope_range=2.0, gyroscope_resolution=0.3)(trajectory, t)
    out.gyroscope.sum().backward()
    inside = imu.Imu()(trajectory, t).gyroscope.abs() < 2.0
    assert torch.equal(bias.grad, inside.sum(0).to(F64))
    assert not inside.all()

    def run(bias):
        sensor = imu.Imu(gyroscope_bias=bias, gyroscope_range=2.0, gyroscope_resolution=0.3)
        return sensor(trajectory, t).gyroscope.sum(0)

    _, forward = torch.func.jvp(run, (bias.detach(),), (torch.ones(3, dtype=F64),))
    assert torch.equal(forward, inside.sum(0).to(F64))


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


@pytest.mark.parametrize("name", parameters())
def test_vmap_over_a_parameter_is_a_loop(name):
    trajectory, t, p = spline(), stamps(5), parameters()
    low_pass = imu.LowPass(3.0, 2)

    def run(x):
        sensor = imu.Imu(**{**p, name: x}, averaging=1, gyroscope_filter=low_pass, gyroscope_range=2.0)
        out = sensor(trajectory, t)
        return out.gyroscope, out.accelerometer

    batch = torch.stack([p[name], p[name] + 1e-3])
    for mapped, one, two in zip(torch.func.vmap(run)(batch), run(batch[0]), run(batch[1]), strict=True):
        assert torch.allclose(mapped, torch.stack([one, two]), rtol=0, atol=1e-12)
