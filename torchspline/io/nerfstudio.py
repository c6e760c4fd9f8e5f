"""Camera poses as nerfstudio has them: `transforms.json` of a data set, `camera_path.json` of a rendering.

Their cameras look along -z with y up (OpenGL); here a camera looks along +z with y down, as images have it and as the
residuals of reprojections take it. The two differ by half a turn about x.
"""

import json
import math
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline import checks
from torchspline.groups.convert import from_transform_matrix, to_transform_matrix
from torchspline.groups.group import SO3
from torchspline.io.archive import check_folder, read_bytes, write_bytes
from torchspline.io.records import PoseRecord
from torchspline.units import SECOND

_KINDS = ("camera_path", "transforms")
#: A rotation from the axes here to theirs, on the right: half a turn about x.
_HALF_TURN = (0.0, 1.0, 0.0, 0.0)
#: Matrices are printed with six digits or more.
_ROUNDED = 1e-4
#: Frames of a video are evenly spaced up to this share of their distance.
_EVEN = 1e-3


def read_nerfstudio(path: str | PathLike[str], fps: float | None = None) -> PoseRecord:
    """Read the camera poses of a `transforms.json` or a `camera_path.json`, camera to world.

    Args:
        path: the file, plain or gzipped; which of the two it is, its content tells.
        fps: frames per second, Hz: frame i is stamped i / fps. By default as the file has it: the `fps` of a camera
            path, the `time` of each frame (s) of a data set.
    Returns:
        PoseRecord: cameras that look along +z with y down, in the units of the file; rotations that were rounded are
        made rotations again.
    Raises:
        FileNotFoundError: no such file.
        ValueError: content that cannot be read as either; the message names the file and the frame. No `fps` and none
        in the file.
    """
    if not isinstance(path, (str, PathLike)):
        raise TypeError(f"path: expected a path, got {type(path).__name__}")
    path = Path(path)
    if fps is not None:
        checks.positive("fps", fps)
    content = _load(path)
    key, entry = (
        ("camera_path", "camera_to_world") if "camera_path" in content else ("frames", "transform_matrix")
    )
    frames = content.get(key)
    if not isinstance(frames, list) or not frames:
        raise ValueError(
            f"{path}: expected a list of frames or camera_path that is not empty, got {_short(frames)}"
        )
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict) or entry not in frame:
            raise ValueError(f"{path}: {key}[{i}]: expected {entry} in it, got {_short(frame)}")
    matrices = _matrices(path, key, entry, [frame[entry] for frame in frames])
    time_ns = _stamps(path, content, frames, fps)
    pose = from_transform_matrix(torch.from_numpy(matrices))
    rotation = SO3.compose(pose[:, 3:], torch.tensor(_HALF_TURN, dtype=torch.float64))
    return PoseRecord(time_ns, pose[:, :3].contiguous(), rotation, str(path))


def write_nerfstudio(
    path: str | PathLike[str],
    record: PoseRecord,
    kind: str = "camera_path",
    field_of_view: float = 50.0,
    resolution: tuple[int, int] = (1920, 1080),
) -> None:
    """Write camera poses for nerfstudio, to render along (`camera_path`) or as the frames of a data set (`transforms`).

    Poses read back are the same to rounding, their stamps counted from the first. An existing file is replaced.

    Args:
        record: poses of a camera that looks along +z with y down, camera to world, finite.
        kind: "camera_path", whose stamps have to be evenly spaced, or "transforms", which keeps their times; the images
            are called `images/frame_00000.png` and so on.
        field_of_view: vertical, degrees. resolution: (width, height), pixels.
    Raises:
        FileNotFoundError: the folder of `path` does not exist.
        ValueError: a record that is empty or not finite, or stamps that such a file cannot hold.
    """
    if not isinstance(path, (str, PathLike)):
        raise TypeError(f"path: expected a path, got {type(path).__name__}")
    path = Path(path)
    checks.instance("record", record, PoseRecord, "a PoseRecord")
    checks.choice("kind", kind, _KINDS)
    if not checks.positive("field_of_view", field_of_view) < 180:
        raise ValueError(f"field_of_view: expected less than 180 degrees, got {field_of_view}")
    if not isinstance(resolution, Sequence) or len(resolution) != 2:
        raise ValueError(f"resolution: expected (width, height), got {resolution!r}")
    for size in resolution:
        checks.whole("resolution", size, least=1)
    if len(record) == 0:
        raise ValueError("record: expected poses to write, got an empty record")
    checks.finite("record", record.position)
    checks.finite("record", record.rotation)
    checks.quaternions("record", record.rotation, [(0, 4)])
    check_folder(path)
    rotation = SO3.compose(record.rotation.detach().cpu(), torch.tensor(_HALF_TURN, dtype=torch.float64))
    pose = torch.cat([record.position.detach().cpu(), rotation], dim=-1)
    matrices = to_transform_matrix(pose).tolist()
    width, height = resolution
    if kind == "camera_path":
        fps = _even_rate(record)
        frame = {"fov": float(field_of_view), "aspect": width / height}
        content: dict[str, Any] = {
            "camera_type": "perspective",
            "render_height": height,
            "render_width": width,
            "fps": fps,
            "seconds": len(record) / fps,
            "smoothness_value": 0.0,
            "is_cycle": False,
            "keyframes": [],
            "camera_path": [{"camera_to_world": [x for row in m for x in row], **frame} for m in matrices],
        }
    else:
        focal = height / 2 / math.tan(math.radians(field_of_view) / 2)
        content = {
            "camera_model": "OPENCV",
            "fl_x": focal,
            "fl_y": focal,
            "cx": width / 2,
            "cy": height / 2,
            "w": width,
            "h": height,
            "frames": [
                {"file_path": f"images/frame_{i:05d}.png", "transform_matrix": matrix, "time": time}
                for i, (matrix, time) in enumerate(zip(matrices, record.time.tolist(), strict=True))
            ],
        }
    write_bytes(path, (json.dumps(content, indent=1) + "\n").encode())


