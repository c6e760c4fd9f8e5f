"""Bad arguments of splines that go through poses or near them."""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from error_arguments import (
    F32,
    I64,
    INF,
    NAN,
    POSE,
    STAMPS,
    Case,
    accept,
    changed,
    control_points,
    groups,
    numbers,
    refused,
    tensor,
    wholes,
)

import torchspline
from torchspline import (
    SE3,
)

FUNCTIONS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "initial_control_points": (
        torchspline.initial_control_points,
        {"t": STAMPS, "poses": POSE[0], "group": SE3, "order": 4, "dt": 1.0, "t0": 0.0, "count": 5},
    ),
    "fit_poses": (torchspline.fit_poses, {"t": STAMPS, "poses": POSE[0], "dt": 2.0, "max_iterations": 1}),
}  # fmt: skip
accept(FUNCTIONS)

#: What is made and handed out.
RESULTS = {"PoseFit"}
UNTRIED = {"PoseFit.rms": "no arguments"}
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE: dict[str, dict[str, str]] = {
    "time": {"no domain before there is a trajectory": " ".join(FUNCTIONS)},
}


def cases() -> Iterator[Case]:
    function = "initial_control_points"
    yield from control_points(function, "poses", POSE[0], 1)
    yield from tensor(function, "t", "s (N,) and (N, P)", named="t, poses")
    yield refused(
        function, "poses", "shape", POSE, "(2, 8, 7)", "expected shapes (N,) and (N, P)", named="t, poses"
    )
    yield refused(function, "t", "device", STAMPS.to("meta"), "meta", "cpu")
    yield refused(function, "t", "option", STAMPS.flip(0), "got 7.0 and then 6.0", "increasing times")
    yield refused(function, "t", "option", 0 * STAMPS, "got 0.0 and then 0.0", "increasing times")
    yield from wholes(function, "order", 2)
    yield from wholes(function, "count", 1)
    yield from numbers(function, "dt", 0.0, -1.0)
    yield from numbers(function, "t0")
    yield from groups(function)
    yield from fits()


def fits() -> Iterator[Case]:
    function, poses = "fit_poses", POSE[0]
    for case in tensor(function, "poses", "s (N,) and (N, 7)", slice(3, 7), named="t, poses"):
        if "nan at" in case.came:  # rows with NaN are left out: only when too few remain
            case = refused(function, "poses", "nan", poses * NAN, "got 0", "usable poses", named="t")
        yield case
    yield refused(function, "poses", "device", poses.to("meta"), "meta", "cpu")
    for bad in (STAMPS.tolist(), STAMPS.numpy(), None):
        yield refused(function, "t", "type", bad, f"got {type(bad).__name__}", "a torch.Tensor")
    for dtype in (F32, torch.float16, torch.int32):
        yield refused(function, "t", "dtype", STAMPS.to(dtype), f"got {dtype}", "float64 seconds or int64")
    for bad in (STAMPS[:-1], STAMPS[0], STAMPS[None]):
        yield refused(
            function, "t", "shape", bad, f"got {tuple(bad.shape)}", "(N,) and (N, 7)", named="t, poses"
        )
    yield refused(function, "t", "nan", changed(STAMPS, 3, INF), "got inf at index (3,)", "finite")
    later = changed(changed(poses, 0, NAN), (4, 2), INF)
    yield refused(function, "poses", "nan", later, "got inf at index (4, 2)", "finite")
    for bad in (STAMPS * 0, STAMPS * NAN, changed(STAMPS * NAN, 2, 1.0)):
        came = f"got {int(not bad.isnan().all())}"
        yield refused(function, "t", "count", bad, came, "at least two distinct times")
    for name in ("dt", "position_sigma", "rotation_sigma", "smoothness"):
        yield from (case for case in numbers(function, name, 0.0, -1.0) if case.changes != {"dt": "a"})
    yield refused(function, "dt", "option", "Auto", "got 'Auto'", "'auto'")
    for bad in (0.1, [0.1, 0.1], (0.1,), "tight"):
        yield refused(function, "accuracy", "option", bad, f"got {bad!r}", "expected two numbers", dt="auto")
    for number in (NAN, INF, 0.0, -1.0):
        yield refused(function, "accuracy", "nan", (0.1, number), f"got {number}", "above zero", dt="auto")
    yield refused(function, "accuracy", "type", ("a", 0.1), "got str", "a number", dt="auto")
    yield refused(function, "accuracy", "option", (0.1, 0.1), "got dt=2.0", 'goes with dt="auto"')
    yield refused(function, "dt", "option", 1e-10, "got 1e-10 s", "at least a nanosecond", t=STAMPS.to(I64))
    yield from numbers(function, "tolerance", -1.0)
    yield from wholes(function, "order", 2, INF)
    yield from (c for c in wholes(function, "max_iterations", 0) if c.changes["max_iterations"] != 0)
    for bad in ("Split", "SE3", None):
        yield refused(function, "representation", "option", bad, f"got {bad!r}", "'split', 'joint'")
