"""Files that other programs read and write, and the library's own: nothing is lost on the way."""

import json
import math
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from scipy.spatial.transform import Rotation
from torch import nn

import torchspline as ts
from torchspline.io import (
    ImuRecord,
    PoseRecord,
    load_trajectory,
    read_imu,
    read_nerfstudio,
    read_poses,
    save_trajectory,
    write_nerfstudio,
    write_poses,
    write_rosbag,
)
from torchspline.io.archive import write_arrays
from torchspline.io.trajectory import FAMILIES

F32, F64 = torch.float32, torch.float64
STAMP = 1520530308189679351


def points(count, group=ts.SE3, dtype=F64, seed=0):
    return group.random(count, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def poses(count, step=33_333_333, seed=0):
    p = points(count, seed=seed)
    return PoseRecord(STAMP + step * torch.arange(count), p[:, :3].contiguous(), p[:, 3:].contiguous())


# ---------------------------------------------------------------------- trajectory files


def hermite(**options):
    rates = torch.randn(2, 6, 6, generator=torch.Generator().manual_seed(1), dtype=F64)
    times = torch.tensor([0.0, 0.1, 0.5, 0.7, 1.1, 2.0], dtype=F64)
    return ts.HermiteSpline(points(6), *rates, group=ts.SE3, times=times, **options)


KNOTS = torch.tensor([0.0] * 3 + [0.1, 0.4, 0.7] + [1.1] * 3, dtype=F64)
TRAJECTORIES = {
    "BSpline": lambda: ts.BSpline(points(7), group=ts.SE3, order=5, dt=0.1, t0=math.pi, extrapolate="clamp"),
    "float32": lambda: ts.BSpline(
        points(5, ts.SO3, F32), group=ts.SO3, dt=0.1, learnable=False, validate=False
    ),
    "learnt times": lambda: ts.BSpline(
        points(5), group=ts.SE3, dt=nn.Parameter(torch.tensor(0.1, dtype=F64)), t0=1e9 / 3
    ),
    "nanoseconds": lambda: ts.BSpline(
        points(6, ts.product(ts.Rn(2), ts.SO2)),
        group=ts.product(ts.Rn(2), ts.SO2),
        dt_ns=10**7 + 1,
        t0_ns=STAMP,
    ),
    "batch": lambda: ts.SplitBSpline(points(12).reshape(2, 6, 7), dt=0.25),
    "NonuniformBSpline": lambda: ts.NonuniformBSpline(points(6, ts.SE2), group=ts.SE2, order=3, knots=KNOTS),
    "HermiteSpline": lambda: hermite(coordinates="logarithm", frame="world", extrapolate="linear"),
    "SQUAD": lambda: ts.KeyframeSpline(
        "SQUAD", points(6, ts.SO3), KNOTS[2:8] + torch.arange(6) * 0.1, way="signs"
    ),
    "options": lambda: ts.KeyframeSpline(
        "composite_bezier", points(6, ts.SO3), torch.arange(6.0, dtype=F64), group=ts.SO3, ends="clamped"
    ),
    "knots in nanoseconds": lambda: ts.NonuniformBSpline(
        points(6), group=ts.SE3, order=3, knots=STAMP + 10**8 * torch.arange(9)
    ),
    "keys in nanoseconds": lambda: ts.KeyframeSpline("SE3Up", points(6), STAMP + 10**8 * torch.arange(6)),
    "Mounted": lambda: hermite().mounted(points(1, seed=5)[0]).mounted(nn.Parameter(points(1, seed=6)[0])),
}


def times_of(trajectory):
    start, end = trajectory.domain
    if isinstance(start, int):
        return torch.arange(start, end, (end - start) // 50)
    return torch.linspace(start, end, 50, dtype=F64)


def test_every_family_is_saved():
    made = {type(make()).__name__ for make in TRAJECTORIES.values()}
    families = {
        name
        for name, x in vars(ts).items()
        if isinstance(x, type) and issubclass(x, ts.Trajectory) and x is not ts.Trajectory
    }
    assert families | {"Mounted"} == made == set(FAMILIES)


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_trajectories_come_back_bit_for_bit(tmp_path, name):
    made = TRAJECTORIES[name]()
    save_trajectory(tmp_path / "motion", made)
    found = load_trajectory(str(tmp_path / "motion"))
    assert type(found) is type(made)
    assert found.group == made.group
    assert found.domain == made.domain
    assert repr(found) == repr(made)
    state = made.state_dict()
    assert list(found.state_dict()) == list(state)
    for key, x in found.state_dict().items():
        assert x.dtype == state[key].dtype
        assert torch.equal(x, state[key])
    assert [k for k, _ in found.named_parameters()] == [k for k, _ in made.named_parameters()]
    for key in (
        "order",
        "extrapolate",
        "validate",
        "way",
        "method",
        "coordinates",
        "frame",
        "dt_ns",
        "t0_ns",
    ):
        assert getattr(found, key, None) == getattr(made, key, None)
    t = times_of(made)
    for a, b in zip(found.evaluate(t), made.evaluate(t), strict=True):
        assert a is b is None or torch.equal(a, b)


@given(
    st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=8, max_size=8),
    st.floats(1e-300, 1e300),
    st.floats(-1e300, 1e300),
)
@examples(30)
def test_any_float64_survives_in_a_trajectory(numbers, dt, t0):
    made = ts.BSpline(torch.tensor(numbers, dtype=F64).reshape(4, 2), group=ts.Rn(2), dt=dt, t0=t0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "x.npz")
        save_trajectory(path, made)
        found = load_trajectory(path)
    assert torch.equal(found.control_points.view(torch.int64), made.control_points.view(torch.int64))
    assert (found.dt.item(), found.t0.item()) == (dt, t0)


def with_header(tmp_path, **changes):
    save_trajectory(tmp_path / "good.npz", TRAJECTORIES["BSpline"]())
    arrays = dict(np.load(tmp_path / "good.npz", allow_pickle=False))
    header = {**json.loads(arrays["header"].tobytes()), **changes}
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    write_arrays(tmp_path / "bad.npz", arrays)
    return tmp_path / "bad.npz"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 2}, "version 2 where 1 is known"),
        ({"format": "x"}, "does not say 'torchspline trajectory'"),
        ({"family": "Module"}, "the family 'Module'"),
        ({"family": ["BSpline"]}, "the family"),
        ({"group": "R99999999999"}, "group: R99999999999 with points of 7 numbers"),
        ({"group": "SO3"}, r"control_points: expected shape \(..., M, 4\)"),
        ({"group": 3}, "group: '3'"),
        ({"order": 10**30}, "order: 1.000e"),
        ({"order": True}, "order: 'True'"),
        ({"order": 40}, "control_points: order 40 needs at least 40 control points"),
        ({"learnable": ["weights"]}, "learnable: "),
        ({"dt_ns": 5}, "expected dt_ns and no dt"),
    ],
)
def test_headers_that_are_wrong(tmp_path, changes, message):
    path = with_header(tmp_path, **changes)
    with pytest.raises(ValueError, match=rf"bad.npz: expected a torchspline trajectory, got .*{message}"):
        load_trajectory(path)


