"""Every reader of the library, with valid files to damage."""

import gzip
import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

import torchspline as ts
from fuzzing.watch import Sample
from torchspline import generate, io
from torchspline.calibrate import read_corners, read_recording
from torchspline.generate.shards import MANIFEST
from torchspline.robot import Robot

_STAMP, _STEP = 1_520_530_308_189_679_351, 5_000_000
_ROWS = 12


class Reader(NamedTuple):
    read: Callable[[Path], Any]
    samples: list[Sample]


def readers(seed: int) -> dict[str, Reader]:
    """By name. Those of ROS bags and MJCF only where the packages rosbags and mujoco are installed."""
    generator = torch.Generator().manual_seed(seed)
    poses = ts.SE3.random(_ROWS, generator=generator)
    record = io.PoseRecord(
        _STAMP + _STEP * torch.arange(_ROWS), poses[:, :3].contiguous(), poses[:, 3:].contiguous()
    )
    imu = io.ImuRecord(record.time_ns, record.position, record.position.flip(0).contiguous())
    with tempfile.TemporaryDirectory() as folder:
        return _readers(Path(folder), record, imu)


def _readers(folder: Path, record: io.PoseRecord, imu: io.ImuRecord) -> dict[str, Reader]:
    def written(name: str, write: Callable[..., Any], *arguments: Any) -> Sample:
        write(folder / name, *arguments)
        return Sample(name, (folder / name).read_bytes())

    def packed(sample: Sample) -> Sample:
        return Sample(f"{sample.name}.gz", gzip.compress(sample.content, mtime=0), sample.beside)

    tum = written("tum.txt", io.write_poses, record, "tum")
    euroc = written("poses.csv", io.write_poses, record, "euroc")
    samples = written("imu.csv", io.write_imu, imu)
    rows = torch.cat([ts.SO3.to_matrix(record.rotation), record.position[..., None]], -1).reshape(-1, 12)
    kitti = "\n".join(" ".join(f"{x:.12e}" for x in row) for row in rows.tolist()).encode()
    stamps = "\n".join(f"{0.1 * i:e}" for i in range(len(record))).encode()
    parameters = io.ImuParameters(ts.imu.ImuNoise(1.7e-4, 1.9e-5, 2e-3, 3e-3), 200.0)
    found = {
        "read_poses, TUM": Reader(io.read_poses, [tum, packed(tum)]),
        "read_poses, EuRoC": Reader(io.read_poses, [euroc, packed(euroc)]),
        "read_imu, EuRoC": Reader(io.read_imu, [samples, packed(samples)]),
        "read_poses, KITTI": Reader(io.read_poses, [Sample("00_gt.txt", kitti, (("00_times.txt", stamps),))]),
        "read_poses, KITTI stamps": Reader(
            _kitti_stamps, [Sample("stamps.txt", stamps, (("gt.txt", kitti),))]
        ),
        "read_imu_parameters": Reader(
            io.read_imu_parameters,
            [
                written(f"{form}.yaml", io.write_imu_parameters, parameters, form)
                for form in ("kalibr", "euroc")
            ]
            + [Sample("imu-result.yaml", _KALIBR)],
        ),
        "load_trajectory": Reader(io.load_trajectory, _trajectories(written)),
        "read_nerfstudio": Reader(
            io.read_nerfstudio,
            [
                written(f"{kind}.json", io.write_nerfstudio, record, kind)
                for kind in ("camera_path", "transforms")
            ],
        ),
        "read_bvh": Reader(io.read_bvh, [Sample("walk.bvh", _BVH), packed(Sample("walk.bvh", _BVH))]),
        "Recipe.load": Reader(generate.Recipe.load, [Sample("recipe.yaml", _RECIPE)]),
        "Robot.from_urdf": Reader(Robot.from_urdf, [Sample("arm.urdf", _URDF)]),
    }
    found |= _calibration(folder, samples)
    if find_spec("pyarrow"):
        found |= _data_sets(folder)
    if find_spec("mujoco"):
        found["Robot.from_mjcf"] = Reader(Robot.from_mjcf, [Sample("arm.xml", _MJCF)])
    return found | (_bags(folder, record, imu) if find_spec("rosbags") else {})


def _kitti_stamps(path: Path) -> Any:
    return io.read_poses(path.with_name("gt.txt"), "kitti", times=path)


def _trajectories(written: Callable[..., Sample]) -> list[Sample]:
    points = ts.SE3.random(6, generator=torch.Generator().manual_seed(0))
    rates = torch.ones(2, 6, 6, dtype=torch.float64)
    times = torch.arange(6.0, dtype=torch.float64)
    families = {
        "uniform": ts.BSpline(points, group=ts.SE3, dt=0.1),
        "mounted": ts.SplitBSpline(points, dt_ns=10**8, t0_ns=_STAMP).mounted(points[0]),
        "hermite": ts.HermiteSpline(points, *rates, group=ts.SE3, times=times),
        "keyframes": ts.KeyframeSpline("SPLIT", points, times),
        "knots": ts.NonuniformBSpline(
            points, group=ts.SE3, order=3, knots=torch.arange(9.0, dtype=torch.float64)
        ),
    }
    return [written(f"{name}.npz", io.save_trajectory, x) for name, x in families.items()]


