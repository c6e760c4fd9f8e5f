"""Figures: what is drawn equals the numbers, axes say what they are in."""

import numpy as np
import pytest
import torch

from torchspline import R3, SE3, SO3, BSpline, NonuniformBSpline, SplitBSpline, fit, imu, plot, use_kernels
from torchspline.splines.basis import blending_matrix

POINTS = SE3.random(9, generator=torch.Generator().manual_seed(5))
JOINT = BSpline(POINTS, group=SE3, order=4, dt=0.5, t0=1.0, learnable=False)
SPLIT = SplitBSpline(POINTS, order=4, dt_ns=500_000_000, t0_ns=10, learnable=False)
TURNS = BSpline(POINTS[:, 3:].contiguous(), group=SO3, order=4, dt=0.5, t0=1.0, learnable=False)
PLACES = BSpline(POINTS[:, :3].contiguous(), group=R3, order=4, dt=0.5, learnable=False)
T = torch.linspace(1.0, 4.0, 40, dtype=torch.float64)


@pytest.fixture(autouse=True)
def reference():
    with use_kernels("reference"):
        yield


def drawn(line):
    return torch.as_tensor(np.stack(line.get_data_3d(), -1))


def test_paths_and_frames():
    figure = plot.trajectory({"joint": JOINT, "mounted": JOINT.mounted(POINTS[0])}, T, frames=4, title="two")
    (axes,) = figure.axes
    assert [axes.get_xlabel(), axes.get_ylabel(), axes.get_zlabel()] == ["x [m]", "y [m]", "z [m]"]
    assert axes.get_title() == "two"
    assert [x.get_text() for x in axes.get_legend().get_texts()] == ["joint", "mounted"]
    torch.testing.assert_close(drawn(axes.lines[0]), JOINT(T)[:, :3])
    # A collection for each axis of each of two curves, of four segments that start on the curve and follow R.
    assert len(axes.collections) == 6
    segments = torch.as_tensor(np.array(axes.collections[1]._segments3d))
    rows = [0, 13, 26, 39]
    torch.testing.assert_close(segments[:, 0], JOINT(T)[rows, :3])
    y = SE3.to_matrix(JOINT(T))[rows, :3, 1]
    steps = segments[:, 1] - segments[:, 0]
    torch.testing.assert_close(steps / steps.norm(dim=-1, keepdim=True), y)
    # Equal scales: a metre is as long along every axis.
    limits = np.array([axes.get_xlim3d(), axes.get_ylim3d(), axes.get_zlim3d()])
    ratio = np.ptp(limits, axis=1) / axes._box_aspect
    np.testing.assert_allclose(ratio, ratio[0])


def test_rotations_are_drawn_on_the_sphere_and_positions_without_frames():
    (axes,) = plot.trajectory(TURNS).axes
    assert len(axes.lines) == 3
    torch.testing.assert_close(drawn(axes.lines[2]).norm(dim=-1), torch.ones(600, dtype=torch.float64))
    assert axes.get_xlabel() == "x"
    (axes,) = plot.trajectory(PLACES).axes
    assert len(axes.lines) == 1
    assert not axes.collections


def test_rates():
    quantities = ("acceleration", "angular_velocity")
    figure = plot.rates({"turns": TURNS, "joint": JOINT}, T, quantities=quantities)
    upper, lower = figure.axes
    assert upper.get_ylabel() == "acceleration [m/s²]"
    assert lower.get_ylabel() == "angular velocity [rad/s]"
    assert lower.get_xlabel() == "time [s]"
    assert (len(upper.lines), len(lower.lines)) == (1, 2)
    motion = JOINT.kinematics(T)
    np.testing.assert_allclose(upper.lines[0].get_ydata(), motion.acceleration.norm(dim=-1))
    np.testing.assert_allclose(lower.lines[1].get_ydata(), motion.angular_velocity.norm(dim=-1))
    np.testing.assert_array_equal(lower.lines[1].get_xdata(), T)


