"""Calibrations of simulated recordings: estimates against the truth, deviations against errors, options, diagnoses."""

import re
from dataclasses import replace

import pytest
import torch

from torchspline import SE3, SO3
from torchspline.calibrate import Corners, Recording, find_start
from torchspline.calibrate.estimate import Calibration, calibrate
from torchspline.calibrate.simulate import Simulation, simulate
from torchspline.calibrate.start import Start
from torchspline.fit import Huber
from torchspline.imu import ImuNoise, measure
from torchspline.io import ImuRecord
from torchspline.kernels.mode import use_kernels

pytestmark = pytest.mark.usefixtures("compiled")
F64 = torch.float64
SHORT = {"seconds": 6.0, "images": 60, "samples": 1200, "spacing": 0.05}


@pytest.fixture(scope="module")
def simulated() -> Simulation:
    return simulate(**SHORT, seed=1)


@pytest.fixture(scope="module")
def start(simulated) -> Start:
    return find_start(simulated.recording)


@pytest.fixture(scope="module")
def calibration(simulated, start) -> Calibration:
    return calibrate(simulated.recording, start, spacing=0.05, stretch=None)


def misses(found: Calibration, made: Simulation) -> dict[str, torch.Tensor]:
    """Errors in standard deviations."""
    result = {}
    for i, camera in enumerate(found.cameras):
        error = SE3.log(SE3.compose(SE3.inverse(made.T_imu_cam[i]), camera.T_imu_cam))
        result[f"extrinsics {i}"] = error / camera.T_imu_cam_sigma
        if camera.time_offset_sigma is not None:
            error = torch.tensor([camera.time_offset]) - made.time_offset[i]
            result[f"offset {i}"] = error / camera.time_offset_sigma
        if camera.intrinsics_sigma is not None:
            error = camera.intrinsics - made.recording.cameras[i].parameters
            result[f"intrinsics {i}"] = error / camera.intrinsics_sigma
    imu = found.imus[0]
    if imu.gyro_bias.ndim == 1:
        result["gyro bias"] = (imu.gyro_bias - made.gyro_bias) / imu.gyro_bias_sigma
        result["accel bias"] = (imu.accel_bias - made.accel_bias) / imu.accel_bias_sigma
    angle = torch.linalg.cross(found.gravity, made.gravity).norm() / made.gravity.norm() ** 2
    result["gravity"] = (angle / found.gravity_sigma.norm())[None]
    return result


def assert_true(found: Calibration, made: Simulation, most: float = 4.5) -> None:
    assert found.result.converged
    for name, error in misses(found, made).items():
        assert float(error.abs().max()) < most, f"{name}: {error.tolist()} standard deviations"


def test_estimates_are_the_truth(calibration, simulated):
    assert_true(calibration, simulated)
    assert len(misses(calibration, simulated)) == 7
    for camera in calibration.cameras:  # and near it
        assert float(camera.T_imu_cam_sigma[:3].max()) < 2e-3
        assert float(camera.T_imu_cam_sigma[3:].max()) < 1e-3
        assert camera.time_offset_sigma is not None
        assert camera.time_offset_sigma < 1e-4
    assert float(calibration.gravity.norm()) == pytest.approx(9.80665, rel=1e-12)
    assert not calibration.observability
    t = simulated.recording.imus[0].time_ns
    low, high = calibration.trajectory.domain
    t = t[(t >= low) & (t <= high)]
    between = SE3.compose(SE3.inverse(simulated.trajectory(t)), calibration.trajectory(t))
    assert float(between[:, :3].norm(dim=1).median()) < 1e-3
    assert float(SO3.log(between[:, 3:]).norm(dim=1).median()) < 1e-3


