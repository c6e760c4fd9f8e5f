"""Bad arguments of what a calibration reads, starts from and writes."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import torch
import yaml
from error_arguments import (
    F32,
    F64,
    FOLDER,
    I64,
    INF,
    NAN,
    POSE,
    SAMPLES,
    Case,
    accept,
    changed,
    file,
    numbers,
    refused,
)

import torchspline.io as records
from torchspline import calibrate
from torchspline.calibrate import Corners, Recording
from torchspline.calibrate.simulate import simulate
from torchspline.imu import ImuNoise
from torchspline.io import CamChain, Camera

#: What `test_errors.public` is to look at besides the rest.
ROOTS = (
    Corners,
    Recording,
    calibrate.board_poses,
    calibrate.find_start,
    calibrate.read_corners,
    calibrate.read_recording,
    calibrate.write_calibration,
)

CAMERA = Camera("cam0", (400.0, 400.0, 320.0, 240.0), (0.0, 0.0, 0.0, 0.0), (640, 480))
XYZ = torch.tensor([[x, y, 0.0] for y in (0.0, 0.1, 0.2) for x in (0.0, 0.1, 0.2)], dtype=F64)
COLUMNS = {
    "t_ns": torch.arange(2),
    "frame": torch.arange(2).repeat_interleave(9),
    "uv": (XYZ[:, :2] * 1000.0 + 100.0).repeat(2, 1),
    "xyz": XYZ.repeat(2, 1),
    "tag_id": torch.arange(9).repeat(2),
    "corner": torch.zeros(18, dtype=I64),
}
CORNERS, NOISE = Corners(**COLUMNS), ImuNoise(1e-4, 1e-3)
RECORDED = {
    "cameras": (CAMERA,),
    "corners": (CORNERS,),
    "imus": (SAMPLES,),
    "noise": (NOISE,),
    "gravity": 9.8,
    "time_offset": None,
}
RECORDING = Recording(**RECORDED)
CHAIN = CamChain((CAMERA,), POSE[0, :1], torch.zeros(1, dtype=F64))
MOVING = simulate(seconds=4.0, images=40, samples=400, cameras=1, order=5, spacing=0.1).recording
CHAIN_FILE = Path(FOLDER.name) / "camchain.yaml"
records.write_camchain(CHAIN_FILE, CHAIN)
CORNER_FILE = Path(FOLDER.name) / "corners.npz"
np.savez(
    CORNER_FILE, xyz_m=COLUMNS["xyz"].numpy(), **{k: v.numpy() for k, v in COLUMNS.items() if k != "xyz"}
)
CONFIG_FILE = file(yaml.safe_dump({"cam0": yaml.safe_load(CHAIN_FILE.read_text())["cam0"]}), "config.yaml")


#: Stands for a calibration until one is needed: making it takes longer than all errors together.
FOUND = object()


@cache
def found() -> calibrate.Calibration:
    return calibrate.calibrate(MOVING, spacing=0.1)


def write(folder: object, calibration: object) -> None:
    calibrate.write_calibration(folder, found() if calibration is FOUND else calibration)


accept(
    {
        "Camera": (
            Camera,
            {
                "name": "cam0", "intrinsics": CAMERA.intrinsics, "coefficients": CAMERA.coefficients,
                "resolution": CAMERA.resolution, "distortion": "radtan", "model": "pinhole",
            },
        ),
        "CamChain": (
            CamChain,
            {"cameras": (CAMERA,), "T_imu_cam": CHAIN.T_imu_cam, "time_offset": CHAIN.time_offset},
        ),
        "read_camchain": (records.read_camchain, {"path": CHAIN_FILE}),
        "write_camchain": (records.write_camchain, {"path": CHAIN_FILE, "chain": CHAIN}),
        "Corners": (Corners, COLUMNS),
        "Corners.select": (CORNERS.select, {"images": torch.tensor([True, False])}),
        "Recording": (Recording, RECORDED),
        "Recording.between": (RECORDING.between, {"start": 0.0, "end": 1.0}),
        "Recording.only": (lambda cameras: RECORDING.only(*cameras), {"cameras": (0,)}),
        "board_poses": (calibrate.board_poses, {"camera": CAMERA, "corners": CORNERS}),
        "find_start": (calibrate.find_start, {"recording": MOVING, "max_offset": 10.0}),
        "read_corners": (calibrate.read_corners, {"path": CORNER_FILE}),
        "read_recording": (
            calibrate.read_recording, {"config": CONFIG_FILE, "corners": [CORNER_FILE], "imus": []}
        ),
        "write_calibration": (write, {"folder": f"{FOLDER.name}/calibration", "calibration": FOUND}),
    }
)  # fmt: skip


def cases() -> Iterator[Case]:
    """All of them."""
    yield from _of_cameras()
    yield from _of_corners()
    yield from _of_recordings()
    for function, argument in (
        ("read_camchain", "path"),
        ("write_camchain", "path"),
        ("read_corners", "path"),
        ("read_recording", "config"),
        ("write_calibration", "folder"),
    ):
        for bad in (None, 3, b"a"):
            yield refused(function, argument, "type", bad, f"got {type(bad).__name__}", "expected a path")
        if function.startswith("read"):
            gone = f"{FOLDER.name}/nowhere"
            yield refused(function, argument, "option", gone, gone, "no such file", named="nowhere")
            yield refused(
                function, argument, "option", FOLDER.name, "got a folder", "expected a file",
                named=Path(FOLDER.name).name,
            )  # fmt: skip
    for bad in (0.0, -1.0, NAN):
        yield refused("Result.standard_deviation", "stretch", "option", bad, f"got {bad}", "above zero")
    empty = file("", "empty.yaml")
    yield refused(
        "read_camchain", "path", "count", empty, "got NoneType", "expected sections", named="empty.yaml"
    )
    some = file("a: 1", "some.yaml")
    yield refused("read_camchain", "path", "count", some, "got only a", "cam0, cam1", named="some.yaml")
    yield refused("write_camchain", "path", "option", f"{FOLDER.name}/no/a", "does not exist", "make it first",
                  named="a")  # fmt: skip
    yield refused("write_camchain", "chain", "type", CAMERA, "got Camera", "CamChain")
    yield refused("write_calibration", "folder", "option", CONFIG_FILE, CONFIG_FILE, "expected a folder")
    yield refused("write_calibration", "calibration", "type", 5, "got int", "expected a Calibration")
    for argument in ("corners", "imus"):
        for bad in (CORNER_FILE, None, "a"):
            yield refused(
                "read_recording",
                argument,
                "type",
                bad,
                f"got {type(bad).__name__}",
                "expected a list of paths",
            )
        yield refused("read_recording", argument, "type", [5], "got int", "expected paths")
    yield refused(
        "read_recording", "corners", "count", [], "got cam0", "one section for each", named="config.yaml"
    )
    twice = [CORNER_FILE, CORNER_FILE]
    yield refused("read_recording", "corners", "count", twice, "got cam0", "cam0, cam1", named="config.yaml")
    bad = file("not an archive", "text.npz")
    yield refused(
        "read_corners", "path", "option", bad, "damaged", "expected an npz archive", named="text.npz"
    )


def _of_cameras() -> Iterator[Case]:
    yield refused("Camera", "name", "type", 5, "got int", "expected a string")
    for argument, count in (("intrinsics", 4), ("coefficients", 4), ("resolution", 2)):
        for bad in (None, 5.0, "fast"):
            yield refused(
                "Camera", argument, "type", bad, f"got {type(bad).__name__}", f"expected {count} numbers"
            )
        yield refused("Camera", argument, "type", ("a",) * count, "got str", "expected a number")
        yield refused(
            "Camera", argument, "shape", (1.0,) * (count + 1), f"got {count + 1}", f"expected {count} numbers"
        )
        for bad in (NAN, INF):
            yield refused("Camera", argument, "nan", (bad,) * count, f"got {bad}", "expected a finite number")
    yield refused("Camera", "intrinsics", "option", (-1.0, 2, 3, 4), "got -1", "above zero")
    yield refused("Camera", "resolution", "option", (640, 480.5), "got 480.5", "whole pixels")
    yield refused("Camera", "distortion", "option", "fov", "got 'fov'", "'radtan', 'equidistant'")
    yield refused("Camera", "model", "option", "omni", "got 'omni'", "'pinhole'")

    good = CHAIN.T_imu_cam
    for bad in (5, None):
        yield refused(
            "CamChain", "cameras", "type", bad, f"got {type(bad).__name__}", "expected a tuple of Camera"
        )
    yield refused("CamChain", "cameras", "type", ("cam0",), "got str", "expected a Camera")
    yield refused("CamChain", "cameras", "count", (), "got none", "at least one")
    for argument, bad, shape in (
        ("T_imu_cam", good[:, :6], "(1, 7)"),
        ("time_offset", torch.zeros(2, dtype=F64), "(1,)"),
    ):
        right = getattr(CHAIN, argument)
        yield refused("CamChain", argument, "type", right.tolist(), "got list", "expected a torch.Tensor")
        yield refused("CamChain", argument, "dtype", right.to(F32), "got torch.float32", "torch.float64")
        yield refused("CamChain", argument, "dtype", right.to(I64), "got torch.int64", "torch.float64")
        yield refused(
            "CamChain", argument, "shape", bad, f"got {tuple(bad.shape)}", f"expected shape {shape}"
        )
        yield refused("CamChain", argument, "nan", right + NAN, "got nan", "expected finite numbers")
    yield refused(
        "CamChain", "T_imu_cam", "zero quaternion", 0.0 * good, "got length 0", "expected quaternions"
    )


def _of_corners() -> Iterator[Case]:
    for argument, good in COLUMNS.items():
        other, name = (F32, "torch.float64") if good.dtype == F64 else (torch.int32, "torch.int64")
        yield refused("Corners", argument, "type", good.tolist(), "got list", "expected a torch.Tensor")
        yield refused("Corners", argument, "dtype", good.to(other), f"got {other}", f"expected {name}")
        yield refused("Corners", argument, "shape", good[None], f"got {(1, *good.shape)}", "expected shape")
        yield refused("Corners", argument, "device", good.to("meta"), "got meta", "on the CPU")
    yield refused("Corners", "uv", "count", COLUMNS["uv"][:5], "got (5, 2)", "expected shape (18, 2)")
    for argument in ("uv", "xyz"):
        for bad in (NAN, INF):
            spoiled = changed(COLUMNS[argument], (3, 1), bad)
            yield refused(
                "Corners", argument, "nan", spoiled, f"got {bad} at index (3, 1)", "expected finite numbers"
            )
    for bad in (torch.tensor([1, 0]), torch.tensor([1, 1])):
        yield refused("Corners", "t_ns", "time", bad, f"got {int(bad[1])} at row 1", "strictly ascending")
    yield refused("Corners", "frame", "option", COLUMNS["frame"] + 1, "got 2", "indices of the 2 images")
    yield refused("Corners", "frame", "option", COLUMNS["frame"] - 1, "got -1", "indices of the 2 images")
    yield refused("Corners", "frame", "option", COLUMNS["frame"].flip(0), "got 0 at row 9", "ascending")
    yield refused("Corners", "xyz", "option", COLUMNS["xyz"] + 0.1, "got z = 0.1", "flat board")
    select = "Corners.select"
    yield refused(select, "images", "type", [True, False], "got list", "expected a torch.Tensor")
    yield refused(select, "images", "dtype", torch.tensor([1, 0]), "got torch.int64", "torch.bool")
    yield refused(select, "images", "shape", torch.tensor([True]), "got (1,)", "expected shape (2,)")
    yield refused(select, "images", "device", torch.ones(2, device="meta").bool(), "got meta", "on the CPU")


def _of_recordings() -> Iterator[Case]:
    yield refused("Recording", "noise", "option", (ImuNoise(1e-4),), "got 0", "above zero")
    yield refused("Recording", "noise", "type", (ImuNoise((1e-4,) * 3, 1e-3),), "got Tensor", "a number")
    for argument, kind in (
        ("cameras", "Camera"),
        ("corners", "Corners"),
        ("imus", "ImuRecord"),
        ("noise", "ImuNoise"),
    ):
        yield refused("Recording", argument, "type", None, "got NoneType", f"expected a tuple of {kind}")
        yield refused("Recording", argument, "type", (5,), "got int", f"expected a {kind}")
    yield refused("Recording", "cameras", "count", (), "got none", "at least one", corners=())
    yield refused("Recording", "corners", "count", (), "got 0", "one for each of the 1 cameras")
    yield refused("Recording", "noise", "count", (NOISE, NOISE), "got 2", "one for each of the 1 imus")
    yield from numbers("Recording", "gravity", 0.0, -9.8)
    for bad in (0.1, "0.1", torch.zeros(1)):
        yield refused("Recording", "time_offset", "type", bad, f"got {type(bad).__name__}", "one a camera")
    yield refused("Recording", "time_offset", "type", ("0",), "got str", "a number")
    yield refused("Recording", "time_offset", "count", (0.0, 0.0), "got 2", "each of the 1 cameras")
    yield refused("Recording", "time_offset", "nan", (NAN,), "got nan", "a finite number")
    aside = Corners(**{**COLUMNS, "uv": COLUMNS["uv"] + 600.0})
    yield refused("Recording", "corners", "option", (aside,), "got (700.0, 700.0)", "640 x 480")
    back = records.ImuRecord(SAMPLES.time_ns.flip(0), SAMPLES.gyroscope, SAMPLES.accelerometer)
    yield refused("Recording", "imus", "time", (back,), "got 6 at row 1", "strictly ascending")
    for argument in ("gyroscope", "accelerometer"):
        columns = {"gyroscope": SAMPLES.gyroscope, "accelerometer": SAMPLES.accelerometer}
        spoiled = records.ImuRecord(SAMPLES.time_ns, **{**columns, argument: columns[argument] + NAN})
        yield refused("Recording", "imus", "nan", (spoiled,), f"{argument}: expected finite", "got nan")
    for argument in ("start", "end"):
        for bad in (None, "a", True):
            yield refused(
                "Recording.between", argument, "type", bad, f"got {type(bad).__name__}", "expected a number"
            )
        for bad in (NAN, INF):
            yield refused("Recording.between", argument, "nan", bad, f"got {bad}", "expected a finite number")
    yield refused("Recording.between", "end", "time", -1.0, "got -1", "after start = 0 s")
    for bad in ((-1,), ("0",), (0.0,)):
        yield refused(
            "Recording.only", "cameras", "option", bad, f"got {bad[0]!r}", "a whole number of at least 0"
        )
    yield refused("Recording.only", "cameras", "option", (1,), "got 1", "numbers from 0 to 0")
    yield refused("Recording.only", "cameras", "count", (), "got ()", "at least one")
    yield refused("Recording.only", "cameras", "count", (0, 0), "got (0, 0)", "each once")
    yield refused("board_poses", "camera", "type", "cam0", "got str", "Camera")
    yield refused("board_poses", "corners", "type", COLUMNS, "got dict", "Corners")
    yield refused("find_start", "recording", "type", (CAMERA,), "got tuple", "Recording")
    bare = Recording((CAMERA,), (CORNERS,), (), ())
    yield refused("find_start", "recording", "count", bare, "got none", "at least one IMU")
    yield refused(
        "find_start", "recording", "count", RECORDING, "got 2 of 2", "at least 20 images", named="cam0"
    )
    apart = MOVING.imus[0]
    apart = records.ImuRecord(apart.time_ns + 10**12, apart.gyroscope, apart.accelerometer)
    late = Recording(MOVING.cameras, MOVING.corners, (apart,), MOVING.noise)
    yield refused("find_start", "recording", "time", late, "begin", "that overlap", named="cam0 with imu0")
    for bad in ("a", True, 1j):
        yield refused(
            "find_start", "max_offset", "type", bad, f"got {type(bad).__name__}", "expected a number"
        )
    for bad in (NAN, INF, 0.0, -1.0):
        yield refused("find_start", "max_offset", "nan", bad, f"got {bad}", "above zero")


_FILES = "read_camchain write_camchain read_corners read_recording write_calibration"
_CHECKED = "Recording board_poses find_start"
_PARTS = "Recording.between Recording.only"
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE = {
    "shape": {
        "files, numbers and what was checked when it was made": f"{_FILES} {_CHECKED} {_PARTS}",
    },
    "dtype": {"files, numbers and checked parts": f"{_FILES} {_CHECKED} {_PARTS} Camera"},
    "device": {
        "files, numbers and checked parts, which are on the CPU": f"{_FILES} {_CHECKED} {_PARTS} Camera",
        "written number by number, wherever they are": "CamChain",
    },
    "nan": {
        "files, whose numbers are tried in test_calibration_files.py": f"{_FILES}",
        "choices and what was checked": "Corners.select Recording.only board_poses",
    },
    "zero quaternion": {
        "no quaternion in recordings": f"{_FILES} {_CHECKED} {_PARTS} Camera Corners Corners.select",
    },
    "count": {
        "one of each": "Camera write_camchain write_calibration read_corners Recording.between",
        "any number of images": "Corners.select board_poses",
    },
    "time": {
        "no times in these": f"{_FILES} Camera CamChain Corners.select Recording.only board_poses",
    },
}
