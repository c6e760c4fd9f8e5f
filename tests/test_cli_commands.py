"""What all commands have in common, and those that open, show and convert files."""

import inspect
import json
import re
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest
import torch
from test_cli import torchspline

from torchspline import SE3, SplitBSpline, cli, use_kernels
from torchspline.io import (
    ImuRecord,
    PoseRecord,
    load_trajectory,
    read_poses,
    save_trajectory,
    write_imu,
    write_poses,
)

ROOT = Path(__file__).resolve().parent.parent
POINTS = SE3.random(9, generator=torch.Generator().manual_seed(7))
SPLINE = SplitBSpline(POINTS, order=4, dt_ns=500_000_000, t0_ns=1_000_000_000, learnable=False)
#: Words that each command takes, with nothing to wait for.
GOOD = {
    "demo": ("--duration", "2", "--out", "{out}"),
    "fit": ("{poses}", "--spacing", "250", "--order", "4", "--out", "{out}/m.npz"),
    "imu": ("{poses}", "--rate", "20", "--order", "4", "--out", "{out}"),
    "body": ("{bvh}", "--rate", "20", "--bandwidth", "3", "--out", "{out}"),
    "generate": ("--config", "{recipe}", "--items", "1", "--out", "{out}"),
    # Which takes its time, and is tried in test_calibration_report.py.
    "calibrate camera-imu": (),
    "bench": ("--queries", "50", "--repeats", "1", "--threads", "1"),
    "view": ("{saved}", "--out", "{out}/v.html"),
    "explore": ("--figure", "{out}/e.png"),
    "convert": ("{poses}", "{out}/p.csv"),
    "info": ("{poses}",),
    "kernels show": ("SO3", "--order", "2"),
}
#: And a mistake each, with what is said about it.
BAD = {
    "demo": (("--duration", "1"), "duration: expected at least 2 s"),
    "fit": (("{broken}",), "broken.txt, line 2: expected a number in column 3"),
    "imu": (("{poses}", "--rate", "0"), "rate: expected"),
    "body": (("{poses}",), "poses.txt"),
    "generate": (("--config", "nowhere.yaml"), "nowhere.yaml"),
    "calibrate camera-imu": (
        ("--imu", "{poses}", "--corners", "{saved}", "--config", "nowhere.yaml", "--out", "{out}"),
        "nowhere.yaml",
    ),
    "bench": (("--queries", "0"), "queries: expected a whole number of at least 1, got 0"),
    "view": (("{saved}", "--up", "w"), "up"),
    "explore": (("--methods", "SLERPY", "--figure", "x.png"), "methods: expected one of"),
    "convert": (("{poses}", "{out}/p.xyz"), "to: expected tum, euroc, kitti, nerfstudio, ros or rerun"),
    "info": (("{broken}",), "broken.txt, line 2: expected a number in column 3"),
    "kernels show": (("SO9",), "no group is called 'SO9'"),
}


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """Files to work on, by name."""
    folder = tmp_path_factory.mktemp("cli")
    t = 1_000_000_000 + torch.arange(61) * 50_000_000
    with use_kernels("reference"):
        poses = SPLINE(t)
    write_poses(folder / "poses.txt", PoseRecord(t, poses[:, :3], poses[:, 3:], "x"))
    first = (folder / "poses.txt").read_text().splitlines()
    (folder / "broken.txt").write_text(
        "\n".join([first[0], re.sub(r"^(\S+ \S+ )\S+", r"\1x", first[1])]) + "\n"
    )
    save_trajectory(folder / "saved.npz", SPLINE)
    rows = "\n".join(" ".join(f"{10 * ((i * j) % 7):d}" for j in range(6)) for i in range(40))
    (folder / "walk.bvh").write_text(
        "HIERARCHY\nROOT hips\n{\n  OFFSET 0 0 0\n  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation "
        f"Yrotation\n  End Site\n  {{\n    OFFSET 0 10 0\n  }}\n}}\nMOTION\nFrames: 40\nFrame Time: 0.04\n{rows}\n"
    )
    (folder / "recipe.yaml").write_text(
        "recipe:\n  motions: {figure_eight: {}}\n  duration: 0.5\n  rate: 20.0\n"
    )
    found = {"poses": "poses.txt", "broken": "broken.txt", "saved": "saved.npz", "bvh": "walk.bvh"}
    return {name: str(folder / file) for name, file in found.items()} | {
        "recipe": str(folder / "recipe.yaml")
    }


@pytest.fixture(autouse=True)
def reference():
    with use_kernels("reference"):
        yield


