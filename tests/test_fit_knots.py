"""Which spacing changes between neighbouring fits speak for."""

import numpy as np
import pytest
import torch

from torchspline import SO3, fit_poses
from torchspline.fit.poses.knots import Knots, _least, choose_spacing

RATIO = 2**0.25


@pytest.mark.parametrize(
    ("changes", "best"),
    [
        # Noise falls, missed motion rises: the parabola through three lies between their spacings.
        ([8.0, 4.0, 2.0, 1.0, 2.0, 4.0, 8.0], 3),
        # Wide fits agree on missing the motion.
        ([8.0, 4.0, 2.0, 1.0, 2.0, 4.0, 2.0, 0.5, 0.1], 3),
        # Smooth noise does not show between narrow spacings.
        ([1.0, 1.1, 1.4, 1.5, 3.0, 6.0], 3),
    ],
)
def test_the_first_minimum_counts(changes, best):
    tried = [RATIO**i for i in range(len(changes) + 2)]
    spacing, change = _least(tried, changes)
    assert change == pytest.approx(changes[best])
    # The parabola moves it by half a step at most.
    assert RATIO ** (best + 0.5) * 0.999 < spacing < RATIO ** (best + 1.5) * 1.001


@pytest.mark.parametrize("noise_slope", [0.4, 0.6])
@pytest.mark.parametrize("motion_slope", [0.0, 0.05])
def test_where_the_noise_ends_well_before_the_least_change(noise_slope, motion_slope):
    """Motion of all frequencies: changes level out, and fall again where nothing is left to miss."""
    steps = np.arange(30)
    noise, motion = np.exp(-noise_slope * (steps - 12)), np.exp(-motion_slope * np.maximum(steps - 12, 0))
    changes = np.sqrt(noise**2 + motion**2) * np.where(steps > 25, np.exp(-0.5 * (steps - 25)), 1.0)
    spacing, _ = _least([RATIO**i for i in range(32)], changes.tolist())
    assert 11.5 < np.log(spacing) / np.log(RATIO) - 1 < 14.5  # equal at 12


def motion_and_noise(seed):
    """Times, positions with motion of all frequencies below 5 Hz and white noise, and true accelerations."""
    rng = np.random.default_rng(seed)
    t = torch.arange(0, 20, 1 / 120, dtype=torch.float64)
    frequency, phase = 2 * np.pi * rng.uniform(0.2, 5.0, (3, 12)), rng.uniform(0, 2 * np.pi, (3, 12))
    waves = (
        rng.normal(size=(3, 12))
        / frequency**1.5
        * np.exp(1j * (t.numpy()[:, None, None] * frequency + phase))
    )
    position, acceleration = waves.imag.sum(-1), (-(frequency**2) * waves.imag).sum(-1)
    measured = torch.from_numpy(position + 1e-3 * rng.normal(size=position.shape))
    return t, torch.cat([measured, SO3.identity(len(t), dtype=torch.float64)], -1), acceleration


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_better_than_the_best_of_many_spacings(seed):
    t, poses, acceleration = motion_and_noise(seed)
    measured = poses[:, :3]
    inside = slice(60, -60)

    def error(dt):
        knots = Knots(t, dt, 6)
        fitted = knots.evaluate(knots.linear_fit(t, measured.numpy(), 1e-9), t[inside], derivative=2)
        return np.sqrt(np.square(fitted - acceleration[inside]).mean())

    best = min(error(0.02 * RATIO**i) for i in range(14))
    assert error(choose_spacing(t, poses, 6, 1e-9, None).position) < 1.2 * best
    # Knots cut off sharply, and differently between them: a smoothing spline of that bandwidth has less of an error.
    trajectory = fit_poses(t, poses, dt="auto", progress=False).trajectory
    found = trajectory.kinematics(t[inside])
    # Without turning, body and world are the same.
    assert np.sqrt(np.square(found.acceleration[:, :3].detach().numpy() - acceleration[inside]).mean()) < best


@pytest.mark.parametrize("step", [0.3, 0.01])
def test_gaps_do_not_change_the_choice(step):
    """Long ones, or pairs of poses that are missing."""
    t, poses, _ = motion_and_noise(3)
    whole = choose_spacing(t, poses, 6, 1e-9, None)
    missing = torch.zeros(len(t), dtype=torch.bool)
    for start in range(200, 2200, 400):
        missing |= (t >= t[start]) & (t < t[start] + max(step, 2.5 / 120))
    some = choose_spacing(t[~missing], poses[~missing], 6, 1e-9, None)
    assert some.position == pytest.approx(whole.position, rel=0.35)
    fit = fit_poses(t[~missing], poses[~missing], dt="auto", progress=False)
    assert fit.position_residual.abs().max() < 6e-3
    # What bridges a gap does not swing out.
    middle = fit.trajectory(t).detach()[:, :3]
    assert middle.abs().max() < 1.5 * poses[:, :3].abs().max()


