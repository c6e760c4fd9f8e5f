"""Sliding windows against batch solutions, dense elimination, Kalman's formulas and counting."""

import copy
import math
import pickle

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

import torchspline as ts
from torchspline.fit.online import SlidingWindow
from torchspline.fit.online.marginal import marginalised, random_walk
from torchspline.fit.problem import Problem
from torchspline.fit.residual import Clock
from torchspline.fit.residuals import Accelerometer, Gyroscope, Pose, StateValue, StateVelocity
from torchspline.fit.result import Result
from torchspline.fit.solving.bends import Bends, Walk
from torchspline.fit.solving.solver import Options, minimise
from torchspline.fit.solving.system import BandSystem
from torchspline.fit.solving.terms import Term
from torchspline.fit.variables import Variable
from torchspline.groups import R3, SE3, SO3, product

F64 = torch.float64


def pytest_generate_tests(metafunc):
    """Every test by compiled loops, and by the reference where that takes less than a few seconds."""
    words = ("rigid", "scatter", "window_with", "update_with")
    long = any(word in metafunc.function.__name__ for word in words)
    metafunc.parametrize("kernels", ["auto"] if long else ["auto", "reference"], indirect=True)


@pytest.fixture(autouse=True)
def kernels(request):
    with ts.use_kernels(request.param):
        yield


EXACT = {"max_iterations": 6, "cost_tolerance": 0.0, "gradient_tolerance": 1e-12, "damping": 1e-13}
LINEAR = Options(*EXACT.values())


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def batch(window, residuals, priors=(), smoothness=100.0, group=R3, options=LINEAR):
    """All of it at once: the same spline, the same measurements, nothing forgotten."""
    whole = window.trajectory
    problem = Problem(whole)
    for residual, index in residuals:
        problem.add(residual, **index)
    for variable, sigma in priors:
        problem.add_prior(variable, sigma=sigma)
    with torch.no_grad():
        linearizer = problem.prepare()
        stiffness = np.full(group.tangent_size, 1.0 / (window._spacing * smoothness))
        linearizer.terms.append(Bends(linearizer.model, stiffness))
        model = linearizer.model
        state, system, trace = minimise(model, model.state(), linearizer, options, lambda _: None)
        model.store(state)
    return whole, Result(linearizer, state, system, trace)


def packets(end, rate, size, start=0.0):
    """Times in packets."""
    t = start + torch.arange(int((end - start) * rate), dtype=F64) / rate
    return t.split(size)


@pytest.mark.parametrize("nanoseconds", [False, True])
@pytest.mark.parametrize("order", [2, 4, 5])
def test_a_linear_window_equals_the_batch_solution(order, nanoseconds):
    """Positions and velocities with an unknown bias, R^3: what was summarised is as good as what is still there."""
    clock = {"dt_ns": 200_000_000, "t0_ns": 10**18} if nanoseconds else {"dt": 0.2, "t0": 3.0}
    stamps = lambda t: (10**18 + (t * 1e9).round().to(torch.int64)) if nanoseconds else 3.0 + t  # noqa: E731
    window = SlidingWindow(
        torch.zeros(3, dtype=F64), group=R3, order=order, window=1.5, smoothness=1.0, **clock
    )
    seen, steps = [], 0
    for n, t in enumerate(packets(9.0, 20.0, 7, start=0.013)):  # order 2 has no velocity at knots
        if 70 < 7 * n < 90:  # a gap
            continue
        position = torch.stack([t.sin(), t.cos(), 0.1 * t], dim=-1) + 0.01 * random(len(t), 3, seed=n)
        velocity = random(len(t), 3, seed=n + 1000)
        arrived = [
            StateValue(stamps(t), position, sigma=0.01),
            StateVelocity(stamps(t), velocity, sigma=0.3 + random(len(t), 3, seed=5).abs()),
        ]
        for residual in arrived:
            window.add(residual)
            seen.append((residual, {}))
        result = window.update(**EXACT)
        if n % 4 == 0:
            whole, _ = batch(window, seen, smoothness=1.0)
            M = len(result._state.points[id(result._linearizer.model.trajectory.module)])
            assert_allclose(
                window.trajectory.control_points[-M:], whole.control_points[-M:], rtol=0, atol=1e-9
            )
            steps += 1
    assert window._first > 30
    assert steps > 4