def test_archives_that_are_no_trajectory(tmp_path):
    path = tmp_path / "x.npz"
    np.savez(path, control_points=np.zeros(3))
    with pytest.raises(
        ValueError, match=r"x.npz: .*no header of a torchspline trajectory, only control_points"
    ):
        load_trajectory(path)
    np.savez(path, header=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match=r"x.npz: header: expected an array of plain numbers, got object"):
        load_trajectory(path)
    np.savez_compressed(path, header=np.zeros(2**25, np.uint8))  # 32 KiB that want to be 32 MiB
    with pytest.raises(ValueError, match=r"x.npz: .*more than such a file can hold"):
        load_trajectory(path)
    whole = with_header(tmp_path).read_bytes()
    for cut in (0, 10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(
            ValueError, match=r"x.npz: expected an npz archive of .*, got a damaged or truncated file"
        ):
            load_trajectory(path)
    flipped = bytearray(whole)
    flipped[len(whole) // 3] ^= 1
    path.write_bytes(flipped)
    with pytest.raises(ValueError, match="damaged or truncated"):
        load_trajectory(path)


def test_a_file_keeps_its_name_and_needs_a_known_family(tmp_path):
    save_trajectory(tmp_path / "motion.dat", TRAJECTORIES["BSpline"]())
    assert [path.name for path in tmp_path.iterdir()] == ["motion.dat"]

    class Mine(ts.BSpline):
        pass

    with pytest.raises(TypeError, match=r"trajectory: expected one of BSpline, .*, got Mine"):
        save_trajectory(tmp_path / "x", Mine(points(4), group=ts.SE3, dt=0.1))


# ---------------------------------------------------------------------- nerfstudio


@pytest.mark.parametrize("kind", ["camera_path", "transforms"])
@pytest.mark.parametrize("name", ["path.json", "path.json.gz"])
def test_nerfstudio_round_trip(tmp_path, kind, name):
    import gzip

    record = poses(20, step=40_000_000)
    write_nerfstudio(tmp_path / "path.json", record, kind, field_of_view=60.0, resolution=(640, 480))
    if name.endswith(".gz"):
        (tmp_path / name).write_bytes(gzip.compress((tmp_path / "path.json").read_bytes()))
    found = read_nerfstudio(tmp_path / name)
    assert torch.equal(found.time_ns, record.time_ns - STAMP)
    torch.testing.assert_close(found.position, record.position, rtol=0, atol=0)
    turn = ts.SO3.log(ts.SO3.between(found.rotation, record.rotation))
    assert turn.abs().max() < 1e-14
    assert torch.equal(read_nerfstudio(tmp_path / name, fps=1.0).time_ns, torch.arange(20) * 10**9)


def test_nerfstudio_files_hold_cameras_as_nerfstudio_means_them(tmp_path):
    """A camera at (1, 2, 3) that looks along the world's +x with the world's z up."""
    looking = Rotation.from_matrix(
        [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    ).as_quat()  # columns: right, down, forward
    record = PoseRecord(
        torch.tensor([0]),
        torch.tensor([[1.0, 2.0, 3.0]], dtype=F64),
        torch.from_numpy(looking[None, [3, 0, 1, 2]]),
    )
    write_nerfstudio(tmp_path / "t.json", record, "transforms", field_of_view=90.0, resolution=(640, 480))
    content = json.loads((tmp_path / "t.json").read_text())
    right, up, back, place = np.array(content["frames"][0]["transform_matrix"])[:3].T
    np.testing.assert_allclose(right, [0, -1, 0], atol=1e-15)
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(back, [-1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(place, [1, 2, 3])
    assert content["fl_x"] == content["fl_y"] == pytest.approx(240.0)
    assert (content["w"], content["h"], content["cx"], content["cy"]) == (640, 480, 320, 240)
    write_nerfstudio(tmp_path / "c.json", record, field_of_view=90.0, resolution=(640, 480))
    content = json.loads((tmp_path / "c.json").read_text())
    (camera,) = content["camera_path"]
    np.testing.assert_allclose(np.reshape(camera["camera_to_world"], (4, 4))[:3].T, [right, up, back, place])
    assert (camera["fov"], camera["aspect"], content["render_width"], content["fps"]) == (
        90.0,
        640 / 480,
        640,
        1.0,
    )


IDENTITY = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
FLAT = [x for row in IDENTITY for x in row]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "expected JSON, got"),
        ("[1]", "expected an object with frames or camera_path, got a list of 1 entries"),
        ({"frames": []}, "expected a list of frames or camera_path that is not empty"),
        ({"frames": [3]}, r"frames\[0\]: expected transform_matrix in it, got 3"),
        ({"frames": [{"transform_matrix": IDENTITY}]}, "expected a time in every frame.*pass fps="),
        (
            {"frames": [{"transform_matrix": [1], "time": 0}]},
            r"frames\[0\].transform_matrix: expected 4 x 4 numbers",
        ),
        (
            {"frames": [{"transform_matrix": IDENTITY, "time": None}]},
            r"frames\[0\].time: expected a finite number",
        ),
        (
            {"frames": [{"transform_matrix": [[2, 0, 0, 0], *IDENTITY[1:]], "time": 0}]},
            r"expected a rotation",
        ),
        (
            {"frames": [{"transform_matrix": [[-1, 0, 0, 0], *IDENTITY[1:]], "time": 0}]},
            r"expected a rotation",
        ),
        (
            {"frames": [{"transform_matrix": [[math.nan] * 4, *IDENTITY[1:]], "time": 0}]},
            "expected finite numbers",
        ),
        ({"frames": [{"transform_matrix": IDENTITY, "time": 1e300}]}, "within the range of int64"),
        ({"fps": 0, "camera_path": [{"camera_to_world": FLAT}]}, "fps: expected a number above zero"),
        ({"camera_path": [{"camera_to_world": FLAT}]}, "fps: expected a finite number, got None"),
    ],
)
def test_nerfstudio_files_that_are_wrong(tmp_path, content, message):
    path = tmp_path / "x.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(ValueError, match=rf"x.json: .*{message}"):
        read_nerfstudio(path)


def test_a_video_needs_even_stamps(tmp_path):
    record = poses(5, step=10**8)
    stamps = record.time_ns + torch.tensor([0, 0, 10**6, 0, 0])
    uneven = PoseRecord(stamps, record.position, record.rotation)
    with pytest.raises(ValueError, match=r"record: expected evenly spaced stamps, .*off by 0.001 s at row 2"):
        write_nerfstudio(tmp_path / "x.json", uneven)
    write_nerfstudio(tmp_path / "x.json", uneven, "transforms")
    assert torch.equal(read_nerfstudio(tmp_path / "x.json").time_ns, stamps - STAMP)


# ---------------------------------------------------------------------- ROS


def samples(count=5):
    values = torch.randn(2, count, 3, generator=torch.Generator().manual_seed(3), dtype=F64)
    return ImuRecord(STAMP + 5_000_001 * torch.arange(count), *values)


def test_rosbag_round_trip(tmp_path):
    pytest.importorskip("rosbags.highlevel")
    record, imu = poses(8), samples()
    write_rosbag(tmp_path / "bag", {"/imu": imu, "/pose": record, "/again": record})
    for path in (tmp_path / "bag", tmp_path / "bag" / "bag.mcap"):
        found = read_imu(path)
        assert torch.equal(found.time_ns, imu.time_ns)
        assert torch.equal(found.gyroscope, imu.gyroscope)
        assert torch.equal(found.accelerometer, imu.accelerometer)
        pose = read_poses(path, topic="/again")
        assert torch.equal(pose.time_ns, record.time_ns)
        assert torch.equal(pose.position, record.position)
        assert torch.equal(pose.rotation, record.rotation)
    with pytest.raises(ValueError, match=r"bag: expected one topic with poses .*/again .*; pass topic="):
        read_poses(tmp_path / "bag")
    with pytest.raises(ValueError, match=r"bag: expected the topic '/pose' with IMU samples .*, got /imu"):
        read_imu(tmp_path / "bag", topic="/pose")
    with pytest.raises(FileExistsError, match="expected a name that nothing has yet"):
        write_rosbag(tmp_path / "bag", {"/imu": imu})


@pytest.mark.parametrize("store", ["ROS1_NOETIC", "ROS2_HUMBLE"])
def test_bags_that_others_write_are_read(tmp_path, store):
    """Odometry and transforms, in ROS 1 and in SQLite of ROS 2, written with the package's own writers."""
    pytest.importorskip("rosbags.highlevel")
    from rosbags import rosbag1, rosbag2, typesys

    types = typesys.get_typestore(typesys.Stores[store])
    make = {name.split("/")[-1]: x for name, x in types.types.items() if name != "std_msgs/msg/Time"}
    first = store == "ROS1_NOETIC"
    header = make["Header"](*([7] if first else []), make["Time"](STAMP // 10**9, STAMP % 10**9), "odom")
    q, zero = make["Quaternion"](0.0, 0.0, 0.6, 0.8), make["Vector3"](0.0, 0.0, 0.0)
    pose = make["PoseWithCovariance"](make["Pose"](make["Point"](1.0, 2.0, 3.0), q), np.zeros(36))
    twist = make["TwistWithCovariance"](make["Twist"](zero, zero), np.zeros(36))
    messages = {
        "nav_msgs/msg/Odometry": make["Odometry"](header, "base", pose, twist),
        "geometry_msgs/msg/TransformStamped": make["TransformStamped"](
            header, "base", make["Transform"](make["Vector3"](1.0, 2.0, 3.0), q)
        ),
    }
    path = tmp_path / ("x.bag" if first else "x")
    with rosbag1.Writer(path) if first else rosbag2.Writer(path, version=8) as writer:
        for kind, message in messages.items():
            connection = writer.add_connection("/" + kind.split("/")[-1], kind, typestore=types)
            raw = types.serialize_ros1(message, kind) if first else types.serialize_cdr(message, kind)
            writer.write(connection, 17, raw)
    for kind in messages:
        record = read_poses(path, topic="/" + kind.split("/")[-1])
        assert record.time_ns.tolist() == [STAMP]
        assert record.position.tolist() == [[1.0, 2.0, 3.0]]
        assert record.rotation.tolist() == [[0.8, 0.0, 0.0, 0.6]]


def test_bags_without_the_package_say_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "x.mcap").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(ImportError, match=r"pip install 'torchspline\[ros\]'"):
        read_imu(tmp_path / "x.mcap")


def test_damaged_bags(tmp_path):
    pytest.importorskip("rosbags.highlevel")
    for content in (b"", b"\x89MCAP0\r\n" + bytes(50), b"no bag"):
        for name in ("x.mcap", "x.db3", "x.bag"):
            (tmp_path / name).write_bytes(content)
            with pytest.raises(ValueError, match=rf"{name}: expected a ROS bag, got damaged data"):
                read_imu(tmp_path / name)


# ---------------------------------------------------------------------- other libraries


def test_tum_files_are_what_evo_reads(tmp_path):
    """evo takes lines of eight numbers between single spaces, comments with #, quaternions xyzw, seconds."""
    record = poses(6)
    write_poses(tmp_path / "poses.txt", record)
    lines = [x for x in (tmp_path / "poses.txt").read_text().split("\n") if x and not x.startswith("#")]
    rows = np.array([[float(x) for x in line.split(" ")] for line in lines])
    assert rows.shape == (6, 8)
    np.testing.assert_allclose(
        rows[:, 0], record.time_ns.numpy() / 1e9, rtol=0, atol=3e-7
    )  # a float64's worth
    np.testing.assert_array_equal(rows[:, 4:], record.rotation[:, [1, 2, 3, 0]].numpy())
    file_interface = pytest.importorskip("evo.tools.file_interface")
    found = file_interface.read_tum_trajectory_file(tmp_path / "poses.txt")
    np.testing.assert_array_equal(found.positions_xyz, record.position.numpy())
    np.testing.assert_array_equal(found.orientations_quat_wxyz, record.rotation.numpy())
    assert found.check()[0]
    file_interface.write_tum_trajectory_file(tmp_path / "evo.txt", found)
    assert read_poses(tmp_path / "evo.txt").rotation.sub(record.rotation).abs().max() < 1e-9


def test_quaternions_are_those_of_roma_and_back():
    roma = pytest.importorskip("roma")
    q = points(50, ts.SO3)
    xyzw = ts.convert.to_xyzw(q)
    torch.testing.assert_close(roma.unitquat_to_rotmat(xyzw), ts.SO3.to_matrix(q))
    torch.testing.assert_close(roma.unitquat_to_rotvec(xyzw), ts.SO3.log(q))
    assert torch.equal(ts.convert.from_xyzw(xyzw), q)
    product = roma.quat_product(xyzw, xyzw.flip(0))
    torch.testing.assert_close(ts.convert.from_xyzw(product), ts.SO3.compose(q, q.flip(0)))