def test_noise_is_found_where_it_was_said_wrong(simulated, start):
    """Stated noise a third and three times of what was made: what comes out is what went in, and so are deviations."""
    wrong = replace(simulated.recording, noise=(ImuNoise(3 * 1.6968e-4, 2.0e-3 / 3),))
    found = calibrate(wrong, start, spacing=0.05, pixel_sigma=1.5, stretch=None)
    rate = (1199 / 6.0) ** 0.5
    assert found.imus[0].gyroscope.sigma == pytest.approx(1.6968e-4 * rate, rel=0.06)
    assert found.imus[0].accelerometer.sigma == pytest.approx(2.0e-3 * rate, rel=0.06)
    assert found.imus[0].gyroscope.stated == pytest.approx(3 * 1.6968e-4 * rate, rel=1e-2)
    for camera in found.cameras:
        assert camera.residuals.sigma == pytest.approx(0.5, rel=0.03)
        assert camera.residuals.stated == 1.5
    assert_true(found, simulated)
    kept = calibrate(wrong, start, spacing=0.05, pixel_sigma=1.5, reweigh=False)
    assert kept.cameras[0].residuals.sigma == 1.5


def test_split_and_joint_agree(calibration, simulated, start):
    """The spline is another, the calibration is not: within one standard deviation."""
    joint = calibrate(simulated.recording, start, spacing=0.05, representation="joint", stretch=None)
    assert joint.trajectory.group == SE3
    for a, b in zip(calibration.cameras, joint.cameras, strict=True):
        error = SE3.log(SE3.compose(SE3.inverse(a.T_imu_cam), b.T_imu_cam))
        assert bool((error.abs() < a.T_imu_cam_sigma).all())
    assert_true(joint, simulated)


def test_residuals_are_of_the_recording(calibration, simulated):
    """Recomputed from the estimates, with the cameras' equations written out."""
    recording = simulated.recording
    for i, camera in enumerate(calibration.cameras):
        corners = recording.corners[i]
        assert camera.residuals.used.shape == (len(corners),)
        rows = torch.nonzero(camera.residuals.used).flatten()[::97]
        t = corners.t_ns[corners.frame[rows]] + round(camera.time_offset * 1e9)
        T = SE3.inverse(SE3.compose(calibration.trajectory(t), camera.T_imu_cam))
        x, y, z = SE3.act(T, corners.xyz[rows]).unbind(-1)
        a, b = x / z, y / z
        fu, fv, pu, pv, k1, k2, p1, p2 = camera.intrinsics
        r2 = a * a + b * b
        c = 1 + k1 * r2 + k2 * r2**2
        u = fu * (a * c + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)) + pu
        v = fv * (b * c + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b) + pv
        expected = torch.stack([u, v], dim=1) - corners.uv[rows]
        # Times are rounded to nanoseconds here.
        assert torch.allclose(camera.residuals.values[::97], expected, atol=1e-5)
    imu = calibration.imus[0]
    t = recording.imus[0].time_ns[imu.gyroscope.used]
    ideal = measure(calibration.trajectory, t, calibration.gravity, imu.gyro_bias, imu.accel_bias)
    part = recording.imus[0].gyroscope[imu.gyroscope.used]
    assert torch.allclose(imu.gyroscope.values, ideal.gyroscope - part, atol=1e-9)
    part = recording.imus[0].accelerometer[imu.accelerometer.used]
    assert torch.allclose(imu.accelerometer.values, ideal.accelerometer - part, atol=1e-9)


@pytest.mark.parametrize("what", ["intrinsics", "line_delay", "imu_scaling"])
def test_more_can_be_estimated(what, simulated, start):
    found = calibrate(
        simulated.recording, start, spacing=0.05, estimate={"time_offset", what}, stretch=None, loss=None
    )
    assert_true(found, simulated)
    camera, imu = found.cameras[0], found.imus[0]
    if what == "intrinsics":
        assert camera.intrinsics_sigma is not None
        assert float(camera.intrinsics_sigma[:4].max()) < 2.0
    if what == "line_delay":  # the shutter was global
        assert camera.line_delay is not None
        assert camera.line_delay_sigma is not None
        assert abs(camera.line_delay) < 4.5 * camera.line_delay_sigma < 1e-5
    if what == "imu_scaling":
        assert imu.gyro_scaling is not None
        assert imu.gyro_scaling_sigma is not None
        assert imu.accel_scaling is not None
        assert imu.accel_scaling_sigma is not None
        for S, sigma in (
            (imu.gyro_scaling, imu.gyro_scaling_sigma),
            (imu.accel_scaling, imu.accel_scaling_sigma),
        ):
            assert bool(((S - torch.eye(3)).abs() < 4.5 * sigma).all())
        assert float(imu.accel_scaling.triu(1).abs().max()) < 1e-8


