"""Alignment of an IMU with a trajectory: against known truth, in hostile conditions, and on recordings."""

import math

import pytest
import torch

import torchspline
from torchspline import SO3, BSpline, SplitBSpline, fit_poses, imu
from torchspline.fit import align_imu
from torchspline.fit.losses import Huber
from torchspline.io import read_imu, read_poses

F64 = torch.float64
SECOND = 1_000_000_000
ARM = torch.tensor([0.06, -0.07, 0.04], dtype=F64)
NOISE = (0.01, 0.05)


@pytest.fixture(autouse=True)
def kernels():
    """The solver's loops, compiled where they can be: in plain Python these problems take minutes."""
    with torchspline.use_kernels("auto"):
        yield


def motion(seed, duration=20.0, turn=0.25, axis=None, knot=0.3, **times):
    """A random motion; about one axis only if it is given."""
    g = torch.Generator().manual_seed(seed)
    count = math.ceil(duration / knot) + 5
    position = 0.3 * torch.randn(count, 3, generator=g, dtype=F64)
    turns = turn * torch.randn(count, 3, generator=g, dtype=F64)
    if axis is not None:
        turns = turns * torch.tensor(axis, dtype=F64)
    rotation = [SO3.identity()]
    for x in turns[1:]:
        rotation.append(SO3.retract(rotation[-1], x, side="right"))
    times = times or {"dt": knot, "t0": 5.0}
    return SplitBSpline(torch.cat([position, torch.stack(rotation)], -1), order=6, learnable=False, **times)


class Truth:
    """Readings of an IMU on a trajectory, and what an alignment should find."""

    def __init__(
        self, trajectory, seed, offset=0.4, skew=1e-4, rate=200.0, noise=NOISE, span=(0.0, 1.0), delay=4e-4
    ):
        g = torch.Generator().manual_seed(seed)
        start, stop = trajectory.domain
        unit = 1 / SECOND if isinstance(start, int) else 1.0
        length = (stop - start) * unit
        tau = torch.arange(span[0] * length + 1e-3, span[1] * length - 1e-3, 1 / rate, dtype=F64)
        self.offset, self.skew, self.mid, self.delay = offset, skew, 0.5 * length, delay
        #: On the IMU's clock, seconds from the start of the trajectory on its own.
        self.s = tau + offset + skew * (tau - self.mid)
        self.start, self.unit = start, unit
        q = SO3.random(generator=g)
        self.rotation_imu_body = SO3.inverse(q)
        self.lever_arm = ARM
        self.gyro_bias = 0.02 * torch.randn(3, generator=g, dtype=F64)
        self.accel_bias = 0.2 * torch.randn(3, generator=g, dtype=F64)
        self.gravity = SO3.act(SO3.random(generator=g), torch.tensor(imu.STANDARD_GRAVITY, dtype=F64))
        mounted = (self.gravity, self.gyro_bias, self.accel_bias, torch.cat([ARM, q]))
        with torch.no_grad():
            # What bears the same stamp was measured by the accelerometer that much earlier.
            gyro, accel = (
                imu.measure(
                    trajectory,
                    start + (x * SECOND).round().long() if isinstance(start, int) else start + x,
                    *mounted,
                )
                for x in (tau, tau - delay / (1 + skew))
            )
        shape = gyro.gyroscope.shape
        self.gyro = gyro.gyroscope + noise[0] * torch.randn(shape, generator=g, dtype=F64)
        self.accel = accel.accelerometer + noise[1] * torch.randn(shape, generator=g, dtype=F64)
        #: Stamps in the unit of the trajectory.
        self.t = start + (self.s * SECOND).round().long() if isinstance(start, int) else start + self.s

    def scores(self, a):
        """Errors over the standard deviations that the alignment gives, by name."""
        away = (a.t_mid - self.start) * self.unit - self.mid
        errors = {
            "time_offset": torch.tensor([a.time_offset - self.offset - self.skew * away], dtype=F64),
            "clock_skew": torch.tensor([a.clock_skew - self.skew], dtype=F64),
            # A step of the rotation from the IMU to the body, seen in the IMU.
            "rotation_imu_body": SO3.log(
                SO3.compose(self.rotation_imu_body, SO3.inverse(a.rotation_imu_body))
            ),
            "gyro_bias": a.gyro_bias - self.gyro_bias,
        }
        if a.gravity is not None:
            if "accel_delay" in a.std:
                errors["accel_delay"] = torch.tensor([a.accel_delay - self.delay], dtype=F64)
            for name in ("lever_arm", "accel_bias", "gravity"):
                errors[name] = getattr(a, name) - getattr(self, name)
        assert errors.keys() == a.std.keys()
        return {name: x / torch.as_tensor(a.std[name], dtype=F64) for name, x in errors.items()}


