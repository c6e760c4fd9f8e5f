"""Files that are damaged, empty, missing or of no known format: what is wrong is named with its line."""

import gzip

import pytest
from io_cases import EUROC_ROW, IMU_ROW, KITTI_ROW, STAMP, TUM_ROW, imu, poses, put

from torchspline.io import read_imu, read_poses, write_imu, write_poses

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