def test_variables_of_a_linear_window_equal_those_of_the_batch():
    """Gravity-like biases: on R^3 nothing has one, so a gyroscope on a straight line of rotations does."""
    bias = Variable("bias", torch.zeros(3, dtype=F64))
    window = SlidingWindow(SO3.identity(dtype=F64), group=SO3, dt=0.2, window=1.0, smoothness=10.0)
    window.add_prior(bias, sigma=0.5)
    axis, truth = torch.tensor([0.0, 0.0, 1.0], dtype=F64), torch.tensor([0.0, 0.0, 0.3], dtype=F64)
    seen = []
    for n, t in enumerate(packets(5.0, 20.0, 6)):
        turned = SO3.exp((0.5 * t + 0.2 * t.sin() + 0.05 * random(len(t), seed=n))[:, None] * axis)
        gyro = (0.5 + 0.2 * t.cos())[:, None] * axis + truth + 0.02 * random(len(t), 1, seed=n + 99) * axis
        for residual in (StateValue(t, turned, sigma=0.05), Gyroscope(t, gyro, sigma=0.02, bias=bias)):
            window.add(residual)
            seen.append((residual, {}))
        result = window.update(**EXACT)
    online, sigma = bias.value.clone(), result.standard_deviation(bias)
    bias.value = torch.zeros(3, dtype=F64)
    _, whole = batch(window, seen, [(bias, 0.5)], 10.0, SO3)
    # Rotations about one axis commute: the problem is linear but for the spread of the axes across.
    assert_allclose(online[2], bias.value[2], atol=1e-9)
    assert_allclose(sigma, whole.standard_deviation(bias), rtol=1e-3)
    assert abs(float(online[2]) - 0.3) < 4 * float(sigma[2])


def motion(group, count=120, dt=0.1, seed=3):
    """A wandering body that keeps turning."""
    steps = 0.05 * random(count, 6, seed=seed)
    smooth = steps.cumsum(0) - steps.cumsum(0).mean(0)
    return ts.BSpline(group.exp(0.4 * smooth), group=group, dt=dt, learnable=False)


def inertial(truth, window, end, seed=0, every=10, sigmas=(0.02, 0.01, 0.1)):
    """Packets of an IMU at 100 Hz with unknown biases and of poses every `every`-th sample."""
    gyro_bias, accel_bias = (Variable(f"{x}_bias", torch.zeros(3, dtype=F64)) for x in ("gyro", "accel"))
    pose_sigma, gyro_sigma, accel_sigma = sigmas
    gravity = torch.tensor([0.0, 0.0, -9.80665], dtype=F64)
    residuals = []
    for n, t in enumerate(packets(end, 100.0, 20)):
        reading = ts.imu.measure(truth, t)
        noise = random(3, len(t), 6, seed=seed * 1000 + n)
        at = t[::every]
        pose = truth(at)
        moved = pose[:, :3] + pose_sigma * noise[2, : len(at), :3]
        turned = SO3.retract(pose[:, 3:], pose_sigma * noise[2, : len(at), 3:], side="right")
        gyro = reading.gyroscope + torch.tensor([0.02, -0.01, 0.03], dtype=F64) + gyro_sigma * noise[0, :, :3]
        force = (
            reading.accelerometer + torch.tensor([0.1, 0.2, -0.1], dtype=F64) + accel_sigma * noise[1, :, :3]
        )
        arrived = [
            Gyroscope(t, gyro, sigma=gyro_sigma, bias=gyro_bias),
            Accelerometer(t, force, sigma=accel_sigma, bias=accel_bias, gravity=gravity),
            Pose(at, torch.cat([moved, turned], dim=-1), sigma=pose_sigma),
        ]
        residuals += [(x, {}) for x in arrived]
        for x in arrived:
            window.add(x)
        yield t, residuals, gyro_bias, accel_bias


def followed(truth, window, end, seed=0):
    """The last of `inertial` with an update after each packet, and the last result."""
    for found in inertial(truth, window, end, seed):
        last = (*found, window.update())
    return last


