"""Bad arguments of figures, pages and the explorer."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from error_arguments import (
    F64,
    FOLDER,
    I64,
    INF,
    NAN,
    POSE,
    SPLINE,
    Case,
    T,
    accept,
    changed,
    refused,
    wholes,
)

from torchspline import SE2, SplitBSpline, explore, imu, plot, view
from torchspline.splines import BSpline

ROOTS = (plot, view, explore)
#: What is made and handed out.
RESULTS = {"Curve"}
UNTRIED = {f"Explorer.{name}": "no arguments" for name in ("add", "remove", "figure")}
#: Parameters that take anything.
FREE = {
    **dict.fromkeys(("title", "labels", "unit"), "goes into figures as it is"),
    "cumulative": "a truth value, and everything has one",
    "axes": "of Matplotlib, which says what is wrong with it",
}

ONE = SplitBSpline(POSE[0], dt=0.1, learnable=False)
PLANAR = BSpline(torch.tensor([[0.0, 0, 1, 0]] * 6, dtype=F64), group=SE2, order=4, dt=0.1)
COVARIANCE = torch.eye(6, dtype=F64).expand(3, 6, 6)
TIMES = torch.arange(6, dtype=F64)
READING = imu.ImuReading(torch.zeros(3, 3, dtype=F64), torch.zeros(3, 3, dtype=F64))
DEVIATION = {
    "a": imu.allan_deviation(torch.randn(40, 3, dtype=F64), torch.arange(40, dtype=F64), clusters=[1, 2])
}


class Panel:
    """As much of Matplotlib's axes as is called."""

    def __getattr__(self, name: str) -> Any:
        return lambda *_, **__: None


def explorer() -> explore.Explorer:
    return explore.Explorer(POSE[0], torch.arange(8, dtype=F64))


def write_page(path: Any, trajectories: Any, **options: Any) -> None:
    view.write_page(path, trajectories, **options)


_SHOWN = {"trajectories": ONE, "t": T}
_PAGE = {"trajectories": ONE, "measured": POSE[0, :, :3], "samples": 5, "up": "z", "title": "x"}
accept(
    {
        "trajectory": (plot.trajectory, {**_SHOWN, "frames": 2}),
        "rates": (plot.rates, {**_SHOWN, "quantities": ("velocity",)}),
        "covariance_tube": (
            plot.covariance_tube, {"trajectory": ONE, "t": T, "covariance": COVARIANCE, "sigmas": 2.0}
        ),
        "residuals": (plot.residuals, {"fit": {"a": T}, "t": T}),
        "basis": (plot.basis, {"method": 4, "times": TIMES}),
        "basis_functions": (
            plot.basis_functions, {"method": "SQUAD", "times": TIMES, "t": T, "derivative": 1}
        ),
        "imu_comparison": (plot.imu_comparison, {"lines": (T, READING), "dots": (T, READING)}),
        "allan": (plot.allan, {"deviations": DEVIATION, "fits": None}),
        "allan_panel": (plot.allan_panel, {"axes": Panel(), "deviations": DEVIATION, "fits": None}),
        "page": (view.page, _PAGE),
        "write_page": (write_page, {"path": Path(FOLDER.name) / "page.html", "trajectories": ONE, "samples": 5}),
        "Explorer": (
            explore.Explorer, {"keyframes": POSE[0], "times": torch.arange(8, dtype=F64), "methods": ["SPLIT"]}
        ),
        "Explorer.choose": (lambda **k: explorer().choose(**k), {"methods": ["SPLIT"]}),
        "Explorer.move": (
            lambda **k: explorer().move(**k), {"index": 1, "position": [0.0, 0, 0], "rotation": [1.0, 0, 0, 0]}
        ),
        "Explorer.curve": (lambda **k: explorer().curve(**k), {"method": "SPLIT", "samples": 5}),
        "Explorer.curves": (lambda **k: explorer().curves(**k), {"samples": 5}),
        "Explorer.weights": (lambda **k: explorer().weights(**k), {"method": "SPLIT", "samples": 5}),
    }
)  # fmt: skip
_PATHS = "trajectory rates"
_PAGES = "page write_page"
_WORDS = "Explorer.choose Explorer.curve Explorer.curves Explorer.weights"
_NOISE = "allan allan_panel"
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE: dict[str, dict[str, str]] = {
    "shape": {"no tensor goes into it": f"{_WORDS} {_NOISE} write_page Explorer.move"},
    "dtype": {"no tensor goes into it ": f"{_WORDS} {_NOISE} write_page Explorer.move"},
    "device": {
        "drawn from copies on the CPU": f"{_PATHS} {_PAGES} {_WORDS} {_NOISE} covariance_tube residuals basis "
        "basis_functions imu_comparison Explorer Explorer.move",
    },
    "nan": {
        "NaN is not drawn": f"residuals imu_comparison {_PAGES} {_NOISE}",
        "no numbers go into it": _WORDS,
    },
    "zero quaternion": {
        "no quaternion goes into it": f"{_PATHS} {_PAGES} {_WORDS} {_NOISE} covariance_tube residuals basis "
        "basis_functions imu_comparison",
    },
    "count": {
        "any number of rows": "imu_comparison",
        "one number for all": f"{_WORDS} {_NOISE} Explorer.move write_page",
    },
    "time": {"any time or none": f"{_PAGES} {_WORDS} {_NOISE} residuals imu_comparison Explorer.move"},
}


