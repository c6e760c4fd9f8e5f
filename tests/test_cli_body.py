"""`torchspline body`: files that equal what the functions give, and mistakes explained."""

import json
import sys

import pytest
import torch
from test_bvh import BVH

from torchspline import cli, imu
from torchspline.io import read_bvh, read_imu
from torchspline.people import fit_body


def command(monkeypatch, *arguments):
    """The exit status of a call."""
    monkeypatch.setattr(sys, "argv", ["torchspline", *map(str, arguments)])
    with pytest.raises(SystemExit) as caught:
        cli.main()
    return caught.value.code


@pytest.fixture
def walk(tmp_path):
    """A file with the skeleton of the tests of BVH and two seconds of motion."""
    t = torch.arange(0.0, 2.0, 0.04, dtype=torch.float64)
    waves = torch.sin(t[:, None] * 3.0 + torch.arange(13)) * torch.tensor([9.0, 3, 20, *[25.0] * 7, 1, 20, 1])
    rows = "\n".join(" ".join(f"{x:.9f}" for x in row) for row in waves.tolist())
    head = BVH[: BVH.index("Frames:")]
    path = tmp_path / "walk.bvh"
    path.write_text(f"{head}Frames: {len(t)}\nFrame Time: 0.04\n{rows}\n")
    return path


def test_files_are_what_the_functions_give(walk, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    options = ("--rate", 100, "--bandwidth", 4, "--gravity", "[0,0,-9.81]", "--out", out)
    assert command(monkeypatch, "body", walk, *options) == 0
    assert "% are kept" in capsys.readouterr().out
    report = json.loads((out / "report.json").read_text())
    assert list(report["joints"]) == ["hips", "left knee", "left knee end", "arm"]
    record = read_imu(out / report["joints"]["left knee"]["file"])
    assert record.time_ns[:2].tolist() == [200_000_000, 210_000_000]
    skeleton = read_bvh(walk)
    body = fit_body(skeleton.time, skeleton.poses(), bandwidth=4.0)
    made = imu.measure(body, record.time_ns * 1e-9, gravity=(0.0, 0.0, -9.81))
    torch.testing.assert_close(record.accelerometer, made.accelerometer[1].detach(), rtol=0, atol=1e-5)
    torch.testing.assert_close(record.gyroscope, made.gyroscope[1].detach(), rtol=0, atol=1e-5)
    assert report["acceleration_kept_at_half_and_full_bandwidth"][1] > 0.99
    assert (out / "imu.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--rate", "0"), "rate: expected a finite number above zero (Hz), got 0.0"),
        (("--margin", "-1"), "margin: expected seconds, zero or more, got -1.0"),
        (("--margin", "1"), "margin: nothing is left"),
        (("--bandwidth", "20"), "bandwidth: expected at most"),
        (("--unit", "0"), "unit: expected a finite number above zero"),
        (("--rate", "1e12"), "more than 1e9 readings"),
    ],
)
def test_mistakes_are_explained(walk, tmp_path, monkeypatch, capsys, arguments, message):
    assert command(monkeypatch, "body", walk, "--out", tmp_path / "out", *arguments) == 2
    assert message in capsys.readouterr().err