def assert_within(truth, a, limit=4.0):
    for name, score in truth.scores(a).items():
        assert score.abs().max() < limit, (name, score)


@pytest.mark.parametrize("seed", range(6))
def test_the_truth_is_found_from_scratch(seed):
    offset = (-3.0, 2.7, 0.003, 1.1, -0.6, 3.0)[seed]
    truth = Truth(motion(seed), seed, offset=offset)
    a = align_imu(motion(seed), truth.t, truth.gyro, truth.accel)
    assert_within(truth, a)
    assert a.std["time_offset"] < 1e-4
    assert a.std["lever_arm"].max() < 2e-3
    assert a.gyro_rms == pytest.approx(NOISE[0], rel=0.05)
    assert a.accel_rms == pytest.approx(NOISE[1], rel=0.05)
    assert a.notes == []


def test_an_accelerometer_that_is_later_than_the_gyroscope():
    """One clock for both would be a compromise, far outside of its own standard deviation."""
    truth = Truth(motion(4), 4, delay=-1.5e-3)
    a = align_imu(motion(4), truth.t, truth.gyro, truth.accel)
    assert_within(truth, a)
    assert a.std["accel_delay"] < 1e-4
    gyro, accel = a.pose_time(truth.t), a.pose_time(truth.t, sensor="accel")
    torch.testing.assert_close(gyro - accel, torch.full_like(gyro, a.accel_delay), rtol=1e-3, atol=0.0)
    one = align_imu(motion(4), truth.t, truth.gyro, truth.accel, estimate_delay=False)
    assert one.accel_delay == 0.0
    assert "accel_delay" not in one.std
    assert abs(one.time_offset - truth.offset) > 10 * one.std["time_offset"]
    with pytest.raises(ValueError, match="sensor: expected one of 'gyro', 'accel', got 'accelerometer'"):
        a.pose_time(truth.t, sensor="accelerometer")


def test_a_delay_that_the_motion_does_not_tell_stays_small():
    """An accelerometer that sees gravity only while the body turns about it."""
    trajectory = motion(5, axis=(0.0, 0.0, 1.0))
    with torch.no_grad():
        trajectory.control_points[:, :3] = 0.0
    truth = Truth(trajectory, 5)
    down = torch.tensor(imu.STANDARD_GRAVITY, dtype=F64)
    with torch.no_grad():
        q = SO3.inverse(truth.rotation_imu_body)
        made = imu.measure(trajectory, truth.t[200:] - truth.offset, down, T_body_imu=torch.cat([0 * ARM, q]))
    accel = made.accelerometer + 0.05 * torch.randn(made.accelerometer.shape, dtype=F64)
    a = align_imu(trajectory, truth.t[200:], truth.gyro[200:], accel)
    assert abs(a.accel_delay) < 0.02
    assert any(note.startswith("accel_delay: the motion hardly tells it") for note in a.notes)


@pytest.mark.slow
def test_standard_deviations_are_those_of_many_draws():
    trajectory = motion(0, duration=10.0)
    scores = []
    for seed in range(30):
        truth = Truth(trajectory, seed, offset=0.2, rate=100.0)
        scores.append(
            torch.cat(list(truth.scores(align_imu(trajectory, truth.t, truth.gyro, truth.accel)).values()))
        )
    spread = torch.stack(scores).square().mean(0).sqrt()
    # 30 draws tell a standard deviation to 13 %; 17 of them stay within three times that.
    assert spread.min() > 0.6
    assert spread.max() < 1.45
    assert torch.stack(scores).square().mean().sqrt() == pytest.approx(1.0, abs=0.1)


