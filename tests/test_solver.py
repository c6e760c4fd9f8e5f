"""Levenberg-Marquardt: why it stops, that it rejects what does not help, and that it finds what is there to find."""

import math

import numpy as np
import pytest
import torch
from batteries import generator, normal
from fit_cases import SPLIT, bias_spline, spread, trajectory
from spline_cases import control_points

from torchspline import R3, SE3, SO3, BSpline, imu, use_kernels
from torchspline.fit import (
    Accelerometer,
    Cauchy,
    Clock,
    Gyroscope,
    Pose,
    Position,
    Problem,
    RelativePose,
    StateValue,
    Variable,
    smoothness,
)
from torchspline.fit.solving.solver import Options, minimise
from torchspline.fit.solving.system import Factor, SingularError, System
from torchspline.kernels.mode import RefusedError

# ---------------------------------------------------------------------- on functions of one number


class Line:
    """A model of one number; kernels refuse numbers beyond the `limit`."""

    limit = math.inf

    def moved(self, state, step):
        if abs(state + step) > self.limit:
            raise RefusedError
        return state + step


class Inverse(Factor):
    def __init__(self, number):
        self.number = number

    def solve(self, right):
        return right / self.number

    def inverse(self, i, j):
        return np.full(i.shape, 1 / self.number)

    def diagonal(self):
        return np.array([1 / self.number])

    def trace(self, other):
        return float(other.diagonal()[0]) / self.number


class Scalar(System):
    """r(x) with derivative d(x)."""

    def __init__(self, r, d):
        self.right, self.cost, self._square = np.array([d * r]), 0.5 * r * r, d * d

    def add(self, rows, chain): ...
    def add_dense(self, columns, matrix, right): ...

    def diagonal(self):
        return np.array([self._square])

    def factor(self, damping):
        if self._square + damping[0] <= 0:
            raise SingularError
        return Inverse(self._square + damping[0])

    def multiply(self, x):
        return self._square * x


def minimise_scalar(r, d, start, limit=math.inf, **options):
    seen, line = [], Line()
    line.limit = limit
    state, system, trace = minimise(
        line,
        np.array([start]),
        lambda x: Scalar(r(float(x[0])), d(float(x[0]))),
        Options(**options),
        seen.append,
    )
    assert len(seen) <= options.get("iterations", 50)
    assert len(trace.cost) == len(trace.damping)
    assert trace.cost[-1] == system.cost
    assert all(after < before for before, after in zip(trace.cost, trace.cost[1:], strict=False))
    return float(state[0]), trace


def test_a_straight_line_takes_one_step():
    x, trace = minimise_scalar(lambda x: 3 * x - 6, lambda x: 3.0, 40.0, damping=1e-12)
    assert x == pytest.approx(2.0, abs=1e-9)
    assert trace.evaluations <= 4
    assert trace.converged


def test_the_start_is_the_optimum():
    _, trace = minimise_scalar(lambda x: 3 * x - 6, lambda x: 3.0, 2.0)
    assert trace.converged
    assert trace.evaluations == 1
    assert "gradient is zero" in trace.reason


def test_a_cost_that_cannot_reach_zero():
    x, trace = minimise_scalar(lambda x: math.sqrt(1 + x * x), lambda x: x / math.sqrt(1 + x * x), 3.0)
    assert trace.converged
    assert abs(x) < 1e-4
    assert trace.cost[-1] == pytest.approx(0.5, rel=1e-8)


def test_steps_that_go_too_far_are_taken_back():
    """Newton's method on atan diverges from 3: each step of Gauss-Newton overshoots by more."""
    x, trace = minimise_scalar(math.atan, lambda x: 1 / (1 + x * x), 3.0, damping=1e-9)
    assert abs(x) < 1e-6
    assert trace.converged
    assert trace.evaluations > len(trace.cost)
    assert max(trace.damping) > 1e-9


def test_values_that_are_not_finite_are_no_improvement():
    x, trace = minimise_scalar(
        lambda x: math.log(x) if x > 0 else math.nan, lambda x: 1 / x, 9.0, damping=1e-9
    )
    assert x == pytest.approx(1.0, abs=1e-6)
    assert trace.evaluations > len(trace.cost)


def test_steps_that_kernels_refuse_are_no_improvement():
    x, trace = minimise_scalar(math.atan, lambda x: 1 / (1 + x * x), 3.0, limit=3.5, damping=1e-9)
    assert abs(x) < 1e-6
    assert trace.converged
    assert trace.evaluations > len(trace.cost)


