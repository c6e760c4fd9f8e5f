"""`torchspline convert`: every format that is read into every format that is written, and what is refused."""

import io
import json
import sys
from pathlib import Path

import pytest
import torch
from test_cli import torchspline

from torchspline import SE3, SO3, SplitBSpline, use_kernels
from torchspline.cli.files import open_record
from torchspline.io import (
    ImuRecord,
    PoseRecord,
    load_trajectory,
    read_poses,
    save_trajectory,
    write_imu,
    write_poses,
)

START, STEP, COUNT = 1_520_530_308_189_679_351, 50_000_000, 12
POINTS = SE3.random(COUNT, generator=torch.Generator().manual_seed(3))
STAMPS = START + STEP * torch.arange(COUNT)
POSES = PoseRecord(STAMPS, POINTS[:, :3].contiguous(), POINTS[:, 3:].contiguous())
IMU = ImuRecord(STAMPS, POSES.position, POSES.position.flip(0).contiguous())
#: Of what is written: the name of the file, whether stamps start at zero, and what is lost of quaternions: nothing, or
#: sign and rounding on the way through matrices.
POSE_FORMATS = {
    "TUM": ("p.txt", False, 0.0),
    "gzipped": ("p.tum.gz", False, 0.0),
    "EuRoC": ("p.csv", False, 0.0),
    "KITTI": ("kitti/poses.txt", False, 1e-14),
    "camera path": ("c.json", True, 1e-14),
    "data set": ("transforms.json", True, 1e-14),
    "ROS 1": ("p.bag", False, 0.0),
    "ROS 2, folder": ("bag", False, 0.0),
    "ROS 2, MCAP": ("p.mcap", False, 0.0),
    "ROS 2, SQLite": ("p.db3", False, 0.0),
}
IMU_FORMATS = ("i.csv", "i.csv.gz", "i.bag", "i.mcap", "i.db3")
BVH = """HIERARCHY
ROOT hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT head
  {
    OFFSET 0 50 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 10 0
    }
  }
}
MOTION
Frames: 3
Frame Time: 0.05
100 0 0 0 0 0 0 0 0
100 1 0 90 0 0 0 0 0
100 2 0 0 0 0 90 0 0
"""


@pytest.fixture(autouse=True)
def reference():
    with use_kernels("reference"):
        yield


def options(name: str) -> list[str]:
    if name.endswith("kitti/poses.txt"):
        return ["--to", "kitti"]
    return ["--to", "ros"] if name.endswith("bag") else []


