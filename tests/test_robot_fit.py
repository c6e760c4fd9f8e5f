"""Splines of joints: from encoder logs, and from sensors on links."""

import pickle

import numpy as np
import pytest
import torch
from fit_oracle import check_assembly
from robot_cases import F64, MOUNT, URDF, joint_spline, ur10e_log
from scipy.interpolate import make_lsq_spline

from torchspline import SE3, SO3, BSpline, Rn, fit, imu, use_kernels
from torchspline.robot import Robot, fit_joints

ROBOT = Robot.from_urdf(URDF)
TRUTH = joint_spline(scale=0.6, learnable=False)
IMUS = ("shoulder", "wrist", "right")
BASE = SE3.random(generator=torch.Generator().manual_seed(3), dtype=F64)


def noise(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def start(by, seed=5):
    """The truth with its control points moved."""
    points = TRUTH.control_points + by * noise(*TRUTH.control_points.shape, seed=seed)
    return BSpline(points, group=TRUTH.group, order=TRUTH.order, dt=0.3)


def stamps(count):
    return torch.linspace(*TRUTH.domain, count, dtype=F64)


# ---------------------------------------------------------------------- sensors on links


def test_sensors_on_links_go_through_pickle():
    """To other processes: their classes are made on the way, and made again there."""
    t = stamps(5)
    made = ROBOT.residual("right", fit.Gyroscope, t, noise(5, 3), base=BASE, sigma=0.7)
    again = pickle.loads(pickle.dumps(made))
    assert type(again) is type(made)
    costs = []
    for residual in (made, again):
        problem = fit.Problem(start(0.1))
        problem.add(residual)
        with use_kernels("reference"):
            costs.append(problem.solve().cost)
    assert costs[0] == costs[1]


@pytest.mark.parametrize(
    "kind",
    [fit.Gyroscope, fit.Accelerometer, fit.AngularAcceleration, fit.Position, fit.Pose, fit.StateValue,
     fit.WorldVelocity, fit.RelativePose],
    ids=lambda kind: kind.__name__,
)  # fmt: skip
def test_jacobians_of_sensors_on_links(kind):
    """Normal equations against automatic differentiation of the residual, joints that mimic included."""
    problem = fit.Problem(start(0.1))
    t = torch.tensor([0.1, 0.37, 1.3], dtype=F64)
    t = t if kind.moments == 1 else torch.stack([t, t.flip(0)])
    _, size = kind.sizes(SE3.arithmetic)
    measured = SE3.random(3, generator=torch.Generator().manual_seed(1)) if size == 7 else noise(3, size)
    options = {"lever_arm": fit.Variable("arm", noise(3, seed=2))} if "lever_arm" in kind.slots else {}
    problem.add(ROBOT.residual("right", kind, t, measured, base=BASE, sigma=0.7, **options))
    check_assembly(problem)


def test_ideal_readings_leave_nothing():
    """The residual's own way through the chain against that of `LinkTrajectory` and `imu.measure`."""
    t = stamps(9)
    problem = fit.Problem(TRUTH)
    moving = ROBOT.links[2:]
    for link in moving:
        body = ROBOT.link(TRUTH, link, base=BASE)
        reading, motion = imu.measure(body.mounted(MOUNT), t), body.kinematics(t)
        arm = {"rotation": MOUNT[3:], "lever_arm": MOUNT[:3]}
        for kind, measured, options in (
            (fit.Gyroscope, reading.gyroscope, {"rotation": MOUNT[3:]}),
            (fit.Accelerometer, reading.accelerometer, arm),
            (fit.Position, motion.position, {}),
            (fit.Pose, body(t), {}),
        ):
            problem.add(ROBOT.residual(link, kind, t, measured, base=BASE, **options))
    residuals = problem.solve(max_iterations=0).residuals
    assert len(residuals) == 4 * len(moving)
    assert "Gyroscope on tip" in residuals
    assert max(x.abs().max() for x in residuals.values()) < 1e-12


def test_joints_from_imus_on_links():
    """From a start 6 degrees off: as near as the covariance says; a bias and a mount come along."""
    t, sigma = stamps(300), (2e-3, 2e-2)
    spline = start(0.1)
    bias = fit.Variable("bias", torch.zeros(3, dtype=F64))
    rotation = fit.Variable("mount", torch.tensor([1.0, 0, 0, 0], dtype=F64), group=SO3)
    problem = fit.Problem(spline)
    for i, link in enumerate(IMUS):
        reading = imu.measure(ROBOT.link(TRUTH, link, base=BASE).mounted(MOUNT) if i == 2 else
                              ROBOT.link(TRUTH, link, base=BASE), t)  # fmt: skip
        gyroscope = reading.gyroscope + sigma[0] * noise(300, 3, seed=2 * i)
        accelerometer = reading.accelerometer + sigma[1] * noise(300, 3, seed=2 * i + 1)
        mount = {"rotation": rotation} if i == 2 else {}
        arm = {"lever_arm": MOUNT[:3]} if i == 2 else {}
        biased = {"bias": bias} if i == 1 else {}
        gyroscope = gyroscope + (torch.tensor([0.01, -0.02, 0.03], dtype=F64) if i == 1 else 0.0)
        problem.add(
            ROBOT.residual(link, fit.Gyroscope, t, gyroscope, base=BASE, sigma=sigma[0], **mount, **biased)
        )
        problem.add(
            ROBOT.residual(
                link, fit.Accelerometer, t, accelerometer, base=BASE, sigma=sigma[1], **mount, **arm
            )
        )
    problem.add_prior(rotation, sigma=1.0)
    result = problem.solve()
    assert result.converged
    assert 0.9 < result.variance_factor < 1.1
    error = (spline(t) - TRUTH(t)).detach()
    sure = result.trajectory_covariance(t).diagonal(dim1=-2, dim2=-1)
    assert 0.4 < float((error**2 / sure).mean()) < 2.0
    assert error.abs().max() < 5e-3
    assert (bias.value - torch.tensor([0.01, -0.02, 0.03], dtype=F64)).abs().max() < 2e-3


# ---------------------------------------------------------------------- encoders


@pytest.mark.parametrize("nanoseconds", [False, True])
@pytest.mark.parametrize("velocities", [False, True])
def test_exact_logs_give_the_spline_back(velocities, nanoseconds):
    """In any order, with rows of NaN, and stamps that are not uniform."""
    t = stamps(200)[torch.randperm(200, generator=torch.Generator().manual_seed(0))]
    t = t + torch.where((t > 0.01) & (t < 1.49), 0.003 * noise(200).clamp(-2, 2), 0.0)
    t = (t * 1e9).round() * 1e-9 if nanoseconds else t
    state = TRUTH.evaluate(t)
    q, rate = state.value.clone(), state.velocity if velocities else None
    q[17, 2] = torch.nan
    times = (t * 1e9).round().to(torch.int64) if nanoseconds else t
    found = fit_joints(
        times, q, rate, dt=0.3, position_sigma=1e-4, velocity_sigma=1e-3 if velocities else None
    )
    assert (found.trajectory.control_points - TRUTH.control_points).abs().max() < 1e-5
    assert found.dropped == 1
    assert found.position_residual[17].isnan().all()
    assert found.position_residual[:17].abs().max() < 1e-8
    assert (found.velocity_residual is None) != velocities
    assert (found.trajectory.dt_ns is not None) == nanoseconds


def test_weights_against_dense_least_squares():
    """Positions and velocities of different noise for each joint, by a dense solution of the same equations."""
    t = stamps(60)
    state = TRUTH.evaluate(t)
    sigma = torch.tensor([1e-3, 1e-2, 3e-3, 1e-4], dtype=F64), torch.tensor([0.1, 1e-3, 0.3, 1e-2], dtype=F64)
    q, rate = (x + s * noise(60, 4, seed=i) for i, (x, s) in enumerate(zip(state[:2], sigma, strict=True)))
    found = fit_joints(t, q, rate, dt=0.3, position_sigma=sigma[0], velocity_sigma=sigma[1])
    unit = torch.eye(len(TRUTH.control_points), dtype=F64)
    one = BSpline(unit, group=Rn(len(unit)), order=6, dt=0.3, learnable=False).evaluate(t, derivatives=1)
    for j in range(4):
        A = torch.cat([one.value / sigma[0][j], one.velocity / sigma[1][j]])
        b = torch.cat([q[:, j] / sigma[0][j], rate[:, j] / sigma[1][j]])
        expected = torch.linalg.lstsq(A, b[:, None]).solution[:, 0]
        assert (found.trajectory.control_points[:, j] - expected).abs().max() < 1e-5
    torch.testing.assert_close(found.velocity_residual, rate - found.trajectory.evaluate(t).velocity)


def test_noise_and_spacing_come_from_the_log():
    """A motion that is no spline of these knots; the right noise to a tenth, and a spacing near the best one."""
    t = torch.arange(0.0, 6.0, 0.01, dtype=F64)
    phase = torch.tensor([[5.0, 3.0]], dtype=F64) * t[:, None]
    q, rate = torch.sin(phase), torch.tensor([[5.0, 3.0]], dtype=F64) * torch.cos(phase)
    sigma = torch.tensor([1e-3, 2e-3], dtype=F64), torch.tensor([1e-2, 3e-3], dtype=F64)
    noisy = [x + s * noise(600, 2, seed=i) for i, (x, s) in enumerate(zip((q, rate), sigma, strict=True))]
    found = fit_joints(t, *noisy, dt="auto")
    for estimate, expected in zip((found.position_sigma, found.velocity_sigma), sigma, strict=True):
        assert ((estimate / expected - 1.0).abs() < 0.1).all()

    def error(dt):
        spline = fit_joints(t, *noisy, dt=dt, position_sigma=sigma[0], velocity_sigma=sigma[1]).trajectory
        return float((spline.evaluate(t).velocity - rate).square().mean().sqrt())

    tried = {dt: error(dt) for dt in (0.015, 0.03, 0.06, 0.12, 0.24, 0.48, 0.9)}
    assert error(found.spacing) < 1.5 * min(tried.values())
    assert tried[0.015] > 2 * min(tried.values())  # the choice matters
    assert "generalised cross-validation" in found.notes[-1]


def test_gaps_are_bridged_and_told():
    t = stamps(200)
    t = t[(t < 0.3) | (t > 1.3)]
    found = fit_joints(t, TRUTH(t), dt=0.1, position_sigma=1e-4)
    assert "1 stretches" in found.notes[-1]
    assert (found.trajectory(stamps(50)) - TRUTH(stamps(50))).abs().max() < 0.5


@pytest.mark.parametrize("nanoseconds", [False, True])
def test_delays_of_velocities_are_found(nanoseconds):
    t = stamps(400)[20:-20]
    delay = torch.tensor([1.5e-3, -4e-3, 0.0, 0.02], dtype=F64)
    rate = torch.stack([TRUTH.evaluate(t - late).velocity[:, j] for j, late in enumerate(delay.tolist())], -1)
    times = (t * 1e9).round().to(torch.int64) if nanoseconds else t
    noisy = (TRUTH(t) + 1e-5 * noise(360, 4), rate + 1e-3 * noise(360, 4, seed=1))
    found = fit_joints(times, *noisy, dt=0.1, position_sigma=1e-5, velocity_sigma=1e-3, estimate_delay=True)
    assert (found.velocity_delay - delay).abs().max() < 1e-4
    assert found.velocity_residual.nan_to_num().square().mean().sqrt() < 1.15e-3
    late = found.velocity_residual[:, 3].isnan()  # what was true before the first position has no place
    assert late[: int(0.02 / float(t[1] - t[0]))].all()
    assert not late[20:].any()
    without = fit_joints(times, *noisy, dt=0.1, position_sigma=1e-5, velocity_sigma=1e-3)
    assert without.velocity_delay is None
    assert without.velocity_residual.square().mean().sqrt() > 2e-3


def test_joints_at_rest_have_no_delay_of_velocities():
    """Neither an exact log of them nor one with noise, beside a joint that tells its own."""
    t = torch.arange(200, dtype=F64) * 0.01
    moving = torch.stack([torch.sin(6 * t), 6 * torch.cos(6 * (t - 0.004))])
    for scale in (0.0, 1.0):
        q = torch.stack([moving[0], torch.ones_like(t)], -1) + scale * 1e-6 * noise(200, 2)
        rate = torch.stack([moving[1], torch.zeros_like(t)], -1) + scale * 1e-4 * noise(200, 2, seed=1)
        delay = fit_joints(t, q, rate, dt=0.05, estimate_delay=True).velocity_delay
        assert abs(delay[0] - 0.004) < 1e-4
        assert abs(delay[1]) <= scale * 1e-3
    at_rest = fit_joints(t, q[:, 1:].round(), 0 * t[:, None], dt="auto", estimate_delay=True)
    assert at_rest.velocity_delay == 0.0
    assert (at_rest.trajectory(t) - 1.0).abs().max() < 1e-9


@pytest.mark.realdata
def test_ur10e_log(shared_data):
    """The spline's velocity is within the noise of the recorded one, seen from a fit of that alone [SciPy], once it is
    known how late the drives report it; without, all but one joint are."""
    t, q, rate = ur10e_log(shared_data)
    found = fit_joints(t, q, rate, dt="auto", estimate_delay=True)
    knots = np.arange(float(t[0]) + 0.04, float(t[-1]) - 0.02, 0.04)
    knots = np.concatenate([[float(t[0])] * 6, knots, [float(t[-1])] * 6])
    alone = make_lsq_spline(t.numpy(), rate.numpy(), knots, 5)(t.numpy()) - rate.numpy()
    independent = torch.from_numpy(np.sqrt((alone**2).sum(0) / (len(t) - len(knots) + 6)))
    assert ((found.velocity_sigma / independent - 1.0).abs() < 0.05).all()
    assert (found.velocity_residual[5:].square().mean(0).sqrt() < independent).all()
    assert ((found.velocity_delay > 3e-4) & (found.velocity_delay < 2.5e-3)).all()
    assert (found.position_residual.square().mean(0).sqrt() < 1.02 * found.position_sigma).all()
    at_once = fit_joints(t, q, rate, dt=found.spacing)
    ratio = at_once.velocity_residual.square().mean(0).sqrt() / independent
    assert (ratio[1:] < 1.05).all()
    assert 1.1 < ratio[0] < 1.3
    assert Robot.from_urdf(shared_data / "robots" / "ur10e.urdf").over_limits(found.trajectory, t) == []
