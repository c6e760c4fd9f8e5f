"""What the functions of the package accept, and what every argument of a kind is tried with."""

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch

import torchspline.io as records
from torchspline import (
    SE3,
    SO3,
    HermiteSpline,
    SplitBSpline,
)
from torchspline.groups import convert

F32, F64, I64 = torch.float32, torch.float64, torch.int64
NAN, INF = float("nan"), float("inf")
FOLDER = tempfile.TemporaryDirectory(prefix="torchspline-errors-")


def file(content: str, name: str) -> str:
    path = Path(FOLDER.name) / name
    path.write_text(content)
    return str(path)


# ---------------------------------------------------------------------- arguments that are accepted

POSE = SE3.random(2, 8, generator=torch.Generator().manual_seed(0))
TANGENT = torch.full((2, 8, 6), 0.1, dtype=F64)
Q, V = POSE[..., 3:], POSE[..., :3]
DUAL = convert.pose_to_dual_quaternion(POSE)
T = torch.tensor([0.0, 0.2, 0.5], dtype=F64)
STAMPS = torch.arange(8, dtype=F64)
NS = torch.arange(3)
SPLINE = SplitBSpline(POSE, dt=0.1)
KNOTS = {
    "values": POSE,
    "velocities": TANGENT,
    "accelerations": TANGENT,
    "group": SE3,
    "times": torch.linspace(0.0, 0.5, 8, dtype=F64),
}
HERMITE = HermiteSpline(**KNOTS)
KNOTTED = {
    "control_points": POSE,
    "group": SE3,
    "knots": torch.tensor([0.0] * 4 + [0.1, 0.2, 0.3, 0.4] + [0.5] * 4, dtype=F64),
}
KEYED = {"keyframes": POSE, "times": KNOTS["times"]}
SE3_MATRIX, SO3_MATRIX = SE3.to_matrix(POSE), SO3.to_matrix(Q)
TUM_FILE = file("1.5 1 2 3 0 0 0 1\n2.5 1 2 3 0 0 0 1\n", "good.txt")
IMU_FILE = file("1520530308189679351,1,2,3,4,5,6\n", "good.csv")
POSE_COLUMNS = {"time_ns": torch.arange(8), "position": V[0], "rotation": Q[0]}
IMU_COLUMNS = {"time_ns": torch.arange(8), "gyroscope": V[0], "accelerometer": V[0]}
POSES, SAMPLES = records.PoseRecord(**POSE_COLUMNS), records.ImuRecord(**IMU_COLUMNS)

# ---------------------------------------------------------------------- functions and good arguments

#: Every public function, called by keyword with arguments it accepts.
ACCEPTED: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {}


def accept(functions: dict[str, tuple[Callable[..., Any], dict[str, Any]]]) -> None:
    """Enters functions, each with arguments it accepts; no two files may enter the same one."""
    again = ACCEPTED.keys() & functions.keys()
    if again:
        raise ValueError(f"{sorted(again)} were entered by another file of cases")
    ACCEPTED.update(functions)


# ---------------------------------------------------------------------- arguments that are refused


class Case(NamedTuple):
    """What is called, the argument that is wrong and how, and what the message has to contain."""

    function: str
    argument: str
    category: str
    changes: dict[str, Any]
    came: str
    expected: str
    #: How the message calls the argument: at its start, or anywhere if two arguments do not go together.
    named: str


TOGETHER = ("device", "batch", "mixed dtype")


def refused(
    function: str,
    argument: str,
    category: str,
    bad: Any,
    came: str,
    expected: str,
    named: str = "",
    **also: Any,
) -> Case:
    return Case(function, argument, category, {argument: bad, **also}, came, expected, named or argument)


def changed(x: torch.Tensor, index: Any, value: float) -> torch.Tensor:
    x = x.clone()
    x[index] = value
    return x


