"""Standard deviations where errors are alike for a while: against dense algebra and draws of correlated noise."""

import math

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

import torchspline as ts
from torchspline.fit.problem import Problem
from torchspline.fit.residuals import Gyroscope, Orientation, Pose, StateValue
from torchspline.fit.solving import linearizer as linearizers
from torchspline.fit.solving.scatter import Scatter
from torchspline.fit.variables import Variable
from torchspline.groups import R3, SE3, SO3

F64 = torch.float64


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def correlated(count, step, time_constant, seed):
    """Noise of unit variance, of a first-order process."""
    from scipy.signal import lfilter

    rho = math.exp(-step / time_constant)
    white = np.sqrt(1 - rho**2) * random(count, 3, seed=seed).numpy()
    return torch.from_numpy(lfilter([1.0], [1.0, -rho], white, axis=0))


def pieces(start, chosen=slice(None), frozen=True):
    """Poses and a gyroscope with two kinds of bias, of all times or of some."""
    spline = ts.BSpline(start, group=SE3, dt=0.3, learnable=False)
    t = (torch.arange(90, dtype=F64) + 0.5) * 0.03
    poses = SE3.retract(spline(t), 0.02 * random(90, 6, seed=5))
    lever = Variable("lever", torch.zeros(3, dtype=F64))
    bias = ts.BSpline(torch.zeros(5, 3, dtype=F64), group=R3, order=3, dt=0.9, learnable=False)
    problem = Problem(spline)
    problem.add(Pose(t[chosen], poses[chosen], sigma=0.02))
    gyro = ts.imu.measure(spline, t).gyroscope + 0.05 * random(90, 3, seed=6)
    problem.add(Gyroscope(t[chosen], gyro[chosen], sigma=0.05, bias=bias))
    problem.add(ts.fit.Position(t[chosen], poses[chosen, :3], sigma=0.03, lever_arm=lever))
    if frozen:
        problem.freeze(spline, torch.arange(12) < 3)
    return problem, bias, lever


@pytest.mark.parametrize("sparse", [False, True])
def test_pulls_of_stretches_are_those_of_dense_equations(sparse, monkeypatch):
    if sparse:
        monkeypatch.setattr(linearizers, "_WIDEST_BORDER", -1)
    start = SE3.exp((0.3 * random(12, 6)).cumsum(0))
    problem, bias, lever = pieces(start)
    result = problem.solve()
    assert result.banded is not sparse
    model, state = result._linearizer.model, result._state
    H = np.stack([result._system.multiply(e) for e in np.eye(model.total)], axis=1)
    at = (torch.arange(90, dtype=F64) + 0.5) / 90
    pulls = []
    for b in range(9):  # as many as segments, of which no stretch has a part only
        own, its_bias, its_lever = pieces(start, (at * 9).floor() == b)
        part = own.prepare()
        names = ((own.trajectory, problem.trajectory), (its_bias, bias), (its_lever, lever))
        points = {id(new): state.points[id(old)] for new, old in names[:2]}
        right = part(part.model.prepared(points, {id(its_lever): state.values[id(lever)]})).right
        pulls.append(np.linalg.solve(H, right))
    squares = np.square(pulls).sum(axis=0)
    scattered = Scatter(result._linearizer, state, result._factor, 0.3)
    everything = np.arange(model.total)
    assert_allclose(scattered._squares(scattered._gradients, everything), squares, rtol=1e-6)
    columns = model.columns[id(lever)][0]
    expected = np.sqrt(np.maximum(squares[columns] * 9 / 8, np.diag(np.linalg.inv(H))[columns]))
    assert_allclose(result.standard_deviation(lever, 0.3), expected, rtol=1e-6)
    # What a solution leaves of drawn errors has no gradient: what stretches have of it cancels.
    for drawn in scattered._drawn:
        total = np.asarray(drawn.sum(axis=1)).ravel()
        assert_allclose(total, np.zeros_like(total), atol=1e-8 * np.abs(drawn).max())
    sigmas = result.standard_deviation(problem.trajectory, 0.3)
    assert not sigmas[:3].any()
    assert (sigmas[3:] >= result.standard_deviation(problem.trajectory)[3:]).all()


def test_errors_of_splines_scatter_as_stretches_say():
    """Control points every 3 s, noise alike for a tenth of a second, stretches of 2 s; independent noise stays what
    it is."""
    T, rate, time_constant = 90.0, 20.0, 0.12
    t = (torch.arange(int(T * rate), dtype=F64) + 0.5) / rate
    squares, factors = {"plain": [], "stretch": []}, []
    at = torch.linspace(6.0, 84.0, 40, dtype=F64)
    for draw in range(5):
        for noisy in (True, False)[: 2 if draw < 1 else 1]:
            noise = (
                correlated(len(t), 1 / rate, time_constant, seed=draw)
                if noisy
                else random(len(t), 3, seed=draw)
            )
            spline = ts.BSpline(torch.zeros(33, 3, dtype=F64), group=R3, dt=3.0, learnable=False)
            problem = Problem(spline)
            problem.add(StateValue(t, 0.1 * noise, sigma=0.1))
            result = problem.solve()
            plain, wide = (result.trajectory_covariance(at, stretch=s) for s in (None, 2.0))
            if not noisy:
                factors.append(wide[0, 0, 0] / plain[0, 0, 0])
                continue
            for name, covariance in (("plain", plain), ("stretch", wide)):
                squares[name].append((spline(at).square() / covariance.diagonal(dim1=1, dim2=2)).mean())
            sigmas = result.standard_deviation(spline, 2.0) / result.standard_deviation(spline)
            assert_allclose(sigmas[5, 0] ** 2, wide[3, 0, 0] / plain[3, 0, 0], rtol=1e-10)
    assert np.mean(factors) < 1.25
    assert np.mean(squares["plain"]) > 3.0
    assert 0.75 < np.mean(squares["stretch"]) < 1.5


def test_biases_that_are_splines_take_stretches_into_account():
    """Knots every 4 s beside those of the trajectory every 0.5 s: the equations are a sparse matrix."""
    rate, T, errors, plain, wide = 25.0, 40.0, [], [], []
    t = (torch.arange(int(T * rate), dtype=F64) + 0.25) / rate
    for draw in range(5):
        spline = ts.BSpline(SO3.identity(163, dtype=F64), group=SO3, dt=0.25, learnable=False)
        bias = ts.BSpline(torch.zeros(13, 3, dtype=F64), group=R3, dt=4.0, learnable=False)
        problem = Problem(spline)
        gyro = 0.01 * correlated(len(t), 1 / rate, 0.12, seed=draw + 20)
        problem.add(Gyroscope(t, gyro, sigma=0.01, bias=bias))
        problem.add(Orientation(t[::5], SO3.identity(len(t[::5]), dtype=F64), sigma=1e-4))
        result = problem.solve()
        assert not result.banded
        errors.append(bias.control_points[3:-3].square())
        plain.append(result.standard_deviation(bias)[3:-3])
        wide.append(result.standard_deviation(bias, 2.0)[3:-3])
    squares = [float((torch.stack(errors) / torch.stack(x).square()).mean()) for x in (plain, wide)]
    assert squares[0] > 3.0
    assert 0.6 < squares[1] < 1.8
    with pytest.raises(
        ValueError, match=r"stretch: expected at most the knot spacing of the spline, 4 s, got 5"
    ):
        result.standard_deviation(bias, 5.0)