def test_plain_least_squares_agree_with_a_dense_solution():
    """The joint minimum against SciPy's, with Jacobians by differences, on the same residuals from `imu.measure`."""
    from scipy.optimize import least_squares

    trajectory = motion(1, duration=6.0)
    truth = Truth(trajectory, 1, offset=0.1, skew=0.0, rate=60.0, span=(0.05, 0.95), delay=0.0)
    a = align_imu(
        trajectory, truth.t, truth.gyro, truth.accel, loss=None, estimate_skew=False, estimate_delay=False
    )
    assert a.accel_delay == 0.0
    assert a.used == (len(truth.t), len(truth.t))
    gyro, accel, t = truth.gyro, truth.accel, truth.t
    q0 = SO3.inverse(a.rotation_imu_body)
    g0 = a.gravity

    def residual(x):
        x = torch.from_numpy(x)
        q = SO3.retract(q0, x[1:4], side="right")
        down = SO3.act(
            SO3.exp(torch.cat([x[4:6], x.new_zeros(1)])), torch.tensor([0.0, 0.0, -1.0], dtype=F64)
        )
        turn = SO3.from_matrix(_frame(g0))
        with torch.no_grad():
            made = imu.measure(
                trajectory, t - x[0], imu_gravity(turn, down), x[6:9], x[9:12], torch.cat([x[12:15], q])
            )
        return torch.cat(
            [
                ((made.gyroscope - gyro) / a.gyro_rms).flatten(),
                ((made.accelerometer - accel) / a.accel_rms).flatten(),
            ]
        ).numpy()

    def imu_gravity(turn, down):
        return SO3.act(turn, down) * math.hypot(*imu.STANDARD_GRAVITY)

    start = torch.cat(
        [torch.tensor([a.time_offset, 0, 0, 0, 0, 0], dtype=F64), a.gyro_bias, a.accel_bias, a.lever_arm]
    )
    found = least_squares(residual, start.numpy(), x_scale="jac", method="lm")
    moved = torch.from_numpy(found.x) - start
    covariance = torch.linalg.inv(torch.from_numpy(found.jac.T @ found.jac))
    deviations = covariance.diagonal().sqrt()
    assert (moved.abs() < 0.02 * deviations).all(), moved / deviations
    theirs = {"time_offset": slice(0, 1), "rotation_imu_body": slice(1, 4), "gyro_bias": slice(6, 9),
              "accel_bias": slice(9, 12), "lever_arm": slice(12, 15)}  # fmt: skip
    for name, part in theirs.items():
        torch.testing.assert_close(
            torch.as_tensor(a.std[name], dtype=F64).reshape(-1), deviations[part], rtol=0.02, atol=0.0
        )


def _frame(gravity):
    """A rotation that takes -z to the direction of gravity."""
    z = -gravity / gravity.norm()
    x = torch.linalg.cross(torch.tensor([0.3, 0.9, 0.1], dtype=F64), z)
    x = x / x.norm()
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)


# ---------------------------------------------------------------------- clocks