def test_a_derivative_of_the_wrong_sign():
    x, trace = minimise_scalar(lambda x: 1 + x, lambda x: -1.0, 0.0, cost=0.0)
    assert x == 0.0
    assert not trace.converged
    assert "however small" in trace.reason


def test_too_few_iterations():
    _, trace = minimise_scalar(lambda x: x**3, lambda x: 3 * x * x, 1e6, iterations=3)
    assert not trace.converged
    assert "reached 3 iterations" in trace.reason
    assert trace.evaluations == 4
    _, trace = minimise_scalar(lambda x: x**3, lambda x: 3 * x * x, 1e6, iterations=0)
    assert (trace.evaluations, len(trace.cost)) == (1, 1)


def test_a_slow_fall_is_the_end():
    _, trace = minimise_scalar(lambda x: 1 + x * x, lambda x: 2 * x, 0.4, cost=0.05)
    assert trace.converged
    assert "the cost fell by less than 0.05" in trace.reason


def test_a_cost_that_is_not_finite_at_the_start():
    with pytest.raises(ValueError, match="cost is not finite"):
        minimise_scalar(lambda x: math.inf, lambda x: 1.0, 0.0)


# ---------------------------------------------------------------------- problems


def test_a_linear_problem_is_that_of_a_dense_solver():
    spline = trajectory(R3, count=20)
    t, measured = spread(spline, 200), normal(200, 3, seed=1)
    expected = np.linalg.lstsq(design(spline, t), measured.numpy(), rcond=None)[0]
    problem = Problem(spline)
    problem.add(Position(t, measured, sigma=0.1))
    result = problem.solve(damping=1e-12)
    assert result.converged
    assert result.evaluations <= 3
    np.testing.assert_allclose(spline.control_points.detach().numpy(), expected, rtol=1e-8, atol=1e-9)
    residual = design(spline, t) @ expected - measured.numpy()
    assert result.cost[-1] == pytest.approx(0.5 * (residual**2).sum() / 0.01, rel=1e-10)


def design(spline, t):
    """How values move with control points in R^n, by evaluating unit ones."""
    M = spline.control_points.shape[0]
    unit = torch.eye(M, dtype=torch.float64)[:, :, None].expand(M, M, 3)
    with torch.no_grad():
        return BSpline(unit, group=R3, order=spline.order, dt=float(spline.dt))(t)[..., 0].mT.numpy()


def shaken(spline, size=0.05, seed=9):
    """The same spline with control points moved at random."""
    tangents = size * normal(spline.control_points.shape[0], spline.group.tangent_size, seed=seed)
    with torch.no_grad():
        points = spline.group.retract(spline.control_points, tangents, side="right")
    times = (
        {"dt": spline.dt, "t0": spline.t0}
        if spline.dt_ns is None
        else {"dt_ns": spline.dt_ns, "t0_ns": spline.t0_ns}
    )
    return BSpline(points, group=spline.group, order=spline.order, **times)


@pytest.mark.parametrize("group", [SE3, SPLIT, SO3], ids=str)
def test_measurements_without_noise_are_met_exactly(group):
    truth = trajectory(group, count=16)
    spline, t = shaken(truth), spread(truth, 120)
    with torch.no_grad():
        measured = truth(t)
    problem = Problem(spline)
    problem.add(StateValue(t, measured))
    result = problem.solve()
    assert result.cost[-1] < 1e-20
    assert result.converged
    assert result.cost[0] > 1e-3
    with torch.no_grad():
        torch.testing.assert_close(
            group.to_matrix(spline(t)), group.to_matrix(measured), rtol=0.0, atol=1e-10
        )
    again = problem.solve()
    assert again.evaluations <= 2
    assert again.cost[0] == pytest.approx(result.cost[-1], abs=1e-20)


def variable(name, value, **options):
    return Variable(name, torch.tensor(value, dtype=torch.float64), **options)