def shown(function: str) -> Iterator[Case]:
    """What trajectories to draw are tried with."""
    for bad in (None, 1.0, [ONE]):
        yield refused(
            function, "trajectories", "type", bad, f"got {type(bad).__name__}", "torchspline.Trajectory"
        )
    yield refused(function, "trajectories", "type", {"a": 1.0}, "got float", "torchspline.Trajectory")
    yield refused(
        function, "trajectories", "option", PLANAR, "SE2", "the motion of a body", named="kinematics"
    )
    if function != "write_page":
        yield refused(function, "trajectories", "count", {}, "got none", "at least one")
        yield refused(function, "trajectories", "shape", SPLINE, "got a batch of (2,)", "single trajectories")


def drawn_at(function: str, others: dict[str, Any]) -> Iterator[Case]:
    """What times to draw at are tried with."""
    yield refused(function, "t", "type", T.tolist(), "got list", "expected a torch.Tensor")
    for bad in (T[None], T[:0], T[0]):
        yield refused(function, "t", "shape", bad, f"got {tuple(bad.shape)}", "expected shape (N,)", **others)
    yield refused(function, "t", "dtype", T.int(), "torch.int32", "float64", **others)
    yield refused(function, "t", "nan", changed(T, 1, NAN), "nan", "", **others)
    yield refused(function, "t", "time", T + 100, "outside the domain", "choose times inside", **others)