def filled(words, places, out):
    return [word.format(**places, out=out) for word in words]


def test_every_command_is_tried():
    assert set(GOOD) == set(BAD) == set(cli.COMMANDS)
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts == {"torchspline": "torchspline.cli:main"}


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_help_tells_arguments_and_examples(name):
    done = torchspline(*name.split(), "--help")
    assert done.returncode == 0
    command = cli.COMMANDS[name]
    module = import_module(command.module)
    for parameter in inspect.signature(getattr(module, command.function)).parameters:
        assert re.search(rf"\b{parameter}\b", done.stdout), parameter
    assert "--json" in done.stdout
    examples = done.stdout.split("examples:\n")[1].strip().splitlines()
    assert any(line.strip().startswith(f"torchspline {name}") for line in examples)


@pytest.mark.parametrize("name", [name for name, words in GOOD.items() if words])
def test_json_is_one_line(name, places, tmp_path):
    if name == "generate":
        pytest.importorskip("pyarrow")
    done = torchspline(*name.split(), *filled(GOOD[name], places, tmp_path), "--json")
    assert done.returncode == 0, done.stderr
    (line,) = done.stdout.splitlines()
    report = json.loads(line)
    assert report["command"] == name
    assert report["passed"] is True
    if name != "generate":  # whose processes tell the folder and how much is in it
        for file in report["files"]:
            assert Path(file).stat().st_size > 0


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_mistakes_are_one_line(name, places, tmp_path):
    words, message = BAD[name]
    for mistake, said in ((words, message), ((*GOOD[name], "--nonsense", "1"), "--nonsense")):
        done = torchspline(*name.split(), *filled(mistake, places, tmp_path))
        assert done.returncode == 2
        assert done.stdout == ""
        (line,) = done.stderr.splitlines()
        assert line.startswith("torchspline: ")
        assert said in line


def test_a_failed_check_is_exit_status_1(tmp_path, monkeypatch):
    module = import_module("torchspline.cli.demo")
    monkeypatch.setattr(module, "rmse", lambda *_: (1.0, 0.0))
    done = torchspline("demo", "--duration", "2", "--out", tmp_path, "--json")
    assert done.returncode == 1
    assert json.loads(done.stdout)["passed"] is False
    assert torchspline("demo", "--duration", "2", "--out", tmp_path).stdout.count("FAILED") == 1


def test_words_that_are_no_command(capsys):
    assert torchspline("nonsense").stderr.startswith(
        "torchspline: 'nonsense' is no command; expected one of demo"
    )
    assert torchspline("nonsense").returncode == 2
    assert torchspline().returncode == 2
    overview = torchspline("--help").stdout
    assert all(f"  {name} " in overview for name in cli.COMMANDS)
    assert "kernels show" in torchspline("kernels", "--help").stdout
    assert torchspline("kernels").returncode == 2


