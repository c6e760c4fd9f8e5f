"""Reports, result files and the command of a calibration."""

import base64
import json
import math
import re
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from torchspline import R3, SE3, SO3, BSpline, cli
from torchspline.calibrate import figures, write_calibration
from torchspline.calibrate.coverage import CELLS, coverage
from torchspline.calibrate.estimate import Calibration, calibrate
from torchspline.calibrate.simulate import Simulation, simulate
from torchspline.cli.calibrate import rows
from torchspline.io import ImuRecord, read_camchain, write_imu

pytestmark = pytest.mark.usefixtures("compiled")
SPACING = 0.05
FILES = ("result.json", "camchain-imucam.yaml", "report.html")


@pytest.fixture(scope="module")
def simulated() -> Simulation:
    return simulate(seconds=6.0, images=60, samples=1200, order=5, spacing=SPACING, seed=5)


@pytest.fixture(scope="module")
def calibration(simulated) -> Calibration:
    return calibrate(simulated.recording, spacing=SPACING)


@pytest.fixture(scope="module")
def folder(calibration, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("calibration") / "new"
    assert write_calibration(out, calibration) == coverage(calibration).warnings
    assert sorted(x.name for x in out.iterdir()) == sorted(FILES)
    return out


# ---------------------------------------------------------------------- result.json and the camera chain


def test_every_estimate_has_its_deviation(folder, calibration, simulated):
    content = json.loads((folder / "result.json").read_text())
    for i, camera in enumerate(calibration.cameras):
        found = content[f"T_imu_cam{i}"]
        point = torch.tensor([0.1, 0.2, 1.0], dtype=torch.float64)
        matrix = torch.tensor(found["matrix"], dtype=torch.float64)
        # It maps points of the camera into the frame of the IMU.
        expected = SE3.act(camera.T_imu_cam, point)
        assert torch.allclose(matrix[:3, :3] @ point + matrix[:3, 3], expected, atol=1e-12)
        assert torch.allclose(SE3.act(simulated.T_imu_cam[i], point), expected, atol=0.01)
        assert found["translation"] + found["quaternion"] == camera.T_imu_cam.tolist()
        assert found["translation_sigma"] + found["rotation_sigma"] == camera.T_imu_cam_sigma.tolist()
        assert content[f"time_offset_cam{i}"] == {
            "value": camera.time_offset,
            "sigma": camera.time_offset_sigma,
        }
        assert content[f"intrinsics_cam{i}"]["sigma"] is None
        error = simulated.time_offset[i] - camera.time_offset
        assert abs(float(error)) < 6.0 * content[f"time_offset_cam{i}"]["sigma"]
    assert content["imu0"]["gyro_bias"]["value"] == calibration.imus[0].gyro_bias.tolist()
    assert len(content["imu0"]["accel_bias"]["sigma"]) == 3
    assert content["gravity"]["value"] == calibration.gravity.tolist()
    assert set(content["residuals"]) == {"cam0", "cam1", "imu0 gyroscope", "imu0 accelerometer"}
    statistics = content["residuals"]["cam1"]
    values = calibration.cameras[1].residuals.values.numpy()
    np.testing.assert_allclose(statistics["rms"], np.sqrt((values**2).mean(0)))
    assert statistics["median_length"] == pytest.approx(np.median(np.hypot(*values.T)), rel=1e-3)
    assert content["solver"]["converged"] is True
    assert content["trajectory"]["spacing_s"] == SPACING


def test_the_camera_chain_is_the_result(folder, calibration):
    chain = read_camchain(folder / "camchain-imucam.yaml")
    for i, camera in enumerate(calibration.cameras):
        assert float(SE3.log(SE3.between(chain.T_imu_cam[i], camera.T_imu_cam)).abs().max()) < 1e-12
        assert float(chain.time_offset[i]) == camera.time_offset
        assert chain.cameras[i].parameters.tolist() == camera.intrinsics.tolist()


# ---------------------------------------------------------------------- the report


class Page(HTMLParser):
    """Words, pictures and links of a page, and whether each tag that was opened is closed in order."""

    def __init__(self, text: str):
        super().__init__()
        self.words: list[str] = []
        self.pictures: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag == "img":
            self.pictures.append(dict(attrs)["src"])
        elif tag != "meta":
            self.open.append(tag)
        assert tag not in ("link", "script", "iframe")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def test_a_report_is_one_file_with_everything(folder, calibration):
    text = (folder / "report.html").read_text()
    page = Page(text)
    assert not page.open
    assert not re.search(r'(src|href)="(?!data:)', text)
    words = " ".join(page.words)
    for word in (
        "T_imu_cam0 position x [m]", "time offset [ms]", "T_cam1_cam0", "gyroscope bias", "m/s^2", "px", "rad/s",
        "Converged", "gravity",
    ):  # fmt: skip
        assert word in words, word
    # Residuals over time and image, their distributions, one comparison of readings, the motion.
    assert len(page.pictures) == 5
    for source in page.pictures:
        png = base64.b64decode(source.removeprefix("data:image/png;base64,"))
        assert png.startswith(b"\x89PNG\r\n")
        assert len(png) > 10_000
    shown = f"{calibration.cameras[0].T_imu_cam_sigma[0]:.2g}"
    assert shown in words


def test_names_cannot_smuggle_in_markup(calibration, tmp_path, monkeypatch):
    for name in ("residuals_over_time", "residuals_over_image", "distributions", "readings", "motion"):
        monkeypatch.setattr(figures, name, lambda *arguments: b"")
    odd = replace(calibration, notes=["<script>alert(1)</script> & more"])
    write_calibration(tmp_path, odd)
    Page((tmp_path / "report.html").read_text())  # refuses scripts
    assert json.loads((tmp_path / "result.json").read_text())["notes"] == odd.notes


def test_everything_that_can_be_estimated_is_reported(calibration, tmp_path, monkeypatch):
    """Line delays, scales, biases over time and a second IMU, with numbers put in by hand."""
    for name in ("residuals_over_time", "residuals_over_image", "distributions", "readings", "motion"):
        monkeypatch.setattr(figures, name, lambda *arguments: b"")
    delayed = replace(
        calibration.cameras[0], line_delay=2e-5, line_delay_sigma=3e-7, intrinsics_sigma=torch.ones(8)
    )
    spline = BSpline(torch.zeros(7, 3).double(), group=R3, order=4, dt_ns=2 * 10**9, t0_ns=0, learnable=False)
    second = replace(
        calibration.imus[0], name="imu1", T_imu0_imu_sigma=torch.full((6,), 0.25), time_offset=0.5,
        time_offset_sigma=1e-3, gyro_scaling=torch.eye(3), gyro_scaling_sigma=torch.full((3, 3), 0.125),
        gyro_bias=torch.arange(21.0).reshape(7, 3), gyro_bias_sigma=torch.full((7, 3), 0.5), gyro_bias_spline=spline,
    )  # fmt: skip
    recording = calibration.recording
    two = replace(recording, imus=recording.imus * 2, noise=recording.noise * 2)
    imus, cameras = (calibration.imus[0], second), (delayed, calibration.cameras[1])
    write_calibration(tmp_path, replace(calibration, cameras=cameras, imus=imus, recording=two))
    content = json.loads((tmp_path / "result.json").read_text())
    assert content["line_delay_cam0"] == {"value": 2e-5, "sigma": 3e-7}
    assert content["intrinsics_cam0"]["sigma"] == [1.0] * 8
    assert content["imu1"]["T_imu0_imu"]["rotation_sigma"] == [0.25] * 3
    assert content["imu1"]["time_offset"] == {"value": 0.5, "sigma": 1e-3}
    assert content["imu1"]["gyro_scaling"]["sigma"] == [[0.125] * 3] * 3
    assert content["imu1"]["gyro_bias"]["value"] == torch.arange(21.0).reshape(7, 3).tolist()
    assert content["imu1"]["gyro_bias_spline"] == {"order": 4, "start_ns": 0, "spacing_ns": 2 * 10**9}
    words = " ".join(Page((tmp_path / "report.html").read_text()).words)
    for word in (
        "line delay [µs]", "20.00", "imu1 time offset [ms]", "imu1 gyro_scaling xx", "imu1 position y in imu0 [m]",
        "imu1 gyroscope bias, in the middle of the recording z [rad/s]", "11.0",
    ):  # fmt: skip
        assert word in words, word


def test_folders_that_cannot_be(calibration, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="folder: expected a folder"):
        write_calibration(tmp_path / "file", calibration)


# ---------------------------------------------------------------------- coverage


def test_nothing_is_wrong_with_a_good_recording(calibration):
    found = coverage(calibration)
    assert found.warnings == []
    assert found.duration == pytest.approx(6.0, abs=0.01)
    for i, image in enumerate(found.cameras):
        assert image.counts.shape == CELLS[::-1]
        assert int(image.counts.sum()) == int(calibration.cameras[i].residuals.used.sum())


@pytest.mark.parametrize(
    ("axes", "missing"), [((0.0, 0.0, 1.0), ["x", "y"]), ((0.6, 0.0, 0.8), ["y", "[-0.80, 0.00, 0.60]"])]
)
def test_motion_about_one_axis_only_is_noticed(calibration, axes, missing):
    """The trajectory as if the IMU had only turned about one axis: its rotation replaced."""
    spline = calibration.trajectory
    t = torch.linspace(0.0, 40.0, spline.control_points.shape[0], dtype=torch.float64)
    points = spline.control_points.detach().clone()
    points[:, 3:] = SO3.exp(torch.sin(t)[:, None] * torch.tensor(axes, dtype=torch.float64))
    times = {"dt_ns": spline.dt_ns, "t0_ns": spline.domain[0]}
    turning = BSpline(points, group=spline.group, order=spline.order, learnable=False, **times)
    warnings = [
        x for x in coverage(replace(calibration, trajectory=turning)).warnings if "rotation about" in x
    ]
    assert len(warnings) == len(missing)
    if missing[0] == "x":
        assert [re.search(r"about (.*) of the first", x).group(1) for x in warnings] == missing
    assert all("hardly excited" in x for x in warnings)


def test_bare_parts_of_images_are_noticed(calibration):
    camera = calibration.cameras[0]
    used = camera.residuals.used.clone()
    right = calibration.recording.corners[0].uv[:, 0] > 300.0
    values = camera.residuals.values[~right[used]]
    part = replace(
        camera, residuals=replace(camera.residuals, used=used & ~right, values=values),
        images=camera.images & (torch.arange(len(camera.images)) % 2 == 0), intrinsics_sigma=torch.ones(8),
    )  # fmt: skip
    warnings = coverage(replace(calibration, cameras=(part, calibration.cameras[1]))).warnings
    assert any("cam0: only 50% of its images" in x for x in warnings)
    (bare,) = (x for x in warnings if "corners cover" in x)
    assert "none at the right" in bare
    assert "intrinsics are extrapolated" in bare


def test_large_residuals_and_deviations_are_noticed(calibration):
    imu, camera = calibration.imus[0], calibration.cameras[1]
    loud = replace(imu, accelerometer=replace(imu.accelerometer, values=12.0 * imu.accelerometer.values))
    unsure = replace(camera, T_imu_cam_sigma=torch.tensor([0.02, 0, 0, 0, 0, math.inf]))
    warnings = coverage(replace(calibration, imus=(loud,), cameras=(calibration.cameras[0], unsure))).warnings
    assert any(re.search(r"imu0 accelerometer: residuals are 1[12]\.\d times", x) for x in warnings), warnings
    assert any("cam1: its position is known to 0.02 m only" in x for x in warnings)
    assert any("cam1: its rotation is known to inf rad only" in x for x in warnings)
    assert len(warnings) == 3


@pytest.mark.parametrize(
    ("board", "gravity", "scale", "said"),
    [
        (
            1.1,
            9.80665,
            1.0,
            r"the motion in the images is at least [45]\.\d% too large for it: .* size of the board",
        ),
        (0.9, 9.80665, 1.0, r"the motion in the images is at least [56]\.\d% too small for it"),
        (1.0, 9.6, 1.0, r"gravity is at least [01]\.\d% too small for it: is its magnitude right"),
        (1.0, 9.80665, 1.05, r"reads motion and gravity at least [23]\.\d% too large: is its scale right"),
    ],
)
def test_wrong_sizes_are_noticed(simulated, board, gravity, scale, said):
    """Of the board, of gravity and of what the accelerometer reads: solutions converge to something else."""
    recording = simulated.recording
    corners = tuple(replace(x, xyz=board * x.xyz) for x in recording.corners)
    imu = recording.imus[0]
    imus = (ImuRecord(imu.time_ns, imu.gyroscope, scale * imu.accelerometer),)
    found = calibrate(replace(recording, corners=corners, imus=imus, gravity=gravity), spacing=SPACING)
    (warning,) = (x for x in coverage(found).warnings if x.startswith("imu0 accelerometer: "))
    assert re.search(said, warning), warning


# ---------------------------------------------------------------------- the command


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "torchspline.cli", "calibrate", "camera-imu", *map(str, arguments)],
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip


