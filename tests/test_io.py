"""Readers and writers of poses and IMU samples: round trips, exact stamps, damage, real files."""

import gzip
import tempfile
import time
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchspline.io import ImuRecord, PoseRecord, read_imu, read_poses, write_imu, write_poses
from torchspline.io.text import format_seconds, parse_seconds

STAMP = 1520530308189679351  # a float64 is off by 55 ns here
TUM_ROW = "1.5 1 2 3 0 0 0.6 0.8"
EUROC_ROW = f"{STAMP},1,2,3,0.8,0,0,0.6"
IMU_ROW = f"{STAMP},1,2,3,4,5,6"
KITTI_ROW = "0 -1 0 1 1 0 0 2 0 0 1 3"


def poses(stamps, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shape = {"dtype": torch.float64, "generator": generator}
    count = len(stamps)
    return PoseRecord(
        torch.tensor(stamps), 1e3 * torch.randn(count, 3, **shape), torch.randn(count, 4, **shape)
    )


def imu(stamps):
    record = poses(stamps, seed=1)
    return ImuRecord(record.time_ns, record.position, record.rotation[:, :3].contiguous())


def put(folder, content, name="file.txt"):
    path = folder / name
    data = content.encode() if isinstance(content, str) else content
    path.write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
    return path


# Records


def test_seconds_lose_nothing_at_epoch_stamps():
    record = poses([STAMP, STAMP + 1, STAMP + 10**9])
    assert record.time.tolist() == [0.0, 1e-9, 1.0]
    assert record.time.dtype == torch.float64
    assert record.seconds(STAMP + 1).tolist() == [-1e-9, 0.0, 0.999999999]
    assert record.seconds(0)[0].item() == STAMP / 1e9


@pytest.mark.parametrize("make", [poses, imu])
def test_window_includes_both_ends_and_keeps_order(make):
    record = make([STAMP + 5, STAMP, STAMP + 1, STAMP + 1, STAMP + 9])
    part = record.window(STAMP + 1, STAMP + 5)
    assert type(part) is type(record)
    assert part.time_ns.tolist() == [STAMP + 5, STAMP + 1, STAMP + 1]
    for column in record._widths:
        assert torch.equal(getattr(part, column), getattr(record, column)[[0, 2, 3]])
    assert (len(record), len(record.window(0, 1))) == (5, 0)
    assert record.window(0, 1).time.shape == (0,)
    with pytest.raises(TypeError):
        record.window(float(STAMP), STAMP + 5)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            {"time_ns": torch.zeros(2)},
            TypeError,
            "PoseRecord.time_ns: expected torch.int64, got torch.float32",
        ),
        ({"time_ns": torch.tensor(1)}, ValueError, r"PoseRecord.time_ns: expected shape \(N,\), got \(\)"),
        ({"position": torch.zeros(2, 3)}, TypeError, "position: expected torch.float64"),
        ({"position": np.zeros((2, 3))}, TypeError, "position: expected a tensor, got ndarray"),
        (
            {"rotation": torch.zeros(2, 3).double()},
            ValueError,
            r"rotation: expected shape \(N, 4\), got \(2, 3\)",
        ),
        ({"rotation": torch.zeros(3, 4).double()}, ValueError, "rotation: expected 2 rows .*, got 3"),
    ],
)
def test_records_check_their_columns(change, error, message):
    columns = {"time_ns": torch.tensor([0, 1]), "position": torch.zeros(2, 3).double()}
    columns["rotation"] = torch.ones(2, 4).double()
    PoseRecord(**columns)
    with pytest.raises(error, match=message):
        PoseRecord(**(columns | change))


