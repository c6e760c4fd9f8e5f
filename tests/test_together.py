"""Batches of small problems: each as if it were alone."""

import pytest
import torch
from numpy.testing import assert_allclose

import torchspline as ts
from torchspline.fit.losses import Huber
from torchspline.fit.problem import Problem
from torchspline.fit.residuals import Accelerometer, Gyroscope, Pose, StateValue
from torchspline.fit.together import BatchProblem
from torchspline.fit.variables import Variable
from torchspline.groups import R3, SE3, SO3, product

F64 = torch.float64


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def windows(group, B, M=13, seed=0, **clock):
    steps = 0.1 * random(B, M, 6, seed=seed).cumsum(-2)
    points = group.exp((steps + random(B, 1, 6, seed=seed + 1)).contiguous())
    return ts.BSpline(points, group=group, learnable=False, **(clock or {"dt": 0.1}))


def inertial(trajectories, seed=5):
    """Times, which, gyroscope, force, times of poses, which, poses; each trajectory has another number of them."""
    B = len(trajectories.control_points)
    found = [[] for _ in range(7)]
    ns = trajectories.dt_ns is not None
    for b in range(B):
        one = single(trajectories, b)
        start, end = one.domain
        t = torch.linspace(0.0, 1.0, 60 + 3 * b, dtype=F64)
        t = start + ((t * (end - start)).round().to(torch.int64) if ns else t * (end - start))
        reading, poses = ts.imu.measure(one, t), one(t[::7])
        noise = random(3, len(t), 6, seed=seed + b)
        gyro = reading.gyroscope + 0.01 * (b + 1) + 0.01 * noise[0, :, :3]
        force = reading.accelerometer - 0.02 * (b + 1) + 0.1 * noise[1, :, :3]
        moved = poses[:, :3] + 0.02 * noise[2, : len(poses), :3]
        turned = SO3.retract(poses[:, 3:], 0.02 * noise[2, : len(poses), 3:], side="right")
        which = torch.full((len(t),), b)
        columns = (t, which, gyro, force, t[::7], which[::7], torch.cat([moved, turned], dim=-1))
        for column, x in zip(found, columns, strict=True):
            column.append(x)
    return [torch.cat(x) for x in found]


def single(trajectories, b):
    start = trajectories.domain[0]
    clock = {"dt_ns": trajectories.dt_ns, "t0_ns": start} if trajectories.dt_ns else {"dt": 0.1, "t0": start}
    return ts.BSpline(trajectories.control_points[b], group=trajectories.group, learnable=False, **clock)


def perturbed(trajectories):
    return trajectories.group.retract(
        trajectories.control_points, 0.05 * random(*trajectories.control_points.shape[:2], 6, seed=9)
    )


@pytest.mark.parametrize(
    "clock", [{"dt": 0.1, "t0": -2.0}, {"dt_ns": 100_000_000, "t0_ns": 10**18}], ids=["s", "ns"]
)
@pytest.mark.parametrize("group", [SE3, product(R3, SO3)], ids=str)
@pytest.mark.parametrize("mode", ["reference", "auto"])
def test_each_comes_out_as_if_it_were_alone(group, clock, mode):
    with ts.use_kernels(mode):
        compare_with_each_alone(group, clock)


def compare_with_each_alone(group, clock, B=5):
    truth = windows(group, B, **clock)
    t, which, gyro, force, at, of, poses = inertial(truth)
    mixed = torch.randperm(len(t), generator=torch.Generator().manual_seed(0))  # in any order
    t, which, gyro, force = (x[mixed] for x in (t, which, gyro, force))
    start = perturbed(truth)

    def unknowns(*batch):
        down = torch.tensor([0.3, 0.0, -9.8], dtype=F64).expand(*batch, 3)
        return (
            Variable("gyro_bias", torch.zeros(*batch, 3, dtype=F64)),
            Variable("accel_bias", torch.zeros(*batch, 3, dtype=F64)),
            Variable("gravity", down, sphere=True),
        )

    def fill(problem, gyro_bias, accel_bias, gravity, chosen, chosen_poses, **more):
        problem.add(Gyroscope(t[chosen], gyro[chosen], sigma=0.01, bias=gyro_bias), *more.get("which", ()))
        reads = Accelerometer(t[chosen], force[chosen], sigma=0.1, bias=accel_bias, gravity=gravity)
        problem.add(reads, *more.get("which", ()))
        seen = Pose(at[chosen_poses], poses[chosen_poses], sigma=0.02, loss=Huber(1.5))
        problem.add(seen, *more.get("of", ()))
        problem.add_prior(accel_bias, sigma=torch.tensor([0.1, 0.2, 0.3], dtype=F64))

    truth.control_points.copy_(start)
    problem, variables, everything = BatchProblem(truth), unknowns(B), slice(None)
    fill(problem, *variables, everything, everything, which=(which,), of=(of,))
    result = problem.solve()
    assert result.converged.all()
    iterations = []
    for b in range(B):
        truth_b = single(truth, b)
        truth_b.control_points.copy_(start[b])
        alone, own = Problem(truth_b), unknowns()
        fill(alone, *own, which == b, of == b)
        expected = alone.solve()
        iterations.append(len(expected.cost) - 1)
        assert expected.converged
        assert_allclose(result.cost[b], expected.cost[-1], rtol=1e-9)
        assert_allclose(result.initial_cost[b], expected.cost[0], rtol=1e-9)
        apart = group.log(group.between(truth_b.control_points, truth.control_points[b]))
        assert_allclose(apart, torch.zeros_like(apart), atol=1e-6)
        for mine, its in zip(variables, own, strict=True):
            assert_allclose(mine.value[b], its.value, atol=1e-6)
            assert_allclose(result.covariance(mine)[b], expected.covariance(its), rtol=1e-4, atol=1e-12)
    assert max(abs(int(x) - y) for x, y in zip(result.iterations, iterations, strict=True)) <= 1


