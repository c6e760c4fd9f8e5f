"""BVH files: poses against matrices of Euler angles, and damaged files, each of which names its line."""

import gzip

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchspline import SE3
from torchspline.io import read_bvh

BVH = """HIERARCHY
ROOT hips
{
  OFFSET 1.0 2.0 3.0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT left knee
  {
    OFFSET 0.0 -40.0 1e0
    CHANNELS 3 Yrotation Zrotation Xrotation
    End Site
    {
      OFFSET 0 -10 0
    }
  }
  JOINT arm {
    OFFSET 5 5 5
    CHANNELS 4 xrotation ZPOSITION Zrotation Xposition
  }
}
MOTION
Frames: 3
Frame Time: 0.04
10 90 20 30 -20 170 5 10 -15 40 1 -50 2
11 91 21 31 -21 179 6 11 -16 41 2 -51 3
12 92 22 32 -22 188 7 12 -17 42 3 -52 4
"""
LINES = BVH.splitlines()


def matrix(position, sequence="", angles=()):
    T = np.eye(4)
    if sequence:
        T[:3, :3] = Rotation.from_euler(sequence, angles, degrees=True).as_matrix()
    T[:3, 3] = np.array(position) * 0.01
    return T


def written(tmp_path, content, name="motion.bvh"):
    path = tmp_path / name
    content = content if isinstance(content, bytes) else content.encode()
    path.write_bytes(gzip.compress(content) if name.endswith(".gz") else content)
    return path


def test_poses_against_matrices(tmp_path):
    skeleton = read_bvh(written(tmp_path, BVH))
    assert skeleton.names == ("hips", "left knee", "left knee end", "arm")
    assert skeleton.parents == (-1, 0, 1, 0)
    assert skeleton.channels[3] == ("xrotation", "ZPOSITION", "Zrotation", "Xposition")
    assert skeleton.channels[2] == ()
    assert torch.equal(skeleton.time, torch.tensor([0.0, 0.04, 0.08], dtype=torch.float64))
    poses = skeleton.poses()
    assert poses.shape == (4, 3, 7)
    for frame in range(3):
        row = [float(x) for x in LINES[22 + frame].split()]
        hips = matrix(row[:3], "ZXY", row[3:6])
        knee = hips @ matrix([0, -40, 1], "YZX", row[6:9])
        end = knee @ matrix([0, -10, 0])
        arm = hips @ matrix([row[12], 5, row[10]], "XZ", [row[9], row[11]])
        found = SE3.to_matrix(poses[:, frame]).numpy()
        assert np.abs(found - np.stack([hips, knee, end, arm])).max() < 1e-14
    neighbours = (poses[:, 1:, 3:] * poses[:, :-1, 3:]).sum(-1)
    assert (neighbours > 0.9).all()  # past 180 degrees quaternions do not jump


@pytest.mark.parametrize(
    "change",
    [
        lambda s: s.replace("\n", "\r\n"),
        lambda s: s.replace("  ", "\t"),
        lambda s: "\ufeff" + s.replace("\n", "\n\n"),
        lambda s: s.replace("End Site\n    {", "End Site {"),
        lambda s: s.replace("HIERARCHY", "Hierarchy").replace("Frame Time:", "frame time :"),
    ],
)
@pytest.mark.parametrize("name", ["motion.bvh", "motion.bvh.gz"])
def test_ways_of_writing_the_same(tmp_path, change, name):
    expected = read_bvh(written(tmp_path, BVH, "plain.bvh"))
    found = read_bvh(str(written(tmp_path, change(BVH), name)))
    assert found.names == expected.names
    assert torch.equal(found.values, expected.values)
    assert torch.equal(found.offsets, expected.offsets)


def test_unit(tmp_path):
    path = written(tmp_path, BVH)
    metres, inches = read_bvh(path, unit=1.0), read_bvh(path, unit=0.0254)
    torch.testing.assert_close(inches.poses()[..., :3], 0.0254 * metres.poses()[..., :3])
    torch.testing.assert_close(inches.poses()[..., 3:], metres.poses()[..., 3:])


def replaced(line, text):
    return "\n".join([*LINES[: line - 1], text, *LINES[line:]])


