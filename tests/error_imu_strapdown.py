"""Bad arguments of increments and strapdown integration."""

from collections.abc import Iterator
from typing import Any

import torch
from error_arguments import (
    ACCEPTED,
    I64,
    INF,
    NAN,
    POSE,
    SPLINE,
    STAMPS,
    Case,
    Q,
    T,
    V,
    accept,
    changed,
    refused,
    tensor,
    times,
)

from torchspline import SO3, BSpline, Rn, imu

READING = imu.ImuReading(V, V)  # (2, 8, 3)
INTEGRALS = imu.Increments(V[:, :7], V[:, :7])
START = imu.Navigation(Q[0, 0], V[0, 0], V[0, 0])
accept(
    {
        "increments": (imu.increments, {"trajectory": SPLINE, "t": T}),
        "sampled_increments": (imu.sampled_increments, {"reading": READING, "t": STAMPS}),
        "compensate": (imu.compensate, {"integrals": INTEGRALS, "t": STAMPS}),
        "integrate_gyroscope": (imu.integrate_gyroscope, {"gyroscope": V, "t": STAMPS, "start": Q[0, 0]}),
        "strapdown": (imu.strapdown, {"increments": INTEGRALS, "t": STAMPS, "start": START}),
    }
)
#: Tuples of tensors: their type, the argument that is one, and the names of its tensors in messages.
_PAIRS = {
    "sampled_increments": ("reading", imu.ImuReading, ("gyroscope", "accelerometer")),
    "compensate": ("integrals", imu.Increments, ("angle", "velocity")),
    "strapdown": ("increments", imu.Increments, ("angle", "velocity")),
}

#: What is made and handed out.
RESULTS = {"Increments", "Navigation"}
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE: dict[str, dict[str, str]] = {
    "zero quaternion": {
        "no rotations go in": "sampled_increments compensate",
    },
    "count": {"any number of intervals": "increments strapdown compensate"},
}


def cases() -> Iterator[Case]:
    function = "increments"
    yield from times(function)
    yield refused(function, "t", "shape", T[0], "got ()", "times in a row")
    yield refused(function, "t", "time", T.flip(0), "got 0.5 and then 0.2", "increasing times")
    yield refused(function, "trajectory", "type", POSE, "got Tensor", "expected a Trajectory")
    for bad in (BSpline(Rn(2).random(5), group=Rn(2), dt=0.1), BSpline(Q, group=SO3, dt=0.1)):
        yield refused(function, "trajectory", "option", bad, f"got {bad.group}", "SE3 or R3xSO3")
    for case in tensor(function, "T_body_imu", " (..., 7)", slice(3, 7), like=POSE[0, 0]):
        if case.changes["T_body_imu"] is not None:
            yield case
    yield refused(function, "compensated", "option", "no", "got 'no'", "True or False")
    for name in ("gravity", "earth_rate"):
        yield from vector(function, name, "trajectory", V[0, 0])
        yield from vector("strapdown", name, "trajectory", V[0, 0])

    for function, (argument, kind, names) in _PAIRS.items():
        good = ACCEPTED[function][1][argument]
        yield refused(function, argument, "type", V, "got Tensor", f"expected {_article(kind.__name__)}")
        for i, name in enumerate(names):
            yield from member(function, argument, kind, tuple(good), i, name)
        short = kind(*(x[:, :0] for x in good))
        if function == "sampled_increments":
            yield refused(function, argument, "count", short, "got (2, 0, 3)", "N at least 1", "gyroscope")
        yield from stamps(function)
    function = "integrate_gyroscope"
    yield from tensor(function, "gyroscope", " (..., 3)", like=V)
    yield refused(function, "gyroscope", "count", V[:, :0], "got (2, 0, 3)", "N at least 1")
    yield from stamps(function)
    for case in tensor(function, "start", " (..., 4)", slice(0, 4), "gyroscope", like=Q[0, 0]):
        if case.changes["start"] is not None:
            yield case
    yield refused(function, "start", "option", Q[0], "got (8, 4)", "(2, 4) or what broadcasts")
    function = "strapdown"
    yield refused(function, "start", "type", Q[0, 0], "got Tensor", "expected a Navigation")
    for i, (name, quaternion) in enumerate(
        (("rotation", slice(0, 4)), ("velocity", None), ("position", None))
    ):
        label = f"start.{name}"
        size = 3 if quaternion is None else 4
        for case in tensor(function, "start", f" (..., {size})", quaternion, "angle", like=START[i]):
            whole = START._replace(**{name: case.changes["start"]})
            yield case._replace(changes={"start": whole}, named=label)
        eight = START[i].expand(8, size)
        yield refused(function, "start", "option", START._replace(**{name: eight}), f"got (8, {size})",
                      f"(2, {size}) or what broadcasts", label)  # fmt: skip