# Stamps


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1305031098.6659", 1305031098665900000),
        ("1520530308.189679", 1520530308189679000),
        ("1520530308.189679351", STAMP),
        ("-0.000000001", -1),
        ("-1520530308.189679351", -STAMP),
        ("9223372036.854775807", 2**63 - 1),
        ("-9223372036.854775808", -(2**63)),
        ("1.037359e-01", 103735900),
        ("0.000000e+00", 0),
        ("0e999999", 0),
        ("1e-999999", 0),
        ("17", 17 * 10**9),
        (".5", 500000000),
        ("1305031098.66590023040771484375", 1305031098665900230),
        ("0.0000000005", 0),
        ("0.0000000015", 2),
    ],
)
def test_decimal_seconds_become_exact_nanoseconds(text, expected):
    assert parse_seconds(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "nan",
        "inf",
        "-inf",
        "",
        "1_0",
        "1.2.3",
        "0x10",
        "1e999999",
        "1e99999999999999999999",
        "9223372036.854775808",
    ],
)
def test_times_that_are_no_time(text):
    with pytest.raises(ValueError):
        parse_seconds(text)


@given(st.integers(-(2**63), 2**63 - 1))
@settings(max_examples=200, deadline=None)
def test_seconds_as_text_round_trip(time_ns):
    assert Decimal(format_seconds(time_ns)) == Decimal(time_ns).scaleb(-9)
    assert parse_seconds(format_seconds(time_ns)) == time_ns


# Round trips

stamps = st.lists(st.integers(-(2**63), 2**63 - 1), min_size=1, max_size=5)
floats = st.floats(allow_infinity=False)


@given(stamps, st.lists(floats, min_size=7, max_size=7), st.sampled_from(["", ".gz"]))
@settings(max_examples=30, deadline=None)
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


# Damage

GOOD = {"tum": TUM_ROW, "euroc": EUROC_ROW, "imu": IMU_ROW, "kitti": KITTI_ROW}


def read(kind, path, form=None):
    return read_imu(path, form) if kind == "imu" else read_poses(path, form)


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize(
    ("kind", "row", "message"),
    [
        ("tum", "1.5 1 2 x 0 0 0 1", "expected a number in column 4, got 'x'"),
        ("tum", "1.5 1 2 1_0 0 0 0 1", "expected a number in column 4, got '1_0'"),
        ("tum", "1.5 1 2 3 0 0 0", r"expected 8 columns \(t x y z qx qy qz qw\), got 7: '1.5 1 2 3 0 0 0'"),
        ("tum", "1.5 1 2 3 0 0 0 1 9", "expected 8 columns .*, got 9"),
        ("tum", "1.5,1,2,,0,0,0,1", "expected a number in column 4, got ''"),
        ("tum", "1.5,1,2,3,0,0,0,", "expected 8 columns .*, got 7"),
        ("tum", "nan 1 2 3 0 0 0 1", "expected a finite number of seconds in column 1, got 'nan'"),
        ("tum", "inf 1 2 3 0 0 0 1", "expected a finite number of seconds in column 1, got 'inf'"),
        ("tum", "1e30 1 2 3 0 0 0 1", "expected a time within the range of int64"),
        ("tum", "abc 1 2 3 0 0 0 1", "expected a finite number of seconds in column 1, got 'abc'"),
        ("tum", "1.5 1 2 3 0 0 0 0", "expected a quaternion xyzw, not zero, got '1.5 1 2 3 0 0 0 0'"),
        ("tum", "words and more words", "expected 8 columns .*, got 4"),
        ("tum", b"\xff\xfe\x00\x01", "expected 8 columns .*, got 1"),
        ("euroc", f"{STAMP}.5,1,2,3,1,0,0,0", "expected an integer number of nanoseconds in column 1"),
        (
            "euroc",
            "1.5e18,1,2,3,1,0,0,0",
            "expected an integer number of nanoseconds in column 1, got '1.5e18'",
        ),
        ("euroc", f"9{STAMP},1,2,3,1,0,0,0", "expected a time within the range of int64"),
        ("euroc", "nan,1,2,3,1,0,0,0", "expected an integer number of nanoseconds in column 1, got 'nan'"),
        ("euroc", f"{STAMP},1,2,3,0,0,0,0", "expected a quaternion wxyz, not zero"),
        ("euroc", f"{STAMP},1,2,3,1,0,0", "expected at least 8 columns .*, got 7"),
        ("euroc", f"{STAMP},1,,3,1,0,0,0", "expected a number in column 3, got ''"),
        ("imu", f"{STAMP},1,2,3,4,5", r"expected 7 columns \(t\[ns\] wx wy wz ax ay az\), got 6"),
        ("imu", EUROC_ROW, "expected 7 columns .*, got 8"),
        ("imu", f"{STAMP},1,2,3,4,5,six", "expected a number in column 7, got 'six'"),
        ("kitti", "0 -1 0 1 1 0 0 2 0 0 1", "expected 12 columns .*, got 11"),
        ("kitti", "0 -1 0 1 1 0 0 2 0 0 1 a", "expected a number in column 12, got 'a'"),
    ],
)
def test_damaged_rows_are_named(tmp_path, kind, row, message, named):
    put(tmp_path, "0\n1\n2", "times.txt")
    parts = [
        b"# head",
        GOOD[kind].encode(),
        b"",
        row if isinstance(row, bytes) else row.encode(),
        GOOD[kind].encode(),
    ]
    path = put(tmp_path, b"\r\n".join(parts))
    with pytest.raises(ValueError, match=rf"file.txt, line 4: {message}"):
        read(kind, path, ("euroc" if kind == "imu" else kind) if named else None)


