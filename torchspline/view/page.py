"""A page with an interactive view of trajectories; what the browser does is in `page.html`."""

import html
import json
from collections.abc import Mapping
from importlib.resources import files
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchspline import checks
from torchspline.io.archive import check_folder, write_bytes
from torchspline.plot.figure import named, times_of
from torchspline.splines import Trajectory
from torchspline.units import SECOND

#: Directions that can point up in a view.
UP = ("x", "y", "z", "-x", "-y", "-z")
_DIGITS = 7
_MOST_POINTS = 5000


def page(
    trajectories: Trajectory | Mapping[str, Trajectory],
    *,
    measured: Tensor | None = None,
    samples: int = 2000,
    up: str = "z",
    title: str = "trajectory",
) -> str:
    """The text of a page: paths in 3D with frames along them, a slider for the time, speeds to click on.

    The page needs a browser and nothing else. `#t=2.5` behind its address shows that moment.

    Args:
        trajectories: one, or several by name, with positions; times are counted from the start of each where they
            are in nanoseconds, else as they are.
        measured: (N, 3) positions to show as dots, m; NaN is left out.
        samples: how finely trajectories are drawn.
        up: "x", "y", "z", "-x", "-y" or "-z": the direction of the world that points up; "-y" for KITTI.
        title: of the page.
    Raises:
        TypeError, ValueError: a wrong type, shape or value, a batch of trajectories, or one without positions.
    """
    checks.whole("samples", samples, least=2)
    checks.choice("up", up, UP)
    checks.instance("title", title, str, "a text")
    shown = [_curve(name, x, samples) for name, x in named(trajectories).items()]
    dots: list[list[float]] = []
    if measured is not None:
        checks.is_floating_tensor("measured", measured)
        if measured.ndim != 2 or measured.shape[-1] != 3:
            raise ValueError(f"measured: expected shape (N, 3), got {tuple(measured.shape)}")
        good = measured.detach().to("cpu", torch.float64)
        good = good[good.isfinite().all(-1)]
        dots = _rounded(good[:: max(1, -(-len(good) // _MOST_POINTS))])
    # "</script>" inside a name must not end the script.
    data = json.dumps({"curves": shown, "measured": dots, "up": up}, allow_nan=False).replace("<", "\\u003c")
    text = files("torchspline.view").joinpath("page.html").read_text(encoding="utf-8")
    return text.replace("{{title}}", html.escape(title)).replace("{{data}}", data)


def write_page(
    path: str | PathLike[str],
    trajectories: Trajectory | Mapping[str, Trajectory],
    **options: Any,
) -> None:
    """Write the page of `page`, whose options these are. An existing file is replaced.

    Raises:
        FileNotFoundError: the folder of `path` does not exist. Otherwise as `page`.
    """
    if not isinstance(path, (str, PathLike)):
        raise TypeError(f"path: expected a path, got {type(path).__name__}")
    check_folder(Path(path))
    write_bytes(Path(path), page(trajectories, **options).encode())


def _curve(name: str, trajectory: Trajectory, samples: int) -> dict[str, Any]:
    t = times_of(trajectory, samples)
    device = next((x.device for x in trajectory.buffers()), torch.device("cpu"))
    device = next((x.device for x in trajectory.parameters()), device)
    with torch.no_grad():
        motion = trajectory.kinematics(t.to(device))
    if motion.position is None or motion.velocity is None:
        raise ValueError(f"trajectories: expected ones with positions, got one of {trajectory.group}")
    if motion.position.ndim != 2:
        raise ValueError(
            f"trajectories: expected single trajectories, got a batch of {tuple(motion.position.shape[:-2])}"
        )
    seconds = (t - t[0]).double() / SECOND if t.dtype == torch.int64 else t
    curve: dict[str, Any] = {
        "name": name,
        "t": seconds.tolist(),
        "position": _rounded(motion.position),
        "speed": _rounded(motion.velocity.norm(dim=-1)),
    }
    if motion.rotation is not None and motion.angular_velocity is not None:
        curve["rotation"] = _rounded(motion.rotation)
        curve["turning"] = _rounded(motion.angular_velocity.norm(dim=-1))
    return curve


def _rounded(x: Tensor) -> Any:
    """Plain numbers to `_DIGITS` digits of the largest."""
    x = x.detach().to("cpu", torch.float64)
    largest = float(x.abs().max()) if x.numel() else 0.0
    if largest == 0.0:
        return x.tolist()
    decimals = max(0, _DIGITS - len(str(int(largest)))) if largest >= 1 else _DIGITS + 2
    return [
        [round(v, decimals) for v in row] if isinstance(row, list) else round(row, decimals)
        for row in x.tolist()
    ]
