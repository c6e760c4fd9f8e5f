"""The library's own trajectory file: every family of spline, bit for bit, without pickles.

An npz archive (`numpy.load` opens it): an array for each tensor of the trajectory, and `header`, the bytes of a JSON
object with the rest: `format`, `version`, `family`, `group`, what else the family's constructor takes, and which
tensors are `learnable`. A new family is a line in `FAMILIES`.
"""

import json
import re
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from torchspline.groups.group import Group
from torchspline.io.archive import read_arrays, write_arrays
from torchspline.splines import (
    BSpline,
    HermiteSpline,
    KeyframeSpline,
    NonuniformBSpline,
    SplitBSpline,
    Trajectory,
)
from torchspline.splines.trajectory import Mounted
from torchspline.units import SECOND

_FORMAT, _VERSION = "torchspline trajectory", 1
_DTYPES = {np.dtype(x) for x in ("float32", "float64", "int64")}
_LONGEST_NAME, _DEEPEST = 200, 16


class Family(NamedTuple):
    """A family of trajectories: its class, and the arguments that make it again."""

    make: type[Trajectory]
    #: Attributes that are tensors, and arguments of the same names; those that are None are left out.
    tensors: tuple[str, ...]
    #: Other attributes: numbers, words, truth values; likewise.
    settings: tuple[str, ...]
    #: Whether the constructor takes a group, and whether it takes `learnable`.
    takes_group: bool = True
    learnable: bool = True


_ALWAYS = ("extrapolate", "validate")
_UNIFORM = (("control_points", "dt", "t0"), ("order", "dt_ns", "t0_ns", *_ALWAYS))
FAMILIES: dict[str, Family] = {
    "BSpline": Family(BSpline, *_UNIFORM),
    "SplitBSpline": Family(SplitBSpline, *_UNIFORM, takes_group=False),
    "NonuniformBSpline": Family(NonuniformBSpline, ("control_points", "knots"), ("order", *_ALWAYS)),
    "HermiteSpline": Family(
        HermiteSpline, ("values", "velocities", "accelerations", "times"), ("coordinates", "frame", *_ALWAYS)
    ),
    "KeyframeSpline": Family(KeyframeSpline, ("keyframes", "times"), ("method", "way", "options", *_ALWAYS)),
    "Mounted": Family(Mounted, ("T_body_sensor",), ("name",), takes_group=False, learnable=False),
}


def save_trajectory(path: str | PathLike[str], trajectory: Trajectory) -> None:
    """Write a trajectory; `load_trajectory` gives back the same numbers to the last bit, stamps and precision included.

    Graphs are not kept: tensors that require grad without being Parameters come back as plain numbers. An existing
    file is replaced; its name stays as given, `.npz` is usual.

    Raises:
        TypeError: no trajectory, or one of a family that is not in `torchspline.io.trajectory.FAMILIES`.
        FileNotFoundError: the folder of `path` does not exist.
    """
    path = _path(path)
    arrays: dict[str, NDArray[Any]] = {}
    header = {"format": _FORMAT, "version": _VERSION, **_describe(trajectory, arrays, "")}
    text = json.dumps(header, allow_nan=False).encode()
    write_arrays(path, {"header": np.frombuffer(text, np.uint8), **arrays})


def load_trajectory(path: str | PathLike[str]) -> Trajectory:
    """Read a trajectory from a file of `save_trajectory`, on the CPU; Parameters are Parameters again.

    Nothing in the file is executed, and no memory is spent on what only a header promises.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no such file of a trajectory, a damaged one, or one of a later version; the message names it.
    """
    path = _path(path)
    arrays = read_arrays(path)
    try:
        stored = arrays.pop("header", None)
        if stored is None or stored.dtype != np.uint8 or stored.ndim != 1:
            raise ValueError(f"no header of a {_FORMAT}, only {', '.join(arrays)[:80] or 'nothing'}")
        header = json.loads(stored.tobytes().decode("utf-8"))
        if not isinstance(header, dict) or header.get("format") != _FORMAT:
            raise ValueError(f"a header that does not say {_FORMAT!r}")
        if header.get("version") != _VERSION:
            raise ValueError(
                f"version {str(header.get('version'))[:20]} where {_VERSION} is known; a later torchspline reads it"
            )
        found = _restore(header, arrays, "", 0)
        if arrays:
            raise ValueError(f"arrays that do not belong to it: {', '.join(arrays)[:80]}")
        return found
    except (TypeError, ValueError, KeyError, RecursionError, OverflowError, RuntimeError) as reason:
        text = " ".join(str(reason).split())[:300]
        raise ValueError(f"{path}: expected a {_FORMAT}, got {text}") from None