def test_rolling_shutter(simulated, start):
    """Lines 30 us apart: corners are moved to where they would have been seen then."""
    made, delay = simulated, 3e-5
    corners = []
    for i, camera in enumerate(made.recording.cameras):
        own = made.recording.corners[i]
        late = delay * (own.uv[:, 1] - 0.5 * (camera.resolution[1] - 1))
        at = own.t_ns[own.frame] + round(float(made.time_offset[i]) * 1e9)
        shift = (late * 1e9).round().long()
        low, high = made.trajectory.domain
        poses = [made.trajectory((t).clamp(int(low), int(high))) for t in (at, at + shift)]
        seen = [_pinhole(T, made.T_imu_cam[i], own.xyz, camera.parameters) for T in poses]
        corners.append(replace(own, uv=own.uv + seen[1] - seen[0]))
    inside = [((c.uv > 0) & (c.uv < torch.tensor([751.0, 479.0]))).all(1) for c in corners]
    corners = [_rows(c, k) for c, k in zip(corners, inside, strict=True)]
    recording = replace(made.recording, corners=tuple(corners))
    options = {"spacing": 0.05, "stretch": None}
    found = calibrate(recording, start, estimate={"time_offset", "line_delay"}, **options)
    for camera in found.cameras:
        assert camera.line_delay is not None
        assert camera.line_delay_sigma is not None
        assert abs(camera.line_delay - delay) < 5 * camera.line_delay_sigma < 2e-6


def _rows(corners: Corners, keep: torch.Tensor) -> Corners:
    columns = {name: getattr(corners, name)[keep] for name in ("frame", "uv", "xyz", "tag_id", "corner")}
    return replace(corners, **columns)


def _pinhole(T: torch.Tensor, mount: torch.Tensor, xyz: torch.Tensor, camera: torch.Tensor) -> torch.Tensor:
    x, y, z = SE3.act(SE3.inverse(SE3.compose(T, mount)), xyz).unbind(-1)
    a, b = x / z, y / z
    fu, fv, pu, pv, k1, k2, p1, p2 = camera
    r2 = a * a + b * b
    c = 1 + k1 * r2 + k2 * r2**2
    u = fu * (a * c + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)) + pu
    return torch.stack([u, fv * (b * c + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b) + pv], dim=1)


def test_biases_that_change(simulated, start):
    """A ramp is followed by a spline, where a constant is off by many deviations."""
    imu = simulated.recording.imus[0]
    t = imu.time[:, None]
    ramp = ImuRecord(imu.time_ns, imu.gyroscope + 0.01 * (t - 3.0), imu.accelerometer)
    recording = replace(simulated.recording, imus=(ramp,))
    found = calibrate(recording, start, spacing=0.05, bias_spacing=2.0, stretch=None)
    spline = found.imus[0].gyro_bias_spline
    assert spline is not None
    low = int(found.trajectory.domain[0])
    at = torch.tensor([1.5, 3.0, 4.5], dtype=F64)
    truth = simulated.gyro_bias + 0.01 * (at - 3.0)[:, None]
    now = spline(low + (1e9 * (at - 1e-9 * (low - int(imu.time_ns[0])))).long())
    assert float((now - truth).abs().max()) < 2e-3
    assert found.imus[0].gyro_bias.shape == found.imus[0].gyro_bias_sigma.shape == spline.control_points.shape
    constant = calibrate(recording, start, spacing=0.05, reweigh=False, stretch=None, max_iterations=4)
    assert found.result.cost[-1] < constant.result.cost[-1]


