"""Batches of small problems: each as if it were alone."""

import pytest
import torch
from numpy.testing import assert_allclose

import torchspline as ts
from torchspline.fit.batch import BatchProblem
from torchspline.fit.losses import Huber
from torchspline.fit.problem import Problem
from torchspline.fit.residual import Clock
from torchspline.fit.residuals import Accelerometer, Gyroscope, Pose, Position, StateValue
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


# ---------------------------------------------------------------------- clocks, splines of biases, what stays

#: Until nothing is left to gain: the solutions then agree to rounding, not to the tolerance of a cost.
TIGHT = {"cost_tolerance": 0.0, "gradient_tolerance": 1e-11, "max_iterations": 60}


def wandering(trajectories, seed=30):
    """Gyroscope readings by clocks that are off, with biases that wander: times, which, readings; poses; biases."""
    B = len(trajectories.control_points)
    found = [[] for _ in range(6)]
    drift = 0.05 * random(B, 7, 3, seed=seed).cumsum(1)
    for b in range(B):
        one = single(trajectories, b)
        start, end = one.domain
        bias = ts.BSpline(drift[b], group=R3, order=3, dt=0.25, t0=start - 0.1, learnable=False)
        t = torch.linspace(start + 0.05, end - 0.05, 60 + 5 * b, dtype=F64)
        stamps = t + 0.002 * (b + 1) + 0.01 * b * (t - 0.5 * (start + end))
        gyro = ts.imu.measure(one, t).gyroscope + bias(stamps)
        gyro = gyro + 0.002 * random(len(t), 3, seed=seed + b)
        at = torch.linspace(start, end, 40, dtype=F64)
        poses = one(at)
        poses = one.group.retract(poses, 0.01 * random(len(at), 6, seed=seed + 50 + b), side="right")
        whose = torch.full((len(t),), b), torch.full((len(at),), b)
        columns = (stamps, whose[0], gyro, at, whose[1], poses)
        for column, x in zip(found, columns, strict=True):
            column.append(x)
    return [torch.cat(x) for x in found]


def clocked(problem, data, chosen, unknowns, which=(), of=()):
    """The measurements of `wandering`, with their unknowns."""
    t, _, gyro, at, _, poses = data
    offset, skew, bias, lever = unknowns
    there, seen = chosen
    clock = Clock(offset=offset, skew=skew)
    problem.add(Gyroscope(t[there], gyro[there], sigma=0.002, bias=bias, clock=clock), *which)
    problem.add(Pose(at[seen], poses[seen], sigma=0.01), *of)
    flat = torch.zeros(int(seen.sum()), 3, dtype=F64)
    problem.add(Position(at[seen], poses[seen, :3] + flat, sigma=0.02, lever_arm=lever), *of)
    for variable, sigma in ((offset, 0.01), (skew, 0.02), (lever, 0.1)):
        problem.add_prior(variable, sigma=sigma)
    problem.add(smooth_bias(at[seen], bias), *of)


def smooth_bias(t, bias):
    """Keeps control points that nothing else sees near where they start: a bias of a body at rest."""
    return Gyroscope(t, torch.zeros(len(t), 3, dtype=F64), sigma=5.0, bias=bias, name="weak")


def unknowns_of(start, *batch):
    zeros = lambda *shape: torch.zeros(*batch, *shape, dtype=F64)  # noqa: E731
    bias = ts.BSpline(zeros(7, 3), group=R3, order=3, dt=0.25, t0=start - 0.1, learnable=False)
    return (
        Variable("offset", zeros(1)),
        Variable("skew", zeros(1)),
        bias,
        Variable("lever", zeros(3)),
    )


