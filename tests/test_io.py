"""Readers and writers of poses and IMU samples: round trips, what files look like, KITTI, real files."""

import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from io_cases import EUROC_ROW, IMU_ROW, KITTI_ROW, STAMP, TUM_ROW, imu, poses, put
from properties import examples
from scipy.spatial.transform import Rotation

from torchspline.io import ImuRecord, PoseRecord, read_imu, read_poses, write_imu, write_poses

# Round trips

stamps = st.lists(st.integers(-(2**63), 2**63 - 1), min_size=1, max_size=5)
floats = st.floats(allow_infinity=False)


@given(stamps, st.lists(floats, min_size=7, max_size=7), st.sampled_from(["", ".gz"]))
@examples(30)
def test_what_is_written_is_read_back_to_the_last_digit(time_ns, row, suffix):
    values = torch.tensor([row] * len(time_ns), dtype=torch.float64)
    values[:, 3] = 1.0  # no zero quaternion
    pose = PoseRecord(torch.tensor(time_ns), values[:, :3], values[:, 3:])
    sample = ImuRecord(torch.tensor(time_ns), values[:, :3], values[:, 4:])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"record{suffix}")
        for form in ("tum", "euroc"):
            write_poses(path, pose, form)
            same(read_poses(path, form), pose)
        write_imu(path, sample)
        same(read_imu(path, "euroc"), sample)


def same(found, expected):
    assert torch.equal(found.time_ns, expected.time_ns)
    for name in expected._widths:
        torch.testing.assert_close(
            getattr(found, name), getattr(expected, name), rtol=0, atol=0, equal_nan=True
        )


@pytest.mark.parametrize("name", ["poses.txt", "poses.txt.gz"])
@pytest.mark.parametrize("form", ["tum", "euroc"])
def test_written_poses_are_recognised(tmp_path, form, name):
    record = poses([STAMP, STAMP - 7, STAMP - 7])  # unsorted and repeated
    write_poses(str(tmp_path / name), record, form)
    assert ((tmp_path / name).read_bytes()[:2] == b"\x1f\x8b") == name.endswith(".gz")
    found = read_poses(str(tmp_path / name))
    same(found, record)
    assert found.source == str(tmp_path / name)


def test_written_imu_samples_are_recognised_even_from_zero(tmp_path):
    record = imu([0, 5, 10])
    write_imu(tmp_path / "imu.csv", record)
    same(read_imu(tmp_path / "imu.csv"), record)


def test_results_do_not_depend_on_the_default_dtype(tmp_path):
    write_poses(tmp_path / "poses.txt", poses([1, 2]))
    before = torch.get_default_dtype()
    try:
        torch.set_default_dtype(torch.float16)
        record = read_poses(tmp_path / "poses.txt")
        assert record.position.dtype == record.rotation.dtype == record.time.dtype == torch.float64
    finally:
        torch.set_default_dtype(before)


# What files look like


def test_quaternion_orders(tmp_path):
    for row, expected in ((TUM_ROW, 1500000000), (EUROC_ROW, STAMP)):
        record = read_poses(put(tmp_path, row))
        assert record.time_ns.tolist() == [expected]
        assert record.position.tolist() == [[1.0, 2.0, 3.0]]
        assert record.rotation.tolist() == [[0.8, 0.0, 0.0, 0.6]]


@pytest.mark.parametrize(
    "head", ["", "# t x y z qx qy qz qw\n", "t x y z qx qy qz qw\n", "#a\n\nt,x,y\n# b\n", "\n"]
)
@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("separator", [" ", "\t", "  ", ",", ", ", " , "])
def test_headers_separators_and_line_endings(tmp_path, head, mark, end, separator):
    lines = f"{head}{TUM_ROW}\n# between\n{TUM_ROW}".split("\n")
    rows = [line.replace(" ", separator) if line == TUM_ROW else line for line in lines]
    record = read_poses(put(tmp_path, mark + end.join([*rows, "", " ", ""])))
    assert record.time_ns.tolist() == [1500000000] * 2
    assert record.rotation.tolist() == [[0.8, 0.0, 0.0, 0.6]] * 2