def even_times(trajectory: Trajectory, rate: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Times of a trajectory, `rate` a second from its start, as it takes them (s or ns) and as whole nanoseconds.

    Raises:
        ValueError: no rate, or so high a one that there would be more than 1e8 times.
    """
    if not 0 < rate < float("inf"):
        raise ValueError(f"rate: expected a finite number above zero (Hz), got {rate}")
    first, last = trajectory.domain
    nanoseconds = isinstance(first, int)
    span = (last - first) / (SECOND if nanoseconds else 1)
    if span * rate > 1e8:
        raise ValueError(f"rate: {rate:g} Hz over {span:g} s makes more than 1e8 times")
    steps = torch.arange(int(span * rate + 1e-9) + 1, dtype=torch.float64) / rate
    stamps = (steps * SECOND).round().to(torch.int64)
    if nanoseconds:
        t = first + stamps.clamp(max=last - first)
        return t, t
    return (first + steps).clamp(first, last), round(first * SECOND) + stamps


def _describe(trajectory: Any, arrays: dict[str, NDArray[Any]], prefix: str) -> dict[str, Any]:
    """The header of a trajectory; its tensors go into `arrays`."""
    name = type(trajectory).__name__
    family = FAMILIES.get(name)
    if family is None or family.make is not type(trajectory):
        raise TypeError(f"trajectory: expected one of {', '.join(FAMILIES)}, got {name}")
    header: dict[str, Any] = {"family": name, "group": trajectory.group.name}
    learnable = []
    for tensor in family.tensors:
        x = getattr(trajectory, tensor)
        if x is None:
            continue
        arrays[prefix + tensor] = x.detach().cpu().contiguous().numpy()
        if isinstance(x, nn.Parameter):
            learnable.append(tensor)
    for setting in family.settings:
        x = getattr(trajectory, setting)
        if x is not None:
            header[setting] = x
    header["learnable"] = learnable
    if name == "Mounted":
        header["trajectory"] = _describe(trajectory.trajectory, arrays, f"{prefix}trajectory.")
    return header


def _restore(
    header: Mapping[str, Any], arrays: dict[str, NDArray[Any]], prefix: str, depth: int
) -> Trajectory:
    name = header.get("family")
    family = FAMILIES.get(name) if isinstance(name, str) else None
    if family is None or depth > _DEEPEST:
        raise ValueError(f"the family {str(name)[:40]!r} where one of {', '.join(FAMILIES)} is expected")
    learnable = header.get("learnable")
    if not isinstance(learnable, list) or not set(map(str, learnable)) <= set(family.tensors):
        names = ", ".join(family.tensors)
        raise ValueError(f"learnable: {str(learnable)[:80]} where names out of {names} are expected")
    arguments: dict[str, Any] = {}
    for tensor in family.tensors:
        array = arrays.pop(prefix + tensor, None)
        if array is None:
            continue
        if array.dtype not in _DTYPES:
            raise ValueError(f"{tensor}: numbers of type {array.dtype}")
        x = torch.from_numpy(array)
        if tensor in learnable:
            if not x.is_floating_point():
                raise ValueError(f"{tensor}: learnable numbers of type {array.dtype}")
            x = nn.Parameter(x)
        arguments[tensor] = x
    for setting in family.settings:
        if setting in header:
            arguments[setting] = _plain(setting, header[setting])
    if family.takes_group:
        arguments["group"] = _group(header.get("group"), arguments)
    if family.learnable:
        arguments["learnable"] = False  # those that are learnt are Parameters by now
    options = arguments.pop("options", {})
    if not isinstance(options, dict) or set(options) & set(arguments):
        raise ValueError(f"options: {str(options)[:80]}")
    if name == "Mounted":
        inner = header.get("trajectory")
        if not isinstance(inner, dict):
            raise ValueError("no trajectory that is mounted")
        arguments["trajectory"] = _restore(inner, arrays, f"{prefix}trajectory.", depth + 1)
    return family.make(**arguments, **options)


def _plain(name: str, x: Any) -> Any:
    """Numbers, words and truth values; for the options of a scheme words by name."""
    if name == "options" and isinstance(x, dict) and all(isinstance(y, str) for y in x.values()):
        return x
    if isinstance(x, bool) != (name == "validate") or not isinstance(x, (int, str)):
        raise ValueError(f"{name}: {str(x)[:40]!r}")
    if isinstance(x, int) and abs(x) >= 2**63:
        raise ValueError(f"{name}: {x:.3e}")
    return x


def _group(name: Any, arguments: Mapping[str, Any]) -> Group:
    """The group, if its points can have as many numbers as there are: `R999999999` would take the memory."""
    points = next(iter(arguments.values()), None)
    width = points.shape[-1] if isinstance(points, torch.Tensor) and points.ndim else 0
    if not isinstance(name, str) or len(name) > _LONGEST_NAME:
        raise ValueError(f"group: {str(name)[:40]!r}")
    sizes = [int(size) for size in re.findall(r"\d+", re.sub(r"S[OE]\d", "", name))]
    if sum(sizes) > width:
        raise ValueError(f"group: {name} with points of {width} numbers")
    return Group(name)


def _path(path: str | PathLike[str]) -> Path:
    if not isinstance(path, (str, PathLike)):
        raise TypeError(f"path: expected a path, got {type(path).__name__}")
    return Path(path)