def with_second_imu(
    made: Simulation, ahead: float
) -> tuple[Recording, torch.Tensor, tuple[torch.Tensor, ...]]:
    """Somewhere else, turned, with biases and a clock of its own: its pose in the first IMU and those biases."""
    T = SE3.exp(torch.tensor([0.05, -0.08, 0.03, 0.4, -0.9, 2.0], dtype=F64))
    stamps = made.recording.imus[0].time_ns[10:-10]
    biases = torch.tensor([0.01, -0.02, 0.005], dtype=F64), torch.tensor([0.1, 0.05, -0.2], dtype=F64)
    ideal = measure(made.trajectory, stamps, made.gravity, *biases, T_body_imu=T)
    g = torch.Generator().manual_seed(7)
    noisy = [
        x + s * torch.randn(x.shape, generator=g, dtype=F64)
        for x, s in ((ideal.gyroscope, 2.4e-3), (ideal.accelerometer, 2.8e-2))
    ]
    second = ImuRecord(stamps + round(ahead * 1e9), *noisy)
    first = made.recording
    return replace(first, imus=(*first.imus, second), noise=first.noise * 2), T, biases


def test_a_second_imu(simulated):
    made, ahead = simulated, 0.003
    recording, T, biases = with_second_imu(made, ahead)
    found = calibrate(recording, spacing=0.05, stretch=None)
    assert_true(found, made)
    imu = found.imus[1]
    assert imu.T_imu0_imu_sigma is not None
    assert imu.time_offset_sigma is not None
    error = torch.cat(
        [imu.T_imu0_imu[:3] - T[:3], SO3.log(SO3.compose(SO3.inverse(T[3:]), imu.T_imu0_imu[3:]))]
    )
    assert float((error / imu.T_imu0_imu_sigma).abs().max()) < 4.5
    assert abs(imu.time_offset - ahead) < 4.5 * imu.time_offset_sigma < 1e-4
    assert bool(((imu.gyro_bias - biases[0]).abs() < 4.5 * imu.gyro_bias_sigma).all())
    assert bool(((imu.accel_bias - biases[1]).abs() < 4.5 * imu.accel_bias_sigma).all())


def test_scalings_of_a_second_imu_do_not_turn_its_frame(simulated):
    recording, _, _ = with_second_imu(simulated, 0.0)
    recording = replace(recording.only(0).between(0.0, 3.0), gravity=9.80665)
    with use_kernels("reference"):  # loops for these residuals take longer to compile
        found = calibrate(
            recording, spacing=0.05, estimate=("imu_scaling",), stretch=None, reweigh=False, max_iterations=4
        )
    assert not found.observability
    for imu in found.imus:
        for S, sigma in (
            (imu.gyro_scaling, imu.gyro_scaling_sigma),
            (imu.accel_scaling, imu.accel_scaling_sigma),
        ):
            assert S is not None
            assert bool(((S - torch.eye(3)).abs() < 4.5 * sigma).all())
        assert float(imu.accel_scaling.triu(1).abs().max()) < 1e-8


@pytest.mark.parametrize("stretch", [1e-9, 1e-300])
def test_stretches_shorter_than_knots_are_apart(calibration, stretch):
    """As many stretches as there are segments, not a row for each nanosecond."""
    (variable,) = (x for x in calibration.result._linearizer.model.variables if x.name == "cam0 extrinsics")
    found = calibration.result.standard_deviation(variable, stretch)
    assert torch.equal(found, calibration.result.standard_deviation(variable, 0.05))


def with_noise(recording: Recording, factor: float) -> Recording:
    """Stated so many times as large."""
    stated = recording.noise[0]
    densities = stated.gyroscope_noise_density * factor, stated.accelerometer_noise_density * factor
    return replace(recording, noise=(replace(stated, gyroscope_noise_density=densities[0],
                                             accelerometer_noise_density=densities[1]),))  # fmt: skip


def test_noise_stated_a_thousand_times_too_large(calibration, simulated, start):
    """Images lead the first solution then, and residuals of the IMU are those of their noise."""
    found = calibrate(with_noise(simulated.recording, 1e3), start, spacing=0.05, stretch=None)
    assert_true(found, simulated)
    for x, expected in zip(
        (found.imus[0].gyroscope, found.imus[0].accelerometer),
        (calibration.imus[0].gyroscope, calibration.imus[0].accelerometer),
        strict=True,
    ):
        assert x.sigma == pytest.approx(expected.sigma, rel=0.1)
    ratio = found.cameras[0].T_imu_cam_sigma / calibration.cameras[0].T_imu_cam_sigma
    assert float(ratio.log().abs().max()) < 0.1