def cases() -> Iterator[Case]:
    for function in ("trajectory", "rates"):
        yield from shown(function)
        yield from drawn_at(function, {})
    yield from wholes("trajectory", "frames", 0)
    for bad in ("velocity", 5, ()):
        yield refused("rates", "quantities", "type", bad, f"got {bad!r}", "a sequence of names")
    yield refused("rates", "quantities", "option", ["speed"], "got 'speed'", "expected one of 'velocity'")

    tube = "covariance_tube"
    yield refused(tube, "trajectory", "type", {"a": ONE}, "got dict", "torchspline.Trajectory")
    yield refused(tube, "trajectory", "option", PLANAR, "got SE2", "one with positions")
    yield from drawn_at(tube, {})
    yield refused(tube, "t", "count", T[:1], "got 1", "two times or more")
    yield refused(tube, "covariance", "type", COVARIANCE.numpy(), "got ndarray", "expected a torch.Tensor")
    yield refused(tube, "covariance", "dtype", COVARIANCE.to(I64), "torch.int64", "torch.float64")
    for bad in (COVARIANCE[:2], COVARIANCE[:, :2, :2], COVARIANCE[0]):
        yield refused(tube, "covariance", "shape", bad, f"got {tuple(bad.shape)}", "expected shape (3, D, D)")
    bad = changed(COVARIANCE, (1, 0, 0), INF)
    yield refused(tube, "covariance", "nan", bad, "got inf at index (1, 0, 0)", "finite numbers")
    for bad in (0.0, -1.0, NAN):
        yield refused(tube, "sigmas", "option", bad, f"got {bad}", "a finite number above zero")

    for bad in (None, T):
        yield refused("residuals", "fit", "type", bad, f"got {type(bad).__name__}", "a PoseFit or a mapping")
    yield refused("residuals", "fit", "dtype", {"a": T.to(I64)}, "torch.int64", "torch.float64")
    yield refused("residuals", "fit", "count", {}, "got none", "at least one")
    for bad in (T[:2], T[:, None, None]):
        yield refused(
            "residuals", "fit", "shape", {"a": bad}, f"got {tuple(bad.shape)}", "expected shape (3,)"
        )
    yield refused("residuals", "t", "type", [1.0], "got list", "expected a torch.Tensor")
    yield refused("residuals", "t", "shape", T[None], "got (1, 3)", "expected shape (N,)")

    for function in ("basis", "basis_functions"):
        for bad in (None, 2.0, True):
            yield refused(function, "method", "type", bad, f"got {type(bad).__name__}", "a name or the order")
        yield refused(function, "method", "option", "SQUID", "got 'SQUID'", "expected one of LERP")
        yield refused(function, "method", "option", 1, "got 1", "at least 2")
        yield refused(function, "times", "type", TIMES.tolist(), "got list", "expected a torch.Tensor")
        yield refused(function, "times", "dtype", TIMES.to(I64), "torch.int64", "torch.float64")
        yield refused(function, "times", "shape", TIMES[None], "got (1, 6)", "expected shape (M,)")
        yield refused(function, "times", "count", TIMES[:1], "got (1,)", "at least ")
        yield refused(function, "times", "nan", changed(TIMES, 2, NAN), "got nan", "finite numbers")
        yield refused(function, "times", "time", TIMES.flip(0), "got equal or falling", "increasing times")
        yield refused(function, "times", "option", TIMES**2, "got [0.0, 1.0", "evenly spaced", method=4)
    yield refused("basis_functions", "t", "type", [1.0], "got list", "expected a torch.Tensor")
    yield refused("basis_functions", "t", "time", T + 100, "outside the domain", "choose times inside")
    for bad in (4, -1):
        yield refused("basis_functions", "derivative", "option", bad, f"got {bad}", "expected one of 0, 1")

    comparison = "imu_comparison"
    for argument in ("lines", "dots"):
        for bad in (T, (T, T), [T, READING]):
            yield refused(
                comparison, argument, "type", bad, f"got {type(bad).__name__}", "(times, ImuReading)"
            )
        yield refused(comparison, argument, "dtype", (T.to(I64), READING), "torch.int64", "torch.float64")
        yield refused(comparison, argument, "shape", (T[:2], READING), "got (2,)", "times of shape (3,)")
        flat = imu.ImuReading(*(x[:, :2] for x in READING))
        yield refused(comparison, argument, "shape", (T, flat), "got (3, 2)", "expected shape (..., 3)")
    for function in ("allan", "allan_panel"):
        for argument in ("deviations", "fits"):
            yield refused(function, argument, "type", 5, "got int", "a mapping of names")
            yield refused(function, argument, "type", {"a": 5}, "got int", "expected a")

    yield from shown("page")
    for bad in (0, 1, 2.5):
        yield refused("page", "samples", "option", bad, f"got {bad}", "at least 2")
    yield refused("page", "up", "option", "w", "got 'w'", "expected one of 'x'")
    yield refused("page", "title", "type", 5, "got int", "a text")
    yield refused("page", "measured", "type", [1.0], "got list", "expected a torch.Tensor")
    yield refused("page", "measured", "dtype", POSE[0, :, :3].to(I64), "torch.int64", "torch.float64")
    yield refused("page", "measured", "shape", POSE[0], "got (8, 7)", "expected shape (N, 3)")
    yield from shown("write_page")
    yield refused("write_page", "path", "type", 5, "got int", "expected a path")
    yield refused(
        "write_page", "path", "option", "nowhere/page.html", "nowhere", "make it first", named="page.html"
    )

    window = "Explorer"
    yield refused(window, "keyframes", "type", [1.0], "got list", "expected a torch.Tensor")
    yield refused(window, "keyframes", "dtype", POSE[0].to(I64), "torch.int64", "torch.float64")
    for bad in (POSE[..., :6], POSE[0, 0], POSE):
        yield refused(window, "keyframes", "shape", bad, f"got {tuple(bad.shape)}", "expected shape (")
    yield refused(window, "keyframes", "count", POSE[0, :1], "got 1", "at least 2")
    bad = changed(POSE[0], (1, 2), INF)
    yield refused(window, "keyframes", "nan", bad, "got inf at index (1, 2)", "finite numbers")
    bad = changed(POSE[0], (1, slice(3, 7)), 0.0)
    yield refused(window, "keyframes", "zero quaternion", bad, "got length 0", "expected quaternions")
    yield refused(window, "times", "shape", TIMES, "got (6,)", "expected shape (8,)")
    yield refused(
        window, "times", "time", torch.arange(8, 0, -1).double(), "got [8.0, 7.0", "increasing times"
    )
    for function in (window, "Explorer.choose"):
        yield refused(function, "methods", "type", "SPLIT", "got str", "a sequence of names")
        yield refused(function, "methods", "option", ["SQUID"], "got 'SQUID'", "expected one of 'LERP'")
    move = "Explorer.move"
    for bad in (-1, 8):
        yield refused(move, "index", "option", bad, f"got {bad}", "one of the 8 keyframes")
    yield refused(move, "position", "nan", [0.0, NAN, 0.0], "got nan", "finite numbers")
    yield refused(move, "position", "option", [0.0, 1.0], "got (6,)", "expected shape (..., 7)")
    yield refused(
        move, "rotation", "zero quaternion", [0.0] * 4, "got length 0", "quaternions", named="position"
    )
    for function in ("Explorer.curve", "Explorer.weights"):
        yield refused(function, "method", "option", "SQUID", "got 'SQUID'", "expected one of 'LERP'")
    for function in ("Explorer.curve", "Explorer.curves", "Explorer.weights"):
        for bad in (1, 2.5):
            yield refused(function, "samples", "option", bad, f"got {bad}", "at least 2")