def test_euroc_with_spaces_more_columns_and_trailing_commas(tmp_path):
    spaced = "#timestamp [ns] p q\n" + EUROC_ROW.replace(",", " ") + " 7 8 9\n"
    ragged = f"{EUROC_ROW},7,8\n{EUROC_ROW},,,\n{EUROC_ROW}\n"
    assert read_poses(put(tmp_path, spaced)).time_ns.tolist() == [STAMP]
    record = read_poses(put(tmp_path, ragged))
    assert record.rotation.tolist() == [[0.8, 0.0, 0.0, 0.6]] * 3
    assert read_imu(put(tmp_path, f"{IMU_ROW},\n")).accelerometer.tolist() == [[4.0, 5.0, 6.0]]


def test_nan_rows_stay(tmp_path):
    record = read_poses(put(tmp_path, f"{TUM_ROW}\n2 nan NaN nan nan nan nan nan\n"))
    assert record.time_ns.tolist() == [1500000000, 2000000000]
    assert record.position.isnan().tolist() == [[False] * 3, [True] * 3]
    assert record.rotation.isnan().tolist() == [[False] * 4, [True] * 4]


@pytest.mark.parametrize("name", ["data.csv", "data.csv.gz"])
def test_folders(tmp_path, name):
    for folder, row in (("mav0/imu0", IMU_ROW), ("mav0/mocap0", EUROC_ROW)):
        (tmp_path / folder).mkdir(parents=True)
        put(tmp_path / folder, row, name)
    for start in ("", "mav0", "mav0/mocap0"):
        assert read_poses(tmp_path / start).time_ns.tolist() == [STAMP]
    for start in ("", "mav0", "mav0/imu0"):
        assert read_imu(tmp_path / start, "euroc").time_ns.tolist() == [STAMP]
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"empty: expected a folder that holds data.csv or imu0/data"):
        read_imu(tmp_path / "empty")
    with pytest.raises(ValueError, match="expected a file, got a folder"):
        read_poses(tmp_path, "tum")


# KITTI


def kitti(folder, matrices, times, name="00_gt.txt", times_name="00_times.txt"):
    rows = [" ".join(f"{x:e}" for x in matrix.ravel()) for matrix in matrices]
    put(folder, "\n".join(times), times_name)
    return put(folder, "\n".join(rows), name)


def test_kitti(tmp_path):
    rotations = Rotation.random(50, random_state=0)
    positions = np.random.default_rng(0).normal(size=(50, 3, 1))
    matrices = np.concatenate([rotations.as_matrix(), positions], axis=2)
    path = kitti(tmp_path, matrices, [f"{0.1 * i:e}" for i in range(50)])
    record = read_poses(path)
    assert record.time_ns.tolist() == [100_000_000 * i for i in range(50)]
    assert record.rotation.norm(dim=1).sub(1).abs().max() < 1e-15
    found = Rotation.from_quat(record.rotation[:, [1, 2, 3, 0]].numpy())
    assert (found * rotations.inv()).magnitude().max() < 2e-6
    np.testing.assert_allclose(record.position, positions[..., 0], rtol=1e-6)
    put(tmp_path, "\n".join(map(str, range(50))), "other.txt")
    assert read_poses(path, times=tmp_path / "other.txt").time_ns[-1] == 49 * 10**9
    with pytest.raises(
        ValueError, match=r"other.txt: expected 1 stamps as there are poses in .*one.txt, got 50"
    ):
        read_poses(put(tmp_path, KITTI_ROW, "one.txt"), times=tmp_path / "other.txt")


@pytest.mark.parametrize(
    ("name", "times"),
    [
        ("00_gt.txt", "00_times.txt.gz"),
        ("gt.txt.gz", "times.txt"),
        ("poses_00.txt", "times_00.txt"),
        ("x.txt", "times.txt"),
        ("poses/00.txt", "sequences/00/times.txt"),
    ],
)
def test_kitti_times_are_found(tmp_path, name, times):
    for file, content in ((name, KITTI_ROW), (times, "1.5")):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        put((tmp_path / file).parent, content, Path(file).name)
    record = read_poses(tmp_path / name)
    assert record.time_ns.tolist() == [1500000000]
    assert record.position.tolist() == [[1.0, 2.0, 3.0]]
    half = 0.5**0.5
    torch.testing.assert_close(record.rotation.abs(), torch.tensor([[half, 0, 0, half]]).double())