def _load(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(read_bytes(path).decode("utf-8-sig"))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as reason:
        raise ValueError(f"{path}: expected JSON, got {' '.join(str(reason).split())[:200]}") from None
    except FileNotFoundError:
        raise
    except ValueError as reason:  # numbers of thousands of digits
        raise ValueError(str(reason) if str(reason).startswith(str(path)) else f"{path}: {reason}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected an object with frames or camera_path, got {_short(content)}")
    return content


def _matrices(path: Path, key: str, entry: str, rows: list[Any]) -> NDArray[np.float64]:
    """`(N, 4, 4)`, each the rigid motion next to what the file has."""
    found = np.empty((len(rows), 4, 4))
    found[:, 3] = 0, 0, 0, 1
    for i, x in enumerate(rows):
        try:
            flat = [y for row in x for y in row] if isinstance(x[0], list) else list(x)
            if len(flat) not in (12, 16) or not all(type(y) in (int, float) for y in flat):
                raise ValueError
            found[i].reshape(-1)[: len(flat)] = flat
        except (TypeError, ValueError, LookupError, OverflowError):
            raise ValueError(f"{path}: {key}[{i}].{entry}: expected 4 x 4 numbers, got {_short(x)}") from None
    if not np.isfinite(found).all():
        i = int(np.isfinite(found).all(axis=(1, 2)).argmin())
        raise ValueError(f"{path}: {key}[{i}].{entry}: expected finite numbers, got {_short(rows[i])}")
    u, _, vh = np.linalg.svd(np.clip(found[:, :3, :3], -10, 10))
    nearest = u @ vh
    off = np.abs(nearest - found[:, :3, :3]).max(axis=(1, 2))
    wrong = (off > _ROUNDED) | (np.linalg.det(nearest) < 0) | (found[:, 3] != (0, 0, 0, 1)).any(axis=1)
    if wrong.any():
        i = int(wrong.argmax())
        raise ValueError(
            f"{path}: {key}[{i}].{entry}: expected a rotation (within {_ROUNDED:g}), a translation and a last row of "
            f"0 0 0 1, got {_short(rows[i])}"
        )
    found[:, :3, :3] = nearest
    return found


def _stamps(path: Path, content: dict[str, Any], frames: list[Any], fps: float | None) -> Tensor:
    count = len(frames)
    if fps is None and "camera_path" not in content:
        if not all("time" in frame for frame in frames):
            raise ValueError(f"{path}: expected a time in every frame, there is none in some; pass fps=")
        seconds = [_number(path, f"frames[{i}].time", frame["time"]) for i, frame in enumerate(frames)]
    else:
        rate = _number(path, "fps", content.get("fps")) if fps is None else fps
        if rate <= 0:
            raise ValueError(f"{path}: fps: expected a number above zero, got {rate:g}")
        seconds = [i / rate for i in range(count)]
    if max(map(abs, seconds)) > 2**63 / SECOND * (1 - 1e-12):
        raise ValueError(
            f"{path}: expected times within the range of int64 nanoseconds, got {max(seconds, key=abs):g} s"
        )
    return torch.tensor([round(x * SECOND) for x in seconds], dtype=torch.int64)


def _number(path: Path, name: str, x: Any) -> float:
    try:
        if type(x) in (int, float) and math.isfinite(x):
            return float(x)
    except OverflowError:
        pass
    raise ValueError(f"{path}: {name}: expected a finite number, got {_short(x)}")


def _even_rate(record: PoseRecord) -> float:
    """Frames per second of stamps that are evenly spaced."""
    if len(record) == 1:
        return 1.0
    stamps = record.time_ns.cpu()
    step = float(stamps[-1] - stamps[0]) / (len(record) - 1)
    even = torch.arange(len(record), dtype=torch.float64) * step
    off = (record.time.cpu() * SECOND - even).abs()
    if step <= 0 or bool((off > max(_EVEN * step, 1.0)).any()):
        raise ValueError(
            f"record: expected evenly spaced stamps, got one that is off by {float(off.max()) / SECOND:.3g} s at row "
            f"{int(off.argmax())}; sample a trajectory at even times, or write kind='transforms'"
        )
    rate = SECOND / step
    return float(round(rate)) if abs(rate - round(rate)) < 1e-6 * rate else rate


def _short(x: Any) -> str:
    """For messages: never the whole of what a file holds."""
    if isinstance(x, (list, dict)):
        return f"{'a list' if isinstance(x, list) else 'an object'} of {len(x)} entries"
    text = repr(x)
    return text if len(text) <= 60 else text[:57] + "..."
