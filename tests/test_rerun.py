"""Recordings for the viewer of rerun, read back through its SDK where that is installed."""

import sys

import numpy as np
import pytest
import torch

from torchspline import SE3, SO3, SplitBSpline
from torchspline.io import ImuRecord, PoseRecord, write_rerun

START = 1_520_530_308_189_679_351
SPLINE = SplitBSpline(
    SE3.random(7, generator=torch.Generator().manual_seed(1)), dt_ns=500_000_000, t0_ns=START, learnable=False
)
VALUES = torch.arange(36, dtype=torch.float64).reshape(2, 6, 3) / 7
IMU = ImuRecord(START + 5_000_001 * torch.arange(6), *VALUES)


def read(path):
    """Columns of each entity of a recording, first those that change over time."""
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    chunk = pytest.importorskip("rerun.chunk", reason="this rerun-sdk does not read recordings")
    found = {}
    for part in chunk.RrdReader(path).stream():
        batch = part.to_record_batch()
        columns = dict(zip(batch.schema.names, batch.columns, strict=True))
        found.setdefault((str(part.entity_path), part.is_static), []).append(columns)
    return {
        key: {name: [x for p in parts for x in p[name]] for name in parts[0]} for key, parts in found.items()
    }


def test_a_trajectory_and_readings(tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    path = tmp_path / "x.rrd"
    path.write_text("something else")
    write_rerun(path, {"body": SPLINE, "/imu0": IMU}, rate=20.0)
    assert [x.name for x in tmp_path.iterdir()] == ["x.rrd"]
    found = read(path)
    t = START + 50_000_000 * torch.arange(41)
    motion = SPLINE.kinematics(t)
    pose = found["/world/body", False]
    stamps = [x.value for x in pose["time"]]
    assert stamps == t.tolist()
    position = np.array([x.as_py()[0] for x in pose["Transform3D:translation"]])
    np.testing.assert_allclose(position, motion.position, atol=1e-6)
    xyzw = torch.tensor([x.as_py()[0] for x in pose["Transform3D:quaternion"]], dtype=torch.float64)
    assert SO3.log(SO3.between(xyzw[:, [3, 0, 1, 2]], motion.rotation)).norm(dim=-1).max() < 1e-6
    for name, expected in (
        ("velocity/body", motion.velocity), ("angular_velocity/body", motion.angular_velocity),
        ("gyroscope/imu0", IMU.gyroscope), ("accelerometer/imu0", IMU.accelerometer),
    ):  # fmt: skip
        series = found[f"/{name}", False]
        assert np.array_equal([x.as_py() for x in series["Scalars:scalars"]], expected.numpy())
        assert found[f"/{name}", True]["SeriesLines:names"][0].as_py() == ["x", "y", "z"]
    assert [x.value for x in found["/gyroscope/imu0", False]["time"]] == IMU.time_ns.tolist()
    strip = found["/paths/body", True]["LineStrips3D:strips"][0].as_py()[0]
    np.testing.assert_allclose(strip, motion.position, atol=1e-6)
    assert ("/world/body", True) in found  # the axes


def test_poses_that_are_not_finite_are_left_out(tmp_path):
    position, stamps = torch.ones(4, 3, dtype=torch.float64), torch.arange(4) * 10
    position[2, 1] = float("nan")
    record = PoseRecord(stamps, position, SE3.identity(4)[:, 3:].contiguous())
    with pytest.raises(ValueError, match=r"records\['a'\]: expected poses that are finite, got none"):
        write_rerun(tmp_path / "x.rrd", {"a": record.window(20, 20)})
    assert not list(tmp_path.iterdir())
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    write_rerun(tmp_path / "x.rrd", {"a": record})
    assert [x.value for x in read(tmp_path / "x.rrd")["/world/a", False]["time"]] == [0, 10, 30]


def test_without_the_package_it_is_said_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ImportError, match=r"pip install 'torchspline\[rerun\]'"):
        write_rerun(tmp_path / "x.rrd", {"imu": IMU})
    assert not list(tmp_path.iterdir())
