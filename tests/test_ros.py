"""Bags of ROS: every kind of message with poses, in every kind of bag, and bags that are not as they should be."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from torchspline import SE3
from torchspline.cli import run
from torchspline.io import ImuRecord, PoseRecord, read_imu, read_poses, write_rosbag
from torchspline.io.ros import MESSAGES

pytest.importorskip("rosbags.highlevel", reason="rosbags is not installed")

START, COUNT = 1_520_530_308_189_679_351, 6
POINTS = SE3.random(COUNT, generator=torch.Generator().manual_seed(5))
STAMPS = START + 50_000_000 * torch.arange(COUNT)
POSES = PoseRecord(STAMPS, POINTS[:, :3].contiguous(), POINTS[:, 3:].contiguous())
IMU = ImuRecord(STAMPS, POSES.position, POSES.position.flip(0).contiguous())
BAGS = ("x.bag", "x.mcap", "x.db3", "folder")


def same(found, expected):
    for column in ("time_ns", *expected._widths):
        assert torch.equal(getattr(found, column), getattr(expected, column))


@pytest.mark.parametrize("name", BAGS)
def test_every_message_in_every_bag(tmp_path, name):
    for message in MESSAGES:
        path = tmp_path / message / name
        path.parent.mkdir()
        write_rosbag(path, {"/a": POSES, "/imu": IMU}, message, parent="map", child="base_link")
        assert [x.name for x in path.parent.iterdir()] == [name]  # and no scratch
        found = read_poses(path)
        same(found, POSES)
        same(read_imu(path), IMU)
        with_child = message not in ("PoseStamped", "PoseWithCovarianceStamped")
        assert found.source.endswith("topic '/a', base_link in map" if with_child else "topic '/a'")
        if with_child:
            same(read_poses(path, child="base_link"), POSES)
        with pytest.raises(ValueError, match=r"expected the frame 'lidar' in one other, got .* in map"):
            read_poses(path, child="lidar")


def test_messages_say_what_is_not_known(tmp_path):
    """As ROS itself reads them: covariances, twists and orientations that nobody measured."""
    from rosbags.highlevel import AnyReader

    write_rosbag(tmp_path / "bag", {"/odom": POSES, "/imu": IMU}, "Odometry")
    with AnyReader([tmp_path / "bag"]) as reader:
        found = {c.topic: reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()}
    assert (found["/odom"].header.frame_id, found["/odom"].child_frame_id) == ("world", "body")
    assert found["/odom"].twist.covariance[0] == found["/imu"].orientation_covariance[0] == -1.0
    assert found["/odom"].pose.pose.position.x == POSES.position[-1, 0].item()
    assert found["/odom"].pose.pose.orientation.w == POSES.rotation[-1, 0].item()


@pytest.fixture
def bag(tmp_path):
    """Writes a bag with the package's own writer: topics with a kind and messages each."""
    from rosbags import rosbag2, typesys

    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)

    def make(**topics):
        path = tmp_path / "bag"
        shutil.rmtree(path, ignore_errors=True)
        with rosbag2.Writer(path, version=9) as writer:
            for topic, (kind, messages) in topics.items():
                connection = writer.add_connection(f"/{topic}", kind, typestore=store)
                for message in messages:
                    writer.write(connection, 1, store.serialize_cdr(message, kind))
        return path

    make.types = {name.split("/")[-1]: x for name, x in store.types.items()}
    return make


def stamped(types, sec, parent, child, x=0.0, q=(0.0, 0.0, 0.0, 1.0)):
    header = types["Header"](types["Time"](sec, 5), parent)
    pose = types["Transform"](types["Vector3"](x, 2.0, 3.0), types["Quaternion"](*q))
    return types["TransformStamped"](header, child, pose)


TREE, TRANSFORM = "tf2_msgs/msg/TFMessage", "geometry_msgs/msg/TransformStamped"


def test_a_tree_of_frames(bag):
    types = bag.types
    tree = types["TFMessage"]
    messages = [
        tree([stamped(types, t, "odom", "base", x=float(t)), stamped(types, t, "base", "lidar", x=-1.0)])
        for t in range(4)
    ]
    path = bag(tf=(TREE, messages))
    found = read_poses(path, child="base")
    assert found.time_ns.tolist() == [5 + t * 10**9 for t in range(4)]
    assert found.position[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0]
    with pytest.raises(
        ValueError, match=r"got base in odom, lidar in base; pass child=|got lidar in base, base"
    ):
        read_poses(path)
    # A pose topic goes before a tree, which has to be asked for.
    path = bag(tf=(TREE, messages), pose=(TRANSFORM, [stamped(types, 9, "map", "base")]))
    assert len(read_poses(path)) == 1
    assert len(read_poses(path, topic="/tf", child="lidar")) == 4
    # One frame in two others, which no name can tell apart.
    path = bag(tf=(TREE, [tree([stamped(types, 1, "odom", "base"), stamped(types, 1, "map", "base")])]))
    with pytest.raises(ValueError, match=r"the frame 'base' in one other, got base in map, base in odom$"):
        read_poses(path, child="base")


