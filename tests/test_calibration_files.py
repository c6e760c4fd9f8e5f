"""Recordings of cameras and IMUs, and Kalibr's files: what is read is what was written, and damage is named."""

import io
import zipfile
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from torchspline import SE3
from torchspline.calibrate import Corners, Recording, read_corners, read_recording
from torchspline.imu import ImuNoise
from torchspline.io import CamChain, Camera, ImuRecord, read_camchain, write_camchain, write_imu

CONFIG = {
    "calib_target": {
        "target_type": "aprilgrid", "tag_rows": 2, "tag_cols": 3, "tag_size": 0.1, "tag_spacing": 0.5,
    },
    "imu0": {"sigma_a_c": 0.002, "sigma_g_c": "1e-4", "sigma_aw_c": 0.003, "sigma_gw_c": 2e-5, "g": 9.81},
    "cam0": {
        "resolution": [640, 480], "proj_model": "pinhole", "dist_model": "radtan4",
        "proj_params": [400, 401.5, 320, 240], "dist_params": [-0.2, 0.1, "1e-4", 0.0],
    },
}  # fmt: skip
COUNT = 24


def columns() -> dict[str, np.ndarray]:
    """Two images of a board of 2 x 3 tags, 100 mm wide and 50 mm apart, and one without corners between them."""
    tag, corner = np.divmod(np.arange(COUNT), 4)
    right, up = np.isin(corner, (1, 2)), corner >= 2
    xyz = np.stack([tag % 3 * 0.15 + 0.1 * right, tag // 3 * 0.15 + 0.1 * up, np.zeros(COUNT)], axis=1)
    return {
        "t_ns": np.array([100, 200, 300], np.int64),
        "frame": np.repeat([0, 2], COUNT).astype(np.uint16),
        "tag_id": np.tile(tag, 2).astype(np.uint8),
        "corner": np.tile(corner, 2).astype(np.uint8),
        "uv": (np.tile(100 + 300 * xyz[:, :2], (2, 1)) + 0.25).astype(np.float32),
        "xyz_m": np.tile(xyz, (2, 1)),
    }


@pytest.fixture
def folder(tmp_path) -> Path:
    np.savez_compressed(tmp_path / "cam0.npz", **columns())
    t = torch.arange(0, 500, 20)
    write_imu(tmp_path / "imu0.csv", ImuRecord(t, torch.rand(25, 3).double(), torch.rand(25, 3).double()))
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(CONFIG))
    return tmp_path


def read(folder: Path) -> Recording:
    return read_recording(folder / "config.yaml", [folder / "cam0.npz"], [folder / "imu0.csv"])


def made(**changes) -> Corners:
    x = columns()
    whole = {
        name: torch.from_numpy(x[name].astype(np.int64)) for name in ("t_ns", "frame", "tag_id", "corner")
    }
    real = {"uv": torch.from_numpy(x["uv"].astype(np.float64)), "xyz": torch.from_numpy(x["xyz_m"])}
    return Corners(**{**whole, **real, **changes})


# ---------------------------------------------------------------------- reading


def test_a_recording_is_read(folder):
    recording = read(folder)
    assert recording.cameras == (
        Camera("cam0", (400.0, 401.5, 320.0, 240.0), (-0.2, 0.1, 1e-4, 0.0), (640, 480), "radtan"),
    )
    assert [asdict(x) for x in recording.noise] == [asdict(ImuNoise(1e-4, 0.002, 2e-5, 0.003))]
    assert recording.gravity == 9.81
    assert len(recording.imus[0]) == 25
    corners, stored = recording.corners[0], columns()
    assert corners.t_ns.tolist() == [100, 200, 300]
    assert corners.first.tolist() == [0, 24, 24, 48]
    for name, there in (("uv", "uv"), ("xyz", "xyz_m"), ("frame", "frame"), ("tag_id", "tag_id")):
        np.testing.assert_array_equal(getattr(corners, name).numpy(), stored[there])
    assert corners.uv.dtype == corners.xyz.dtype == torch.float64


def test_kalibrs_words_are_understood(folder):
    content = {
        "cam0": {
            "camera_model": "pinhole", "intrinsics": [400, 401.5, 320, 240], "distortion_model": "equidistant",
            "distortion_coeffs": [0.1, 0.0, 0.0, 0.0], "resolution": [640, 480],
        },
        "imu0": {
            "accelerometer_noise_density": 0.1, "accelerometer_random_walk": 0.2, "gyroscope_noise_density": 0.3,
            "gyroscope_random_walk": 0.4, "update_rate": 200.0,
        },
    }  # fmt: skip
    (folder / "config.yaml").write_text(yaml.safe_dump(content))
    recording = read(folder)
    assert [asdict(x) for x in recording.noise] == [asdict(ImuNoise(0.3, 0.1, 0.4, 0.2))]
    assert recording.time_offset is None
    # Of a camchain-imucam.yaml: t_imu = t_cam + timeshift_cam_imu, as of `CamChain` and `Recording`.
    content["cam0"]["timeshift_cam_imu"] = -0.0125
    (folder / "config.yaml").write_text(yaml.safe_dump(content))
    assert read(folder).time_offset == (-0.0125,)
    for bad, words in (("soon", "expected a number"), (float("nan"), "expected a finite number, got nan")):
        content["cam0"]["timeshift_cam_imu"] = bad
        (folder / "config.yaml").write_text(yaml.safe_dump(content))
        with pytest.raises(ValueError, match=rf"config.yaml: cam0: timeshift_cam_imu: {words}"):
            read(folder)
    assert recording.cameras[0].distortion == "equidistant"
    assert recording.gravity == 9.80665


@pytest.mark.realdata
def test_the_real_recording_is_read(shared_data):
    real = shared_data / "camera_imu_april"
    recording = read_recording(
        real / "config.yaml", [real / "cam0_corners.npz", real / "cam1_corners.npz"], [real / "imu0.csv.gz"]
    )
    assert [len(x.t_ns) for x in recording.corners] == [1416, 1416]
    assert [len(x) for x in recording.corners] == [179_524, 178_764]
    assert recording.gravity == 9.81007


# ---------------------------------------------------------------------- parts of recordings


def test_images_are_chosen():
    corners = made()
    last = corners.select(torch.tensor([False, True, True]))
    assert last.t_ns.tolist() == [200, 300]
    assert last.first.tolist() == [0, 0, 24]
    assert torch.equal(last.uv, corners.uv[24:])


def test_times_and_cameras_are_chosen():
    imu = ImuRecord(torch.arange(0, 500, 20), torch.rand(25, 3).double(), torch.rand(25, 3).double())
    camera = Camera("cam0", (400, 400, 320, 240), (0, 0, 0, 0), (640, 480))
    other = replace(camera, name="cam1")
    noise = ImuNoise(1e-4, 1e-3)
    recording = Recording((camera, other), (made(), made()), (imu,), (noise,))
    part = recording.between(100e-9, 200e-9)
    assert part.corners[0].t_ns.tolist() == [200, 300]
    assert part.imus[0].time_ns.tolist() == list(range(200, 301, 20))
    assert [x.name for x in recording.only(1).cameras] == ["cam1"]
    assert [x.name for x in recording.only(1, 0).cameras] == ["cam1", "cam0"]


# ---------------------------------------------------------------------- damage


def rewritten(folder: Path, **changes) -> str:
    """The message when some columns are others, or (None) are not there."""
    stored = {name: x for name, x in {**columns(), **changes}.items() if x is not None}
    np.savez(folder / "cam0.npz", **stored)
    with pytest.raises(ValueError) as caught:
        read(folder)
    return str(caught.value)


def test_columns_that_are_wrong(folder):
    good = columns()
    for name, bad, words in (
        ("t_ns", good["t_ns"][::-1], "strictly ascending numbers, got 200 at row 1 after 300"),
        ("t_ns", good["t_ns"].astype(float), "whole numbers"),
        ("t_ns", good["t_ns"][:2], "expected indices of the 2 images"),
        ("frame", good["frame"][::-1], "ascending numbers"),
        ("frame", good["frame"][:-1], "expected shape"),
        ("uv", np.where(good["uv"] > 200, np.nan, good["uv"]), "finite numbers, got nan"),
        ("uv", good["uv"][:, :1], "expected shape (48, 2), got (48, 1)"),
        ("uv", good["uv"] + 900, "order of the cameras"),
        ("uv", None, "uv: expected this array in the archive, got only t_ns, frame"),
        ("xyz_m", good["xyz_m"] + [0, 0, 0.001], "flat board in its plane z = 0"),
        ("xyz_m", 1.1 * good["xyz_m"], "expected the board of"),
        ("tag_id", good["tag_id"] + 40, "expected 0 to 5"),
        ("corner", good["corner"] + 1, "corner: expected 0 to 3, got 4"),
        ("tag_id", np.array(["a"] * 48), "plain numbers"),
        ("tag_id", np.array([{}] * 48), "plain numbers"),
    ):
        message = rewritten(folder, **{name: bad})
        assert "cam0.npz" in message, message
        assert words in message, message


def test_files_that_are_cut_off(folder):
    whole = (folder / "cam0.npz").read_bytes()
    for size in (0, 1, 100, len(whole) // 2, len(whole) - 30):
        (folder / "cam0.npz").write_bytes(whole[:size])
        with pytest.raises(ValueError, match="damaged or truncated") as caught:
            read(folder)
        assert "cam0.npz" in str(caught.value)


def test_archives_that_are_damaged_inside(folder):
    np.savez(folder / "cam0.npz", **columns())
    whole = (folder / "cam0.npz").read_bytes()
    pixels = columns()["uv"].tobytes()
    assert pixels in whole
    (folder / "cam0.npz").write_bytes(whole.replace(pixels, pixels[:-1] + b"\x01"))
    with pytest.raises(
        ValueError, match=r"cam0\.npz: expected an npz archive of numbers, got a damaged .*uv"
    ):
        read(folder)


def test_headers_are_not_believed(folder):
    """An array that promises terabytes is refused before anything is allocated."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 2)}
    )
    with zipfile.ZipFile(folder / "cam0.npz") as source:
        content = {name: source.read(name) for name in source.namelist()}
    content["uv.npy"] = header.getvalue() + b"\0" * 64
    with zipfile.ZipFile(folder / "cam0.npz", "w") as target:
        for name, data in content.items():
            target.writestr(name, data)
    with pytest.raises(ValueError, match="uv: expected an array of plain numbers"):
        read(folder)


def test_pickles_are_not_opened(folder):
    class Trap:
        def __reduce__(self):
            return pytest.fail, ("a pickle was opened",)

    array = np.empty(48, object)
    array[:] = [Trap()] * 48
    assert "plain numbers" in rewritten(folder, frame=array)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda x: x.pop("cam0"), "one section for each of the 1 files of cams, cam0, got none"),
        (lambda x: x.update(cam1=x["cam0"]), "got cam0, cam1"),
        (lambda x: x["cam0"].pop("resolution"), "cam0: resolution: expected it in the section"),
        (lambda x: x["cam0"].update(proj_model="omni"), "camera_model: expected 'pinhole', got 'omni'"),
        (lambda x: x["cam0"].update(dist_model="fov"), "distortion_model: expected one of radtan"),
        (lambda x: x["cam0"].update(proj_params=[1, 2, 3]), "intrinsics: expected 4 numbers, got 3"),
        (lambda x: x["cam0"].update(proj_params=[0, 2, 3, 4]), "focal lengths above zero, got 0"),
        (
            lambda x: x["cam0"].update(dist_params=[1, 2, 3, float("nan")]),
            "distortion_coeffs: expected a finite",
        ),
        (
            lambda x: x["cam0"].update(dist_params=["a", 2, 3, 4]),
            "distortion_coeffs: expected a number, got 'a'",
        ),
        (lambda x: x.update(cam0=5), "cam0: expected a section of entries, got int"),
        (lambda x: x["imu0"].pop("sigma_g_c"), "imu0: gyroscope_noise_density: expected it"),
        (
            lambda x: x["imu0"].update(sigma_a_c=0),
            "imu0: accelerometer_noise_density: expected a finite number above",
        ),
        (lambda x: x["imu0"].update(g="earth"), "g: expected a number, got 'earth'"),
        (lambda x: x["imu0"].update(g=-9.8), "g: expected a finite number above zero, got -9.8"),
        (lambda x: x["imu0"].update(g=[9.8]), "g: expected a number, got [9.8]"),
        (
            lambda x: x["calib_target"].update(tag_cols=1e30),
            "calib_target: tag_cols: expected the size of a board, got 1e+30",
        ),
        (lambda x: x["calib_target"].pop("tag_size"), "tag_size: expected a number, got none"),
    ],
)
def test_settings_that_are_wrong(folder, change, words):
    content = {name: dict(section) for name, section in CONFIG.items()}
    change(content)
    (folder / "config.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError) as caught:
        read(folder)
    assert words in str(caught.value)
    assert "config.yaml" in str(caught.value)


@pytest.mark.parametrize("text", ["a: [", "- 1\n- 2\n", "", "\xff: !!python/object/apply:os.getcwd []"])
def test_files_that_are_no_settings(folder, text):
    (folder / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"config\.yaml(, line \d+)?: expected"):
        read(folder)


def test_missing_files_are_named(folder):
    for name in ("config.yaml", "cam0.npz", "imu0.csv"):
        content = (folder / name).read_bytes()
        (folder / name).unlink()
        with pytest.raises(FileNotFoundError, match=name):
            read(folder)
        (folder / name).write_bytes(content)
    with pytest.raises(ValueError, match="got a folder"):
        read_corners(folder)


def test_readings_out_of_order(folder):
    lines = (folder / "imu0.csv").read_text().splitlines()
    (folder / "imu0.csv").write_text("\n".join([lines[0], *lines[1:][::-1]]))
    with pytest.raises(ValueError, match=r"imu0\.csv: time_ns: expected strictly ascending"):
        read(folder)


# ---------------------------------------------------------------------- Kalibr's result


def chain() -> CamChain:
    one = Camera("cam0", (458.654, 457.296, 367.215, 248.375), (-0.28, 0.074, 1.9e-4, 1.76e-05), (752, 480))
    two = Camera("cam1", (190.9, 190.8, 254.9, 256.8), (3.4e-3, 7e-4, -2e-3, 2e-4), (512, 512), "equidistant")
    poses = SE3.random(2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return CamChain((one, two), poses, torch.tensor([1.25e-3, -4e-5], dtype=torch.float64))


def test_a_chain_comes_back(tmp_path):
    write_camchain(tmp_path / "camchain-imucam.yaml", chain())
    back = read_camchain(tmp_path / "camchain-imucam.yaml")
    assert back.cameras == chain().cameras
    assert torch.equal(back.time_offset, chain().time_offset)
    assert float(SE3.log(SE3.between(back.T_imu_cam, chain().T_imu_cam)).abs().max()) < 1e-12


def test_a_chain_is_what_kalibr_writes(tmp_path):
    """`T_cam_imu` takes points of the IMU to the camera, `T_cn_cnm1` those of the camera before to the next."""
    write_camchain(tmp_path / "camchain-imucam.yaml", chain())
    content = yaml.safe_load((tmp_path / "camchain-imucam.yaml").read_text())
    assert list(content) == ["cam0", "cam1"]
    first, second = (np.array(content[x]["T_cam_imu"]) for x in ("cam0", "cam1"))
    T_imu_cam = SE3.to_matrix(chain().T_imu_cam).numpy()
    np.testing.assert_allclose(first @ T_imu_cam[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(np.array(content["cam1"]["T_cn_cnm1"]) @ first, second, atol=1e-12)
    assert "T_cn_cnm1" not in content["cam0"]
    assert content["cam0"]["cam_overlaps"] == [1]
    assert content["cam0"]["timeshift_cam_imu"] == 1.25e-3
    assert content["cam1"]["distortion_model"] == "equidistant"
    assert content["cam0"]["distortion_coeffs"][3] == 1.76e-05


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda x: x.pop("T_cam_imu"), "cam1: T_cam_imu: expected a 4 x 4 matrix, got none; camchain.yaml"),
        (lambda x: x.update(T_cam_imu=[[1, 0], [0, 1]]), "T_cam_imu: expected a 4 x 4 matrix"),
        (lambda x: x["T_cam_imu"][3].__setitem__(0, 1.0), "expected a last row of 0 0 0 1"),
        (lambda x: x["T_cam_imu"][0].__setitem__(0, 7.0), "rotation blocks must be orthonormal"),
        (lambda x: x["T_cam_imu"][0].__setitem__(0, "x"), "T_cam_imu: expected a number, got 'x'"),
        (lambda x: x.update(timeshift_cam_imu=[1]), "timeshift_cam_imu: expected a number"),
        (lambda x: x.pop("intrinsics"), "intrinsics: expected it in the section"),
    ],
)
def test_chains_that_are_wrong(tmp_path, change, words):
    path = tmp_path / "camchain-imucam.yaml"
    write_camchain(path, chain())
    content = yaml.safe_load(path.read_text())
    change(content["cam1"])
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError) as caught:
        read_camchain(path)
    assert words in str(caught.value)
    assert str(path) in str(caught.value)