@pytest.mark.parametrize("group", [SE3, product(R3, SO3)], ids=str)
def test_a_rigid_body_with_an_imu_is_close_to_the_batch_solution(group):
    truth = motion(group)
    start = truth(torch.zeros(1, dtype=F64))[0]
    window = SlidingWindow(start, group=group, dt=0.1, window=1.5)
    t, residuals, gyro_bias, accel_bias, result = followed(truth, window, 5.0)
    assert window._first > 25
    biases = torch.cat([gyro_bias.value, accel_bias.value])
    at = t[-40:]
    ours, covariance = window.trajectory(at), result.trajectory_covariance(at)
    sigma = torch.stack([x.diagonal() for x in covariance]).sqrt()
    bias_sigma = torch.cat([result.standard_deviation(x) for x in (gyro_bias, accel_bias)])
    whole, full = batch(window, residuals, group=group, options=Options(30, 1e-10, 1e-9))
    assert full.converged
    apart = group.log(group.between(whole(at), ours)) / sigma
    assert apart.abs().max() < 0.02
    moved = torch.cat([gyro_bias.value, accel_bias.value]) - biases
    assert (moved / bias_sigma).abs().max() < 0.05
    # As sure of itself as the batch is.
    expected = torch.stack([x.diagonal() for x in full.trajectory_covariance(at)]).sqrt()
    assert_allclose(sigma, expected, rtol=0.02)
    # And what is finished stays in reach.
    finished = window.trajectory.kinematics(torch.tensor([0.05, 1.0, 3.0], dtype=F64)).position
    assert (finished - truth.kinematics(torch.tensor([0.05, 1.0, 3.0], dtype=F64)).position).norm(
        dim=-1
    ).max() < 0.1


def test_estimates_scatter_as_their_covariance_says():
    """Normalised squared errors of biases and the latest pose: 12 numbers, 20 draws, 4 standard deviations."""
    truth, squares = motion(product(R3, SO3)), []
    end = torch.tensor([2.35], dtype=F64)
    actual = truth(end)[0]
    for draw in range(20):
        window = SlidingWindow(truth(0 * end)[0], group=truth.group, dt=0.1, window=0.8)
        _, _, gyro_bias, accel_bias, result = followed(truth, window, 2.4, seed=draw + 1)
        error = torch.cat([
            truth.group.log(truth.group.between(actual, window.trajectory(end)[0])),
            gyro_bias.value - torch.tensor([0.02, -0.01, 0.03], dtype=F64),
            accel_bias.value - torch.tensor([0.1, 0.2, -0.1], dtype=F64),
        ])  # fmt: skip
        blocks = [result.trajectory_covariance(end)[0], *map(result.covariance, (gyro_bias, accel_bias))]
        parts = error.split([6, 3, 3])
        squares.append(sum(float(e @ torch.linalg.solve(C, e)) for e, C in zip(parts, blocks, strict=True)))
    # The sum of three blocks has the mean of its dimensions; their correlation at most triples its variance.
    assert 12 - 4 * math.sqrt(3 * 24 / 20) < np.mean(squares) < 12 + 4 * math.sqrt(3 * 24 / 20)


def test_what_is_remembered_is_the_schur_complement_of_a_dense_jacobian():
    generator = np.random.default_rng(1)
    J, r = generator.normal(size=(40, 9)), generator.normal(size=40)
    keep, drop = np.array([7, 2, 5, 0]), np.array([1, 3, 4, 6, 8])
    information, slope, constant = marginalised(J.T @ J, J.T @ r, keep)
    # Projecting the dropped unknowns out of the equations themselves.
    left = np.linalg.svd(J[:, drop])[0][:, len(drop) :].T
    assert_allclose(information, (left @ J[:, keep]).T @ (left @ J[:, keep]), rtol=1e-10)
    assert_allclose(slope, (left @ J[:, keep]).T @ (left @ r), rtol=1e-10)
    x = np.linalg.solve(information, -slope)
    assert 0.5 * x @ information @ x + slope @ x + constant == pytest.approx(0.0, abs=1e-10)
    # Unknowns that nothing sees, or of very different units, are no trouble.
    J[:, 3] = 0.0
    J[:, 4] *= 1e-9
    again, _, _ = marginalised(J.T @ J, J.T @ r, keep)
    left = np.linalg.svd(J[:, drop] * [1, 1, 1e9, 1, 1])[0][:, 4:].T
    assert_allclose(again, (left @ J[:, keep]).T @ (left @ J[:, keep]), rtol=1e-9)