@pytest.mark.slow
def test_inertial_sensors_are_calibrated_from_poses():
    """Everything at once: biases, one of them a spline; gravity, extrinsics with lever arm, time offset and skew."""
    truth = BSpline(control_points(SE3, 40, gap=0.5, seed=5), group=SE3, order=5, dt=0.2)
    low, high = truth.domain
    T = SE3.exp(torch.tensor([0.1, -0.2, 0.05, 0.2, -0.1, 0.15], dtype=torch.float64))
    offset, skew, mid = 0.013, 2e-4, 3.0
    true_bias = bias_spline(truth, count=6)
    accel_bias, gravity = torch.tensor([0.1, -0.05, 0.2]), torch.tensor([0.3, -0.2, -9.79]).double()
    gravity *= 9.80665 / gravity.norm()
    t_body = torch.linspace(low + 0.05, high - 0.05, 800, dtype=torch.float64)
    t = t_body + offset + skew * (t_body - mid)
    keep = (t > low) & (t < high)
    t, t_body = t[keep], t_body[keep]
    with torch.no_grad():
        reading = imu.measure(truth, t_body, gravity=gravity, T_body_imu=T)
        gyro, accel = reading.gyroscope + true_bias(t), reading.accelerometer + accel_bias
        t_pose = torch.linspace(low, high, 200, dtype=torch.float64)
        poses = truth(t_pose)
    spline, bias = shaken(truth, 0.01), bias_spline(truth, count=6, seed=77)
    unknown = {
        "accel_bias": variable("accel_bias", [0.0, 0, 0]),
        "gravity": variable("gravity", [0.0, 0, -9.80665], sphere=True),
        "rotation": variable("rotation", [1.0, 0, 0, 0], group=SO3),
        "lever_arm": variable("lever_arm", [0.0, 0, 0]),
    }
    clock = Clock(offset=variable("offset", [0.0]), skew=variable("skew", [0.0]), mid=mid)
    problem = Problem(spline)
    problem.add(Pose(t_pose, poses, sigma=torch.tensor([1e-3] * 3 + [1e-3] * 3)))
    problem.add(Gyroscope(t, gyro, bias=bias, rotation=unknown["rotation"], clock=clock, sigma=1e-3))
    problem.add(
        Accelerometer(
            t, accel, bias=unknown["accel_bias"], rotation=unknown["rotation"], clock=clock, sigma=1e-2,
            gravity=unknown["gravity"], lever_arm=unknown["lever_arm"],
        )
    )  # fmt: skip
    with use_kernels("auto"):
        result = problem.solve()
    assert result.converged
    assert result.cost[-1] < 1e-10 * result.cost[0]
    expected = {
        "accel_bias": accel_bias, "gravity": gravity, "lever_arm": T[:3], "offset": [offset], "skew": [skew],
    }  # fmt: skip
    for name, value in expected.items():
        np.testing.assert_allclose(
            problem.variables[name].value.numpy(), value, rtol=1e-6, atol=1e-8, err_msg=name
        )
    turned = SO3.log(SO3.between(problem.variables["rotation"].value, T[3:]))
    assert turned.norm() < 1e-8
    with torch.no_grad():
        torch.testing.assert_close(bias(t), true_bias(t), rtol=0.0, atol=1e-7)


def test_a_robust_loss_ignores_outliers():
    truth = trajectory(R3, count=10)
    t = spread(truth, 200)
    with torch.no_grad():
        measured = truth(t)
    measured[::5] += 30.0 + normal(40, 3, seed=4)
    plain, robust = shaken(truth), shaken(truth)
    for spline, loss in ((plain, None), (robust, Cauchy(0.1))):
        problem = Problem(spline)
        problem.add(Position(t, measured, loss=loss))
        assert problem.solve(max_iterations=100).converged
    with torch.no_grad():
        assert (robust(t) - truth(t)).abs().max() < 0.01
        assert (plain(t) - truth(t)).abs().max() > 1.0


def test_costs_fall_and_times_are_booked():
    truth = trajectory(SE3, count=16, gap=1.5)
    spline, t = shaken(truth, 1.0), spread(truth, 80)
    problem = Problem(spline)
    with torch.no_grad():
        problem.add(Pose(t, truth(t), sigma=0.1))
    result = problem.solve(damping=1e-9)
    assert all(after < before for before, after in zip(result.cost, result.cost[1:], strict=False))
    assert result.evaluations >= len(result.cost)
    assert set(result.seconds) == {"linearize", "solve", "update"}
    assert min(result.seconds.values()) > 0


