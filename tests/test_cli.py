"""The command line, run as a user runs it."""

import io
import json
import math
import re
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

from torchspline import SE3, cli, imu
from torchspline.io import PoseRecord, read_imu, read_poses, write_poses

ROOT = Path(__file__).resolve().parent.parent


class Done(NamedTuple):
    """How a command ended and what it said."""

    returncode: int
    stdout: str
    stderr: str


def torchspline(*arguments: str | Path) -> Done:
    """In this process, which saves the time of starting another."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            status = cli.run([str(x) for x in arguments])
        except SystemExit as ended:  # --help
            status = int(ended.code or 0)
    return Done(status, out.getvalue(), err.getvalue())


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a demo, made by a process of its own."""
    out = tmp_path_factory.mktemp("demo")
    done = subprocess.run(
        [sys.executable, "-m", "torchspline.cli", "demo", "--out", out, "--duration", "5"],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert "check against the truth: passed" in done.stdout
    return out


def test_demo_writes_what_it_says(demo: Path) -> None:
    report = json.loads((demo / "report.json").read_text())
    assert report["passed"] is True
    assert 0 < report["gyroscope_rmse_rad_s"] < report["allowed"][0]
    assert (demo / "imu.png").stat().st_size > 10_000
    assert len(read_poses(demo / "poses.txt")) == pytest.approx(600, abs=2)
    made, truth = read_imu(demo / "imu.csv"), read_imu(demo / "imu_truth.csv")
    assert torch.equal(made.time_ns, truth.time_ns)
    rmse = (made.accelerometer - truth.accelerometer).square().mean().sqrt().item()
    assert rmse == pytest.approx(report["accelerometer_rmse_m_s2"], rel=1e-6)


def test_imu_of_the_demo_equals_its_truth(demo: Path, tmp_path: Path) -> None:
    done = torchspline(
        "imu", demo / "poses.txt", "--recorded", demo / "imu_truth.csv", "--rate", "100", "--spacing", "100",
        "--out", tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["gyroscope_rmse_rad_s"] < 0.006
    assert report["accelerometer_rmse_m_s2"] < 0.03
    assert max(map(abs, report["gyroscope_bias_rad_s"])) < 1e-3
    assert "accelerometer RMSE" in done.stdout
    stamps = read_imu(tmp_path / "imu.csv").time_ns
    assert (stamps.diff() - 10_000_000).abs().max() <= 1
    header, first, *_ = (tmp_path / "comparison.csv").read_text().splitlines()
    assert header.split(",")[:2] == ["timestamp_ns", "w_recorded_x"]
    assert len(first.split(",")) == 13
    assert re.fullmatch(r"[0-9]+", first.split(",")[0])


def test_gravity_and_a_gap(tmp_path: Path) -> None:
    """A body at rest in a world whose y axis points down, with a hole of half a second in its poses."""
    stamps = torch.arange(0, 4_000_000_000, 20_000_000)
    stamps = stamps[(stamps < 1_000_000_000) | (stamps > 1_500_000_000)]
    rest = SE3.identity(len(stamps))
    write_poses(tmp_path / "rest.txt", PoseRecord(stamps, rest[:, :3], rest[:, 3:], "rest"))
    for gap, notes in (("1000", 1), ("60", 0)):
        out = tmp_path / gap
        done = torchspline(
            "imu", tmp_path / "rest.txt", "--gravity", "[0, 9.80665, 0]", "--gap", gap, "--out", out
        )
        assert done.returncode == 0, done.stderr
        assert len(json.loads((out / "report.json").read_text())["fit"]["notes"]) == notes
        accelerometer = read_imu(out / "imu.csv").accelerometer
        expected = torch.tensor([0.0, -9.80665, 0.0], dtype=torch.float64)
        torch.testing.assert_close(accelerometer, expected.expand_as(accelerometer), atol=1e-6, rtol=0)


def test_kernels_show_prints_a_loop() -> None:
    done = torchspline(
        "kernels", "show", "SO3", "--order", "3", "--sweep", "reverse", "--precision", "float32"
    )
    assert done.returncode == 0, done.stderr
    compile(done.stdout, "shown", "exec")
    assert "def reverse_SO3_k3_d2_float32(" in done.stdout
    assert "real = np.float32" in done.stdout


def test_kernels_show_prints_a_triton_kernel() -> None:
    done = torchspline("kernels", "show", "SO3", "--order", "2", "--target", "triton")
    assert done.returncode == 0, done.stderr
    compile(done.stdout, "shown", "exec")
    assert "@triton.jit\ndef forward_SO3_k2_d2_float64(" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("imu", "nowhere.txt"), "nowhere.txt"),
        (("demo", "--duration", "1"), "duration: expected at least 2 s, got 1.0"),
        (("imu", "{poses}", "--rate", "0"), "rate: expected a finite number above zero (Hz), got 0.0"),
        (("imu", "{poses}", "--spacing", "-5"), "spacing: expected a number above zero (ms)"),
        (("imu", "{poses}", "--margin", "1e3"), "margin: nothing is left"),
        (("imu", "{poses}", "--start", "1e3"), "nothing is left of the longest stretch"),
        (("imu", "{poses}", "--recorded", "{early}"), "has no reading between"),
        (("imu", "{poses}", "--order", "1"), "order: expected a whole number of at least 2, got 1"),
        (("kernels", "show", "SO9"), "no group is called 'SO9'"),
    ],
)
def test_mistakes_are_explained(demo: Path, tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    early = tmp_path / "early.csv"
    early.write_text("#timestamp [ns],wx,wy,wz,ax,ay,az\n-9000000000,0,0,0,0,0,9.8\n")
    places = {"poses": demo / "poses.txt", "early": early}
    where = [] if arguments[0] == "kernels" else ["--out", tmp_path / "out"]
    done = torchspline(*(a.format(**places) for a in arguments), *where)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("poses", "recorded", "spacing", "gyroscope", "accelerometer"),
    [
        ("tum_vi/room1/mocap0", "tum_vi/room1/imu0", "80", 0.0304, 0.142),
        ("euroc/V1_02_medium/state_groundtruth_estimate0", "euroc/V1_02_medium/imu0", "20", 0.0277, 0.882),
    ],
)
def test_real_recordings(
    shared_data: Path,
    tmp_path: Path,
    poses: str,
    recorded: str,
    spacing: str,
    gyroscope: float,
    accelerometer: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No worse than 1.1 times a SciPy least-squares spline of the same order and spacing on the same window."""
    monkeypatch.setenv("TORCHSPLINE_KERNELS", "auto")  # as for users, and several times as fast
    done = torchspline(
        "imu", shared_data / poses, "--recorded", shared_data / recorded, "--rate", "200", "--duration", "60",
        "--spacing", spacing, "--out", tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["gyroscope_rmse_rad_s"] <= 1.1 * gyroscope
    assert report["accelerometer_rmse_m_s2"] <= 1.1 * accelerometer


@pytest.mark.realdata
def test_kitti_with_gravity_along_y(
    shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHSPLINE_KERNELS", "auto")
    done = torchspline(
        "imu", shared_data / "poses/kitti_00_gt.txt.gz", "--gravity", "[0, 9.80665, 0]", "--rate", "20",
        "--out", tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    mean = read_imu(tmp_path / "imu.csv").accelerometer.mean(0)
    assert mean[1] == pytest.approx(-9.8, abs=0.2)
    assert math.hypot(mean[0], mean[2]) < 0.5
    assert imu.STANDARD_GRAVITY[2] == -9.80665