@pytest.fixture
def files(simulated, tmp_path) -> Path:
    """The simulated recording as files."""
    recording = simulated.recording
    content = {}
    for i, (camera, corners) in enumerate(zip(recording.cameras, recording.corners, strict=True)):
        columns = {
            name: getattr(corners, name).numpy() for name in ("t_ns", "frame", "uv", "tag_id", "corner")
        }
        np.savez(tmp_path / f"cam{i}.npz", xyz_m=corners.xyz.numpy(), **columns)
        content[f"cam{i}"] = {
            "camera_model": "pinhole", "intrinsics": list(camera.intrinsics), "distortion_model": "radtan",
            "distortion_coeffs": list(camera.coefficients), "resolution": list(camera.resolution),
        }  # fmt: skip
    (noise,) = recording.noise
    names = ("gyroscope_noise_density", "gyroscope_random_walk")
    names += ("accelerometer_noise_density", "accelerometer_random_walk")
    content["imu0"] = {name: getattr(noise, name) for name in names}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(content))
    write_imu(tmp_path / "imu.csv", recording.imus[0])
    return tmp_path


def test_the_command_calibrates(files, calibration):
    done = run(
        "--imu", files / "imu.csv", "--corners", files / "cam0.npz", files / "cam1.npz", "--config",
        files / "config.yaml", "--out", files / "out", "--spacing", "50", "--estimate-intrinsics", "--order=5",
        "--json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["command"] == "calibrate camera-imu"
    assert "T_imu_cam1 position x y z" in [row[0] for row in rows(calibration)]
    assert sorted(x.name for x in (files / "out").iterdir()) == sorted(FILES)
    content = json.loads((files / "out" / "result.json").read_text())
    assert report["T_imu_cam1"] == content["T_imu_cam1"]
    assert content["trajectory"]["spacing_s"] == 0.05
    assert len(content["intrinsics_cam1"]["sigma"]) == 8
    pose = torch.tensor(content["T_imu_cam1"]["translation"] + content["T_imu_cam1"]["quaternion"]).double()
    assert float((pose[:3] - calibration.cameras[1].T_imu_cam[:3]).norm()) < 0.01


def test_the_command_says_what_is_wrong(files):
    done = run("--imu", files / "imu.csv", "--corners", files / "cam0.npz", "--config", files / "config.yaml")
    assert done.returncode == 2
    assert "one section for each of the 1 files of cams" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--spacing=0", "spacing: expected a finite number above zero"),
        ("--start=-1", "start: expected seconds, zero or more"),
        ("--duration=0", "duration: expected seconds above zero"),
        ("--duration=0.2", "expected at least 20 images"),
    ],
)
def test_the_command_refuses_options(files, option, words, capsys):
    arguments = ["--imu", files / "imu.csv", "--corners", files / "cam0.npz", files / "cam1.npz"]
    options = ["--config", files / "config.yaml", option]
    assert cli.run(["calibrate", "camera-imu", *map(str, (*arguments, *options))]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.realdata
@pytest.mark.slow
def test_the_command_calibrates_a_real_recording(shared_data, tmp_path):
    real = shared_data / "camera_imu_april"
    done = run(
        "--imu", real / "imu0.csv.gz", "--corners", real / "cam0_corners.npz", real / "cam1_corners.npz", "--config",
        real / "config.yaml", "--out", tmp_path, "--start", "5", "--duration", "25",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "result.json").read_text())
    assert content["solver"]["converged"] is True
    chain = read_camchain(tmp_path / "camchain-imucam.yaml")
    # The pair is 11 cm wide and almost parallel.
    between = SE3.between(*chain.T_imu_cam)
    assert float(between[:3].norm()) == pytest.approx(0.110, abs=0.002)
    assert float(SO3.log(between[3:]).norm()) < math.radians(1.5)
    for i in range(2):
        assert content["residuals"][f"cam{i}"]["median_length"] < 0.5
        assert abs(content[f"time_offset_cam{i}"]["value"]) < 1e-3
    assert content["residuals"]["imu0 gyroscope"]["rms"] == pytest.approx([0.005] * 3, abs=0.004)


def test_biases_over_time_of_a_second_imu_with_a_clock_of_its_own():
    made = simulate(seconds=3.0, images=30, samples=300, cameras=1, order=5, spacing=0.1, seed=2).recording
    first = made.imus[0]
    second = ImuRecord(first.time_ns + 400_000_000, first.gyroscope, first.accelerometer, "second")
    both = replace(made, imus=(first, second), noise=made.noise * 2)
    found = calibrate(both, spacing=0.1, bias_spacing=1.5, reweigh=False)
    assert found.imus[1].time_offset == pytest.approx(0.4, abs=1e-3)
    for imu, record in zip(found.imus, both.imus, strict=True):
        low, high = imu.gyro_bias_spline.domain
        assert low <= int(record.time_ns[0]) < int(record.time_ns[-1]) <= high
        assert bool((imu.gyro_bias_sigma[1:-1] < 0.02).all())