def _calibration(folder: Path, samples: Sample) -> dict[str, Reader]:
    count = 24
    tag, corner = np.divmod(np.arange(count), 4)
    right, up = np.isin(corner, (1, 2)), corner >= 2
    xyz = np.stack([tag % 3 * 0.15 + 0.1 * right, tag // 3 * 0.15 + 0.1 * up, np.zeros(count)], axis=1)
    columns = {
        "t_ns": np.array([100, 200, 300], np.int64),
        "frame": np.repeat([0, 2], count).astype(np.uint16),
        "tag_id": np.tile(tag, 2).astype(np.uint8),
        "corner": np.tile(corner, 2).astype(np.uint8),
        "uv": (np.tile(100 + 300 * xyz[:, :2], (2, 1)) + 0.25).astype(np.float32),
        "xyz_m": np.tile(xyz, (2, 1)),
    }
    np.savez_compressed(folder / "cam0.npz", **columns)
    corners = Sample("cam0.npz", (folder / "cam0.npz").read_bytes())
    camera = io.Camera("cam0", (400.0, 401.5, 320.0, 240.0), (-0.2, 0.1, 1e-4, 0.0), (640, 480))
    pose = ts.SE3.identity(2, dtype=torch.float64)
    chain = io.CamChain((camera, camera), pose, torch.tensor([0.01, -0.02], dtype=torch.float64))
    io.write_camchain(folder / "camchain-imucam.yaml", chain)
    beside = ((corners.name, corners.content), (samples.name, samples.content))

    def recording(path: Path) -> Any:
        return read_recording(path, [path.with_name(corners.name)], [path.with_name(samples.name)])

    return {
        "read_camchain": Reader(
            io.read_camchain, [Sample("camchain-imucam.yaml", (folder / "camchain-imucam.yaml").read_bytes())]
        ),
        "read_corners": Reader(read_corners, [corners]),
        "read_recording": Reader(recording, [Sample("config.yaml", _CONFIG, beside)]),
    }


def _data_sets(folder: Path) -> dict[str, Reader]:
    recipe = generate.Recipe({"smooth": {}}, duration=0.5, rate=20.0, knot_spacing=0.03)
    generate.write(recipe, folder / "set", seed=0, items=2)
    (shard,) = (folder / "set").glob("*.parquet")
    manifest = folder / "set" / MANIFEST
    names = ((shard.name, shard.read_bytes()), (manifest.name, manifest.read_bytes()))

    def read(path: Path) -> Any:
        items = generate.read(path.parent)
        return [items[i] for i in range(min(len(items), 100))]

    return {
        "generate.read, manifest": Reader(read, [Sample(*names[1], beside=names[:1])]),
        "generate.read, shard": Reader(read, [Sample(*names[0], beside=names[1:])]),
    }


def _bags(folder: Path, record: io.PoseRecord, imu: io.ImuRecord) -> dict[str, Reader]:
    from rosbags import rosbag1, rosbag2, typesys

    io.write_rosbag(folder / "both", {"/pose": record, "/imu": imu})
    mcap = Sample("both.mcap", (folder / "both" / "both.mcap").read_bytes())
    trees = []
    for name in ("tree.mcap", "tree.bag"):
        io.write_rosbag(folder / name, {"/tf": record}, "TFMessage")
        trees.append(Sample(name, (folder / name).read_bytes()))
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    old = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    kind = "geometry_msgs/msg/PoseStamped"
    with rosbag2.Reader(folder / "both") as reader:
        raw = [(t, x) for c, t, x in reader.messages() if c.msgtype == kind]
    with rosbag2.Writer(folder / "sqlite", version=8) as writer:
        connection = writer.add_connection("/pose", kind, typestore=store)
        for t, x in raw:
            writer.write(connection, t, x)
    with rosbag1.Writer(folder / "old.bag") as writer:
        connection = writer.add_connection("/pose", kind, typestore=old)
        for t, x in raw:
            writer.write(connection, t, store.cdr_to_ros1(x, kind))
    (database,) = (folder / "sqlite").glob("*.db3")
    return {
        "read_poses, ROS 2 MCAP": Reader(io.read_poses, [mcap]),
        "read_poses, ROS transforms": Reader(io.read_poses, trees),
        "read_imu, ROS 2 MCAP": Reader(io.read_imu, [mcap]),
        "read_poses, ROS 2 SQLite": Reader(io.read_poses, [Sample("x.db3", database.read_bytes())]),
        "read_poses, ROS 1": Reader(io.read_poses, [Sample("old.bag", (folder / "old.bag").read_bytes())]),
    }


_KALIBR = b"""imu0:
  T_i_b:
  - [1.0, 0.0, 0.0, 0.0]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  accelerometer_noise_density: 0.006
  accelerometer_random_walk: 0.0002
  accelerometers:
    M:
    - [1.01, 0.0, 0.0]
    - [0.001, 0.99, 0.0]
    - [0.002, -0.003, 1.0]
  gyroscope_noise_density: 0.0004
  gyroscope_random_walk: 4.0e-06
  gyroscopes:
    A: [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    C_gyro_i: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    M: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
  model: scale-misalignment
  rostopic: /imu0
  time_offset: 0.0
  update_rate: 200.0
"""

_BVH = b"""HIERARCHY
ROOT Hips
{
  OFFSET 0.0 0.0 0.0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Spine
  {
    OFFSET 0.0 10.5 0.0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0.0 20.0 0.0
    }
  }
}
MOTION
Frames: 3
Frame Time: 0.008333
1.0 90.5 3.0 10.0 -20.0 30.0 1.0 2.0 3.0
1.1 90.4 3.1 10.5 -20.5 30.5 1.5 2.5 3.5
1.2 90.3 3.2 11.0 -21.0 31.0 2.0 3.0 4.0
"""

_URDF = b"""<?xml version="1.0"?>
<robot name="arm">
  <link name="base"/>
  <link name="upper"/>
  <link name="lower"/>
  <link name="hand"/>
  <joint name="shoulder" type="revolute">
    <parent link="base"/>
    <child link="upper"/>
    <origin xyz="0 0 0.3" rpy="0 0.1 0"/>
    <axis xyz="0 0 1"/>
    <limit lower="-1.5" upper="1.5" velocity="2.0" effort="10"/>
  </joint>
  <joint name="elbow" type="prismatic">
    <parent link="upper"/>
    <child link="lower"/>
    <origin xyz="0.4 0 0" rpy="0 0 0"/>
    <axis xyz="1 0 0"/>
    <limit lower="0" upper="0.5" velocity="1.0" effort="10"/>
  </joint>
  <joint name="wrist" type="continuous">
    <parent link="lower"/>
    <child link="hand"/>
    <axis xyz="0 1 0"/>
    <mimic joint="elbow" multiplier="2.0" offset="0.1"/>
  </joint>
</robot>
"""

_MJCF = b"""<?xml version="1.0"?>
<mujoco model="arm">
  <compiler angle="degree" autolimits="true"/>
  <option timestep="0.002" gravity="0 0 -9.81"/>
  <size memory="1M"/>
  <default>
    <joint damping="0.1"/>
    <default class="small"><geom type="sphere" size="0.02"/></default>
  </default>
  <asset>
    <texture name="sky" builtin="gradient" rgb1="1 1 1" rgb2="0 0 0" width="8" height="8"/>
    <material name="grey" rgba="0.5 0.5 0.5 1"/>
    <hfield name="hill" nrow="3" ncol="3" size="1 1 0.1 0.1" elevation="0 0 0 0 1 0 0 0 0"/>
    <mesh name="tetrahedron" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" material="grey"/>
    <body name="upper" pos="0 0 0.3" quat="0.9 0.1 0.2 0.3">
      <joint name="shoulder" type="hinge" axis="0 0 1" range="-90 90"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.4 0 0"/>
      <body name="lower" pos="0.4 0 0" euler="0 10 0">
        <joint name="elbow" type="slide" axis="1 0 0" range="0 0.5" ref="0.1"/>
        <geom class="small" mass="0.1"/>
        <site name="imu" pos="0.1 0 0" size="0.01"/>
        <replicate count="3" offset="0.1 0 0"><site name="r" size="0.01"/></replicate>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="shoulder" gear="2"/></actuator>
  <keyframe><key name="home" qpos="0.1 0.2"/></keyframe>
</mujoco>
"""

_CONFIG = b"""calib_target:
  {target_type: aprilgrid, tag_rows: 2, tag_cols: 3, tag_size: 0.1, tag_spacing: 0.5}
imu0:
  accelerometer_noise_density: 0.002
  gyroscope_noise_density: 1.0e-4
  accelerometer_random_walk: 0.003
  gyroscope_random_walk: 2.0e-5
  g: 9.81
cam0:
  resolution: [640, 480]
  camera_model: pinhole
  distortion_model: radtan
  intrinsics: [400, 401.5, 320, 240]
  distortion_coeffs: [-0.2, 0.1, 1e-4, 0.0]
"""

_RECIPE = b"""recipe:
  duration: 10.0
  rate: 200.0
  rest: {choice: [0.0, 1.0]}
  mounting: random
  dtype: float32
  motions:
    smooth:
      weight: 2.0
      bandwidth: {log_uniform: [0.3, 3.0]}
    drone: {acceleration: {uniform: [0.3, 3.0]}}
  sensor:
    gyroscope_bias: {normal: [0.0, 0.02]}
    gyroscope_range: 35.0
"""
