"""Motion capture in BVH files: a skeleton, and how it moves."""

import gzip
import math
import zlib
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import NoReturn, Protocol

import numpy as np
import torch
from torch import Tensor

from torchspline import checks
from torchspline.groups.group import SE3, SO3
from torchspline.splines.keyframes import consistent_signs

#: Characters of a line and joints of a skeleton beyond which a file is taken for something else.
_LONGEST_LINE, _MOST_JOINTS = 1 << 20, 10_000
_AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
_CHANNELS = {f"{axis}{kind}".lower(): (kind, axis) for axis in _AXES for kind in ("position", "rotation")}


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Joints and their motion, as a BVH file has them; ends of limbs are joints without channels, "NAME end".

    Attributes:
        names: of the J joints, each after its parent. parents: which one that is, -1 for a root.
        offsets: of each joint from its parent, (J, 3), m.
        channels: of each joint, such as "Zrotation", in the order of the file.
        values: of all channels one after another, (F, C): m and degrees.
        interval: between frames, s.
        source: where it comes from, for messages and titles.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Tensor
    channels: tuple[tuple[str, ...], ...]
    values: Tensor
    interval: float
    source: str = ""

    def __repr__(self) -> str:
        frames = f"{len(self.values)} frames at {1 / self.interval:.5g} Hz"
        return f"Skeleton({len(self.names)} joints, {frames}, {self.source})"

    @property
    def time(self) -> Tensor:
        """Of the frames, (F,), s from the first."""
        return torch.arange(len(self.values), dtype=torch.float64) * self.interval

    def poses(self) -> Tensor:
        """Of every joint in the world, `(J, F, 7)` on SE3, m; quaternions of continuous sign.

        A joint's rotations are multiplied in the order of its channels, each about an axis of what came before. Its
        position channels, where it has some, stand in place of its offset, as Blender and MotionBuilder have it.
        """
        found: list[Tensor] = []
        column, count = 0, len(self.values)
        for parent, offset, channels in zip(self.parents, self.offsets, self.channels, strict=True):
            position, rotation = offset.repeat(count, 1), SO3.identity(count, dtype=torch.float64)
            for channel in channels:
                kind, axis = _CHANNELS[channel.lower()]
                x = self.values[:, column]
                column += 1
                if kind == "position":
                    position[:, "XYZ".index(axis)] = x
                else:
                    turn = torch.deg2rad(x)[:, None] * torch.tensor(_AXES[axis], dtype=torch.float64)
                    rotation = SO3.compose(rotation, SO3.exp(turn))
            local = torch.cat([position, rotation], -1)
            found.append(local if parent < 0 else SE3.compose(found[parent], local))
        return consistent_signs(torch.stack(found), SE3)


def read_bvh(path: str | PathLike[str], unit: float = 0.01) -> Skeleton:
    """Read a BVH file, plain or gzipped: any order of channels, on any joint, in any number.

    Args:
        path: the file.
        unit: of its lengths, m. BVH does not say; centimetres are usual.
    Raises:
        FileNotFoundError: no such file. TypeError: a path or unit that is none.
        ValueError: content that is no BVH, or damaged; the message names the file and the line.
    """
    if not isinstance(path, (str, PathLike)):
        raise TypeError(f"path: expected the path of a file, got {type(path).__name__}")
    checks.positive("unit", unit)
    file = Path(path)
    if file.is_dir():
        raise ValueError(f"path: {file}: expected a file, got a folder")
    if not file.is_file():
        raise FileNotFoundError(f"path: {file}: no such file")
    with file.open("rb") as raw:
        packed = raw.read(2) == b"\x1f\x8b"
    with gzip.open(file, "rb") if packed else file.open("rb") as stream:
        return _Parser(file, stream).skeleton(unit)


class _Stream(Protocol):
    def readline(self, size: int, /) -> bytes: ...