def test_the_prior_of_a_window_is_the_dense_schur_complement():
    """Of a nonlinear problem, at the estimate, from the rows that automatic differentiation gives."""
    truth = motion(SE3, count=20)
    bias = Variable("bias", torch.full((3,), 0.01, dtype=F64))
    t = torch.arange(0.0, 1.7, 0.01, dtype=F64)
    gyro = ts.imu.measure(truth, t).gyroscope + 0.02 * random(len(t), 3)
    window = SlidingWindow(truth.control_points, group=SE3, dt=0.1, window=1.2, smoothness=0.5)
    window.add(Gyroscope(t, gyro, sigma=0.02, bias=bias))
    window.add(StateValue(t[::5], truth(t[::5]), sigma=0.01))
    window.update(max_iterations=0)
    drop, count = 5, 20
    assert window._first == drop
    ((spline_part, _),) = (prior.parts for prior in window._priors)
    assert spline_part.points.tolist() == [0, 1, 2]

    def residuals(steps, bias_step):
        steps = torch.cat([steps.reshape(drop + 3, 6), torch.zeros(count - drop - 3, 6, dtype=F64)])
        points = SE3.retract(truth.control_points, steps, side="right")
        old = t < 0.5
        state = ts.functional.bspline(points, t[old], group=SE3, dt=0.1, derivatives=1)
        poses = ts.functional.bspline(points, t[::5][t[::5] < 0.5], group=SE3, dt=0.1, derivatives=0)
        logs = SE3.log(SE3.between(points[:-1], points[1:]))
        bends = (logs[1:] - logs[:-1])[:drop] / (0.1 * 0.5)
        read = (state.velocity[:, 3:] + bias.value + bias_step - gyro[old]) / 0.02
        known = SE3.log(SE3.compose(poses.value, SE3.inverse(truth(t[::5][t[::5] < 0.5])))) / 0.01
        return torch.cat([bends.flatten(), read.flatten(), known.flatten()])

    at = torch.zeros((drop + 3) * 6, dtype=F64), torch.zeros(3, dtype=F64)
    J = torch.cat(torch.func.jacfwd(residuals, argnums=(0, 1))(*at), dim=1).numpy()
    r = residuals(*at).numpy()
    keep = np.arange(drop * 6, (drop + 3) * 6 + 3)
    H, g, gone = J.T @ J, J.T @ r, np.arange(drop * 6)
    carried = H[np.ix_(keep, gone)] @ np.linalg.inv(H[np.ix_(gone, gone)])
    (prior,) = window._priors
    expected = H[np.ix_(keep, keep)] - carried @ H[np.ix_(gone, keep)]
    assert_allclose(prior.information, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())
    slope = g[keep] - carried @ g[gone]
    assert_allclose(prior.slope, slope, atol=1e-7 * np.abs(slope).max())


def test_a_random_walk_is_the_prediction_of_a_kalman_filter():
    A = random(4, 4, seed=2)
    H, g = (A @ A.mT).numpy(), random(4, seed=3).numpy()
    variance = np.array([0.3, 0.1])
    larger, right, new = random_walk(H, g, np.array([1, 3]), variance)
    information, slope, _ = marginalised(larger, right, np.array([0, new[0], 2, new[1]]))
    predicted = np.linalg.inv(H) + np.diag([0.0, 0.3, 0.0, 0.1])
    assert_allclose(np.linalg.inv(information), predicted, rtol=1e-9)
    assert_allclose(np.linalg.solve(information, slope), np.linalg.solve(H, g), rtol=1e-9)


def test_a_walking_bias_is_followed():
    """A bias that drifts by 0.5 rad/s: constant, its memory holds it back; walking, it keeps up."""
    t = torch.arange(0.0, 12.0, 0.02, dtype=F64)
    turn = torch.zeros(len(t), 3, dtype=F64)
    drift = torch.stack([0.5 * t / 12, 0 * t, 0 * t], dim=-1)
    misses, sigmas = [], []
    for walks in (False, True):
        bias = Variable("bias", torch.zeros(3, dtype=F64))
        window = SlidingWindow(SO3.identity(dtype=F64), group=SO3, dt=0.2, window=1.0)
        if walks:
            window.random_walk(bias, 0.1)
        for n in range(0, len(t), 25):
            part = slice(n, n + 25)
            window.add(Gyroscope(t[part], turn[part] + drift[part], sigma=0.01, bias=bias))
            window.add(StateValue(t[part], SO3.exp(turn[part]), sigma=0.01))
            result = window.update()
        misses.append(float((bias.value - drift[-1]).abs().max()))
        sigmas.append(float(result.standard_deviation(bias)[0]))
    assert misses[0] > 0.1
    assert misses[1] < 0.04
    assert sigmas[1] > 2 * sigmas[0]