def test_any_unit_and_epoch_of_the_clocks():
    nanoseconds = {"dt_ns": 3 * SECOND // 10, "t0_ns": 1_500_000_000 * SECOND}
    in_ns, in_s = motion(2, **nanoseconds), motion(2, dt=0.3, t0=0.0)
    truth = Truth(in_ns, 2, offset=0.7)
    other = truth.s + 1000.0  # a clock that counts from when the sensor was switched on
    expected = align_imu(in_ns, truth.t, truth.gyro, truth.accel)
    assert_within(truth, expected)
    for trajectory, t, epoch in (
        (in_s, other, 1000.0),
        (in_ns, other, 1000.0 - 1.5e9),
        (in_s, (other * SECOND).round().long(), 1000.0),
        (in_s, truth.t, 1.5e9),
    ):
        a = align_imu(trajectory, t, truth.gyro, truth.accel, max_offset=None)
        assert a.time_offset == pytest.approx(expected.time_offset + epoch, abs=1e-6)
        torch.testing.assert_close(a.lever_arm, expected.lever_arm, rtol=0, atol=1e-5)
        back = a.pose_time(t) - trajectory.domain[0]
        back = 1e-9 * back.to(F64) if trajectory is in_ns else back
        exact = 1e-9 * (expected.pose_time(truth.t) - in_ns.domain[0]).to(F64)
        torch.testing.assert_close(back, exact, rtol=0, atol=1e-6)
    with pytest.raises(TypeError, match=r"t: expected torch\.float64"):
        align_imu(in_s, truth.s, truth.gyro).pose_time(truth.t)


def test_pose_time_undoes_the_clock():
    trajectory = motion(3)
    truth = Truth(trajectory, 3, offset=-1.3, skew=3e-4)
    a = align_imu(trajectory, truth.t, truth.gyro, truth.accel)
    t = a.pose_time(truth.t)
    torch.testing.assert_close(t + a.time_offset + a.clock_skew * (t - a.t_mid), truth.t, rtol=0, atol=1e-9)
    inside = (t > trajectory.domain[0]) & (t < trajectory.domain[1])
    made = imu.measure(trajectory, t[inside], a.gravity, a.gyro_bias, a.accel_bias, a.T_body_imu)
    assert (made.gyroscope - truth.gyro[inside]).square().mean().sqrt() < 1.05 * NOISE[0]
    assert (made.accelerometer - truth.accel[inside]).square().mean().sqrt() < 1.05 * NOISE[1]


def test_part_of_the_motion_is_enough():
    trajectory = motion(4, duration=30.0)
    truth = Truth(trajectory, 4, offset=-2.0, skew=0.0, span=(0.5, 0.9))
    assert_within(truth, align_imu(trajectory, truth.t, truth.gyro, truth.accel))


def test_order_and_batches_of_stamps_do_not_matter():
    trajectory = motion(5)
    truth = Truth(trajectory, 5)
    a = align_imu(trajectory, truth.t, truth.gyro, truth.accel)
    mixed = torch.randperm(len(truth.t), generator=torch.Generator().manual_seed(0))
    b = align_imu(trajectory, truth.t[mixed], truth.gyro[mixed], truth.accel[mixed])
    assert b.time_offset == pytest.approx(a.time_offset, abs=1e-12)


def test_the_trajectory_stays_as_it_is():
    trajectory = motion(6)
    points = 2.0 * trajectory.control_points.clone()
    points[:, :3] *= 0.5
    longer = SplitBSpline(points, order=6, dt=0.3, t0=5.0)
    truth = Truth(trajectory, 6)
    version = longer.control_points._version
    align_imu(longer, truth.t, truth.gyro, truth.accel)
    assert torch.equal(longer.control_points, points)
    assert longer.control_points._version == version


# ---------------------------------------------------------------------- other sensors and trajectories


def test_gyroscope_alone():
    trajectory = motion(7)
    truth = Truth(trajectory, 7, offset=1.5)
    turning = BSpline(trajectory.control_points[:, 3:], group=SO3, order=6, dt=0.3, t0=5.0, learnable=False)
    for one in (trajectory, turning):
        a = align_imu(one, truth.t, truth.gyro)
        assert a.lever_arm is a.accel_bias is a.gravity is a.accel_rms is None
        assert a.used[1] == 0
        assert_within(truth, a)
        assert torch.equal(a.T_body_imu[:3], torch.zeros(3, dtype=F64))


def test_joint_trajectories_and_float32():
    split = motion(8)
    joint = BSpline(split.control_points, group=torchspline.SE3, order=6, dt=0.3, t0=5.0, learnable=False)
    truth = Truth(joint, 8)
    assert_within(truth, align_imu(joint, truth.t, truth.gyro, truth.accel))
    a = align_imu(joint, truth.t, truth.gyro.float(), truth.accel.float())
    assert_within(truth, a)
    assert a.gravity.dtype == F64


def test_length_of_gravity():
    trajectory = motion(9)
    truth = Truth(trajectory, 9)
    a = align_imu(trajectory, truth.t, truth.gyro, truth.accel, gravity_magnitude=None)
    assert_within(truth, a)
    fixed = align_imu(trajectory, truth.t, truth.gyro, truth.accel)
    assert float(fixed.gravity.norm()) == pytest.approx(9.80665, abs=1e-9)
    along = truth.gravity / 9.80665
    assert float((fixed.std["gravity"] * along).norm()) < float(a.std["gravity"].norm())


def test_turning_about_one_axis():
    """A ground vehicle: the gyroscope leaves the rotation about the vertical open, accelerations tell it."""
    trajectory = motion(10, axis=(0.0, 0.0, 1.0))
    truth = Truth(trajectory, 10)
    a = align_imu(trajectory, truth.t, truth.gyro, truth.accel)
    scores = truth.scores(a)
    for name in ("time_offset", "clock_skew", "rotation_imu_body", "gyro_bias"):
        assert scores[name].abs().max() < 4, (name, scores)
    # Along the axis the lever arm never shows, and gravity hides a bias.
    assert any(note.startswith("lever_arm: the motion hardly tells it") for note in a.notes)
    with pytest.raises(ValueError, match="gyro: the motion turns about one axis"):
        align_imu(trajectory, truth.t, truth.gyro)


# ---------------------------------------------------------------------- hostile


def test_a_fifth_of_the_readings_wrong():
    trajectory = motion(11)
    truth = Truth(trajectory, 11, offset=2.2)
    g = torch.Generator().manual_seed(0)
    for x, size in ((truth.gyro, 8.0), (truth.accel, 60.0)):
        wrong = torch.rand(len(x), generator=g) < 0.2
        x[wrong] = size * (torch.rand(int(wrong.sum()), 3, generator=g, dtype=F64) - 0.2)
    a = align_imu(trajectory, truth.t, truth.gyro, truth.accel)
    assert_within(truth, a, 4.5)
    assert any("gyro: 2" in note or "gyro: 1" in note for note in a.notes), a.notes
    plain = align_imu(trajectory, truth.t, truth.gyro, truth.accel, loss=None)
    assert abs(plain.time_offset - 2.2) > 3 * abs(a.time_offset - 2.2)


def test_nan_readings_are_left_out():
    trajectory = motion(12)
    truth = Truth(trajectory, 12)
    expected = align_imu(trajectory, truth.t[::2], truth.gyro[::2], truth.accel[::2])
    for x in (truth.gyro, truth.accel, truth.t):
        x[1::2] = math.nan
    a = align_imu(trajectory, truth.t, truth.gyro, truth.accel)
    assert a.time_offset == pytest.approx(expected.time_offset, abs=1e-9)
    truth.accel[::4, 1] = math.nan
    b = align_imu(trajectory, truth.t, truth.gyro, truth.accel)
    assert b.used[0] == a.used[0]
    assert b.used[1] == pytest.approx(a.used[1] / 2, abs=2)
    assert_within(truth, b)


def test_clocks_that_never_overlap():
    trajectory = motion(13)
    truth = Truth(trajectory, 13, offset=100.0)
    with pytest.raises(ValueError, match=r"t: expected stamps that overlap .* max_offset = 5 s"):
        align_imu(trajectory, truth.t, truth.gyro, truth.accel)
    assert_within(truth, align_imu(trajectory, truth.t, truth.gyro, truth.accel, max_offset=None))
    late = torch.cat([truth.t, truth.t[-1:] + 1e7])
    with pytest.raises(ValueError, match="t: expected recordings of less than"):
        align_imu(trajectory, late, truth.gyro[[*range(len(truth.t)), 0]], max_offset=None)


@pytest.mark.parametrize("max_offset", [0.5, 5.0, None])
def test_readings_of_another_motion(max_offset):
    truth = Truth(motion(14), 14)
    with pytest.raises(ValueError, match="gyro: expected readings of the trajectory's motion"):
        align_imu(motion(15), truth.t, truth.gyro, truth.accel, max_offset=max_offset)


@pytest.mark.parametrize(
    ("mistake", "word"),
    [
        (lambda x: x / 9.80665, "accel: the motion leaves"),
        (lambda x: 0 * x, "accel: the motion leaves"),
        (lambda x: -x, "accel: the motion leaves"),
        (lambda x: x.roll(60, 0), "accel_delay: 0.3 s"),
    ],
    ids=["in g", "zero", "negated", "late"],
)
def test_an_accelerometer_that_reads_something_else_is_noted(mistake, word):
    trajectory = motion(4)
    truth = Truth(trajectory, 5)
    found = align_imu(trajectory, truth.t, truth.gyro, mistake(truth.accel))
    assert any(note.startswith(word) for note in found.notes), found.notes
    assert align_imu(trajectory, truth.t, truth.gyro, truth.accel).notes == []


@pytest.mark.parametrize("nanoseconds", [False, True])
def test_a_stamp_far_before_the_others_does_not_matter(nanoseconds):
    trajectory = motion(4)
    truth = Truth(trajectory, 5)
    t = (truth.t * SECOND).long() if nanoseconds else truth.t.clone()
    whole = align_imu(trajectory, t, truth.gyro)
    t[0] = -9 * 10**18 if nanoseconds else -1e7
    found = align_imu(trajectory, t, truth.gyro)
    assert found.time_offset == pytest.approx(whole.time_offset, abs=1e-5)


def test_an_offset_beyond_the_limit():
    trajectory = motion(14)
    truth = Truth(trajectory, 14, offset=3.0)
    with pytest.raises(ValueError, match="is max_offset large enough"):
        align_imu(trajectory, truth.t, truth.gyro, truth.accel, max_offset=1.0)


@pytest.mark.parametrize("noise", [NOISE, (0.0, 0.0)])
def test_a_motion_that_does_not_turn(noise):
    trajectory = motion(16, turn=0.0)
    truth = Truth(trajectory, 16, noise=noise)
    with pytest.raises(ValueError, match="trajectory: its angular speed varies by"):
        align_imu(trajectory, truth.t, truth.gyro, truth.accel)


def test_a_motion_that_repeats_itself_is_noted():
    once = motion(17, duration=4.0)
    points = once.control_points[:12].repeat(6, 1)
    points[:, 3:] = SO3.random(12, generator=torch.Generator().manual_seed(1)).repeat(6, 1)
    points[:, 3:] = SO3.exp(0.3 * SO3.log(points[:, 3:]))
    trajectory = SplitBSpline(points, order=6, dt=0.3, t0=0.0, learnable=False)
    truth = Truth(trajectory, 17, offset=0.2, skew=0.0)
    a = align_imu(trajectory, truth.t, truth.gyro, truth.accel)
    assert any("the motion repeats itself" in note for note in a.notes)


def test_few_readings():
    trajectory = motion(18)
    truth = Truth(trajectory, 18)
    few = slice(0, 20)
    with pytest.raises(ValueError, match=r"gyro: expected at least 30 readings .* got 20"):
        align_imu(trajectory, truth.t[few], truth.gyro[few], truth.accel[few])
    truth.accel[10:] = math.nan
    with pytest.raises(ValueError, match=r"accel: expected at least 30 readings .* got 10"):
        align_imu(trajectory, truth.t, truth.gyro, truth.accel)


def test_another_loss():
    trajectory = motion(19)
    truth = Truth(trajectory, 19)
    assert_within(truth, align_imu(trajectory, truth.t, truth.gyro, truth.accel, loss=Huber(2.0)))


# ---------------------------------------------------------------------- recordings

#: Poses of the IMU's own frame on clocks that were aligned before: what remains is small.
RECORDINGS = {"euroc/V1_02_medium": 0.04, "tum_vi/room1": 0.08}


@pytest.mark.realdata
@pytest.mark.parametrize("name", RECORDINGS)
def test_recordings(shared_data, name):
    poses, samples = read_poses(shared_data / name), read_imu(shared_data / name)
    start = int(poses.time_ns[0])
    poses = poses.window(start, start + 40 * SECOND)
    samples = samples.window(start, start + 40 * SECOND)
    trajectory = fit_poses(
        poses.time_ns, torch.cat([poses.position, poses.rotation], -1), dt=RECORDINGS[name], progress=False
    ).trajectory
    # Turned, and on a clock of its own, 2.4 s late: all of it has to be found again.
    q = SO3.random(generator=torch.Generator().manual_seed(0))
    gyro, accel = (SO3.act(q, x) for x in (samples.gyroscope, samples.accelerometer))
    a = align_imu(trajectory, samples.time_ns + 24 * SECOND // 10, gyro, accel)
    assert a.time_offset == pytest.approx(2.4, abs=1.5e-3)
    assert SO3.log(SO3.between(q, a.rotation_imu_body)).norm() < 0.01
    assert a.lever_arm.norm() < 0.02
    assert float(a.gravity[2]) == pytest.approx(-9.8, abs=0.02)