def test_kitti_keeps_nan_and_takes_rounding_but_no_other_matrices(tmp_path):
    put(tmp_path, "0\n1\n", "times.txt")
    record = read_poses(put(tmp_path, f"{KITTI_ROW}\n{KITTI_ROW.replace('-1', 'nan')}"))
    assert record.rotation.isnan().all(dim=1).tolist() == [False, True]
    read_poses(put(tmp_path, f"{KITTI_ROW}\n{KITTI_ROW.replace('-1', '-0.99996')}"))
    with pytest.raises(
        ValueError, match=r"line 2: expected a rotation matrix, orthonormal within 0.0001, .* off by 0.02"
    ):
        read_poses(put(tmp_path, f"{KITTI_ROW}\n{KITTI_ROW.replace('-1', '-0.99')}"))
    with pytest.raises(ValueError, match=r"line 1: expected a rotation matrix.*reflection"):
        read_poses(put(tmp_path, f"{KITTI_ROW.replace('-1', '1')}\n{KITTI_ROW}"))


def test_kitti_without_times(tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"pass times=PATH or provide one of .*00_times.txt, .*times.txt"
    ):
        read_poses(put(tmp_path, KITTI_ROW, "00_gt.txt"))
    with pytest.raises(FileNotFoundError, match=r"none.txt: no such file"):
        read_poses(put(tmp_path, KITTI_ROW), times=tmp_path / "none.txt")
    with pytest.raises(ValueError, match="tum files hold their own stamps"):
        read_poses(put(tmp_path, TUM_ROW), times=tmp_path / "none.txt")


def test_long_files_read_fast(tmp_path):
    row = ",".join(["0.123456789012345"] * 16)
    stamps = range(STAMP, STAMP + 60_000 * 5_000_000, 5_000_000)
    path = put(tmp_path, "\n".join(f"{stamp},{row}" for stamp in stamps))
    start = time.process_time()
    record = read_poses(path)
    assert time.process_time() - start < 3  # about 0.4 s; the bound leaves room for a busy machine
    assert record.time_ns.tolist() == list(stamps)


# Real files

FOLDERS = {
    "euroc/V1_02_medium": (17100, 16702, 1403715523912143104, 1403715524907143168),
    "tum_vi/room1": (28122, 16541, 1520530308181901469, STAMP),
}


@pytest.mark.realdata
@pytest.mark.parametrize("folder", FOLDERS)
def test_real_sequences(shared_data, folder):
    samples, count, first_sample, first_pose = FOLDERS[folder]
    pose, sample = read_poses(shared_data / folder), read_imu(shared_data / folder)
    assert (len(sample), len(pose)) == (samples, count)
    assert (sample.time_ns[0], pose.time_ns[0]) == (first_sample, first_pose)
    assert pose.rotation.norm(dim=1).sub(1).abs().max() < 1e-3
    assert sample.accelerometer.norm(dim=1).mean().sub(9.8).abs() < 0.5
    assert sample.time.diff().median().sub(0.005).abs() < 1e-4


@pytest.mark.realdata
def test_every_real_csv_and_pose_file_is_recognised(shared_data):
    imus = [*shared_data.glob("*/*/imu0"), shared_data / "camera_imu_april" / "imu0.csv.gz"]
    truths = [*shared_data.glob("*/*/state_groundtruth_estimate0"), *shared_data.glob("*/*/mocap0")]
    assert (len(imus), len(truths)) == (6, 5)
    for path in imus:
        assert len(read_imu(path)) > 10_000
    for path in truths:
        assert len(read_poses(path)) > 10_000


@pytest.mark.realdata
def test_real_tum_and_kitti_poses(shared_data):
    record = read_poses(shared_data / "poses" / "tum_rgbd_fr1_xyz.txt.gz")
    assert (len(record), int(record.time_ns[0])) == (3000, 1305031098665900000)
    assert record.rotation[0].tolist() == [-0.3986, 0.6132, 0.5962, -0.3311]
    record = read_poses(shared_data / "poses" / "tum_rgbd_fr2_desk.txt.gz")
    steps = record.time_ns.diff()
    assert (len(record), int((steps <= 0).sum())) == (20957, 1)
    assert 10 < steps.max() / 1e9 < 14
    record = read_poses(shared_data / "poses" / "kitti_00_gt.txt.gz")
    assert (len(record), int(record.time_ns[1])) == (4541, 103735900)
    assert (
        record.position[3].tolist() == [-1.406429e-01, -5.202373e-02, 2.574964e00]
        or record.position[3, 2] == 2.574964
    )
    assert record.rotation.norm(dim=1).sub(1).abs().max() < 1e-14
