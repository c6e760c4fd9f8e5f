"""What is written is what evo, the usual tool for evaluating trajectories, reads; and the other way round."""

import numpy as np
import pytest
import torch

from torchspline import SE3, SO3
from torchspline.io import PoseRecord, read_poses, write_poses, write_rosbag

interface = pytest.importorskip("evo.tools.file_interface", reason="evo is not installed")

COUNT = 30
POINTS = SE3.random(COUNT, generator=torch.Generator().manual_seed(8))
POSES = PoseRecord(
    1_403_715_523_912_143_104 + 50_000_000 * torch.arange(COUNT),
    POINTS[:, :3].contiguous(),
    POINTS[:, 3:].contiguous(),
)


def agrees(theirs, stamped=True):
    """evo keeps seconds in float64: stamps agree to their rounding, a quarter of a microsecond."""
    np.testing.assert_array_equal(theirs.positions_xyz, POSES.position)
    wxyz = torch.from_numpy(np.asarray(theirs.orientations_quat_wxyz))
    assert SO3.log(SO3.between(wxyz, POSES.rotation)).abs().max() < 1e-14
    if stamped:
        assert np.abs(theirs.timestamps - POSES.time_ns.numpy() / 1e9).max() < 2.5e-7


def test_evo_reads_what_is_written(tmp_path):
    write_poses(tmp_path / "p.txt", POSES)
    agrees(interface.read_tum_trajectory_file(tmp_path / "p.txt"))
    write_poses(tmp_path / "p.csv", POSES, "euroc")
    agrees(interface.read_euroc_csv_trajectory(tmp_path / "p.csv"))
    write_poses(tmp_path / "poses.txt", POSES, "kitti")
    agrees(interface.read_kitti_poses_file(tmp_path / "poses.txt"), stamped=False)


def test_evo_reads_our_bags(tmp_path):
    pytest.importorskip("rosbags.highlevel")
    from rosbags import rosbag1, rosbag2

    for message in ("PoseStamped", "TransformStamped", "Odometry", "PoseWithCovarianceStamped"):
        for name, kind in ((message, rosbag2.Reader), (f"{message}.bag", rosbag1.Reader)):
            write_rosbag(tmp_path / name, {"/pose": POSES}, message)
            with kind(tmp_path / name) as reader:
                agrees(interface.read_bag_trajectory(reader, "/pose"))


def test_what_evo_writes_is_read(tmp_path):
    write_poses(tmp_path / "p.txt", POSES)
    theirs = interface.read_tum_trajectory_file(tmp_path / "p.txt")
    interface.write_tum_trajectory_file(tmp_path / "evo.txt", theirs)
    found = read_poses(tmp_path / "evo.txt")
    assert (found.time_ns - POSES.time_ns).abs().max() < 1000
    torch.testing.assert_close(found.position, POSES.position, rtol=0, atol=1e-6)
    interface.write_kitti_poses_file(tmp_path / "evo_gt.txt", theirs)
    write_poses(tmp_path / "unused.txt", POSES, "kitti", times=tmp_path / "evo_times.txt")
    found = read_poses(tmp_path / "evo_gt.txt")
    assert torch.equal(found.time_ns, POSES.time_ns)
    assert SO3.log(SO3.between(found.rotation, POSES.rotation)).abs().max() < 1e-6
