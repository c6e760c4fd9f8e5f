"""Random motions: bandwidths, strengths and physics, in the units they are asked for."""

import math

import pytest
import torch
from scipy.signal import welch

from torchspline import SO3, imu
from torchspline.generate import MOTIONS, random_motion
from torchspline.generate.motions.motion import differences, facing, smooth_curve, turned

SECONDS, RATE = 40.0, 100.0


def made(kind: str, count: int = 8, seconds: float = SECONDS, **options):
    generator = torch.Generator().manual_seed(1)
    spline = random_motion(kind, count, seconds, generator=generator, **options)
    t = torch.arange(0.0, seconds, 1 / RATE, dtype=torch.float64)
    return t, spline.kinematics(t)


def power(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Frequencies and the power spectrum over items and axes, of samples (B, N, 3)."""
    f, p = welch(x.numpy(), fs=RATE, axis=1, nperseg=1024)
    return torch.from_numpy(f), torch.from_numpy(p).sum((0, 2))


@pytest.mark.parametrize("kind", MOTIONS)
def test_every_kind_is_a_batch_of_smooth_splines(kind):
    spline = random_motion(kind, 3, 2.03, generator=torch.Generator().manual_seed(0))
    assert spline.control_points.shape[0] == 3
    assert spline.control_points.dtype == torch.float64
    start, stop = spline.domain
    assert start == 0.0
    assert 2.03 <= stop < 2.05 + 1e-9
    again = random_motion(kind, 3, 2.03, generator=torch.Generator().manual_seed(0))
    assert torch.equal(spline.control_points, again.control_points)
    other = random_motion(kind, 3, 2.03, generator=torch.Generator().manual_seed(1))
    assert not torch.equal(spline.control_points, other.control_points)
    # No two items of a batch are alike.
    assert (spline.control_points[0] - spline.control_points[1]).abs().max() > 1e-3


@pytest.mark.parametrize(("kind", "band"), [("smooth", (0.0, 2.0)), ("band_limited", (1.0, 2.0))])
def test_acceleration_and_body_rate_stay_in_their_band(kind, band):
    low, high = band
    options = {"bandwidth": high - low, "acceleration": 2.0, "angular_velocity": 0.7}
    options |= {"low": low} if kind == "band_limited" else {}
    _, motion = made(kind, **options)
    for x, rms in ((motion.acceleration, 2.0), (motion.angular_velocity, 0.7)):
        f, p = power(x)
        # The windows of the spectrum blur it by 0.2 Hz.
        inside = (f > low - 0.2) & (f < high + 0.2)
        share = (p[inside].sum() / p.sum()).item()
        assert share > 0.95
        assert x.square().mean().sqrt().item() == pytest.approx(rms, rel=0.1)
    if kind == "band_limited":  # and flat there: both halves of the band have as much
        f, p = power(motion.acceleration)
        halves = [p[(f > a) & (f < b)].sum().item() for a, b in ((1.0, 1.5), (1.5, 2.0))]
        assert halves[0] == pytest.approx(halves[1], rel=0.3)
    else:  # 24 dB down at the bandwidth in position, 48 dB below its rate's spectrum an octave higher
        f, p = power(motion.angular_velocity)
        assert p[(f - high).abs().argmin()] < 0.03 * p[1:20].mean()


def test_smooth_curves_have_unit_derivatives():
    tau = torch.arange(0.0, 200.0, 0.05, dtype=torch.float64).expand(4, -1)
    for rate in (0, 1, 2):
        for bandwidth in (0.5, 1.5):
            generator = torch.Generator().manual_seed(rate)
            x = smooth_curve(tau, torch.full((4,), bandwidth, dtype=torch.float64), generator, rate)
            for _ in range(rate):
                x = x.diff(dim=1) / 0.05
            assert x.square().mean().sqrt().item() == pytest.approx(1.0, abs=0.1)


def test_figure_eight_is_one():
    t, motion = made("figure_eight", size=1.5, period=8.0, tilt=0.3, banking=0.0)
    position = motion.position
    # Twice as long as its half, flat, and periodic.
    extent = position - position.mean(1, keepdim=True)
    values = torch.linalg.eigvalsh(extent.mT @ extent / len(t))
    assert values[:, 0].max() < 1e-6
    torch.testing.assert_close(position[:, 800:1600], position[:, 1600:2400], atol=1e-6, rtol=0)
    assert extent.norm(dim=-1).amax(-1).min().item() == pytest.approx(1.5, rel=0.01)
    # It faces where it goes, and its z axis is normal to the plane, 0.3 rad off the vertical.
    forward = SO3.act(motion.rotation, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    along = torch.nn.functional.normalize(motion.velocity, dim=-1)
    assert (forward * along).sum(-1).min() > 0.995
    up = SO3.act(motion.rotation, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(up[..., 2].acos(), torch.full_like(up[..., 2], 0.3), atol=1e-3, rtol=0)


def test_figure_eight_banks_into_its_turns():
    _, motion = made("figure_eight", size=2.0, period=6.0, tilt=0.0, banking=1.0)
    force = imu_force(motion)
    # A coordinated turn: what the sensor feels is along its z axis.
    sideways = force[..., :2].norm(dim=-1) / force.norm(dim=-1)
    assert sideways.max() < 0.02


def imu_force(motion) -> torch.Tensor:
    gravity = torch.tensor(imu.STANDARD_GRAVITY, dtype=torch.float64)
    return SO3.act(SO3.inverse(motion.rotation), motion.acceleration - gravity)


def test_walking_goes_forward_step_by_step():
    _, motion = made(
        "walking",
        speed=1.2,
        step_frequency=1.5,
        bounce=0.03,
        sway=0.02,
        wobble=0.05,
        turn_rate=0.2,
        circling=0.3,
    )
    velocity = motion.velocity[..., :2].norm(dim=-1)
    assert velocity.mean().item() == pytest.approx(1.2, rel=0.05)
    f, p = power(motion.position[..., 2:].expand(-1, -1, 3))
    assert f[p[2:].argmax() + 2].item() == pytest.approx(1.5, abs=0.11)
    height = motion.position[..., 2]
    assert 0.02 < height.amax().item() < 0.06
    forward = SO3.act(motion.rotation, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    assert SO3.act(motion.rotation, motion.angular_velocity)[..., 2].mean().item() == pytest.approx(
        0.3, abs=0.03
    )
    along = (forward * motion.velocity).sum(-1)
    assert along.mean().item() == pytest.approx(1.2, rel=0.1)


def test_drone_accelerates_along_its_own_axis():
    _, motion = made("drone", bandwidth=0.8, acceleration=2.0, yaw_rate=0.3, drag=0.0)
    force = imu_force(motion)
    sideways = force[..., :2].norm(dim=-1)
    assert motion.acceleration.square().mean().sqrt().item() == pytest.approx(2.0, rel=0.15)
    # It leans by a fifth of a radian most of the time, and yet feels next to nothing from the side.
    up = SO3.act(motion.rotation, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    assert up[..., 2].acos().square().mean().sqrt() > 0.2
    assert sideways.square().mean().sqrt() < 0.05
    _, dragged = made("drone", bandwidth=0.8, acceleration=2.0, yaw_rate=0.3, drag=1.0)
    assert imu_force(dragged)[..., :2].norm(dim=-1).square().mean().sqrt() > 0.2


def test_rest_comes_first_and_ends_smoothly():
    t, motion = made("smooth", seconds=8.0, rest=3.0)
    still = t < 2.9
    assert motion.angular_velocity[:, still].abs().max() < 1e-9
    assert motion.acceleration[:, still].abs().max() < 1e-9
    assert motion.angular_velocity[:, t > 5].abs().max() > 0.1
    jump = motion.acceleration.diff(dim=1).norm(dim=-1).max()
    assert jump < 0.2 * motion.acceleration.norm(dim=-1).max()


def test_random_mounting_turns_the_body_and_not_the_path():
    options = {"seconds": 4.0, "size": 1.0, "period": 5.0, "tilt": 0.0, "banking": 0.0}
    _, upright = made("figure_eight", **options)
    _, mounted = made("figure_eight", mounting="random", **options)
    torch.testing.assert_close(upright.position, mounted.position)
    between = SO3.compose(SO3.inverse(upright.rotation), mounted.rotation)
    turn = SO3.to_matrix(between)
    torch.testing.assert_close(turn, turn[:, :1].expand_as(turn), atol=1e-9, rtol=0)
    angles = SO3.log(between[:, 0]).norm(dim=-1)
    assert angles.max() > 1.0
    assert angles.std() > 0.1


def test_turning_is_the_integral_of_the_rates():
    """About a fixed axis the angle is the integral; about any, many small steps by hand."""
    tau = torch.linspace(0.0, 2.0, 41, dtype=torch.float64).expand(2, -1)
    generator = torch.Generator().manual_seed(3)
    start = SO3.random(2, generator=generator)
    rates = torch.randn(2, 41, 3, generator=generator, dtype=torch.float64)
    found = turned(rates, tau, start)
    by_hand = [start]
    for i in range(40):
        step = 0.5 * (rates[:, i] + rates[:, i + 1]) * 0.05
        by_hand.append(SO3.compose(by_hand[-1], SO3.exp(step)))
    angle = SO3.log(SO3.between(found, torch.stack(by_hand, 1))).norm(dim=-1)
    assert angle.max() < 1e-12


def test_differences_and_facing():
    t = torch.linspace(0.0, 1.0, 101, dtype=torch.float64)
    first, second = differences((t**2)[None, :, None], 0.01)
    torch.testing.assert_close(first[0, 1:-1, 0], 2 * t[1:-1])
    torch.testing.assert_close(second[0, :, 0], torch.full_like(t, 2.0))
    forward = torch.tensor([math.cos(0.3), math.sin(0.3), 0.0], dtype=torch.float64)
    up = torch.tensor([0.1, -0.2, 1.0], dtype=torch.float64)
    R = SO3.to_matrix(facing(forward, up))
    torch.testing.assert_close(R[:, 2], up / up.norm())
    assert torch.det(R).item() == pytest.approx(1.0)
    assert R[:, 0] @ forward > 0.97
    assert abs(torch.linalg.cross(up, forward) @ R[:, 0]) < 1e-12


def test_motion_faster_than_the_knots_is_refused():
    with pytest.raises(
        ValueError, match=r"smooth: frequencies reach 6 Hz, but knots 0.02 s apart carry 5 Hz"
    ):
        random_motion("smooth", 1, 1.0, bandwidth={"uniform": [1.0, 6.0]})
    random_motion("smooth", 1, 1.0, bandwidth=6.0, knot_spacing=0.01)
    with pytest.raises(ValueError, match=r"walking: frequencies reach"):
        random_motion("walking", 1, 1.0, step_frequency={"choice": [1.0, 2.0]})