def convert(source, target, *more):
    Path(target).parent.mkdir(exist_ok=True)
    done = torchspline("convert", source, target, *options(str(target)), *more, "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    for file in report["files"]:
        assert Path(file).exists()
    return report


def turn(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(SO3.log(SO3.between(a, b)).detach().abs().max())


@pytest.mark.parametrize("source", POSE_FORMATS)
def test_poses_between_all_formats(source, tmp_path):
    """From a text file through every format into every other, and back to numbers."""
    if "ROS" in source:
        pytest.importorskip("rosbags.highlevel")
    write_poses(tmp_path / "original.txt", POSES)
    name, source_shifts, source_loss = POSE_FORMATS[source]
    convert(tmp_path / "original.txt", tmp_path / name)
    for target, (other, target_shifts, target_loss) in POSE_FORMATS.items():
        if "ROS" in target and "rosbags" not in sys.modules:
            continue
        folder = tmp_path / "out"
        if target != source:
            report = convert(tmp_path / name, folder / other)
            assert (report["rows"], report["kind"]) == (COUNT, "poses")
        found = open_record(folder / other if target != source else tmp_path / name)
        shift = START if source_shifts or (target_shifts and target != source) else 0
        assert torch.equal(found.time_ns, STAMPS - shift), target
        assert torch.equal(found.position, POSES.position), target
        loss = source_loss + (target_loss if target != source else 0.0)
        assert loss or torch.equal(found.rotation, POSES.rotation), target
        assert turn(found.rotation, POSES.rotation) <= loss + 1e-15, target


@pytest.mark.parametrize("source", IMU_FORMATS)
def test_imu_readings_between_all_formats(source, tmp_path):
    pytest.importorskip("rosbags.highlevel")
    write_imu(tmp_path / "original.csv", IMU)
    convert(tmp_path / "original.csv", tmp_path / source)
    for target in IMU_FORMATS:
        report = convert(tmp_path / source, tmp_path / "out" / target)
        assert (report["rows"], report["kind"]) == (COUNT, "IMU readings")
        found = open_record(tmp_path / "out" / target)
        for column in ("time_ns", "gyroscope", "accelerometer"):
            assert torch.equal(getattr(found, column), getattr(IMU, column)), (target, column)
    done = torchspline("convert", tmp_path / source, tmp_path / "x.txt")
    assert done.returncode == 2
    assert "to: expected one of euroc, ros, rerun for IMU readings" in done.stderr


def test_trajectories_and_motion_capture_into_all_formats(tmp_path):
    """What is only read: a saved trajectory, sampled, and a joint of a skeleton."""
    spline = SplitBSpline(POINTS, order=4, dt_ns=100_000_000, t0_ns=START)
    save_trajectory(tmp_path / "motion.npz", spline)
    (tmp_path / "walk.bvh").write_text(BVH)
    t = START + 50_000_000 * torch.arange(19)
    exact = load_trajectory(tmp_path / "motion.npz").kinematics(t)
    for name, shifts, _ in POSE_FORMATS.values():
        if name.endswith(("bag", "mcap", "db3")):
            pytest.importorskip("rosbags.highlevel")
        convert(tmp_path / "motion.npz", tmp_path / "out" / name, "--rate", "20")
        found = open_record(tmp_path / "out" / name)
        assert torch.equal(found.time_ns, t - START if shifts else t)
        torch.testing.assert_close(found.position, exact.position.detach(), rtol=0, atol=0)
        assert turn(found.rotation, exact.rotation) < 1e-14
        convert(tmp_path / "walk.bvh", tmp_path / "head" / name, "--joint", "head")
        found = open_record(tmp_path / "head" / name)
        assert found.time_ns.tolist() == [0, STEP, 2 * STEP]
        half = 0.5**0.5
        expected = torch.tensor([[1.0, 0.5, 0.0], [0.5, 0.01, 0.0], [1.0, 0.52, 0.0]], dtype=torch.float64)
        torch.testing.assert_close(found.position, expected, rtol=0, atol=1e-15)
        rotation = torch.tensor([[1.0, 0, 0, 0], [half, 0, 0, half], [half, 0, 0, half]], dtype=torch.float64)
        assert turn(found.rotation, rotation.expand_as(found.rotation)) < 1e-14
    convert(tmp_path / "walk.bvh", tmp_path / "inches.txt", "--unit", "0.0254")
    assert read_poses(tmp_path / "inches.txt").position[1].tolist() == pytest.approx([2.54, 0.0254, 0.0])


def test_kitti_writes_stamps_beside_the_poses(tmp_path):
    write_poses(tmp_path / "original.txt", POSES)
    for name, times in (
        ("poses.txt", "times.txt"), ("00_gt.txt", "00_times.txt"), ("00.txt", "00_times.txt"),
        ("x.txt.gz", "x_times.txt.gz"),
    ):  # fmt: skip
        report = convert(tmp_path / "original.txt", tmp_path / name, "--to", "kitti")
        assert report["files"] == [str(tmp_path / name), str(tmp_path / times)]
        assert torch.equal(read_poses(tmp_path / name).time_ns, STAMPS)
    row = (tmp_path / "poses.txt").read_text().splitlines()[2].split()
    assert len(row) == 12
    matrix = torch.tensor([float(x) for x in row], dtype=torch.float64).reshape(3, 4)
    assert torch.equal(matrix[:, 3], POSES.position[2])
    torch.testing.assert_close(matrix[:, :3], SO3.to_matrix(POSES.rotation[2]), rtol=0, atol=1e-15)
    assert (tmp_path / "times.txt").read_text().splitlines()[2] == "1520530308.289679351"
    write_poses(tmp_path / "here.txt", POSES, "kitti", times=tmp_path / "there.txt")
    assert torch.equal(read_poses(tmp_path / "here.txt", times=tmp_path / "there.txt").time_ns, STAMPS)
    lost = PoseRecord(STAMPS, POSES.position.clone(), POSES.rotation.clone())
    lost.rotation[3] = float("nan")
    write_poses(tmp_path / "lost_gt.txt", lost, "kitti")
    assert read_poses(tmp_path / "lost_gt.txt").rotation.isnan().all(-1).nonzero().tolist() == [[3]]


def test_what_is_packed_alike_belongs_together(tmp_path):
    """Stamps that an earlier run left behind, not gzipped, are not taken for those of gzipped poses."""
    write_poses(tmp_path / "a_gt.txt", POSES, "kitti")
    late = PoseRecord(STAMPS + 5, POSES.position, POSES.rotation)
    write_poses(tmp_path / "a_gt.txt.gz", late, "kitti")
    assert torch.equal(read_poses(tmp_path / "a_gt.txt.gz").time_ns, STAMPS + 5)
    assert torch.equal(read_poses(tmp_path / "a_gt.txt").time_ns, STAMPS)


class Piped(io.StringIO):
    def __init__(self, content: bytes) -> None:
        super().__init__()
        self.buffer = io.BytesIO(content)


def test_standard_input_and_output(tmp_path, monkeypatch):
    write_poses(tmp_path / "p.txt", POSES)
    content = (tmp_path / "p.txt").read_bytes()
    monkeypatch.setattr(sys, "stdin", Piped(content))
    done = torchspline("convert", "-", "-", "--to", "euroc", "--json")
    assert done.returncode == 0, done.stderr
    (tmp_path / "p.csv").write_text(done.stdout)
    assert torch.equal(read_poses(tmp_path / "p.csv").rotation, POSES.rotation)
    assert json.loads(done.stderr)["rows"] == COUNT
    monkeypatch.setattr(sys, "stdin", Piped(content.replace(b" ", b" x", 20)))
    done = torchspline("info", "-")
    assert done.returncode == 2
    assert "standard input, line 2: expected" in done.stderr
    for words, message in (
        (("convert", tmp_path / "p.txt", "-"), "to: expected tum"),
        (
            ("convert", tmp_path / "p.txt", "-", "--to", "kitti"),
            "target: expected the name of a file for kitti",
        ),
        (("fit", "-"), "out: expected a name for the result"),
    ):
        monkeypatch.setattr(sys, "stdin", Piped(content))
        done = torchspline(*words)
        assert done.returncode == 2
        assert message in done.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("{p}", "{o}/x.npz"), "torchspline fit --out"),
        (("{p}", "{p}"), "target: expected another file"),
        (("{o}/times.txt", "{o}/poses.txt", "--to", "kitti"), "target: expected another file"),
        (("{p}", "{o}/x.txt", "--joint", "head"), "joint: expected none"),
        (("{p}", "{o}/x.txt", "--fps", "30"), "fps: expected none"),
        (("{p}", "{o}/x.txt", "--topic", "/a"), "topic: expected none"),
        (("{p}", "{o}/x.txt", "--child", "a"), "child: expected none"),
        (("{b}", "{o}/x.txt", "--joint", "tail"), "joint: expected one of hips, head, head end, got 'tail'"),
        (("{b}", "{o}/x.txt", "--topic", "/a"), "topic: expected none"),
        (("{b}", "{o}/x.txt", "--times", "t.txt"), "times: expected none"),
        (("{u}", "{o}/x.json"), "write transforms.json"),
        (("{p}", "{o}/none/x.txt"), "the folder"),
        (("{p}", "{o}"), "to: expected tum"),
        (("{p}", "{o}", "--to", "tum"), "expected the name of a file, got a folder"),
    ],
)  # fmt: skip
def test_mistakes(tmp_path, words, message):
    for name in ("p.txt", "times.txt"):
        write_poses(tmp_path / name, POSES)
    uneven = PoseRecord(STAMPS + torch.arange(COUNT) ** 5, POSES.position, POSES.rotation)
    write_poses(tmp_path / "u.txt", uneven)
    (tmp_path / "b.bvh").write_text(BVH)
    places = {"p": tmp_path / "p.txt", "b": tmp_path / "b.bvh", "u": tmp_path / "u.txt", "o": tmp_path}
    before = sorted(tmp_path.iterdir())
    done = torchspline("convert", *(word.format(**places) for word in words))
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert message in line
    assert sorted(tmp_path.iterdir()) == before