def test_bags_that_are_not_as_they_should_be(bag):
    types = bag.types
    whole = [stamped(types, t, "map", "base", x=float(t)) for t in (3, 1, 2)]
    backwards = read_poses(bag(a=(TRANSFORM, whole)))
    assert backwards.time_ns.tolist() == [3 * 10**9 + 5, 10**9 + 5, 2 * 10**9 + 5]  # as they are in the file
    lost = read_poses(bag(a=(TRANSFORM, [stamped(types, 1, "map", "base", x=float("nan"))])))
    assert bool(lost.position[0, 0].isnan())
    with pytest.raises(
        ValueError, match=r"topic '/a': expected quaternions that are not zero, got one in pose 1"
    ):
        read_poses(bag(a=(TRANSFORM, [whole[0], stamped(types, 1, "map", "base", q=(0.0,) * 4)])))
    with pytest.raises(ValueError, match=r"bag: expected poses in the topic '/a', got none"):
        read_poses(bag(a=(TRANSFORM, [])))
    path = bag(a=(TRANSFORM, whole), words=("std_msgs/msg/String", [types["String"]("hello")]))
    with pytest.raises(
        ValueError, match=r"expected the topic '/words' with poses .*, got /a .*, /words \(std_msgs"
    ):
        read_poses(path, topic="/words")
    with pytest.raises(
        ValueError, match=r"expected the topic '/b' with poses .*, got /a \(geometry_msgs/msg/Tr"
    ):
        read_poses(path, topic="/b")
    with pytest.raises(
        ValueError, match=r"expected one topic with IMU samples \(sensor_msgs/msg/Imu\), got /a"
    ):
        read_imu(path)
    with pytest.raises(ValueError, match=r"expected one topic with poses .*, got no topics"):
        read_poses(bag())
    database = next(path.glob("*.db3"))
    content = database.read_bytes()
    for cut in (0, 100, len(content) // 2):
        database.write_bytes(content[:cut])
        with pytest.raises(ValueError, match=r"bag: expected a ROS bag, got damaged data \(.*\)$"):
            read_poses(path, topic="/a")


def said(capsys, *words):
    status = run([str(word) for word in words])
    return status, capsys.readouterr()


@pytest.mark.parametrize("command", ["fit", "imu", "view", "info", "convert"])
def test_commands_choose_among_topics(tmp_path, command, capsys):
    from torchspline import use_kernels

    many = 80
    points = SE3.exp(0.1 * torch.arange(6 * many).reshape(many, 6).double().sin())
    record = PoseRecord(
        START + 20_000_000 * torch.arange(many), points[:, :3].contiguous(), points[:, 3:].contiguous()
    )
    path = tmp_path / "drive.mcap"
    write_rosbag(path, {"/odom": record, "/map": record})
    more = {
        "fit": ("--out", tmp_path / "m.npz", "--spacing", "100"),
        "imu": ("--out", tmp_path / "imu", "--spacing", "100"),
        "view": ("--out", tmp_path / "m.html", "--spacing", "100"),
        "info": (),
        "convert": (),
    }[command]
    words = (command, path, *((tmp_path / "out.txt",) if command == "convert" else ()), *more)
    with use_kernels("reference"):
        status, done = said(capsys, *words)
        assert status == 2
        assert "expected one topic with poses" in done.err
        assert (
            "/odom (geometry_msgs/msg/PoseStamped), /map (geometry_msgs/msg/PoseStamped); pass topic="
            in done.err
        )
        assert said(capsys, *words, "--topic", "/odom", "--json")[0] == 0


def test_a_recording_is_compared_from_the_same_bag(tmp_path, capsys):
    from torchspline import SplitBSpline, imu, use_kernels

    spline = SplitBSpline(
        SE3.exp(torch.randn(16, 6, generator=torch.Generator().manual_seed(2)).double() / 5), dt=0.2
    )
    t = torch.arange(120, dtype=torch.float64) / 50
    with use_kernels("reference"), torch.no_grad():
        motion, made = spline.kinematics(t), imu.measure(spline, t)
        stamps = START + (t * 1e9).round().long()
        poses = PoseRecord(stamps, motion.position, motion.rotation)
        samples = ImuRecord(stamps, made.gyroscope, made.accelerometer)
        write_rosbag(tmp_path / "x.bag", {"/pose": poses, "/imu": samples, "/other": samples})
        bag = tmp_path / "x.bag"
        words = (
            "imu",
            bag,
            "--recorded",
            bag,
            "--spacing",
            "200",
            "--order",
            "4",
            "--out",
            tmp_path / "out",
            "--json",
        )
        status, done = said(capsys, *words)
        assert (
            status,
            "/imu (sensor_msgs/msg/Imu), /other (sensor_msgs/msg/Imu); pass topic=" in done.err,
        ) == (2, True)
        status, done = said(capsys, *words, "--recorded-topic", "/imu")
    assert status == 0, done.err
    import json

    assert json.loads(done.out)["gyroscope_rmse_rad_s"] < 0.05


def test_names_of_bags(tmp_path):
    path = Path(tmp_path, "x.bag")
    write_rosbag(path, {"/a": POSES})
    assert path.is_file()
    with pytest.raises(FileExistsError, match=r"x.bag: expected a name that nothing has yet"):
        write_rosbag(path, {"/a": POSES})
    assert np.array_equal(read_poses(str(path)).position, POSES.position)