def test_frozen_unknowns_stay_to_the_last_bit():
    truth = trajectory(SE3, count=14)
    spline = shaken(truth)
    with torch.no_grad():
        spline.control_points[:, 3:] *= -1.7  # numbers a solver would like to normalise
    t = spread(truth, 100)
    T = Variable("T", SE3.identity() * 3.0, group=SE3)
    bias = bias_spline(truth)
    with torch.no_grad():
        measured, gyro = truth(t), normal(100, 3, seed=1)
    problem = Problem(spline)
    problem.add(Pose(t, measured, T_body_sensor=T))
    problem.add(Gyroscope(t, gyro, bias=bias))
    keep = torch.zeros(14, dtype=torch.bool)
    keep[[0, 3, 13]] = True
    problem.freeze(spline, keep)
    problem.freeze(T)
    problem.freeze(bias)
    before = [x.clone() for x in (spline.control_points.detach(), T.value, bias.control_points.detach())]
    problem.solve(max_iterations=4)
    assert torch.equal(spline.control_points[keep], before[0][keep])
    assert not (spline.control_points[~keep] == before[0][~keep]).all(dim=-1).any()
    assert torch.equal(T.value, before[1])
    assert torch.equal(bias.control_points, before[2])
    problem.release(T)
    problem.solve(max_iterations=4)
    assert not torch.equal(T.value, before[1])


def test_nothing_to_solve():
    spline = trajectory(SE3)
    problem = Problem(spline)
    with pytest.raises(ValueError, match="no residuals"):
        problem.solve()
    problem.add(Pose(spread(spline, 9), SE3.random(9, generator=generator(5))))
    problem.freeze(spline)
    with pytest.raises(ValueError, match="everything is frozen"):
        problem.solve()
    problem.release(spline)
    assert problem.solve(max_iterations=2).evaluations == 3


def test_control_points_that_nothing_measures_stay_where_they_are():
    spline = trajectory(SE3, count=20)
    low, high = spline.domain
    before = spline.control_points.detach().clone()
    t = low + 0.3 * (high - low) * torch.rand(40, generator=generator(1), dtype=torch.float64)
    with torch.no_grad():
        measured = SE3.compose(spline(t), SE3.exp(torch.full((6,), 0.1, dtype=torch.float64)))
    problem = Problem(spline)
    problem.add(Pose(t, measured))
    result = problem.solve()
    assert result.converged
    assert result.cost[-1] < 1e-3 * result.cost[0]
    torch.testing.assert_close(spline.control_points[12:], before[12:], rtol=0.0, atol=1e-9)


def test_a_problem_whose_place_in_the_world_is_free():
    truth = trajectory(SE3, count=16)
    spline = shaken(truth)
    t = torch.linspace(*truth.domain, 60, dtype=torch.float64)
    pairs = torch.stack([t[:-2], t[2:]])
    with torch.no_grad():
        measured = SE3.between(truth(pairs[0]), truth(pairs[1]))
    problem = Problem(spline)
    problem.add(RelativePose(pairs, measured))
    result = problem.solve()
    assert result.converged
    assert result.cost[-1] < 1e-15


def test_float32_control_points_and_buffers_are_moved_in_place():
    truth = trajectory(R3)
    t, points = spread(truth, 100), truth.control_points.detach().float()
    spline = BSpline(points + 0.1, group=R3, order=4, dt=0.3, learnable=False)
    memory = spline.control_points.data_ptr()
    problem = Problem(spline)
    with torch.no_grad():
        problem.add(Position(t, truth(t)))
    problem.solve()
    assert spline.control_points.data_ptr() == memory
    assert spline.control_points.dtype == torch.float32
    torch.testing.assert_close(spline.control_points, points, rtol=1e-6, atol=1e-6)


def test_control_points_that_went_bad_are_refused():
    for bad, message in ((math.nan, "finite"), (0.0, "quaternions")):
        spline = trajectory(SE3)
        problem = Problem(spline)
        problem.add(smoothness(spline, sigma=1.0))
        with torch.no_grad():
            spline.control_points[3, 3:] = bad
        for mode in ("reference", "auto"):
            with use_kernels(mode), pytest.raises(ValueError, match=f"trajectory: expected {message}"):
                problem.solve()


def test_showing_progress_changes_nothing():
    costs = []
    for progress in (False, True):
        spline = trajectory(R3)
        problem = Problem(spline)
        problem.add(Position(spread(spline, 30), normal(30, 3, seed=1), loss=Cauchy(0.5)))
        costs.append(problem.solve(progress=progress).cost)
    assert costs[0] == costs[1]
    assert len(costs[0]) > 2