class _Parser:
    def __init__(self, path: Path, stream: _Stream):
        self.path, self.number = path, 0
        self.lines = self._lines(stream)
        self.names: list[str] = []
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []
        self.channels: list[tuple[str, ...]] = []

    def _lines(self, stream: _Stream) -> Iterator[list[str]]:
        """Fields of lines that have some, a line in memory at a time."""
        try:
            while line := stream.readline(_LONGEST_LINE):
                self.number += 1
                if len(line) == _LONGEST_LINE:
                    self.fail(f"lines below {_LONGEST_LINE} characters", "a longer one")
                if fields := line.decode(
                    "utf-8-sig" if self.number == 1 else "utf-8", errors="replace"
                ).split():
                    yield fields
        except (OSError, EOFError, zlib.error) as reason:
            self.fail("gzipped text", f"damaged data ({reason})")

    def fail(self, expected: str, got: str) -> NoReturn:
        got = got if len(got) <= 80 else got[:77] + "..."
        raise ValueError(f"path: {self.path}, line {self.number}: expected {expected}, got {got}")

    def next(self, expected: str) -> list[str]:
        fields = next(self.lines, None)
        if fields is None:
            self.fail(expected, "the end of the file")
        return fields

    def numbers(self, fields: list[str], count: int, what: str) -> list[float]:
        if len(fields) != count:
            self.fail(f"{count} numbers ({what})", f"{len(fields)}: {' '.join(fields)!r}")
        found = []
        for field in fields:
            try:
                found.append(float(field))
            except ValueError:
                found.append(math.nan)
            if not math.isfinite(found[-1]) or "_" in field:
                self.fail(f"a finite number ({what})", repr(field))
        return found

    def skeleton(self, unit: float) -> Skeleton:
        first = self.next("HIERARCHY")
        if [x.upper() for x in first] != ["HIERARCHY"]:
            self.fail("HIERARCHY", repr(" ".join(first)))
        self.hierarchy()
        values, interval = self.motion(sum(map(len, self.channels)))
        scale = np.array([unit if "position" in c.lower() else 1.0 for own in self.channels for c in own])
        return Skeleton(
            tuple(self.names),
            tuple(self.parents),
            torch.tensor(self.offsets, dtype=torch.float64) * unit,
            tuple(self.channels),
            torch.from_numpy(values * scale),
            interval,
            str(self.path),
        )

    def hierarchy(self) -> None:
        """Up to the line MOTION; no recursion, however deep the joints go."""
        stack: list[int] = []
        while True:
            word, *rest = self.next(
                "a joint or MOTION" if not stack else "a joint, its OFFSET or CHANNELS, or }"
            )
            kind = word.upper()
            if kind == "}" and not rest and stack:
                self.check_joint(stack.pop())
            elif kind == "MOTION" and not stack and self.names:
                return
            elif kind == ("JOINT" if stack else "ROOT"):
                self.joint(stack, " ".join(rest))
            elif kind == "END" and stack and " ".join(rest).upper().removesuffix("{").strip() == "SITE":
                brace = "{" if rest[-1].endswith("{") else ""
                self.joint(stack, f"{self.names[stack[-1]]} end{brace}")
            elif kind == "OFFSET" and stack and not self.offsets[stack[-1]]:
                self.offsets[stack[-1]] = self.numbers(rest, 3, "x, y, z of an offset")
            elif kind == "CHANNELS" and stack and not self.channels[stack[-1]]:
                self.channels[stack[-1]] = self.channel_names(rest)
            else:
                place = f"inside {self.names[stack[-1]]!r}" if stack else "outside of joints"
                self.fail(f"what may stand {place}", repr(" ".join([word, *rest])))

    def joint(self, stack: list[int], name: str) -> None:
        opened = name.endswith("{")
        name = name.removesuffix("{").strip()
        if not name:
            self.fail("a joint with a name", "none")
        if len(self.names) >= _MOST_JOINTS:
            self.fail(f"at most {_MOST_JOINTS} joints", "more")
        while name in self.names:
            name += "'"
        self.names.append(name)
        self.parents.append(stack[-1] if stack else -1)
        self.offsets.append([])
        self.channels.append(())
        stack.append(len(self.names) - 1)
        if not opened and (fields := self.next("{")) != ["{"]:
            self.fail("{", repr(" ".join(fields)))

    def check_joint(self, joint: int) -> None:
        if not self.offsets[joint]:
            self.fail(f"an OFFSET in {self.names[joint]!r}", "none")

    def channel_names(self, fields: list[str]) -> tuple[str, ...]:
        if not fields or not fields[0].isdecimal() or int(fields[0]) != len(fields) - 1:
            self.fail("CHANNELS, how many, and as many names", repr(" ".join(fields)))
        for i, name in enumerate(fields[1:], 1):
            if name.lower() not in _CHANNELS or name.lower() in (x.lower() for x in fields[1:i]):
                self.fail("different channels such as Xposition or Zrotation", repr(name))
        return tuple(fields[1:])

    def motion(self, columns: int) -> tuple[np.ndarray, float]:
        """`(F, C)` and the interval. Memory goes with the frames that are there, whatever the file says."""
        if columns == 0:
            self.fail("joints with CHANNELS", "none")
        frames = self.header("Frames:", "how many frames")
        if frames != int(frames) or frames < 1:
            self.fail("a number of frames of at least 1", f"{frames:g}")
        interval = self.header("Frame Time:", "seconds between frames")
        if interval <= 0:
            self.fail("seconds above zero between frames", f"{interval:g}")
        found = array("d")
        for i in range(int(frames)):
            found.extend(
                self.numbers(self.next(f"{int(frames)} frames, {i} came"), columns, f"channels of frame {i}")
            )
        if (more := next(self.lines, None)) is not None:
            self.fail(f"the end of the file after {int(frames)} frames", repr(" ".join(more)))
        return np.frombuffer(found, dtype=np.float64).reshape(-1, columns).copy(), interval

    def header(self, name: str, meaning: str) -> float:
        fields = " ".join(self.next(name)).split(":")
        if len(fields) != 2 or f"{fields[0].strip()}:".lower() != name.lower():
            self.fail(f"{name!r} and {meaning}", repr(":".join(fields)))
        return self.numbers(fields[1].split(), 1, meaning)[0]