def test_main_ends_with_the_status(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["torchspline", "info", "nowhere.txt"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    assert capsys.readouterr().err == "torchspline: nowhere.txt: no such file\n"


def test_options_come_from_yaml_and_hyphens_do(places, tmp_path):
    config = tmp_path / "options.yaml"
    config.write_text("spacing: 300\norder: 4\nrepresentation: joint\n")
    out = tmp_path / "m.npz"
    done = torchspline("fit", places["poses"], "--config", config, "--out", out, "--spacing=250", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert (report["group"], report["order"], report["knot_spacing_s"]) == ("SE3", 4, 0.25)


def test_fit_gives_back_the_spline(places, tmp_path):
    """Poses of a spline, its own knots: the same curve, which the file holds."""
    out = tmp_path / "m.npz"
    done = torchspline(
        "fit",
        places["poses"],
        "--spacing",
        "500",
        "--order",
        "4",
        "--out",
        out,
        "--figure",
        tmp_path / "r.png",
    )
    assert done.returncode == 0, done.stderr
    assert "pose residual, RMS" in done.stdout
    t = 1_000_000_000 + torch.arange(50) * 60_000_000
    again, spline = load_trajectory(out).kinematics(t), SPLINE.kinematics(t)
    torch.testing.assert_close(again.position, spline.position, atol=1e-4, rtol=0)
    torch.testing.assert_close(again.angular_velocity, spline.angular_velocity, atol=5e-3, rtol=0)
    assert (tmp_path / "r.png").read_bytes().startswith(b"\x89PNG")
    assert torchspline("fit", places["saved"], "--out", places["saved"]).returncode == 2


def test_results_are_named_after_the_data_and_go_into_this_folder(places, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for command, name in (("fit", "poses.npz"), ("view", "poses.html")):
        done = torchspline(command, places["poses"], "--spacing", "500", "--order", "4", "--json")
        assert json.loads(done.stdout)["files"] == [name]
    assert sorted(x.name for x in tmp_path.iterdir()) == ["poses.html", "poses.npz"]


def test_convert_keeps_every_number(places, tmp_path):
    original = read_poses(places["poses"])
    for chain in (("a.csv", "b.txt"), ("a.txt.gz", "b.csv.gz")):
        here = Path(places["poses"])
        for name in chain:
            done = torchspline("convert", here, tmp_path / name, "--json")
            assert json.loads(done.stdout)["rows"] == 61
            here = tmp_path / name
        again = read_poses(here)
        assert torch.equal(again.time_ns, original.time_ns)
        assert torch.equal(again.position, original.position)
        assert torch.equal(again.rotation, original.rotation)
    done = torchspline("convert", places["saved"], tmp_path / "s.txt", "--rate", "20")
    assert done.returncode == 0, done.stderr
    sampled = read_poses(tmp_path / "s.txt")
    assert torch.equal(sampled.time_ns, original.time_ns)
    torch.testing.assert_close(sampled.position, original.position)
    same = torchspline("convert", places["poses"], places["poses"], "--to", "tum")
    assert same.returncode == 2
    assert "another file" in same.stderr


def test_info_finds_what_is_wrong(tmp_path):
    stamps = torch.tensor([0, 10, 20, 20, 120, 110]) * 1_000_000
    position = torch.tensor(
        [[0, 0, 0], [3, 4, 0], [3, 4, 1], [3, 4, 1], [3, 4, 1], [3, 4, float("nan")]]
    ).double()
    write_poses(tmp_path / "p.txt", PoseRecord(stamps, position, SE3.identity(6)[:, 3:], "x"))
    report = json.loads(torchspline("info", tmp_path / "p.txt", "--json").stdout)
    expected = {
        "kind": "poses", "rows": 6, "first_ns": 0, "last_ns": 120_000_000, "duration_s": 0.12, "rate_hz": 100.0,
        "gaps": 1, "longest_gap_s": 0.09, "rows_with_nan": 1, "repeated_stamps": 1, "in_order": False,
        "path_length_m": 6.0, "position_max": [3.0, 4.0, 1.0],
    }  # fmt: skip
    assert {name: report[name] for name in expected} == expected
    assert len(report["notes"]) == 3
    rows = torch.arange(6).double().reshape(2, 3)
    write_imu(tmp_path / "i.csv", ImuRecord(stamps[:2], rows, rows + 1, "x"))
    report = json.loads(torchspline("info", tmp_path / "i.csv", "--json").stdout)
    assert report["kind"] == "IMU readings"
    assert report["accelerometer_max"] == [4.0, 5.0, 6.0]
    assert "rad/s" in torchspline("info", tmp_path / "i.csv").stdout


def test_info_of_a_trajectory(places):
    report = json.loads(torchspline("info", places["saved"], "--json").stdout)
    assert (report["kind"], report["family"], report["group"]) == ("trajectory", "SplitBSpline", "R3xSO3")
    assert report["domain"] == [1_000_000_000, 4_000_000_000]
    assert report["duration_s"] == 3.0
    assert report["tensors"]["control_points"] == [9, 7]


def test_bench_times_what_it_says(places):
    report = json.loads(
        torchspline("bench", "--queries", "50", "--repeats", "2", "--threads", "1", "--json").stdout
    )
    assert report["threads"] == 1
    for call in report["calls"].values():
        assert call["best_s"] > 0
        assert call["ns_each"] == pytest.approx(1e9 * call["best_s"] / call["count"])


def test_view_of_poses_shows_them(places, tmp_path):
    out = tmp_path / "v.html"
    done = torchspline("view", places["poses"], "--spacing", "500", "--order", "4", "--out", out, "--up=-y")
    assert done.returncode == 0, done.stderr
    data = json.loads(re.search(r'type="application/json">(.*?)</script>', out.read_text(), re.S)[1])
    assert len(data["measured"]) == 61
    assert data["up"] == "-y"
    assert data["curves"][0]["t"][0] == 0.0


def test_explore_without_its_library_says_what_brings_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    done = torchspline("explore", "--duration", "0")
    assert done.returncode == 2
    assert "pip install 'torchspline[explore]'" in done.stderr


def test_explore_serves_for_a_while():
    pytest.importorskip("viser", reason="viser is not installed")
    done = torchspline("explore", "--duration", "0.1", "--port", "0", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["url"] in done.stderr
    assert report["seconds"] >= 0.1