def test_cost_of_an_update_does_not_depend_on_the_length(monkeypatch):
    """Measurements that are linearised and unknowns that are solved for, counted over an ever longer history."""
    counts = {"rows": 0, "columns": 0, "updates": 0}
    chunk, factor = Term._chunk, BandSystem.factor

    def counting_chunk(self, state, places, part):
        counts["rows"] += part.stop - part.start
        return chunk(self, state, places, part)

    def counting_factor(self, damping):
        counts["columns"] += len(damping)
        return factor(self, damping)

    monkeypatch.setattr(Term, "_chunk", counting_chunk)
    monkeypatch.setattr(BandSystem, "factor", counting_factor)
    window = SlidingWindow(torch.zeros(3, dtype=F64), group=R3, dt=0.1, window=1.0)
    found = []
    for n in range(120):
        t = n * 0.2 + torch.arange(10, dtype=F64) / 50
        window.add(StateValue(t, random(10, 3, seed=n), sigma=0.1))
        before = dict(counts)
        window.update(max_iterations=1)
        found.append(tuple(counts[k] - before[k] for k in ("rows", "columns")))
    assert max(found[60:]) <= max(found[20:60])
    assert window.measurements < 80
    assert len(window._streams) == 1
    assert window.trajectory.domain[1] >= 23.98


def test_measurements_older_than_the_window_are_refused():
    window = SlidingWindow(torch.zeros(3, dtype=F64), group=R3, dt=0.5, window=2.0)
    for n in range(6):
        window.add(StateValue(torch.tensor([n + 0.5], dtype=F64), torch.zeros(1, 3, dtype=F64)))
        window.update()
    before = window.measurements
    start = window.active.domain[0]
    assert start == 3.5
    late = torch.tensor([3.6, 3.4, 1.0], dtype=F64)
    message = r"t: 2 of 3 times of StateValue lie before the window, which starts at 3.5, the first is 3.4; .* longer"
    with pytest.raises(ValueError, match=message):
        window.add(StateValue(late, torch.zeros(3, 3, dtype=F64)))
    assert window.measurements == before
    window.add(StateValue(late[:1], torch.zeros(1, 3, dtype=F64)))  # late, but not too late
    assert window.measurements == before + 1
    with pytest.raises(
        ValueError, match=r"t: 1000000000000.0 lies .* control points after the end .* check its unit"
    ):
        window.add(StateValue(torch.tensor([1e12], dtype=F64), torch.zeros(1, 3, dtype=F64)))


def test_a_gap_longer_than_the_window_is_bridged_at_a_steady_pace():
    """Nanoseconds of an epoch, three seconds without data, a window of one."""
    velocity, origin = torch.tensor([1.0, -2.0, 0.5], dtype=F64), 1_700_000_000_000_000_000
    window = SlidingWindow(torch.zeros(3, dtype=F64), group=R3, dt_ns=100_000_000, t0_ns=origin, window=1.0)
    for begin in (0.0, 0.5, 1.0, 4.5, 5.0):
        t = begin + torch.arange(10, dtype=F64) / 20
        stamps = origin + (t * 1e9).round().to(torch.int64)
        window.add(StateValue(stamps, t[:, None] * velocity, sigma=0.01))
        if begin == 4.5:
            assert window.active.domain[1] - window.active.domain[0] > 3_000_000_000
        window.update()
        assert window.active.domain[1] - window.active.domain[0] <= 1_000_000_000
    seconds = torch.arange(0.0, 5.4, 0.05, dtype=F64)
    times = origin + (seconds * 1e9).round().to(torch.int64)
    state = window.trajectory.evaluate(times, 1)
    assert_allclose(state.value, seconds[:, None] * velocity, atol=1e-5)
    assert_allclose(state.velocity, velocity.expand(len(seconds), 3), atol=1e-4)
    window.extend(origin + 7_000_000_000)
    ahead = window.trajectory(torch.tensor([origin + 7_000_000_000]))
    assert_allclose(ahead, 7.0 * velocity[None], atol=1e-4)