def test_noise_stated_far_too_small_is_named(simulated, start):
    quiet = with_noise(simulated.recording, 1e-3)
    with pytest.raises(ValueError, match=r"noise densities and pixel_sigma = 0.5 .* right size") as caught:
        calibrate(quiet, start, spacing=0.05, stretch=None)
    message = str(caught.value)
    assert "not determine all" in message
    assert message.startswith("noise: ")
    for sensor in ("gyroscope", "accelerometer"):
        told = float(re.search(rf"{sensor} of imu0 (\d+) times as much", message).group(1))
        assert told == pytest.approx(1000, rel=0.2)


def test_a_recording_without_noise():
    made = simulate(
        **{**SHORT, "seconds": 3.0},
        cameras=1,
        pixel_sigma=0.0,
        noise=ImuNoise(1e-12, 1e-12, 0.0, 0.0),
        seed=1,
    )
    recording = with_noise(made.recording, 1e9)
    found = calibrate(recording, spacing=0.05, stretch=None)
    assert all(float(error.abs().max()) < 4.5 for error in misses(found, made).values())
    camera = found.cameras[0]
    assert float(SE3.log(SE3.compose(SE3.inverse(made.T_imu_cam[0]), camera.T_imu_cam)).abs().max()) < 1e-9
    assert camera.residuals.sigma == pytest.approx(1e-4 * camera.residuals.stated)


def test_outliers_are_not_believed(simulated, start):
    """Two in a hundred corners are wrong by up to 30 px."""
    g = torch.Generator().manual_seed(3)
    own = simulated.recording.corners[0]
    bad = torch.rand(len(own), generator=g) < 0.02
    moved = own.uv + bad[:, None] * (60 * torch.rand(len(own), 2, generator=g, dtype=F64) - 30)
    moved = moved.clamp(min=0.0).minimum(torch.tensor([751.0, 479.0], dtype=F64))
    recording = replace(simulated.recording, corners=(replace(own, uv=moved), simulated.recording.corners[1]))
    robust = calibrate(recording, start, spacing=0.05, stretch=None, loss=Huber(2.0))
    assert_true(robust, simulated, most=6.0)
    plain = calibrate(recording, start, spacing=0.05, stretch=None, loss=None)
    assert plain.cameras[0].residuals.sigma > 2 * robust.cameras[0].residuals.sigma


def test_what_is_known_stays(simulated, start):
    known = replace(start, time_offset=simulated.time_offset)
    found = calibrate(simulated.recording, known, spacing=0.05, estimate=(), stretch=None)
    for i, camera in enumerate(found.cameras):
        assert camera.time_offset == pytest.approx(float(simulated.time_offset[i]), abs=1e-15)
        assert camera.time_offset_sigma is None
        assert camera.intrinsics_sigma is None
        assert bool((camera.intrinsics == simulated.recording.cameras[i].parameters).all())
    assert_true(found, simulated)
    between = SE3.compose(SE3.inverse(found.cameras[0].T_imu_cam), found.cameras[1].T_imu_cam)
    assert torch.allclose(found.T_cam_cam(0, 1), between)


@pytest.mark.parametrize(
    ("changes", "kind", "message"),
    [
        ({"order": 3}, ValueError, "order: .*at least 4, got 3"),
        ({"order": 5.0}, (TypeError, ValueError), "order: "),
        ({"spacing": 0.0}, ValueError, "spacing: .*got 0"),
        ({"spacing": 0.001}, ValueError, "spacing: expected at least the 0.005.* s between readings"),
        ({"spacing": 100.0}, ValueError, r"spacing: expected less than the .* s that sensors share, got 100"),
        ({"representation": "SE3"}, ValueError, "representation: .*'split', 'joint'"),
        ({"estimate": "time_offset"}, TypeError, "estimate: expected a set of names"),
        ({"estimate": {"gravity"}}, ValueError, "estimate: .*'imu_scaling'"),
        ({"bias_spacing": -1.0}, ValueError, "bias_spacing: "),
        ({"pixel_sigma": 0.0}, ValueError, "pixel_sigma: "),
        ({"loss": 3.0}, TypeError, "loss: .*got float"),
        ({"imu_loss": "huber"}, TypeError, "imu_loss: .*got str"),
        ({"reweigh": 1}, TypeError, "reweigh: expected True or False, got int"),
        ({"stretch": 0.0}, ValueError, "stretch: "),
        ({"max_iterations": -1}, ValueError, "max_iterations: "),
        ({"cost_tolerance": -1.0}, ValueError, "cost_tolerance: "),
        ({"start": 5}, TypeError, "start: .*got int"),
        ({"recording": None}, TypeError, "recording: .*got NoneType"),
    ],
)
def test_wrong_arguments(changes, kind, message, simulated, start):
    given = {"recording": simulated.recording, "start": start, **changes}
    with pytest.raises(kind, match=message):
        calibrate(given.pop("recording"), **given)


