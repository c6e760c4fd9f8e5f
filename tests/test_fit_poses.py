"""Trajectories fitted to timed poses: known splines, dense least squares, awkward input."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from batteries import generator, tangents
from scipy.interpolate import make_lsq_spline
from spline_cases import chain

from torchspline import R3, SE3, SO3, BSpline, fit_poses, product
from torchspline.fit.poses.banded import (
    difference_band,
    gram_band,
    solve_band,
    transpose_apply,
)

F32, F64 = torch.float32, torch.float64
GROUP = {"split": product(R3, SO3), "joint": SE3}
REPRESENTATIONS = pytest.mark.parametrize("representation", ["split", "joint"])
EXACT = {"smoothness": 1e-13, "tolerance": 0.0}


def known(representation, order=4, count=12, gap=0.5, dt=0.5, t0=0.0, seed=0):
    """A spline whose neighbours lie `gap` rad and about as many metres apart, in random directions."""
    group = GROUP[representation]
    steps = gap * tangents(group, [1.0], each=count - 1, seed=seed)
    return BSpline(chain(group, steps, seed), group=group, order=order, dt=dt, t0=t0, learnable=False)


def grid(spline, count):
    return torch.linspace(*spline.domain, count, dtype=F64)


def distance(a, b):
    """The largest component of position and rotation differences, whatever the representation."""
    return GROUP["split"].log(GROUP["split"].between(a, b)).abs().max().item()


def noisy(poses, position_sigma, rotation_sigma, seed=0):
    noise = torch.randn(len(poses), 6, generator=generator(seed), dtype=F64)
    q = SO3.retract(poses[:, 3:], rotation_sigma * noise[:, 3:], side="right")
    return torch.cat([poses[:, :3] + position_sigma * noise[:, :3], q], dim=-1)


# ---------------------------------------------------------------------- what the answer has to be


@REPRESENTATIONS
@pytest.mark.parametrize("order", range(2, 8))
def test_a_known_spline_comes_back(representation, order):
    spline = known(representation, order)
    t = grid(spline, 300)
    fit = fit_poses(t, spline(t), dt=0.5, order=order, representation=representation, **EXACT)
    assert fit.trajectory.order == order
    assert fit.trajectory.group == GROUP[representation]
    assert fit.trajectory.domain == spline.domain
    assert distance(fit.trajectory(t).detach(), spline(t)) < 2e-8
    assert max(fit.rms()) < 2e-9
    between = spline.group.log(spline.group.between(fit.trajectory.control_points, spline.control_points))
    assert between.abs().max() < 1e-7 * math.factorial(order - 1)  # at the ends weights are that small


@REPRESENTATIONS
def test_residuals_are_the_noise(representation):
    spline = known(representation, order=5, count=20)
    t = grid(spline, 4000)
    measured = noisy(spline(t), 0.02, 0.03)
    fit = fit_poses(t, measured, dt=0.5, order=5, representation=representation)
    position, rotation = fit.rms()
    left = math.sqrt(1 - 20 / 4000)  # what the control points take up
    assert position == pytest.approx(0.02 * left, rel=0.02)
    assert rotation == pytest.approx(0.03 * left, rel=0.02)
    fitted = fit.trajectory(t).detach()
    assert torch.allclose(fit.position_residual, measured[:, :3] - fitted[:, :3], rtol=0, atol=1e-14)
    turned = SO3.retract(fitted[:, 3:], fit.rotation_residual, side="right")
    assert SO3.log(SO3.between(turned, measured[:, 3:])).abs().max() < 1e-14
    assert distance(fitted, spline(t)) < 0.015


@pytest.mark.parametrize("order", [2, 4, 6])
def test_positions_are_the_dense_least_squares_spline(order):
    t = torch.rand(400, generator=generator(1), dtype=F64).sort().values * 7
    t[0], t[-1] = 0.0, 7.0
    poses = SE3.identity(400)
    poses[:, :3] = torch.stack([t.sin(), (2 * t).cos(), t], -1)
    poses[:, :3] += 0.01 * torch.randn(400, 3, generator=generator(2), dtype=F64)
    fit = fit_poses(t, poses, dt=0.7, order=order, **EXACT)
    knots = 0.7 * np.arange(-order + 1, 10 + order)
    dense = make_lsq_spline(t.numpy(), poses[:, :3].numpy(), knots, k=order - 1)
    points = fit.trajectory.control_points.detach()
    assert np.abs(points[:, :3].numpy() - dense.c).max() < 1e-6 * np.abs(dense.c).max()
    assert (
        distance(fit.trajectory(t).detach(), torch.cat([torch.from_numpy(dense(t)), poses[:, 3:]], -1)) < 1e-7
    )


def documented_cost(fit, t, measured, sigmas, smoothness):
    """What the docstring says, term by term, as a function of the control points."""
    spline = fit.trajectory
    group, points = spline.group, spline.control_points
    weight = torch.tensor([1 / sigmas[0]] * 3 + [1 / sigmas[1]] * 3, dtype=F64)
    misses = GROUP["split"].log(GROUP["split"].between(spline(t), measured)) * weight
    steps = group.log(group.between(points[:-1], points[1:]))
    bends = (steps[1:] - steps[:-1]) * weight
    intervals = len(points) - spline.order + 1
    return 0.5 * (misses.square().sum() + smoothness * len(t) / intervals * bends.square().sum())


@REPRESENTATIONS
def test_the_gradient_of_the_documented_cost_vanishes(representation):
    spline = known(representation, order=5, gap=0.8)
    t = grid(spline, 150)
    measured = noisy(spline(t), 0.05, 0.2)
    options = {"position_sigma": 0.05, "rotation_sigma": 0.2, "smoothness": 1e-3}
    fit = fit_poses(t, measured, dt=0.5, order=5, representation=representation, tolerance=1e-15, **options)
    cost = documented_cost(fit, t, measured, (0.05, 0.2), 1e-3)
    assert cost.item() == pytest.approx(fit.cost[-1], rel=1e-12)
    (gradient,) = torch.autograd.grad(cost, fit.trajectory.control_points)
    with torch.no_grad():
        fit.trajectory.control_points += 0.01 * torch.randn(12, 7, generator=generator(0), dtype=F64)
    off = documented_cost(fit, t, measured, (0.05, 0.2), 1e-3)
    (typical,) = torch.autograd.grad(off, fit.trajectory.control_points)
    assert off > cost
    assert gradient.norm() < 1e-5 * typical.norm()
    assert all(b <= a * (1 + 1e-14) for a, b in pairwise(fit.cost))


def test_sigmas_weigh_positions_against_rotations_in_joint_fits_only():
    spline = known("joint", order=4, count=8)
    t = grid(spline, 100)
    measured = noisy(spline(t), 0.05, 0.05)
    fits = {
        (representation, sigma): fit_poses(
            t, measured, dt=0.5, order=4, representation=representation, position_sigma=sigma, tolerance=1e-14
        )
        for representation in GROUP
        for sigma in (0.001, 0.1)
    }
    ends = {key: fit.trajectory(t).detach() for key, fit in fits.items()}
    assert distance(ends["split", 0.001], ends["split", 0.1]) < 1e-6
    assert distance(ends["joint", 0.001], ends["joint", 0.1]) > 1e-4
    assert fits["joint", 0.001].rms()[0] < fits["joint", 0.1].rms()[0]


# ---------------------------------------------------------------------- awkward input


def untidy(case, t, poses):
    """The same information in another form; returns what has to come back in the same way."""
    if case == "flipped signs":
        poses[::3, 3:] *= -1
    elif case == "lengths":
        poses[:, 3:] *= torch.logspace(-6, 6, len(poses), dtype=F64)[:, None]
    elif case == "unsorted":
        order = torch.randperm(len(t), generator=generator(3))
        t, poses = t[order], poses[order]
    elif case == "NaN rows":
        bad = torch.full((5, 7), math.nan, dtype=F64)
        bad[:3, 1:] = 0.0  # one NaN is enough
        t = torch.cat([t[:50], t[:5] + 0.01, t[50:]])
        poses = torch.cat([poses[:50], bad, poses[50:]])
    elif case == "NaN times":
        t, poses = torch.cat([t[:1] * math.nan, t]), torch.cat([poses[:1] * 0, poses])
    return t, poses


@REPRESENTATIONS
@pytest.mark.parametrize("case", ["flipped signs", "lengths", "unsorted", "NaN rows", "NaN times"])
def test_order_signs_lengths_and_nan_do_not_matter(representation, case):
    spline = known(representation)
    t = grid(spline, 120)
    clean = noisy(spline(t), 0.01, 0.01)
    expected = fit_poses(t, clean, dt=0.5, order=4, representation=representation, tolerance=1e-13)
    bad_t, bad = untidy(case, t.clone(), clean.clone())
    fit = fit_poses(bad_t, bad, dt=0.5, order=4, representation=representation, tolerance=1e-13)
    assert distance(fit.trajectory(t).detach(), expected.trajectory(t).detach()) < 1e-8
    assert fit.cost[0] == pytest.approx(expected.cost[0], rel=1e-6)
    used = ~(bad.isnan().any(-1) | bad_t.isnan())
    assert fit.dropped == int((~used).sum())
    for residual in (fit.position_residual, fit.rotation_residual):
        assert residual.shape == (len(bad), 3)
        assert torch.equal(~residual.isnan().any(-1), used)
    at = fit.trajectory(bad_t[used]).detach()
    assert torch.allclose(fit.position_residual[used], bad[used, :3] - at[:, :3], rtol=0, atol=1e-14)
    notes = " ".join(fit.notes)
    assert ("sorted" in notes) == (case == "unsorted")
    assert ("left out" in notes) == case.startswith("NaN")


def test_duplicates_count_twice():
    spline = known("split")
    t = grid(spline, 60)
    measured = noisy(spline(t), 0.1, 0.1)
    again = torch.cat([t, t[10:12]])
    fit = fit_poses(again, torch.cat([measured, measured[10:12]]), dt=0.5, order=4)
    assert fit.duplicates == 2
    assert any("share their time" in note for note in fit.notes)
    once = fit_poses(t, measured, dt=0.5, order=4)
    assert fit.position_residual[10:12].norm() < once.position_residual[10:12].norm()
    assert once.duplicates == 0
    assert once.notes == []


@REPRESENTATIONS
def test_gaps_are_reported_and_bridged(representation):
    t = torch.cat([torch.arange(0, 4, 0.02, dtype=F64), torch.arange(6, 10, 0.02, dtype=F64)])
    positions = torch.stack([t.sin(), (0.7 * t).cos(), 0.2 * t], -1)
    poses = torch.cat([positions, SO3.exp(0.8 * positions)], -1)
    fit = fit_poses(t, poses, dt=0.1, representation=representation)
    assert fit.gaps == [(t[199].item(), t[200].item())]
    assert any(
        "1 stretches of more than two knot intervals without poses, up to 2.02 s" in note
        for note in fit.notes
    )
    assert max(fit.rms()) < 1e-4
    motion = fit.trajectory.kinematics(torch.linspace(3.9, 6.1, 200, dtype=F64))
    assert motion.velocity.norm(dim=-1).max() < 2.0  # ends at about 1 m/s and 0.8 rad/s
    assert motion.angular_velocity.norm(dim=-1).max() < 2.0
    middle = fit.trajectory(torch.tensor([5.0], dtype=F64))[0, :3]
    assert (middle - torch.tensor([-0.96, -0.94, 1.0])).norm() < 0.4


def test_several_turns():
    t = torch.linspace(0, 10, 500, dtype=F64)
    axis = torch.tensor([0.36, 0.48, 0.8], dtype=F64)
    q = SO3.exp((math.pi * t)[:, None] * axis)  # five turns
    q = q * torch.randn(500, 1, generator=generator(4), dtype=F64).sign()
    poses = torch.cat([torch.zeros(500, 3, dtype=F64), q], dim=-1)
    for representation in GROUP:
        fit = fit_poses(t, poses, dt=0.4, order=4, representation=representation, smoothness=1e-9)
        assert fit.rms()[1] < 1e-6
        rate = fit.trajectory.kinematics(t).angular_velocity
        assert torch.allclose(rate, (math.pi * axis).expand(500, 3), rtol=0, atol=1e-3)


@REPRESENTATIONS
@pytest.mark.parametrize("order", [2, 4, 6])
def test_two_poses_and_knots_denser_than_poses(representation, order):
    poses = torch.stack([SE3.identity(), SE3.exp(torch.tensor([1.0, -2, 0.5, 0.4, 0.9, -0.3], dtype=F64))])
    fit = fit_poses(
        torch.tensor([3.0, 4.0], dtype=F64), poses, dt=0.1, order=order, representation=representation
    )
    assert max(fit.rms()) < 1e-8
    assert any("use a larger dt" in note for note in fit.notes)
    speed = fit.trajectory.kinematics(torch.linspace(3, 4, 50, dtype=F64)).angular_velocity.norm(dim=-1)
    assert torch.allclose(speed, torch.full_like(speed, SO3.log(poses[1, 3:]).norm()), rtol=1e-3, atol=0)


@REPRESENTATIONS
def test_spacing_longer_than_the_recording(representation):
    spline = known(representation, count=4)
    t = grid(spline, 50)[:30]
    fit = fit_poses(t, spline(t), dt=0.5, order=4, representation=representation, **EXACT)
    assert fit.trajectory.domain == (0.0, 0.5)
    assert max(fit.rms()) < 1e-8


@REPRESENTATIONS
@pytest.mark.parametrize("order", [2, 6])
def test_identical_poses(representation, order):
    pose = SE3.random(generator=generator(5))
    t = torch.tensor([0.0, 0.3, 1.0, 2.0], dtype=F64)
    fit = fit_poses(t, pose.expand(4, 7), dt=0.2, order=order, representation=representation)
    assert max(fit.rms()) < 1e-13
    motion = fit.trajectory.kinematics(torch.linspace(0, 2, 50, dtype=F64))
    assert motion.velocity.abs().max() < 1e-11
    assert motion.angular_velocity.abs().max() < 1e-11


def test_all_poses_at_one_time():
    with pytest.raises(ValueError, match="t: expected at least two distinct times with usable poses, got 1"):
        fit_poses(torch.ones(5, dtype=F64), SE3.random(5), dt=0.1)


@pytest.mark.parametrize("origin", [0.0, 1000.0, 1520530308.19])
@pytest.mark.parametrize("end", [0.5, 0.5 + 5e-11, 0.5 + 1e-14, 0.5 - 1e-14, 0.7, 0.3])
def test_the_last_pose_lies_in_the_domain(origin, end):
    t = origin + torch.tensor([0.0, 0.1, 0.23, end], dtype=F64)
    fit = fit_poses(t, SE3.identity(4), dt=0.1, order=4)
    start, stop = fit.trajectory.domain
    assert start == t[0].item()
    assert -1e-6 < stop - t[-1].item() < 0.1
    if end in (0.3, 0.5, 0.7):  # rounding must not add a knot
        assert round((stop - start) / 0.1) == round(end / 0.1)
    assert torch.isfinite(fit.position_residual).all()


# ---------------------------------------------------------------------- times, dtypes, side effects


@REPRESENTATIONS
def test_nanoseconds_equal_seconds(representation):
    spline = known(representation)
    ns = (torch.rand(90, generator=generator(6), dtype=F64) * 4.5e9).long().sort().values
    ns[0], ns[-1] = 0, 4_500_000_000
    poses = noisy(spline(ns.double() * 1e-9), 0.01, 0.01)
    epoch = 1_520_530_308_189_679_351
    seconds = fit_poses(
        ns.double() * 1e-9, poses, dt=0.5, order=4, representation=representation, tolerance=1e-14
    )
    whole = fit_poses(ns + epoch, poses, dt=0.5, order=4, representation=representation, tolerance=1e-14)
    assert whole.trajectory.domain == (epoch, epoch + 4_500_000_000)
    a, b = seconds.trajectory(ns.double() * 1e-9), whole.trajectory(ns + epoch)
    assert distance(a.detach(), b.detach()) < 1e-8
    gap = fit_poses(torch.cat([ns, ns + 10**10]), torch.cat([poses, poses]), dt=0.5, order=4)
    assert gap.gaps == [(4_500_000_000, 10**10)]
    assert any("up to 5.5 s" in note for note in gap.notes)


def test_arguments_are_left_alone():
    spline = known("split")
    t = grid(spline, 40).flip(0).requires_grad_()
    poses = (-2 * spline(t.detach())).requires_grad_()
    before = t.detach().clone(), poses.detach().clone()
    fit = fit_poses(t, poses, dt=0.5, order=4, max_iterations=2)
    assert torch.equal(t.detach(), before[0])
    assert torch.equal(poses.detach(), before[1])
    assert fit.trajectory.control_points.is_leaf
    assert not fit.position_residual.requires_grad
    single = fit_poses(t.detach(), poses.detach().float(), dt=0.5, order=4)
    assert single.trajectory.control_points.dtype == single.rotation_residual.dtype == F64


def test_how_the_iteration_ends():
    spline = known("joint", gap=1.0)
    t = grid(spline, 60)
    measured = noisy(spline(t), 0.1, 0.1)
    start, once, whole = (
        fit_poses(t, measured, dt=0.5, order=4, representation="joint", max_iterations=n) for n in (0, 1, 60)
    )
    assert (len(start.cost), len(once.cost)) == (1, 2)
    assert (start.reason, once.reason) == ("reached 0 iterations", "reached 1 iterations")
    assert whole.reason == "the cost fell by less than 1e-09 of itself"
    assert whole.cost[:2] == once.cost
    assert start.cost[0] > once.cost[1] > whole.cost[-1]
    assert len(whole.cost) < 15


def test_progress_shows_on_terminals_only(capfd, monkeypatch):
    t, poses = torch.arange(6, dtype=F64), SE3.random(6, generator=generator(7))
    fit_poses(t, poses, dt=1.0, progress=True)
    assert capfd.readouterr() == ("", "")
    monkeypatch.setattr("rich.console.Console.is_terminal", True)
    fit_poses(t, poses, dt=1.0, progress=False)
    assert capfd.readouterr() == ("", "")
    fit_poses(t, poses, dt=1.0, progress=True)
    out, err = capfd.readouterr()
    assert out == ""
    assert "fitting poses" in err


# ---------------------------------------------------------------------- band matrices against dense ones


def dense_of(band):
    width, count = band.shape
    lower = sum(np.diag(band[i, : count - i], -i) for i in range(width))
    return lower + np.tril(lower, -1).T


@pytest.mark.parametrize(("width", "count"), [(1, 3), (2, 2), (4, 9)])
def test_gram_band_and_transpose(width, count):
    rng = np.random.default_rng(0)
    first = rng.integers(0, count - width + 1, 30)
    weights, values = rng.normal(size=(30, width)), rng.normal(size=(30, 2))
    B = np.zeros((30, count))
    for row, at in enumerate(first):
        B[row, at : at + width] = weights[row]
    np.testing.assert_allclose(dense_of(gram_band(weights, first, count)), B.T @ B, atol=1e-13)
    np.testing.assert_allclose(transpose_apply(weights, first, count, values), B.T @ values, atol=1e-13)


@pytest.mark.parametrize(("difference", "width"), [(1, 2), (1, 4), (2, 3), (2, 6), (3, 4)])
def test_difference_band(difference, width):
    D = np.diff(np.eye(8), difference, axis=0)
    band = difference_band(8, difference, width)
    assert band.shape == (width, 8)
    np.testing.assert_allclose(dense_of(band), D.T @ D, atol=1e-14)


def test_solution_of_a_band():
    rng = np.random.default_rng(0)
    B = rng.normal(size=(12, 12)) * (np.abs(np.subtract.outer(np.arange(12), np.arange(12))) < 3)
    matrix, right = B.T @ B + np.eye(12), rng.normal(size=(12, 2))
    band = np.array([np.pad(np.diag(matrix, -i), (0, i)) for i in range(5)])
    np.testing.assert_allclose(solve_band(band, right), np.linalg.solve(matrix, right), atol=1e-12)