def test_an_unknown_time_offset_is_found():
    """A gyroscope 23 ms late; its measurements move with the estimate, past the end of the trajectory, too."""
    group = product(R3, SO3)
    truth = motion(group, count=90)
    offset = Variable("offset", torch.zeros(1, dtype=F64))
    window = SlidingWindow(truth(torch.zeros(1, dtype=F64))[0], group=group, dt=0.1, window=1.5)
    for n in range(25):
        t = 0.3 * n + torch.arange(30, dtype=F64) / 100
        window.add(Pose(t[::3], truth(t[::3]), sigma=0.001))
        gyro = truth.kinematics(t).angular_velocity
        window.add(Gyroscope(t + 0.023, gyro, sigma=0.001, clock=Clock(offset=offset)))
        result = window.update()
    assert abs(float(offset.value) - 0.023) < 5e-4
    assert result.standard_deviation(offset) < 5e-4
    assert window._first > 30


def test_a_skew_needs_a_middle_that_stays():
    t = torch.tensor([0.1, 0.2], dtype=F64)
    skew = Variable("skew", torch.zeros(1, dtype=F64))
    window = SlidingWindow(torch.zeros(3, dtype=F64), group=R3, dt=0.1)
    with pytest.raises(ValueError, match=r"expected Clock\(mid=...\)"):
        window.add(StateValue(t, random(2, 3), clock=Clock(skew=skew)))
    window.add(StateValue(t, random(2, 3), clock=Clock(skew=skew, mid=0.0)))


def test_buffers_of_packets_may_be_used_again():
    window, other = (SlidingWindow(torch.zeros(3, dtype=F64), group=R3, dt=0.1) for _ in range(2))
    t, y = torch.zeros(4, dtype=F64), torch.zeros(4, 3, dtype=F64)
    for i in range(3):
        t.copy_(0.1 * i + torch.arange(4) * 0.02)
        y.copy_(random(4, 3, seed=i))
        window.add(StateValue(t, y, sigma=0.1))
        other.add(StateValue(t.clone(), y.clone(), sigma=0.1))
    for x in (window, other):
        x.update(**EXACT)
    assert_allclose(window.trajectory.control_points, other.trajectory.control_points, atol=1e-15)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_keep_random_walks(copied):
    window = SlidingWindow(SO3.identity(dtype=F64), group=SO3, dt=0.1, window=0.3)
    bias = Variable("bias", torch.zeros(3, dtype=F64))
    window.random_walk(bias, 0.1)
    window.add(Gyroscope(torch.arange(30, dtype=F64) * 0.02, random(30, 3), sigma=0.1, bias=bias))
    window.add_prior(bias, sigma=0.1)
    other = copied(window)
    found = []
    for x in (window, other):
        x.add(StateValue(torch.zeros(1, dtype=F64), SO3.identity(dtype=F64)[None], sigma=0.1))
        x.update()
        found.append(x.update().covariance(x.variables["bias"]))
    assert_allclose(found[1], found[0], rtol=1e-9)


def test_packets_of_one_kind_are_kept_together():
    t = torch.tensor([0.1, 0.2], dtype=F64)
    window = SlidingWindow(torch.zeros(3, dtype=F64), group=R3, dt=0.1)
    y = random(2, 3)
    window.add(StateValue(t, y, sigma=0.1))
    window.add(StateValue(t, y, sigma=0.1))  # the same weight stays one number
    assert window._streams[0].residual.weighting[1].shape == ()
    window.add(StateValue(t, y, sigma=torch.tensor([0.1, 0.2, 0.3], dtype=F64)))
    window.add(StateValue(t, y, sigma=torch.tensor([[0.1], [0.2]], dtype=F64)))
    assert len(window._streams) == 1
    expected = [[0.1] * 3] * 4 + [[0.1, 0.2, 0.3]] * 2 + [[0.1] * 3, [0.2] * 3]
    assert_allclose(window._streams[0].residual.weighting[1], expected)
    window.add(StateValue(t, y, covariance=torch.eye(3, dtype=F64)))
    window.add(StateValue(t, y, covariance=2 * torch.eye(3, dtype=F64).expand(2, 3, 3)))
    assert len(window._streams) == 2
    assert window._streams[1].residual.weighting[1].shape == (4, 3, 3)
    window.add(StateVelocity(t, y))
    assert len(window._streams) == 3
    assert window.measurements == 14
    # Together or apart, the estimate is the same.
    window.update(**EXACT)
    problem = Problem(window.trajectory)
    for x in (0.1, 0.1, torch.tensor([0.1, 0.2, 0.3], dtype=F64), torch.tensor([[0.1], [0.2]], dtype=F64)):
        problem.add(StateValue(t, y, sigma=x))
    for x in (torch.eye(3, dtype=F64), 2 * torch.eye(3, dtype=F64)):
        problem.add(StateValue(t, y, covariance=x))
    problem.add(StateVelocity(t, y))
    linearizer = problem.prepare()
    with torch.no_grad():
        joint = linearizer(linearizer.model.state())
    model = window.update(max_iterations=0)._linearizer
    terms = model.terms[:-1]
    model.terms = terms
    with torch.no_grad():
        ours = model(model.model.state())
    assert_allclose(ours.cost, joint.cost, rtol=1e-12)
    assert_allclose(ours.band, joint.band, rtol=1e-12)