def test_recordings_that_cannot_be_calibrated(simulated, start):
    recording = simulated.recording
    with pytest.raises(ValueError, match="recording: expected at least one IMU, got none"):
        calibrate(replace(recording, imus=(), noise=()))
    imu = recording.imus[0]
    late = ImuRecord(imu.time_ns + 50 * 10**9, imu.gyroscope, imu.accelerometer)
    with pytest.raises(
        ValueError, match=r"expected images while the IMU measured.*are the clocks synchronised"
    ):
        calibrate(replace(recording, imus=(late,)), start, spacing=0.05)
    keep = (imu.time < 2.0) | (imu.time > 3.0)
    gap = ImuRecord(*(x[keep] for x in (imu.time_ns, imu.gyroscope, imu.accelerometer)))
    with pytest.raises(ValueError, match=r"readings at most 0.2 s apart .* got a gap of 1.0\d* s"):
        calibrate(replace(recording, imus=(gap,)), start, spacing=0.05)
    for name, x, said in (
        (
            "time_offset",
            start.time_offset * torch.nan,
            "start: time_offset: expected finite numbers, got nan",
        ),
        ("time_offset", start.time_offset[:1], "start: expected 2 rows of time_offset, .* got 1"),
        ("gyro_bias", start.gyro_bias[:0], "start: expected 1 rows of gyro_bias, .* got 0"),
        ("T_imu_cam", start.T_imu_cam * torch.nan, "start: T_imu_cam: expected finite numbers"),
        ("gravity", start.gravity * 0, "start: gravity: expected a direction"),
    ):
        with pytest.raises(ValueError, match=said):
            calibrate(recording, replace(start, **{name: x}), spacing=0.05)
    with pytest.raises(ValueError, match=r"start: expected 1 rows of T_imu_cam, .* got 2"):
        calibrate(recording.only(0), start, spacing=0.05)


def test_simulations_say_what_is_wrong():
    for changes, kind, message in (
        ({"seconds": 0.0}, ValueError, "seconds: "),
        ({"images": 0}, ValueError, "images: "),
        ({"samples": 1.5}, (TypeError, ValueError), "samples: "),
        ({"cameras": 0}, ValueError, "cameras: "),
        ({"corners": 10**9}, ValueError, "corners: expected at most .* in sight, got 1000000000"),
        ({"corners": -1}, ValueError, "corners: "),
        ({"representation": "SE2"}, ValueError, "representation: "),
        ({"distortion": ""}, ValueError, "distortion: "),
        ({"spacing": -0.1}, ValueError, "spacing: "),
        ({"order": 1}, ValueError, "order: "),
        ({"pixel_sigma": -0.1}, ValueError, "pixel_sigma: "),
        ({"noise": 1.0}, TypeError, "noise: .*got float"),
        ({"seed": "a"}, (TypeError, ValueError), "seed: "),
    ):
        with pytest.raises(kind, match=message):
            simulate(**{**SHORT, "seconds": 1.0, "images": 3, "samples": 100, **changes})


def test_simulations_are_what_was_asked_for():
    made = simulate(**{**SHORT, "corners": 5000}, seed=2)
    again = simulate(**{**SHORT, "corners": 5000}, seed=2)
    assert sum(map(len, made.recording.corners)) == 5000
    assert [len(c.t_ns) for c in made.recording.corners] == [60, 60]
    assert len(made.recording.imus[0]) == 1200
    assert bool((made.recording.corners[0].uv == again.recording.corners[0].uv).all())
    assert isinstance(made.recording, Recording)