@pytest.mark.parametrize("order", [4, 6])
@pytest.mark.parametrize("nanoseconds", [False, True])
@pytest.mark.parametrize("ratio", [0.7, 1.0, 1.4])
def test_smoothing_is_a_filter_of_known_gain(order, nanoseconds, ratio):
    """Of waves as fast as every other knot, half the amplitude is left."""
    t = torch.arange(3000, dtype=torch.float64) / 300
    spacing = 0.08
    wave = torch.cos(ratio * np.pi / spacing * t)[:, None]
    times = (t * 1e9).round().long() if nanoseconds else t
    knots = Knots(times, spacing / 4, order)
    smooth = knots.evaluate(knots.smooth_fit(times, wave.numpy(), spacing, 1 / 300), times)
    inside = slice(600, -600)
    gain = (smooth[inside] * wave.numpy()[inside]).sum() / np.square(wave.numpy()[inside]).sum()
    assert gain == pytest.approx(1 / (1 + ratio ** (2 * order - 2)), abs=0.02)


def test_smoothing_leaves_polynomials_alone():
    """Up to where the penalised derivative begins; gaps included."""
    t = torch.linspace(0, 5, 400, dtype=torch.float64)
    t = t[(t < 2) | (t > 2.4)]
    values = torch.stack([t**4 - 3 * t**2, 2 * t**3], -1).numpy()
    knots = Knots(t, 0.1, 6)
    smooth = knots.evaluate(knots.smooth_fit(t, values, 0.2, 5 / 400), t)
    assert np.abs(smooth - values).max() < 1e-4 * np.abs(values).max()


def test_bursts_do_not_ask_for_knots_between_them():
    """Triples of poses a fraction of a microsecond apart, ten a second."""
    t = (torch.arange(200, dtype=torch.float64)[:, None] / 10 + 1e-7 * torch.arange(3)).reshape(-1)
    angle = torch.sin(0.7 * t)[:, None] * torch.tensor([[0.3, 0.1, -0.2]], dtype=torch.float64)
    poses = torch.cat([torch.cos(0.5 * t)[:, None].expand(-1, 3), SO3.exp(angle)], dim=-1)
    fit = fit_poses(t, poses, dt="auto", progress=False)
    assert fit.trajectory.dt > 0.04
    assert max(fit.rms()) < 1e-3


@pytest.mark.parametrize("accuracy", [(2e-5, 1e-5), (4.4e-3, 1e-5), (5.9e-3, 1e-3), (1e-4, 1e-2)])
def test_an_accuracy_asked_for_is_kept(accuracy):
    """Also where positions may have wider knots than rotations, by a ratio that is no whole number."""
    t = torch.arange(1200, dtype=torch.float64) / 100
    angle = torch.sin(3.0 * t)[:, None] * torch.tensor([[0.6, 0.2, -0.4]], dtype=torch.float64)
    position = torch.stack([torch.cos(2.0 * t), torch.sin(2.0 * t), torch.sin(1.3 * t)], dim=-1)
    fit = fit_poses(
        t, torch.cat([position, SO3.exp(angle)], -1), dt="auto", accuracy=accuracy, progress=False
    )
    for reached, limit in zip(fit.rms(), accuracy, strict=True):
        assert reached <= limit * 1.02
    assert fit.trajectory.dt > 0.03


def swinging(t):
    """Poses of a slow motion with noise of 1 mm and 1 mrad, and the motion."""
    noise = 1e-3 * torch.from_numpy(np.random.default_rng(0).normal(size=(len(t), 6)))
    angle = torch.sin(0.8 * t)[:, None] * torch.tensor([[0.3, 0.1, -0.2]], dtype=torch.float64)
    position = torch.stack([torch.cos(t), torch.sin(1.3 * t), torch.sin(0.5 * t)], dim=-1)
    rotation = SO3.exp(angle)
    measured = SO3.compose(rotation, SO3.exp(noise[:, 3:]))
    return torch.cat([position + noise[:, :3], measured], -1), torch.cat([position, rotation], -1)


@pytest.mark.parametrize("nanoseconds", [False, True])
@pytest.mark.parametrize(
    "t",
    [
        torch.cat([torch.arange(0, 4, 1 / 100), torch.arange(4, 30, 1.0)]),
        (torch.arange(12)[:, None] * 4.0 + 0.01 * torch.arange(25)).reshape(-1),
        torch.logspace(-6, 1, 300),
    ],
    ids=["slower later", "short stretches", "logarithmic"],
)
def test_poses_that_are_alone_count(t, nanoseconds):
    """Where most others are close together."""
    t = t.double()
    measured, truth = swinging(t)
    times = (t * 1e9).round().long() if nanoseconds else t
    fit = fit_poses(times, measured, dt="auto", progress=False)
    assert max(fit.rms()) < 1.5e-3
    found = fit.trajectory(times).detach()
    assert (found[:, :3] - truth[:, :3]).abs().max() < 5e-3
    assert SO3.log(SO3.between(found[:, 3:], truth[:, 3:])).abs().max() < 5e-3


@pytest.mark.parametrize("times", [[0, 1_700_000_000_000_000_000], [-9_000_000_000_000_000_000, 0]])
def test_times_far_apart_are_named(times):
    """Beyond what differences of 64 bits hold, too."""
    t = torch.cat([torch.tensor(times[:1]), times[1] + 20_000_000 * torch.arange(50)])
    measured, _ = swinging((t - t[1]) * 1e-9)
    with pytest.raises(
        ValueError, match=rf"^t: .* are mostly 0\.02 s apart, .* from {times[0]} to {times[1]} "
    ):
        fit_poses(t, measured, dt="auto", progress=False)