@pytest.mark.parametrize(("mode", "frozen"), [("reference", True), ("auto", True), ("auto", False)])
def test_clocks_and_splines_of_biases_come_out_as_if_each_were_alone(mode, frozen):
    B = 3
    with ts.use_kernels(mode):
        truth = windows(SE3, B, dt=0.1, t0=-2.0)
        data = wandering(truth)
        _, which, _, _, of, _ = data
        start = perturbed(truth)
        lead = truth.domain[0]
        # Which control points and rows stay, another number in each trajectory.
        stay = torch.zeros(B, 13, dtype=torch.bool)
        bias_stays, lever_stays = torch.zeros(B, 7, dtype=torch.bool), torch.zeros(B, dtype=torch.bool)
        if frozen:
            stay[1, :4], stay[2], bias_stays[0, 2:4], bias_stays[2] = True, True, True, True
            lever_stays[1] = True
        truth.control_points.copy_(start)
        problem, unknowns = BatchProblem(truth), unknowns_of(lead, B)
        everything = (torch.ones(len(which), dtype=torch.bool), torch.ones(len(of), dtype=torch.bool))
        clocked(problem, data, everything, unknowns, (which,), (of,))
        if frozen:
            problem.freeze(truth, stay)
            problem.freeze(unknowns[2], bias_stays)
            problem.freeze(unknowns[3], lever_stays)
        result = problem.solve(**TIGHT)
        assert result.converged.all(), result.reason
        for b in range(B):
            own, alone = unknowns_of(lead), single(truth, b)
            alone.control_points.copy_(start[b])
            one = Problem(alone)
            clocked(one, data, (which == b, of == b), own)
            if frozen:
                one.freeze(alone, stay[b])
                one.freeze(own[2], bias_stays[b])
                if lever_stays[b]:
                    one.freeze(own[3])
            expected = one.solve(**TIGHT)
            assert expected.converged
            assert_allclose(result.cost[b], expected.cost[-1], rtol=1e-12)
            at = torch.linspace(*truth.domain, 50, dtype=F64)
            apart = SE3.log(SE3.between(alone(at), truth(at)[b]))
            assert_allclose(apart, torch.zeros_like(apart), atol=1e-10)
            assert_allclose(unknowns[2].control_points[b], own[2].control_points, atol=1e-10)
            for i in (0, 1, 3):
                assert_allclose(unknowns[i].value[b], own[i].value, atol=1e-10)
                if i == 3 and lever_stays[b]:
                    assert not result.covariance(unknowns[i])[b].any()
                    continue
                found = result.covariance(unknowns[i])[b]
                assert_allclose(found, expected.covariance(own[i]), rtol=1e-6, atol=1e-18)
        # The clocks are found: the offset is 2 ms more in each, the skew a hundredth.
        assert_allclose(unknowns[0].value[0], torch.tensor([0.002], dtype=F64), atol=5e-4)


def test_a_clock_may_leave_the_domain_without_meeting_the_next_trajectory():
    """Measurements that an offset moves beyond the end have no weight; they are not those of the neighbour."""
    truth = windows(SE3, 3)
    poses, t = truth(torch.linspace(0.0, 1.0, 41, dtype=F64)), torch.linspace(0.0, 1.0, 41, dtype=F64)
    problem = BatchProblem(truth)
    offset = Variable("offset", torch.tensor([[0.0], [-0.3], [0.0]], dtype=F64))
    which = torch.arange(3).repeat_interleave(41)
    clock = Clock(offset=offset)
    problem.add(Pose(t.repeat(3), poses.flatten(0, 1), sigma=0.1, clock=clock), which)
    problem.freeze(truth)
    result = problem.solve(max_iterations=0)
    alone = Problem(single(truth, 1))
    own = Variable("offset", offset.value[1])
    alone.add(Pose(t, poses[1], sigma=0.1, clock=Clock(offset=own)))
    expected = alone.solve(max_iterations=0)
    assert expected.outside == 12
    assert_allclose(
        result.cost, torch.tensor([0.0, expected.cost[0], 0.0], dtype=F64), rtol=1e-12, atol=1e-20
    )


def test_what_stays_is_not_touched_and_can_be_released():
    truth = windows(SE3, 2)
    t = torch.linspace(0.0, 1.0, 40, dtype=F64)
    values = truth(t)
    exact = truth.control_points.clone()
    truth.control_points.copy_(perturbed(truth))
    truth.control_points[0] *= torch.tensor([1.0] * 3 + [3.0] * 4, dtype=F64)  # quaternions of any length
    before = truth.control_points.clone()
    problem = BatchProblem(truth)
    bias = Variable("bias", torch.full((2, 3), 0.01, dtype=F64))
    for b in range(2):
        problem.add(StateValue(t, values[b], sigma=0.01), torch.full((40,), b))
        gyro = ts.imu.measure(ts.BSpline(exact[b], group=SE3, dt=0.1), t).gyroscope.detach()
        problem.add(Gyroscope(t, gyro, sigma=0.01, bias=bias), torch.full((40,), b))
    problem.freeze(truth)
    problem.freeze(bias)
    with pytest.raises(ValueError, match="solve: everything is frozen"):
        problem.solve()
    problem.release(truth)
    first = torch.zeros(2, 13, dtype=torch.bool)
    first[0] = True
    problem.freeze(truth, first)
    problem.solve()
    assert torch.equal(truth.control_points[0], before[0])
    assert torch.equal(bias.value, torch.full((2, 3), 0.01, dtype=F64))
    problem.release(truth)
    problem.release(bias)
    before = truth.control_points.clone()
    problem.freeze(truth, torch.arange(13) < 2)  # of all trajectories
    problem.solve()
    assert torch.equal(truth.control_points[:, :2], before[:, :2])
    problem.release(truth)
    assert problem.solve(**TIGHT).cost.max() < 1e-15
    assert_allclose(truth(t), values, atol=1e-9)