# ---------------------------------------------------------------------- biases that are splines


def wandering(start, dt, nanoseconds=False, order=3):
    """A bias with its first control points: the window appends the others."""
    clock = {"dt_ns": round(dt * 1e9), "t0_ns": start} if nanoseconds else {"dt": dt, "t0": start}
    points = torch.zeros(order, 3, dtype=F64)
    return ts.BSpline(points, group=R3, order=order, learnable=not nanoseconds, **clock)


@pytest.mark.parametrize(("nanoseconds", "knots"), [(False, 0.5), (True, 0.13), (False, 3.0)])
def test_a_linear_window_with_a_spline_of_biases_equals_the_batch_solution(nanoseconds, knots):
    """Turns about one axis commute, so that all is linear in what is about it; knots of the bias are farther apart or
    closer than those of the trajectory, or farther than the window is long."""
    origin = 10**18 if nanoseconds else 3.0
    stamps = lambda t: (10**18 + (t * 1e9).round().to(torch.int64)) if nanoseconds else 3.0 + t  # noqa: E731
    clock = {"dt_ns": 200_000_000, "t0_ns": origin} if nanoseconds else {"dt": 0.2, "t0": origin}
    bias = wandering(origin, knots, nanoseconds)
    window = SlidingWindow(SO3.identity(dtype=F64), group=SO3, window=1.0, smoothness=10.0, **clock)
    window.random_walk(bias, 0.3)
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=F64)
    seen, steps = [], 0
    for n, t in enumerate(packets(6.0, 20.0, 6, start=0.02)):
        if 8 < n < 11:  # a gap
            continue
        turned = SO3.exp((0.5 * t + 0.2 * t.sin() + 0.05 * random(len(t), seed=n))[:, None] * axis)
        drift = (0.3 * t.sin())[:, None] + 0.02 * random(len(t), 1, seed=n + 99)
        gyro = ((0.5 + 0.2 * t.cos())[:, None] + drift) * axis
        for residual in (
            StateValue(stamps(t), turned, sigma=0.05),
            Gyroscope(stamps(t), gyro, sigma=0.02, bias=bias),
        ):
            window.add(residual)
            seen.append((residual, {}))
        result = window.update(**EXACT)
        if n % 5 == 4:
            online = bias.control_points.detach().clone()
            before = window.trajectory.control_points
            whole = window.trajectory
            problem = Problem(whole)
            for residual, _ in seen:
                problem.add(residual)
            with torch.no_grad():
                linearizer = problem.prepare()
                model = linearizer.model
                linearizer.terms.append(Bends(model, np.full(3, 0.5)))  # 1 / (dt smoothness)
                linearizer.terms.append(Walk(model, bias, np.full(3, 1.0 / (0.3 * math.sqrt(knots)))))
                state, system, _ = minimise(model, model.state(), linearizer, LINEAR, lambda _: None)
            free = result._linearizer.model.splines[0].count
            apart = SO3.log(SO3.between(torch.from_numpy(state.points[id(whole)]), before))[-free:]
            assert_allclose(apart[:, 2], torch.zeros(free, dtype=F64), atol=1e-9)
            moving = result._linearizer.model.splines[1].count
            found = torch.from_numpy(state.points[id(bias)])
            assert found.shape == online.shape
            assert_allclose(online[-moving:], found[-moving:], atol=1e-9)
            columns = model.columns[id(bias)][-moving:, 2]
            variances = system.factor(np.zeros(model.total)).inverse(columns, columns)
            assert_allclose(result.standard_deviation(bias)[:, 2], np.sqrt(variances), rtol=1e-6)
            steps += 1
    assert steps > 2
    assert window._first > 20
    assert window._wandering[bias].first >= len(bias.control_points) - moving
    # What it learnt is the drift.
    t = torch.linspace(1.0, 5.8, 40, dtype=F64)
    if knots < 1.0:
        assert (bias(stamps(t))[:, 2] - 0.3 * t.sin()).abs().mean() < 0.05


