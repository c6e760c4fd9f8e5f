"""Commands on a full disk, on files that are not what they should be, and over their own sources."""

import io
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from test_cli import torchspline

from torchspline import SE3, cli, use_kernels
from torchspline.io import PoseRecord, write_poses, write_rosbag
from torchspline.io.archive import replacing

resource = pytest.importorskip("resource", reason="no limits of processes here")
COUNT = 40
POINTS = SE3.random(COUNT, generator=torch.Generator().manual_seed(3))
POSES = PoseRecord(
    25_000_000 * torch.arange(COUNT), 1e-3 * POINTS[:, :3], SE3.identity(COUNT).double()[:, 3:]
)
#: What is said where files may not grow.
ROOM = "make room or choose another place"


@pytest.fixture
def poses(tmp_path):
    """A file, in a folder of its own."""
    (tmp_path / "data").mkdir()
    path = tmp_path / "data" / "trajectory.txt"
    write_poses(path, POSES)
    return path


@pytest.fixture(autouse=True)
def reference():
    with use_kernels("reference"):
        yield


@contextmanager
def small_files(size):
    """Files of this process may not grow beyond that, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def refused(words, *said):
    done = torchspline(*words)
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    for text in said:
        assert str(text) in line
    return line


@pytest.mark.parametrize(
    ("name", "to"),
    [
        ("x.txt", "tum"), ("x.csv.gz", "euroc"), ("x.txt", "kitti"), ("x.json", "nerfstudio"),
        ("x.bag", "ros"), ("x.mcap", "ros"), ("x.db3", "ros"), ("x", "ros"), ("x.rrd", "rerun"),
    ],
)  # fmt: skip
def test_a_full_disk_leaves_what_was_there(poses, name, to):
    package = {"ros": "rosbags.highlevel", "rerun": "rerun"}
    if to in package:
        pytest.importorskip(package[to])
    folder = poses.parent
    if to != "ros":
        (folder / name).write_text("before")
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with small_files(100):
        refused(("convert", poses, folder / name, "--to", to), f"{folder / name}: ", ROOM)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_poses_of_kitti_do_not_come_without_their_stamps(poses):
    stamps = poses.with_name("x_times.txt")
    stamps.mkdir()
    refused(("convert", poses, poses.with_name("x.txt"), "--to", "kitti"), stamps, "got a folder")
    assert not poses.with_name("x.txt").exists()
    refused(("convert", poses, "/dev/null", "--to", "kitti"), "expected the name of a file", "/dev/null")


def test_what_is_read_is_not_written(poses):
    content, folder = poses.read_bytes(), poses.parent
    quick = ("--spacing", "300", "--order", "4")
    for words, said in (
        (("view", poses, "--out", poses), "out: expected another file than the source"),
        (("fit", poses, "--out", poses), "out: expected another file than the source"),
        (
            ("fit", poses, "--out", folder / "m.npz", "--figure", poses),
            "figure: expected another file than the",
        ),
        (("fit", poses, "--out", folder / "m.npz", "--figure", folder / "m.npz"), "than that of out"),
        (
            ("fit", poses, "--out", folder / "m.npz", "--figure", folder / "m.xyz"),
            "figure: expected a name that",
        ),
        (("fit", poses, "--out", folder / "m.npz", "--figure", folder / "no" / "m.png"), "make it first"),
        (("fit", poses, "--out", folder), "out: expected the name of a file, got the folder"),
        (("imu", poses, "--out", folder), "out: expected another file than the source"),
        (("imu", poses, "--out", poses), "out: expected a folder"),
        (("imu", poses, "--out", folder / "new", "--margin", "9"), "margin: nothing is left"),
    ):
        refused((*words, *quick), said)
        assert [path.name for path in folder.iterdir()] == [poses.name], words
        assert poses.read_bytes() == content


@pytest.mark.parametrize("name", ["x.bvh", "x.json", "x.json.gz"])
def test_what_has_no_imu_readings_is_not_blamed_for_it(tmp_path, name):
    (tmp_path / name).write_bytes(b"{]")
    assert "IMU" not in refused(("info", tmp_path / name), tmp_path / name)


def test_a_missing_package_is_said_in_one_line(poses, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    refused(("convert", poses, poses.with_name("x.rrd")), "pip install 'torchspline[rerun]'")


def test_topics_do_not_reach_the_terminal_as_they_are(tmp_path):
    pytest.importorskip("rosbags.highlevel")
    bag = tmp_path / "x.mcap"
    write_rosbag(bag, {"/a\x1b[2J\x07": POSES, "/b": POSES})
    line = refused(("info", bag), bag, "/a\\x1b[2J\\x07", "pass topic=")
    assert line.isprintable()


def test_a_folder_in_place_of_a_file(tmp_path):
    with (
        pytest.raises(IsADirectoryError, match="expected the name of a file, got a folder"),
        replacing(tmp_path),
    ):
        raise AssertionError


def test_want_of_memory_is_said(poses, monkeypatch):
    def greedy(*_):
        raise MemoryError

    monkeypatch.setattr("torchspline.io.read_table", greedy)
    refused(("info", poses), "not enough memory")


@pytest.mark.parametrize(
    ("command", "status", "said"),
    [
        ("info {} > /dev/full", 2, "torchspline: no space left on device; make room or choose another place"),
        (
            "--version > /dev/full",
            2,
            "torchspline: no space left on device; make room or choose another place",
        ),
        (
            "info - <&-",
            2,
            "torchspline: -: expected something on standard input, which is closed; name a file",
        ),
        ("--version >&-", 0, ""),
    ],
)
def test_standard_streams_that_are_full_or_closed(poses, command, status, said):
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    shell = f"{sys.executable} -m torchspline.cli {command.format(poses)}"
    done = subprocess.run(["sh", "-c", shell], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr.strip()) == (status, said)


def test_a_terminal_that_knows_no_unicode(monkeypatch):
    screen = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", screen)
    monkeypatch.setattr(cli, "run", lambda words: print("m/s²") or 0)
    with pytest.raises(SystemExit, match="0"):
        cli.main([])
    screen.flush()
    assert screen.buffer.getvalue() == b"m/s?\n"