def tensor(
    function: str,
    argument: str,
    size: str,
    quaternion: slice | None = None,
    mixed: str | None = None,
    like: torch.Tensor | None = None,
    named: str = "",
) -> Iterator[Case]:
    """What every tensor argument is tried with.

    Args:
        size: the shape that is expected. quaternion: which components are one. like: an argument that is accepted.
        mixed: another tensor it has to go with. named: who a wrong shape is blamed on.
    """
    good = ACCEPTED[function][1][argument] if like is None else like

    def case(category: str, bad: Any, came: str, expected: str) -> Case:
        return refused(function, argument, category, bad, came, expected)

    yield case("type", good.tolist(), "got list", "expected a torch.Tensor")
    yield case("type", good.numpy(), "got ndarray", "expected a torch.Tensor")
    yield case("type", None, "got NoneType", "expected a torch.Tensor")
    for dtype in (I64, torch.float16, torch.bfloat16, torch.complex64, torch.bool):
        yield case("dtype", good.to(dtype), f"{dtype}", "torch.float32 or torch.float64")
    for bad in (torch.zeros((), dtype=F64), good[..., :-1], torch.cat([good, good], -1)):
        got = f"{tuple(bad.shape)}" if named else f"got {tuple(bad.shape)}"
        yield case("shape", bad, got, f"expected shape{size}")._replace(named=named or argument)
    first = (0,) * good.ndim
    for value in (NAN, INF):
        yield case(
            "nan", changed(good, first, value), f"got {value} at index {first}", "expected finite numbers"
        )
    if quaternion:
        zero = changed(good, (*first[:-1], quaternion), 0.0)
        yield case("zero quaternion", zero, f"got length 0 at index {first[:-1]}", "expected quaternions")
    if mixed:
        yield case("device", good.to("meta"), "meta", "cpu")
        yield case("mixed dtype", good.float(), "torch.float32", "torch.float64")


def times(function: str, points: str = "control_points", ns: bool = True) -> Iterator[Case]:
    """What the times of a trajectory with the domain [0, 0.5] are tried with.

    Args:
        points: what it is made of. ns: whether there are trajectories of its kind in nanoseconds.
    """

    def case(category: str, bad: Any, came: str, expected: str) -> Case:
        return refused(function, "t", category, bad, came, expected)

    yield case("type", 0.1, "got float", "expected a torch.Tensor")
    yield case("type", T.numpy(), "got ndarray", "expected a torch.Tensor")
    for dtype in (torch.float16, torch.bfloat16, torch.complex128, torch.int32, torch.bool):
        yield case("dtype", T.to(dtype), f"got {dtype}", "torch.float32 or torch.float64")
    yield case("dtype", NS, *(("int64 times", "dt_ns") if ns else ("got torch.int64", "torch.float64")))
    yield case("device", T.to("meta"), "meta", "cpu")
    yield case("batch", T.expand(3, 3), "t (3,)", f"{points} (2,)")
    for value in (NAN, INF, -INF):
        yield case("nan", changed(T, 1, value), f"got {value} at index (1,)", "expected finite numbers")
    yield case("time", T + 0.1, "the first is 0.6", "outside the domain [0.0, 0.5] s")
    yield case("time", T[:1] - 1e-9, "the first is -1e-09", "outside the domain [0.0, 0.5] s")
    yield case("time", T.float() + 1e6, "near 1e+06 s", "dt = 0.1 s" if ns else "shortest segment")