def test_nanoseconds_count_from_the_start():
    figure = plot.rates(SPLIT)
    assert figure.axes[-1].get_xlabel() == "time since start [s]"
    x = figure.axes[0].lines[0].get_xdata()
    assert (x[0], x[-1]) == (0.0, 3.0)


@pytest.mark.parametrize("order", [2, 3, 4, 5])
def test_basis_of_uniform_splines(order):
    """Against the exact matrices of the basis, and its cumulative sums."""
    times = torch.arange(8, dtype=torch.float64)
    (axes,) = plot.basis(order, times).axes
    assert axes.get_xlabel() == "time [s]"
    *curves, total, _keys = axes.lines
    assert len(curves) == 8
    np.testing.assert_allclose(total.get_ydata(), 1.0)
    t = curves[0].get_xdata()
    s = t - (order - 2) / 2
    segment = np.minimum(np.floor(s + 1e-12).astype(int), 8 - order)
    u = s - segment
    matrix = np.array(blending_matrix(order), dtype=float)
    for i, curve in enumerate(curves):
        j = i - segment
        inside = (j >= 0) & (j < order)
        weight = (matrix[np.clip(j, 0, order - 1)] * u[:, None] ** np.arange(order)).sum(-1)
        np.testing.assert_allclose(curve.get_ydata(), np.where(inside, weight, 0.0), atol=1e-12)
    (axes,) = plot.basis(order, times, cumulative=True).axes
    np.testing.assert_allclose(axes.lines[3].get_ydata(), sum(x.get_ydata() for x in curves[3:]), atol=1e-12)
    assert axes.get_ylabel() == "cumulative weight"


def test_basis_is_one_at_its_own_key_where_keys_are_met():
    times = torch.tensor([0.0, 1.0, 1.5, 3.0, 4.0], dtype=torch.float64)
    for method in ("SQUAD", "CompositeBezier", "LERP", "scLERP"):
        np.testing.assert_allclose(plot.basis_functions(method, times, times), np.eye(5), atol=1e-12)
    slopes = plot.basis_functions("LERP", times, torch.tensor([1.25], dtype=torch.float64), derivative=1)
    np.testing.assert_allclose(slopes, [[0.0, -2.0, 2.0, 0.0, 0.0]], atol=1e-12)