def test_cost_of_an_update_with_a_spline_of_biases_does_not_depend_on_the_length():
    window = SlidingWindow(SO3.identity(dtype=F64), group=SO3, dt=0.1, window=1.0)
    bias = wandering(0.0, 0.3)
    window.random_walk(bias, 0.1)
    sizes = []
    for n in range(60):
        t = n * 0.2 + torch.arange(10, dtype=F64) / 50
        window.add(StateValue(t, SO3.identity(10, dtype=F64), sigma=0.1))
        window.add(Gyroscope(t, 0.1 * random(10, 3, seed=n), sigma=0.1, bias=bias))
        model = window.update(max_iterations=1)._linearizer.model
        sizes.append((model.total, sum(len(p.information) for p in window._priors)))
    assert max(sizes[30:]) <= max(sizes[10:30])
    assert window._wandering[bias].first > 30
    assert len(window._streams) == 2
    # The module is as long as the trajectory, and may go on.
    assert bias.domain[1] >= 11.9
    assert isinstance(bias.control_points, torch.nn.Parameter)
    other = copy.deepcopy(window)
    t = torch.tensor([12.0], dtype=F64)
    other.add(StateValue(t, SO3.identity(1, dtype=F64), sigma=0.1))
    other.update()
    assert other._wandering.keys().isdisjoint(window._wandering)


def test_a_spline_of_biases_that_starts_long_is_used_as_far_as_measurements_came():
    points = torch.full((50, 3), 0.2, dtype=F64)
    bias = ts.BSpline(points, group=R3, dt=0.5, learnable=False)
    window = SlidingWindow(SO3.identity(dtype=F64), group=SO3, dt=0.1, window=1.0)
    window.random_walk(bias, 0.1)
    t = torch.linspace(0.0, 1.2, 60, dtype=F64)
    window.add(StateValue(t, SO3.identity(60, dtype=F64), sigma=0.1))
    window.add(Gyroscope(t, torch.full((60, 3), 0.4, dtype=F64), sigma=0.1, bias=bias))
    result = window.update()
    assert result._linearizer.model.splines[1].count == 6
    assert torch.equal(bias.control_points[6:], points[6:])
    assert (bias(t) - 0.4).abs().max() < 0.05
    late = ts.BSpline(points, group=R3, dt=0.5, t0=1.0)
    window.random_walk(late, 0.1)
    early = Gyroscope(t[-40:], torch.zeros(40, 3, dtype=F64), bias=late)
    with pytest.raises(ValueError, match=r"bias: .* lie outside the domain .* of its spline"):
        window.add(early)


@pytest.mark.parametrize("nanoseconds", [False, True])
def test_a_bias_spline_may_begin_long_before_the_window(nanoseconds):
    """What no measurement sees costs nothing."""
    unit = 10**9 if nanoseconds else 1.0
    clock = (lambda dt, t0: {"dt_ns": round(dt * unit), "t0_ns": round(t0 * unit)}) if nanoseconds else None
    clock = clock or (lambda dt, t0: {"dt": dt, "t0": t0})
    found = []
    for early in (0.0, 400.0):
        points = torch.zeros(int(2 * early) + 3, 3, dtype=F64)
        bias = ts.BSpline(points, group=R3, order=2, learnable=False, **clock(0.5, -early))
        window = SlidingWindow(SO3.identity(dtype=F64), group=SO3, window=1.0, **clock(0.2, 0.0))
        window.random_walk(bias, 0.1)
        for s in packets(3.0, 20, 10):
            t = (s * unit).round().to(torch.int64) if nanoseconds else s
            turn = torch.tensor([0.3, 0.1, -0.2], dtype=F64)
            window.add(StateValue(t, SO3.exp(s[:, None] * turn), sigma=0.01))
            window.add(Gyroscope(t, turn + 0.1 * s[:, None], sigma=0.01, bias=bias))
            window.update(**EXACT)
        assert len(window._wandering[bias].active.control_points) < 12
        at = torch.linspace(0, 2.9, 30, dtype=F64) * unit
        found.append(bias(at.round().to(torch.int64) if nanoseconds else at))
        before = max(int(2 * early) - 4, 0)
        assert torch.equal(bias.control_points[:before], points[:before])
    assert_allclose(found[1], found[0], atol=1e-6)