def spacings(function: str, ns: dict[str, Any]) -> Iterator[Case]:
    """What knot spacing and start are tried with; `ns`: what makes a call with nanoseconds right."""
    for name in ("dt", "t0"):
        for bad in (True, "a", [0.1], 1j):
            yield refused(
                function, name, "type", bad, f"got {type(bad).__name__}", "expected seconds as a number"
            )
        for bad in (NAN, INF, -INF):
            yield refused(function, name, "nan", bad, f"got {bad}", "expected a finite number")
            yield refused(function, name, "nan", torch.tensor(bad), f"got {bad}", "expected a finite number")
        yield refused(function, name, "dtype", torch.tensor(1), "got torch.int64", "torch.float64")
        yield refused(function, name, "shape", T, "got shape (3,)", "expected one number")
        yield refused(function, name, "device", torch.zeros((), device="meta"), "meta", "cpu")
        for bad in (True, 0.5, T):
            both = {**ns, f"{name}_ns": bad}
            yield refused(function, f"{name}_ns", "type", bad, f"got {bad!r}", "a whole number", **both)
    for bad in (0.0, -0.1):
        yield refused(function, "dt", "option", bad, f"got {bad}", "above zero")
        yield refused(function, "dt", "option", torch.tensor(bad), f"got {torch.tensor(bad)}", "above zero")
    yield refused(function, "t0", "type", None, "got NoneType", "expected seconds as a number")
    yield refused(function, "dt", "option", None, "got neither", "expected the knot spacing")
    for bad in (0, -5):
        yield refused(function, "dt_ns", "option", bad, f"got {bad}", "above zero", **{**ns, "dt_ns": bad})
    yield refused(function, "dt_ns", "option", 5, "got dt_ns=5 and dt=0.1", "expected dt_ns and no dt")
    yield refused(function, "t0_ns", "option", 5, "got dt_ns=None and dt=None", "expected dt_ns", dt=None)
    yield refused(function, "t0", "option", 0.5, "got t0=0.5", "expected as t0_ns", **ns)


def wholes(function: str, argument: str, least: int, *more: Any) -> Iterator[Case]:
    for bad in (least - 1, float(least), True, None, "4", *more):
        yield refused(
            function, argument, "option", bad, f"got {bad!r}", f"a whole number of at least {least}"
        )


def groups(function: str) -> Iterator[Case]:
    for bad in ("SE3", None, SE3.arithmetic):
        yield refused(
            function, "group", "type", bad, f"got {type(bad).__name__}", "expected a torchspline.Group"
        )


def numbers(function: str, argument: str, *outside: float) -> Iterator[Case]:
    for bad in (None, "a", True, 1j, T):
        yield refused(function, argument, "type", bad, f"got {type(bad).__name__}", "expected a number")
    for bad in (NAN, INF, *outside):
        yield refused(function, argument, "nan", bad, f"got {bad}", "expected a ")


def control_points(function: str, argument: str, good: torch.Tensor, least: int) -> Iterator[Case]:
    yield from tensor(function, argument, " (..., M, 7), M points of", slice(3, 7), like=good)
    bad = good[..., : least - 1, :]
    yield refused(function, argument, "count", bad, f"got {least - 1}", f"at least {least} ")


def pointwise(function: str) -> Iterator[Case]:
    """What functions of points and tangents are tried with, one tensor after the other."""
    quaternions = {"x": 3, "point": 3, "left": 3, "right": 3, "start": 3, "end": 3, "pose": 3, "q": 0, "Q": 0}
    good = ACCEPTED[function][1]
    together = [name for name, x in good.items() if isinstance(x, torch.Tensor)]
    for name in together:
        if name in ("s", "exponent", "matrix"):
            continue  # of another shape, and tried by the callers
        start = quaternions.get(name)
        width = good[name].shape[-1]
        part = None if start is None else slice(start, width)
        if function == "pose_from_xyzw":
            part = slice(3, 7)
        if name == "Q":
            part = slice(0, 4)
        others = [other for other in together if other != name]
        yield from tensor(function, name, f" (..., {width})", part, others[0] if others else None)
        if others:
            other, batch = others[0], good[name][:1].expand(3, *good[name].shape[1:])
            yield refused(function, name, "batch", batch, f"{name} (3, 8)", f"{other} (2, 8)")


def matrices(function: str, size: int) -> Iterator[Case]:
    """What matrices of a group are tried with."""
    good = ACCEPTED[function][1]["matrix"]
    yield from tensor(function, "matrix", f" (..., {size}, {size})")
    for bad in (-good, good.mT * 1.01):
        yield refused(function, "matrix", "option", bad, "is off by", "expected matrices of the group")
