"""Covariances, residuals and open directions of a solution, against dense linear algebra and Monte Carlo."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

import torchspline as ts
from torchspline.fit.problem import Problem
from torchspline.fit.residuals import Accelerometer, Gyroscope, Pose, StateValue, StateVelocity
from torchspline.fit.solving.system import SparseSystem
from torchspline.fit.variables import Variable
from torchspline.groups import R3, SE3, SO3, product

F64 = torch.float64


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def trajectory(group=SE3, count=12, order=4, dt=0.3, seed=0):
    points = group.exp((0.3 * random(count, group.tangent_size, seed=seed)).cumsum(0))
    return ts.BSpline(points, group=group, order=order, dt=dt)


def inertial_problem(seed=0, bias_spline=True, group=SE3):
    """Poses and an IMU with everything unknown."""
    spline = trajectory(group, seed=seed)
    t = torch.linspace(0.0, 2.7, 120, dtype=F64)
    with torch.no_grad():
        reading = ts.imu.measure(spline, t)
        poses = spline(t[::4])
    bias = Variable("accel_bias", torch.zeros(3, dtype=F64))
    wandering = ts.BSpline(torch.zeros(6, 3, dtype=F64), group=R3, order=3, dt=0.7)
    down = 9.80665 * torch.nn.functional.normalize(torch.tensor([0.1, 0.0, -9.8], dtype=F64), dim=0)
    gravity = Variable("gravity", down, sphere=True)
    rotation = Variable("rotation", SO3.identity(), group=SO3)
    problem = Problem(spline)
    problem.add(Pose(t[::4], poses, sigma=0.01))
    gyro_bias = wandering if bias_spline else Variable("gyro_bias", torch.zeros(3, dtype=F64))
    problem.add(Gyroscope(t, reading.gyroscope, sigma=0.02, bias=gyro_bias, rotation=rotation))
    problem.add(
        Accelerometer(t, reading.accelerometer, sigma=0.1, bias=bias, gravity=gravity, rotation=rotation)
    )
    for unknown in (bias, rotation):
        problem.add_prior(unknown, sigma=0.5)
    return problem, bias, gravity, rotation


def dense(result):
    """`J^T J` written out."""
    return np.stack([result._system.multiply(e) for e in np.eye(result._linearizer.model.total)], axis=1)


@pytest.mark.parametrize("bias_spline", [True, False])
@pytest.mark.parametrize("group", [SE3, product(R3, SO3)], ids=str)
def test_covariances_are_blocks_of_the_inverse(group, bias_spline):
    problem, bias, gravity, rotation = inertial_problem(bias_spline=bias_spline, group=group)
    result = problem.solve()
    assert result.converged
    assert result.cost[-1] < 1e-12
    assert result.observability == []
    inverse = np.linalg.inv(dense(result))
    columns = result._linearizer.model.columns
    for variable in (bias, gravity, rotation):
        own = columns[id(variable)][0]
        assert_allclose(result.covariance(variable), inverse[np.ix_(own, own)], rtol=1e-7, atol=1e-14)
        assert result.covariance(variable).shape == (variable.dimension,) * 2
    assert_allclose(
        result.standard_deviation(bias), np.sqrt(np.diag(inverse)[columns[id(bias)][0]]), rtol=1e-7
    )
    t = torch.tensor([0.0, 0.71, 1.5, 2.7], dtype=F64)
    ours = result.trajectory_covariance(t, derivatives=2)
    jacobians = problem.trajectory.jacobians(t, 2, side="right")
    for n in range(len(t)):
        J = np.zeros((18, len(inverse)))
        for j in range(4):
            own = columns[id(problem.trajectory)][int(jacobians.first[n]) + j]
            J[:, own] = torch.cat([x[n, j] for x in jacobians[1:4]])
        assert_allclose(ours[n], J @ inverse @ J.T, rtol=1e-6, atol=1e-12)
    assert result.trajectory_covariance(t[1]).shape == (6, 6)


def test_covariance_of_a_sparse_system_is_the_same(monkeypatch):
    problem, bias, *_ = inertial_problem()
    expected = problem.solve().covariance(bias)
    monkeypatch.setattr("torchspline.fit.solving.linearizer._WIDEST_BORDER", 0)
    again = problem.solve()
    assert isinstance(again._system, SparseSystem)
    assert_allclose(again.covariance(bias), expected, rtol=1e-7)
    t = torch.tensor([0.71], dtype=F64)
    assert again.trajectory_covariance(t, 1).shape == (1, 12, 12)


def test_estimates_scatter_as_their_covariance_says():
    """200 draws: the mean of the normalised squared error lies within its 99.9 % interval."""
    truth = trajectory(SO3, count=8)
    t = torch.linspace(0.0, 1.5, 40, dtype=F64)
    clean = truth.evaluate(t, 1)
    start, errors = truth.control_points.detach().clone(), []
    bias = torch.tensor([0.1, -0.2, 0.05], dtype=F64)
    for draw in range(200):
        noise = random(2, 40, 3, seed=draw + 1)
        truth.control_points.data.copy_(start)
        variable = Variable("bias", torch.zeros(3, dtype=F64))
        problem = Problem(truth)
        problem.add(StateValue(t, SO3.retract(clean.value.detach(), 0.1 * noise[0]), sigma=0.1))
        gyro = clean.velocity.detach() + bias + 0.05 * noise[1]
        problem.add(Gyroscope(t, gyro, sigma=0.05, bias=variable))
        result = problem.solve()
        miss = variable.value - bias
        errors.append(float(miss @ torch.linalg.solve(result.covariance(variable), miss)))
        assert 0.4 < result.variance_factor < 1.7
    assert 3.0 - 3.3 * (6 / 200) ** 0.5 < np.mean(errors) < 3.0 + 3.3 * (6 / 200) ** 0.5


def test_residuals_come_in_the_order_of_the_measurements():
    spline = trajectory(SO3)
    t = torch.tensor([2.0, 0.1, 1.3, 0.1], dtype=F64)
    measured = random(4, 3, seed=5)
    problem = Problem(spline)
    problem.add(StateVelocity(t, measured, sigma=2.0))
    problem.add(StateVelocity(t.flip(0), measured.flip(0)))
    result = problem.solve(max_iterations=0)
    expected = spline.evaluate(t, 1).velocity.detach() - measured
    assert_allclose(result.residuals["StateVelocity"], expected, atol=1e-13)
    assert_allclose(result.residuals["StateVelocity 2"], expected.flip(0), atol=1e-13)
    assert result.cost == [pytest.approx(0.5 * (0.25 + 1) * float(expected.square().sum()))]
    assert "not converged" in repr(result)


def test_residuals_of_no_measurements():
    problem, *_ = inertial_problem()
    problem.add(Gyroscope(torch.zeros(0, dtype=F64), torch.zeros(0, 3, dtype=F64), name="none"))
    assert problem.solve(max_iterations=2).residuals["none"].shape == (0, 3)


def test_covariance_stays_that_of_the_solution():
    """Wherever the trajectory goes afterwards."""
    problem, *_ = inertial_problem()
    result, t = problem.solve(), torch.linspace(0.0, 2.7, 7, dtype=F64)
    before = result.trajectory_covariance(t, 1)
    with torch.no_grad():
        problem.trajectory.control_points.copy_(SE3.random(12))
    assert_allclose(result.trajectory_covariance(t, 1), before, rtol=1e-12)


def test_open_directions_are_named():
    """A gyroscope says nothing of the rotation it started from, and nothing of a bias that moves along."""
    spline = trajectory(SO3)
    t = torch.linspace(0.0, 2.7, 60, dtype=F64)
    with torch.no_grad():
        gyro = spline.evaluate(t, 1).velocity
    problem = Problem(spline)
    problem.add(Gyroscope(t, gyro))
    result = problem.solve()
    assert len(result.observability) == 3
    for direction in result.observability:
        assert direction.shares == {"trajectory": pytest.approx(1.0)}
        turned = SO3.adjoint_act(spline.control_points.detach(), direction.steps["trajectory"])
        assert_allclose(
            turned, turned[:1].expand_as(turned), atol=1e-5
        )  # the same turn of the world everywhere
    with pytest.raises(ValueError, match=r"do not determine all unknowns: not determined .* trajectory 100%"):
        result.trajectory_covariance(t)
    problem.add(StateValue(t[:1], spline(t[:1]).detach()))
    assert problem.solve().observability == []


def test_control_points_without_measurements_are_named():
    spline = trajectory(SO3, count=30)
    t = torch.linspace(0.0, 1.0, 60, dtype=F64)
    problem = Problem(spline)
    problem.add(StateValue(t, spline(t).detach()))
    before = spline.control_points.detach().clone()
    result = problem.solve()
    assert torch.equal(spline.control_points.detach()[8:], SO3.normalize(before[8:]))
    dead = result.observability[0]
    assert dead.eigenvalue == 0.0
    assert dead.steps["trajectory"][8:].min() == 1.0
    assert dead.steps["trajectory"][:7].max() == 0.0
    with pytest.raises(ValueError, match="do not determine"):
        result.trajectory_covariance(t)


@pytest.mark.parametrize("kind", ["plain", "group", "sphere"])
def test_priors_hold_what_nothing_measures(kind):
    spline = trajectory()
    t = torch.linspace(0.0, 2.7, 60, dtype=F64)
    with torch.no_grad():
        force = ts.imu.measure(spline, t).accelerometer
    problem = Problem(spline)
    problem.add(Pose(t, spline(t).detach(), sigma=0.1))
    options, value = {
        "plain": ({}, torch.zeros(3, dtype=F64)),
        "group": ({"group": SO3}, SO3.exp(torch.tensor([0.2, 0.1, 0.0], dtype=F64))),
        "sphere": ({"sphere": True}, torch.tensor([1.0, 0.0, -9.75], dtype=F64)),
    }[kind]
    variable = Variable("x", value, **options)
    problem.add(
        Accelerometer(
            t, force, **{{"plain": "bias", "group": "rotation", "sphere": "gravity"}[kind]: variable}
        )
    )
    problem.add_prior(variable, sigma=1e-6)
    result = problem.solve()
    if kind == "plain":
        moved = variable.value - value
    elif kind == "group":
        moved = SO3.log(SO3.between(value, variable.value))
    else:
        moved = (variable.value - value) / 9.8
    assert moved.abs().max() < 2e-5
    assert_allclose(result.standard_deviation(variable), torch.full((variable.dimension,), 1e-6), rtol=1e-3)
    free = Variable("free", torch.zeros(2, dtype=F64))
    problem.add_prior(free, covariance=torch.tensor([[2.0, 0.5], [0.5, 1.0]], dtype=F64))
    assert_allclose(problem.solve().covariance(free), [[2.0, 0.5], [0.5, 1.0]], rtol=1e-9)


def test_frozen_unknowns_have_no_covariance():
    problem, bias, gravity, _ = inertial_problem()
    problem.freeze(gravity)
    keep = torch.zeros(12, dtype=torch.bool)
    keep[:4] = True
    problem.freeze(problem.trajectory, keep)
    result = problem.solve()
    with pytest.raises(ValueError, match="gravity is not among the unknowns"):
        result.covariance(gravity)
    assert result.covariance(bias).diagonal().min() > 0
    first = result.trajectory_covariance(torch.tensor([0.1, 2.0], dtype=F64))
    assert first[0].abs().max() == 0
    assert first[1].diagonal().min() > 0