def test_one_that_fails_leaves_the_others_alone():
    """A trajectory without measurements, one with infinite cost, one that is where it belongs, one that is not."""
    truth = windows(SE3, 4)
    t = torch.linspace(0.0, 1.0, 30, dtype=F64)
    values = truth(t)
    exact = truth.control_points.clone()
    start = perturbed(truth)
    start[2] = exact[2]
    truth.control_points.copy_(start)
    problem = BatchProblem(truth)
    for b in (1, 2, 3):
        far = 1e200 if b == 1 else 1.0
        measured = values[b] * torch.tensor([far] * 3 + [1.0] * 4, dtype=F64)
        problem.add(StateValue(t, measured, sigma=0.01), torch.full((30,), b))
    result = problem.solve()
    assert result.converged.tolist() == [True, False, True, True]
    assert "not finite" in result.reason[1]
    assert result.iterations[:2].tolist() == [0, 0]
    assert result.iterations[2] <= 1 < result.iterations[3]
    assert_allclose(truth.control_points[:2], SE3.normalize(start[:2]), atol=1e-15)
    assert_allclose(truth.control_points[2], SE3.normalize(exact[2]), atol=1e-12)
    assert_allclose(truth(t)[3], values[3], atol=1e-6)
    assert result.cost[3] < 1e-9


def test_covariances_that_the_data_leave_open_are_nan():
    truth = windows(SE3, 2)
    bias = Variable("bias", torch.zeros(2, 3, dtype=F64))
    t = torch.linspace(0.0, 1.0, 60, dtype=F64)
    problem = BatchProblem(truth)
    for b in range(2):
        gyro = ts.imu.measure(single(truth, b), t).gyroscope
        problem.add(Gyroscope(t, gyro, sigma=0.01, bias=bias), torch.full((60,), b))
    problem.add(StateValue(t, truth(t)[1], sigma=0.01), torch.ones(60, dtype=torch.int64))
    covariance = problem.solve().covariance(bias)
    assert covariance[0].isnan().all()
    assert covariance[1].diagonal().min() > 0


def test_covariance_of_a_trajectory_without_measurements_is_nan():
    truth = windows(SE3, 3)
    bias = Variable("bias", torch.zeros(3, 3, dtype=F64))
    t = torch.linspace(0.0, 1.0, 60, dtype=F64)
    problem = BatchProblem(truth)
    for b in range(2):
        gyro = ts.imu.measure(single(truth, b), t).gyroscope
        problem.add(Gyroscope(t, gyro, sigma=0.01, bias=bias), torch.full((60,), b))
        problem.add(StateValue(t, truth(t)[b], sigma=0.01), torch.full((60,), b))
    covariance = problem.solve().covariance(bias)
    assert covariance[:2].isfinite().all()
    assert covariance[2].isnan().all()


def test_what_a_batch_does_not_take_is_refused():
    truth = windows(SE3, 3)
    t, gyro = torch.linspace(0.0, 1.0, 5, dtype=F64), torch.zeros(5, 3, dtype=F64)
    which = torch.zeros(5, dtype=torch.int64)
    problem = BatchProblem(truth)
    with pytest.raises(ValueError, match="solve: the problem has no residuals"):
        problem.solve()
    with pytest.raises(
        ValueError, match=r"trajectories: expected .* \(B, M, P\), got \(13, 7\); for a single"
    ):
        BatchProblem(single(truth, 0))
    with pytest.raises(ValueError, match="trajectory: expected numbers from 0 to 2, got 3 to 3"):
        problem.add(Gyroscope(t, gyro), which + 3)
    with pytest.raises(
        ValueError, match=r"trajectory: expected int64 of shape \(5,\), got torch.float64 \(5,\)"
    ):
        problem.add(Gyroscope(t, gyro), which.double())
    with pytest.raises(ValueError, match="bias: expected a Variable with a row for each of 3 trajectories"):
        problem.add(Gyroscope(t, gyro, bias=Variable("b", torch.zeros(3, dtype=F64))), which)
    with pytest.raises(ValueError, match=r"t: .* lie outside"):
        problem.add(Gyroscope(t + 0.5, gyro), which)
    problem.add(Gyroscope(t, gyro), which)
    result = problem.solve(max_iterations=0)
    with pytest.raises(ValueError, match="variable: x is not among the unknowns"):
        result.covariance(Variable("x", torch.zeros(3, dtype=F64)))
