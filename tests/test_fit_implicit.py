"""Gradients of solutions with respect to what went into them, against finite differences of whole solves."""

import pytest
import torch
from torch.autograd import gradcheck

import torchspline as ts
from torchspline.fit.losses import Cauchy
from torchspline.fit.problem import Problem
from torchspline.fit.residual import Clock
from torchspline.fit.residuals import Accelerometer, Gyroscope, Pose, StateValue, StateVelocity
from torchspline.fit.variables import Variable
from torchspline.groups import R3, SE3, SO3, Rn, product

F64 = torch.float64
EXACT = {"max_iterations": 40, "cost_tolerance": 0.0, "gradient_tolerance": 1e-12, "differentiable": True}


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def start(group, count=6, seed=0):
    return group.exp((0.3 * random(count, group.tangent_size, seed=seed)).cumsum(0))


def aligned(points, reference):
    """Signs of quaternions are free: those of the reference."""
    return points * (points * reference).sum(-1, keepdim=True).sign()


@pytest.mark.contract(
    function="Problem.solve (differentiable)", arguments="measurements sigma covariance", regimes="general",
    properties="first",
)  # fmt: skip
@pytest.mark.parametrize("group", [SO3, SE3, product(R3, SO3), Rn(2)], ids=str)
def test_measurements_and_weights(group):
    points = start(group)
    t = torch.linspace(0, 1.5, 14, dtype=F64)
    truth = ts.BSpline(points, group=group, order=4, dt=0.5)
    clean = truth.evaluate(t, 1)
    D = group.tangent_size

    def solution(value, velocity, sigma, covariance):
        spline = ts.BSpline(points.clone(), group=group, order=4, dt=0.5)
        problem = Problem(spline)
        problem.add(StateValue(t, value, sigma=sigma))
        problem.add(
            StateVelocity(t, velocity, covariance=covariance @ covariance.mT + 0.1 * torch.eye(D, dtype=F64))
        )
        return problem.solve(**EXACT).control_points

    value = group.retract(clean.value.detach(), 0.1 * random(14, D, seed=1))
    velocity = clean.velocity.detach() + 0.2 * random(14, D, seed=2)
    sigma = (0.1 + 0.05 * random(D, seed=3).abs()).requires_grad_()
    inputs = (
        value.requires_grad_(),
        velocity.requires_grad_(),
        sigma,
        (0.3 * random(D, D, seed=4)).requires_grad_(),
    )
    assert gradcheck(solution, inputs, atol=1e-6, rtol=1e-5, eps=1e-5, fast_mode=True)


@pytest.mark.contract(
    function="Problem.solve (differentiable)", arguments="measurements times sigma arguments", regimes="general",
    properties="first",
)  # fmt: skip
def test_known_arguments_times_variables_and_a_robust_loss():
    points = start(SE3)
    truth = ts.BSpline(points, group=SE3, order=4, dt=0.5)
    t = torch.linspace(0.05, 1.4, 25, dtype=F64)
    with torch.no_grad():
        reading = ts.imu.measure(truth, t)
        poses = truth(t)
    noise = random(25, 6, seed=7)
    wandering = torch.zeros(5, 3, dtype=F64)

    def solution(gyro, arm, stamps, prior_free):
        spline = ts.BSpline(points.clone(), group=SE3, order=4, dt=0.5)
        bias = ts.BSpline(wandering.clone(), group=R3, order=3, dt=0.5)
        accel_bias = Variable("accel_bias", torch.zeros(3, dtype=F64))
        gravity = Variable("gravity", torch.tensor([0.0, 0.0, -9.80665], dtype=F64), sphere=True)
        offset = Variable("offset", torch.zeros(1, dtype=F64))
        problem = Problem(spline)
        problem.add(Pose(stamps, poses, sigma=0.05, loss=Cauchy(2.0)))
        problem.add(Gyroscope(t, gyro, sigma=0.1, bias=bias, clock=Clock(offset=offset)))
        problem.add(
            Accelerometer(
                t, reading.accelerometer + 0.1 * noise[:, 3:], sigma=prior_free, bias=accel_bias, gravity=gravity,
                lever_arm=arm, clock=Clock(offset=offset),
            )
        )  # fmt: skip
        problem.add_prior(accel_bias, sigma=0.1)
        result = problem.solve(**EXACT)
        assert result.outside == 0
        return (
            aligned(result.control_points[:, 3:], points[:, 3:]), result.control_points[:, :3],
            result.values["gravity"], result.values["offset"], result.values["accel_bias"],
        )  # fmt: skip

    inputs = (
        reading.gyroscope + 0.1 * noise[:, :3],
        0.1 * random(3, seed=9),
        t + 0.001 * random(25, seed=10),
        torch.full((3,), 0.2, dtype=F64),
    )
    assert gradcheck(
        solution, tuple(x.requires_grad_() for x in inputs), atol=1e-5, rtol=1e-4, eps=1e-5, fast_mode=True
    )


def test_a_solve_inside_a_training_loop():
    """The weight of a sensor is learnt from how well trajectories come out."""
    truth = ts.BSpline(start(SO3, 12), group=SO3, order=4, dt=0.5)
    t = torch.linspace(0, 4.5, 80, dtype=F64)
    with torch.no_grad():
        clean = truth.evaluate(t, 1)
        orientation = SO3.retract(clean.value, 0.3 * random(80, 3, seed=1))
        gyro = clean.velocity + 0.02 * random(80, 3, seed=2)
    log_sigma = torch.zeros((), dtype=F64, requires_grad=True)
    optimiser = torch.optim.Adam([log_sigma], lr=0.3)
    losses = []
    for _ in range(8):
        spline = ts.BSpline(truth.control_points.detach().clone(), group=SO3, order=4, dt=0.5)
        problem = Problem(spline)
        problem.add(StateValue(t, orientation, sigma=0.3))
        problem.add(Gyroscope(t, gyro, sigma=log_sigma.exp()))
        points = problem.solve(differentiable=True).control_points
        fitted = ts.functional.bspline(points, t, group=SO3, order=4, dt=0.5, derivatives=0).value
        loss = SO3.log(SO3.between(clean.value, fitted)).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.9 * losses[0]
    assert log_sigma < -1.0


def test_nothing_to_differentiate_and_nothing_determined():
    spline = ts.BSpline(start(SO3), group=SO3, order=4, dt=0.5)
    t = torch.linspace(0, 1.5, 14, dtype=F64)
    problem = Problem(spline)
    problem.add(StateVelocity(t, torch.zeros(14, 3, dtype=F64)))
    with pytest.raises(ValueError, match="differentiable: none of the"):
        problem.solve(differentiable=True)
    problem = Problem(spline)
    problem.add(StateValue(t[:1], SO3.identity(1).requires_grad_()))
    with pytest.raises(ValueError, match="differentiable: the measurements do not determine"):
        problem.solve(differentiable=True)
    assert not problem.solve().control_points.requires_grad