@pytest.mark.parametrize(
    ("content", "line", "message"),
    [
        ("", 0, "expected HIERARCHY, got the end of the file"),
        ("1 2 3\n", 1, "expected HIERARCHY, got '1 2 3'"),
        (replaced(2, "JOINT hips"), 2, "outside of joints, got 'JOINT hips'"),
        (replaced(2, "ROOT"), 2, "a joint with a name, got none"),
        (replaced(3, "OFFSET 1 2 3"), 3, "expected {, got 'OFFSET 1 2 3'"),
        (replaced(4, "OFFSET 1 2"), 4, "3 numbers (x, y, z of an offset), got 2: '1 2'"),
        (replaced(4, "OFFSET 1 2 x"), 4, "a finite number (x, y, z of an offset), got 'x'"),
        (replaced(4, "OFFSET 1 2 1_0"), 4, "a finite number (x, y, z of an offset), got '1_0'"),
        (replaced(4, "OFFSET 1 2 nan"), 4, "a finite number (x, y, z of an offset), got 'nan'"),
        (replaced(5, "CHANNELS 6 Xposition"), 5, "CHANNELS, how many, and as many names"),
        (replaced(5, "CHANNELS 1 Wrotation"), 5, "such as Xposition or Zrotation, got 'Wrotation'"),
        (replaced(9, "CHANNELS 3 Xrotation Yrotation xrotation"), 9, "different channels"),
        (replaced(5, "OFFSET 1 2 3"), 5, "inside 'hips', got 'OFFSET 1 2 3'"),
        (replaced(8, ""), 14, "expected an OFFSET in 'left knee', got none"),
        (replaced(19, ""), 20, "inside 'hips', got 'MOTION'"),
        (replaced(21, "Frames 3"), 21, "'Frames:' and how many frames, got 'Frames 3'"),
        (replaced(21, "Frames: 0"), 21, "a number of frames of at least 1, got 0"),
        (replaced(21, "Frames: 1.5"), 21, "a number of frames of at least 1, got 1.5"),
        (replaced(21, "Frames: 2"), 25, "the end of the file after 2 frames, got '12 92"),
        (replaced(21, "Frames: 1000000000000000"), 25, "1000000000000000 frames, 3 came, got the end of the file"),
        (replaced(22, "Frame Time: 0"), 22, "seconds above zero between frames, got 0"),
        (replaced(22, "Frame Time: inf"), 22, "a finite number (seconds between frames), got 'inf'"),
        (replaced(24, "1 2 3"), 24, "13 numbers (channels of frame 1), got 3: '1 2 3'"),
        (replaced(24, LINES[23].replace("21", "2x1")), 24, "(channels of frame 1), got '2x1'"),
        ("HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\n}\nMOTION\nFrames: 1\n", 6, "joints with CHANNELS, got none"),
        ("HIERARCHY\nMOTION\n", 2, "outside of joints, got 'MOTION'"),
        (b"\xff\xfe\x00\x01" * 30, 1, "expected HIERARCHY"),
        (b"HIERARCHY\n" + b"ROOT " + b"a" * (1 << 21), 2, "lines below 1048576 characters"),
    ],
)  # fmt: skip
def test_damaged_files_name_file_and_line(tmp_path, content, line, message):
    path = written(tmp_path, content)
    with pytest.raises(ValueError) as caught:
        read_bvh(path)
    assert str(caught.value).startswith(f"path: {path}, line {line}: expected ")
    assert message in str(caught.value)


def test_files_that_end_early_are_refused_wherever_they_end(tmp_path):
    for count in range(len(LINES)):
        with pytest.raises(ValueError, match=r"line \d+: expected .* got the end of the file"):
            read_bvh(written(tmp_path, "\n".join(LINES[:count])))


def test_damaged_gzip(tmp_path):
    path = written(tmp_path, BVH, "motion.bvh.gz")
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(ValueError, match="expected gzipped text, got damaged data"):
        read_bvh(path)


def test_deep_skeletons_need_no_recursion(tmp_path):
    depth = 3000
    chain = "".join(
        f"{'JOINT' if i else 'ROOT'} j{i}\n{{\nOFFSET 0 1 0\nCHANNELS 1 Xrotation\n" for i in range(depth)
    )
    text = f"HIERARCHY\n{chain}{'}' + chr(10)}" + "}\n" * (depth - 1)
    path = written(tmp_path, f"{text}MOTION\nFrames: 1\nFrame Time: 1\n{'0 ' * depth}\n")
    assert read_bvh(path).parents[-1] == depth - 2


@pytest.mark.realdata
def test_real_walk(shared_data):
    skeleton = read_bvh(shared_data / "mocap_bvh" / "walk.bvh.gz")
    poses = skeleton.poses()
    assert poses.shape == (11, 471, 7)
    assert abs(1 / skeleton.interval - 120) < 0.01
    bones = (poses[1:, :, :3] - poses[list(skeleton.parents[1:]), :, :3]).norm(dim=-1)
    assert (bones - bones[:, :1]).abs().max() < 1e-12
    toes = poses[[5, 10], :, 1]
    assert 0.0 < toes.min() < 0.06  # feet on the floor, y up