@pytest.mark.parametrize("name", ["file.txt", "file.txt.gz"])
@pytest.mark.parametrize("content", ["", "\n\r\n", "# only a comment\n", "t x y z qx qy qz qw\n", "\ufeff"])
def test_files_without_rows(tmp_path, content, name):
    for kind in GOOD:
        with pytest.raises(ValueError, match=f"{name}: expected rows of numbers, got a file without any"):
            read(kind, put(tmp_path, content, name))


def test_missing_files_and_damaged_gzip(tmp_path):
    for kind in GOOD:
        with pytest.raises(FileNotFoundError, match=r"none.csv: no such file"):
            read(kind, tmp_path / "none.csv")
    packed = gzip.compress(b"1.5 1 2 3 0 0 0 1\n" * 1000)
    for damaged in (packed[:-20], packed[:20] + b"junk" + packed[24:], packed[:2]):
        with pytest.raises(ValueError, match=r"file.txt: expected gzipped text, got damaged data"):
            read_poses(put(tmp_path, damaged))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            "1 2 3\n4 5 6",
            r"line 1: expected rows that look like euroc or kitti or tum .*, got 3 columns, here '1 2 3'",
        ),
        ("0,1,2,3,1,0,0,0", "pass format="),  # seconds or nanoseconds, xyzw or wxyz?
        (EUROC_ROW.replace(",", " "), "pass format="),
        (f"#t[ns],x,y,z,qx,qy,qz,qw\n{EUROC_ROW}", "pass format="),  # nanoseconds, but w last
        (IMU_ROW, "expected at least 8 columns"),
    ],
)
def test_formats_are_never_guessed(tmp_path, content, message):
    with pytest.raises(ValueError, match=message):
        read_poses(put(tmp_path, content))


def test_formats_by_name(tmp_path):
    path = put(tmp_path, "0,1,2,3,1,0,0,0")
    assert read_poses(path, "tum").rotation.tolist() == [[0.0, 1.0, 0.0, 0.0]]
    assert read_poses(path, "euroc").rotation.tolist() == [[1.0, 0.0, 0.0, 0.0]]
    with pytest.raises(ValueError, match="read_poses: expected a format out of euroc, kitti, tum, got 'csv'"):
        read_poses(path, "csv")
    with pytest.raises(ValueError, match="read_imu: expected a format out of euroc, got 'tum'"):
        read_imu(path, "tum")
    with pytest.raises(
        ValueError, match="write_poses: expected a format out of euroc, kitti, tum, got 'bvh'"
    ):
        write_poses(path, poses([1]), "bvh")


def test_writing_needs_a_folder_and_rows(tmp_path):
    for write, record in ((write_poses, poses([1])), (write_imu, imu([1]))):
        with pytest.raises(FileNotFoundError, match=r"the folder .*none does not exist"):
            write(tmp_path / "none" / "file.txt", record)
    with pytest.raises(ValueError, match="expected rows to write, got an empty record"):
        write_poses(tmp_path / "poses.txt", poses([1]).window(5, 6))


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