def test_residuals():
    t = torch.arange(300) * 10_000_000
    x = torch.randn(300, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    x[5] = float("nan")
    figure = plot.residuals({"gyroscope [rad/s]": x, "pixel": x[:, 0]}, t, title="fit")
    first, spread, second, _ = figure.axes
    assert first.get_ylabel() == "gyroscope [rad/s]"
    assert [len(axes.lines) for axes in figure.axes] == [3, 3, 1, 1]
    np.testing.assert_allclose(first.lines[1].get_ydata(), x[:, 1])
    assert first.lines[1].get_xdata()[-1] == pytest.approx(2.99)
    assert first.get_title(loc="right") == f"RMS {float(x[~x.isnan()].square().mean().sqrt()):.4g}"
    assert second.get_xlabel() == "time since start [s]"
    # The histogram is a density.
    (stairs, *_) = spread.patches
    values, edges, _ = stairs.get_data()
    assert float((values * np.diff(edges)).sum()) == pytest.approx(1.0)


def test_residuals_of_a_fit():
    t = torch.linspace(1.0, 4.0, 60, dtype=torch.float64)
    found = fit.fit_poses(t, JOINT(t), dt=0.6, order=4, progress=False)
    figure = plot.residuals(found, t)
    assert figure.axes[0].get_ylabel() == "position residual [mm]"
    np.testing.assert_allclose(figure.axes[0].lines[2].get_ydata(), 1e3 * found.position_residual[:, 2])
    np.testing.assert_allclose(figure.axes[2].lines[0].get_ydata(), 1e3 * found.rotation_residual[:, 0])


@pytest.mark.parametrize("spline", [JOINT, SPLIT, PLACES], ids=["SE3", "R3xSO3", "R3"])
def test_covariance_tube(spline):
    """Every point of the surface is across the path and `sigmas` away in the measure of the covariance there."""
    dimension = spline.group.tangent_size
    A = torch.randn(30, dimension, dimension, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    covariance = 1e-4 * A @ A.mT
    first, last = spline.domain
    t = torch.linspace(0, 1, 30, dtype=torch.float64) * (last - first) + first
    if spline is SPLIT:
        t = t.round().long()
    figure = plot.covariance_tube(spline, t, covariance, sigmas=2.0)
    space, below = figure.axes
    path = drawn(space.lines[0])
    motion = spline.kinematics(t)
    torch.testing.assert_close(path, motion.position)
    world = covariance[:, :3, :3]
    if spline is JOINT:  # tangents of the body
        R = SE3.to_matrix(spline(t))[:, :3, :3]
        world = R @ world @ R.mT
    deviations = world.diagonal(dim1=1, dim2=2).sqrt()
    np.testing.assert_allclose(below.lines[1].get_ydata(), 1e3 * deviations[:, 1])
    assert below.get_ylabel() == "standard deviation of the position [mm]"
    from torchspline.plot.motion import _ellipses

    offsets = torch.as_tensor(_ellipses(path.numpy(), world.numpy()))
    tangent = torch.as_tensor(np.gradient(path.numpy(), axis=0))
    assert float((offsets @ tangent[..., None]).abs().max()) < 1e-12
    # The conditional measure within the plane: the inverse of the covariance restricted to it.
    plane = torch.linalg.svd(tangent[:, None])[2][:, 1:]  # (N, 2, 3)
    inside = offsets @ plane.mT
    restricted = plane @ world @ plane.mT
    distance = (inside * torch.linalg.solve(restricted, inside.mT).mT).sum(-1)
    torch.testing.assert_close(distance, torch.ones_like(distance))
    assert len(space.collections) == 1


def test_covariance_tube_of_a_solution():
    """Poses of known noise: what the figure shows at the times of the poses is what `Result` says."""
    t = torch.linspace(1.0, 4.0, 60, dtype=torch.float64)
    spline = SplitBSpline(POINTS, order=4, dt=0.5, t0=1.0)
    problem = fit.Problem(spline)
    problem.add(fit.Pose(t, SPLIT(((t - 1.0) * 1e9).round().long() + 10), sigma=0.01))
    covariance = problem.solve(progress=False).trajectory_covariance(t)
    figure = plot.covariance_tube(spline, t, covariance)
    shown = figure.axes[1].lines[2].get_ydata()
    np.testing.assert_allclose(shown, 1e3 * covariance[:, 2, 2].sqrt())
    assert shown.min() > 1.0
    assert shown.max() < 10.0


def test_imu_comparison():
    reading = imu.measure(JOINT, T)
    dots = imu.ImuReading(reading.gyroscope[::3] + 1.0, reading.accelerometer[::3])
    figure = plot.imu_comparison((T, reading), (T[::3], dots), "IMU")
    upper, lower = figure.axes
    assert upper.get_ylabel() == "specific force [m/s²]"
    assert (lower.get_ylabel(), lower.get_xlabel()) == ("angular velocity [rad/s]", "time [s]")
    assert len(upper.lines) == len(lower.lines) == 6
    np.testing.assert_allclose(lower.lines[2].get_ydata(), dots.gyroscope[:, 1])
    np.testing.assert_allclose(lower.lines[3].get_ydata(), reading.gyroscope[:, 1])


def test_figures_can_be_written_without_a_screen(tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    knots = torch.tensor([0.0] * 4 + [0.5, 1.0, 2.0] + [2.5] * 4, dtype=torch.float64)
    spline = NonuniformBSpline(POINTS[:7], group=SE3, order=4, knots=knots, learnable=False)
    figure = plot.trajectory(spline)
    for suffix, begin in (("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")):
        figure.savefig(tmp_path / f"a.{suffix}")
        assert (tmp_path / f"a.{suffix}").read_bytes().startswith(begin)