def _article(name: str) -> str:
    return f"an {name}" if name == "ImuReading" else name


def member(
    function: str, argument: str, kind: Any, good: tuple[torch.Tensor, ...], i: int, name: str
) -> Iterator[Case]:
    """One tensor of a pair."""

    def case(category: str, bad: Any, came: str, expected: str) -> Case:
        both = kind(*(bad if j == i else x for j, x in enumerate(good)))
        return refused(function, argument, category, both, came, expected, name)

    for bad in (None, good[i].tolist(), good[i].numpy()):
        yield case("type", bad, f"got {type(bad).__name__}", "expected a torch.Tensor")
    for dtype in (I64, torch.float16, torch.bool):
        yield case("dtype", good[i].to(dtype), f"{dtype}", "torch.float32 or torch.float64")
    yield case("shape", good[i][..., :2], f"got {tuple(good[i][..., :2].shape)}", "expected shape (..., 3)")
    yield case("shape", good[i][0, 0], "got (3,)", "expected shape (*batch, N, 3)")
    for value in (NAN, INF):
        yield case("nan", changed(good[i], (0, 0, 0), value), f"got {value}", "expected finite")
    if i:
        yield case(
            "shape", good[i][:, 1:], f"got {tuple(good[i][:, 1:].shape)}", f"{tuple(good[0].shape)} as"
        )
        yield case("device", good[i].to("meta"), "meta", "cpu")
        yield case("mixed dtype", good[i].float(), "torch.float32", "torch.float64")


def vector(function: str, name: str, like: str, good: torch.Tensor) -> Iterator[Case]:
    for bad in ("down", [[1.0, 2, 3], [1]], [None] * 3, *((None,) if name == "gravity" else ())):
        yield refused(function, name, "type", bad, f"got {bad!r}", "a tensor or three numbers")
    yield from (
        case for case in tensor(function, name, " (..., 3)", None, like, like=good) if case.category != "type"
    )


def stamps(function: str) -> Iterator[Case]:
    for bad in (None, 0.5, STAMPS.numpy()):
        yield refused(function, "t", "type", bad, f"got {type(bad).__name__}", "expected a torch.Tensor")
    for dtype in (torch.int32, torch.float16, torch.bool):
        yield refused(
            function, "t", "dtype", STAMPS.to(dtype), f"got {dtype}", "torch.float32 or torch.float64"
        )
    for bad in (STAMPS[:5], STAMPS[0], STAMPS[None].mT):
        yield refused(function, "t", "shape", bad, f"got {tuple(bad.shape)}", "expected shape (8,) or")
    yield refused(function, "t", "shape", STAMPS.expand(3, 8), "got (3, 8)", "broadcasts to (2, 8)")
    yield refused(function, "t", "nan", changed(STAMPS, 1, NAN), "got nan", "finite")
    yield refused(function, "t", "time", STAMPS.flip(0), "got 7.0 and then 6.0", "increasing times")
    yield refused(function, "t", "time", 0 * STAMPS, "got 0.0 and then 0.0", "increasing times")
    yield refused(function, "t", "device", STAMPS.to("meta"), "on device meta", "are on cpu")
