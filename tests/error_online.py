"""Bad arguments of sliding windows and of batches of problems."""

from collections.abc import Callable, Iterator

import torch
from error_arguments import (
    F32,
    F64,
    I64,
    INF,
    NAN,
    POSE,
    SPLINE,
    Case,
    T,
    V,
    accept,
    changed,
    groups,
    numbers,
    refused,
    spacings,
    tensor,
    wholes,
)

from torchspline import R3, SE3, BSpline
from torchspline.fit import BatchProblem, SlidingWindow
from torchspline.fit.residual import Clock
from torchspline.fit.residuals import Gyroscope
from torchspline.fit.variables import Variable

WINDOW = SlidingWindow(POSE[0], group=SE3, dt=0.1)
BATCH = BatchProblem(SPLINE)
BIAS = Variable("bias", torch.zeros(3, dtype=F64))
ROWS = Variable("rows", torch.zeros(2, 3, dtype=F64))
GYRO = Gyroscope(T, V[0, :3], bias=BIAS)
EACH = Gyroscope(T, V[0, :3], bias=ROWS)
WHICH = torch.tensor([0, 1, 1])
WINDOW.add(GYRO)
BATCH.add(EACH, WHICH)

STAYS = torch.zeros(2, 8, dtype=torch.bool)


def frozen(method: str) -> Callable[..., None]:
    """A method of a batch of its own: what one test freezes shall not stay for the next."""

    def call(unknown: object, **more: object) -> None:
        batch = BatchProblem(SPLINE)
        batch.add(EACH, WHICH)
        getattr(batch, method)(ROWS if unknown == "rows" else unknown, **more)

    return call


SOLVING = {"max_iterations": 1, "cost_tolerance": 1e-6, "gradient_tolerance": 1e-6, "damping": 1e-5}
accept(
    {
        "SlidingWindow": (SlidingWindow, {"start": POSE[0], "group": SE3, "dt": 0.1}),
        "SlidingWindow.add": (
            lambda residual, index: WINDOW.add(residual, **index),
            {"residual": GYRO, "index": {}},
        ),
        "SlidingWindow.add_prior": (WINDOW.add_prior, {"variable": BIAS, "sigma": 1.0}),
        "SlidingWindow.random_walk": (WINDOW.random_walk, {"variable": BIAS, "sigma": 1.0}),
        "SlidingWindow.extend": (WINDOW.extend, {"t": 0.7}),
        "SlidingWindow.update": (WINDOW.update, SOLVING),
        "BatchProblem": (BatchProblem, {"trajectories": SPLINE}),
        "BatchProblem.add": (BATCH.add, {"residual": EACH, "trajectory": WHICH}),
        "BatchProblem.add_prior": (BATCH.add_prior, {"variable": ROWS, "sigma": 1.0}),
        "BatchProblem.freeze": (frozen("freeze"), {"unknown": SPLINE, "points": STAYS}),
        "BatchProblem.release": (frozen("release"), {"unknown": SPLINE}),
        "BatchProblem.solve": (BATCH.solve, SOLVING),
        "BatchResult.covariance": (lambda variable: BATCH.solve().covariance(variable), {"variable": ROWS}),
    }
)

_UPDATES = "SlidingWindow.update BatchProblem.solve"
_PRIORS = "SlidingWindow.add_prior BatchProblem.add_prior"
_ADD = "SlidingWindow.add BatchProblem.add"
_HOLD = "BatchProblem.freeze BatchProblem.release"
_OTHERS = f"{_PRIORS} BatchResult.covariance {_HOLD}"
_GROWS = "SlidingWindow.random_walk SlidingWindow.extend"
#: Where test_errors.py looks for public functions; what it finds that nobody is meant to call.
ROOTS = (SlidingWindow, BatchProblem)
RESULTS = {"BatchResult"}
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE = {
    "shape": {
        "plain numbers": f"{_UPDATES} SlidingWindow.extend BatchResult.covariance BatchProblem.release"
    },
    "dtype": {
        "plain numbers": f"{_UPDATES} SlidingWindow.extend BatchResult.covariance BatchProblem.release",
        "a spline was checked": "BatchProblem",
    },
    "device": {
        "plain numbers": f"{_UPDATES} SlidingWindow.extend",
        "solved on the CPU, where all comes together": f"{_ADD} {_OTHERS}",
    },
    "nan": {
        "what was checked when it was made": f"{_ADD} BatchResult.covariance",
        "no numbers that can be one": _HOLD,
    },
    "zero quaternion": {
        "no quaternion goes in that was not checked": f"{_ADD} {_OTHERS} {_GROWS} {_UPDATES}"
    },
    "count": {"any number": f"SlidingWindow.add {_OTHERS} {_GROWS} {_UPDATES}"},
    "time": {"no times": f"SlidingWindow BatchProblem {_OTHERS} SlidingWindow.random_walk {_UPDATES}"},
}


def cases() -> Iterator[Case]:
    yield from windows()
    yield from results()
    yield from residuals()
    for function in ("SlidingWindow.add_prior", "SlidingWindow.random_walk", "BatchProblem.add_prior"):
        yield from sigmas(function)
    yield refused("SlidingWindow.extend", "t", "nan", NAN, "got nan", "expected a finite number")
    yield refused("SlidingWindow.extend", "t", "type", "a", "got str", "expected a number")
    yield refused("SlidingWindow.extend", "t", "time", 1e9, "1000000000.0 lies", "check its unit")
    for function in _UPDATES.split():
        yield from (
            c for c in wholes(function, "max_iterations", 0) if c.changes["max_iterations"] is not False
        )
        for name in ("cost_tolerance", "gradient_tolerance"):
            yield from numbers(function, name, -1.0)
        yield from numbers(function, "damping", 0.0, -1.0)


def results() -> Iterator[Case]:
    for bad in (None, "bias", SPLINE):
        yield refused(
            "BatchResult.covariance", "variable", "type", bad, f"got {type(bad).__name__}", "fit.Variable"
        )
    yield refused(
        "BatchResult.covariance", "variable", "option", BIAS, "bias is not among", "unknowns that were solved"
    )


def windows() -> Iterator[Case]:
    function = "SlidingWindow"
    yield from tensor(function, "start", " (7,), a point of SE3, or (M, 7)", slice(3, 7))
    few = POSE[0, :3]
    yield refused(function, "start", "count", few, "got (3, 7)", "at least 4 control points")
    yield refused(function, "start", "device", POSE[0].to("meta"), "meta", "on the CPU")
    yield from groups(function)
    yield from wholes(function, "order", 2)
    yield from spacings(function, {"dt": None, "dt_ns": 5, "t0_ns": 0})
    yield from numbers(function, "window", 0.0, -1.0)
    yield from deviations(function, "smoothness", 6)


def deviations(function: str, name: str, size: int) -> Iterator[Case]:
    for bad in ("a", True, 1j):
        yield refused(function, name, "type", bad, f"got {type(bad).__name__}", "expected a number")
    for bad in (NAN, INF, 0.0, -1.0):
        yield refused(function, name, "nan", bad, f"got {bad}", "expected a ")
    good = torch.ones(size, dtype=F64)
    yield refused(function, name, "nan", changed(good, 1, NAN), "got nan at index (1,)", "finite")
    yield refused(function, name, "dtype", good.to(I64), "torch.int64", "torch.float64")
    yield refused(
        function, name, "shape", torch.ones(size + 1, dtype=F64), f"got ({size + 1},)", f"shape ({size},)"
    )


def sigmas(function: str) -> Iterator[Case]:
    yield refused(function, "variable", "type", 5, "got int", "Variable")
    yield from deviations(function, "sigma", 3)
    if function == "SlidingWindow.random_walk":
        return
    eye = torch.eye(3, dtype=F64)
    for name in ("covariance", "information"):
        alone = {"sigma": None}
        yield refused(function, name, "shape", eye[:2], "got (2, 3)", "shape (3, 3)", **alone)
        yield refused(function, name, "option", -eye, "at index 0 is not", "positive definite", **alone)
    yield refused(function, "sigma", "option", None, "got none", "expected one of them")
    if function == "BatchProblem.add_prior":
        yield refused(function, "variable", "shape", BIAS, "Variable('bias'", "a row for each of 2")


def residuals() -> Iterator[Case]:
    for function in _ADD.split():
        yield refused(function, "residual", "type", 5, "got int", "expected a residual")
        ns = Gyroscope((T * 1e9).to(I64), V[0, :3])
        yield refused(function, "residual", "dtype", ns, "torch.int64 times", "float64 seconds", named="t")
        for t, came in ((T - 0.3, "-0.3"), (T - 1e-3, "-0.001")):
            late = Gyroscope(t, V[0, :3])
            yield refused(
                function, "residual", "time", late, came, "domain" if "B" in function else "window", "t"
            )
    function = "SlidingWindow.add"
    several = Gyroscope(T, V[0, :3], bias=ROWS)
    index = {"bias": WHICH[:2]}
    yield refused(function, "index", "shape", index, "", "index of shape (3,)", "bias", residual=several)
    spline = BSpline(V[0], group=R3, dt=1.0)
    wandering = Gyroscope(T, V[0, :3], bias=spline)
    yield refused(
        function, "residual", "option", wandering, "got a BSpline", "whose random walk is known", "bias"
    )
    walk = "SlidingWindow.random_walk"
    for bad, category, came, expected in (
        (BSpline(V, group=R3, dt=1.0), "shape", "shape (2, 8, 3)", "without a batch"),
        (BSpline(POSE[0], group=SE3, dt=1.0), "option", "got one in SE3", "a spline in R^n"),
        (BSpline(V[0].to(F32), group=R3, dt=1.0), "dtype", "got torch.float32", "of float64"),
        (BSpline(V[0], group=R3, dt_ns=10**8), "dtype", "got dt_ns", "the window's kind of time"),
        (BSpline(V[0], group=R3, dt=1.0).to("meta"), "device", "got meta", "on the CPU"),
    ):
        yield refused(walk, "variable", category, bad, came, expected)
    broken = BSpline(V[0], group=R3, dt=1.0)
    with torch.no_grad():
        broken.control_points[3, 1] = NAN
    yield refused(walk, "variable", "nan", broken, "got nan at index (3, 1)", "finite")
    yield refused(walk, "sigma", "shape", torch.ones(2, dtype=F64), "got (2,)", "shape (3,)", variable=spline)
    function = "BatchProblem.add"
    for bad in (None, [0, 1, 1]):
        yield refused(function, "trajectory", "type", bad, f"got {type(bad).__name__}", "int64 tensor")
    yield refused(
        function, "trajectory", "option", WHICH.to(F32), "torch.float32 (3,)", "int64 of shape (3,)"
    )
    yield refused(function, "trajectory", "shape", WHICH[:2], "torch.int64 (2,)", "int64 of shape (3,)")
    yield refused(function, "trajectory", "count", WHICH + 1, "got 1 to 2", "numbers from 0 to 1")
    yield refused(function, "residual", "shape", GYRO, "Variable('bias'", "row for each of 2", "bias")
    clock = Clock(offset=Variable("offset", torch.zeros(1, dtype=F64)))
    late = Gyroscope(T, V[0, :3], clock=clock)
    yield refused(
        function, "residual", "shape", late, "Variable('offset'", "with a row for each of 2", "clock"
    )
    for count in (1, 3):
        splines = BSpline(V[0].expand(count, -1, -1), group=R3, dt=1.0)
        each = Gyroscope(T, V[0, :3], bias=splines)
        came = f"got ({count}, 8, 3)"
        yield refused(function, "residual", "shape", each, came, "control points (2, M, 3)", "bias")
    yield refused(function, "residual", "shape", wandering, "got (8, 3)", "control points (2, M, 3)", "bias")
    short = Gyroscope(T, V[0, :3], bias=BSpline(V[:2], group=R3, dt=0.01))
    yield refused(function, "residual", "time", short, "of its spline", "covers them", "bias")
    yield from holds()
    yield refused("BatchProblem", "trajectories", "type", POSE, "got Tensor", "a BSpline")
    one = BSpline(POSE[0], group=SE3, dt=0.1)
    yield refused("BatchProblem", "trajectories", "shape", one, "got (8, 7)", "(B, M, P)")
    none = BSpline(POSE[:0], group=SE3, dt=0.1)
    yield refused("BatchProblem", "trajectories", "count", none, "got (0, 8, 7)", "(B, M, P)")
    for changes, category, came in (((1, 2, 0), "nan", "got nan"), ((1, 2), "zero quaternion", "length 0")):
        bad = BSpline(POSE, group=SE3, dt=0.1)
        with torch.no_grad():
            bad.control_points[changes] = NAN if category == "nan" else torch.zeros(7, dtype=F64)
        yield refused("BatchProblem", "trajectories", category, bad, came, "expected")
    meta = BSpline(POSE, group=SE3, dt=0.1).to("meta")
    yield refused("BatchProblem", "trajectories", "device", meta, "meta", "on the CPU")


def holds() -> Iterator[Case]:
    for name in _HOLD.split():
        for bad in (None, "bias", BIAS, BSpline(POSE, group=SE3, dt=0.1)):
            yield refused(name, "unknown", "option", bad, "got ", "an unknown of a residual that was added")
    function = "BatchProblem.freeze"
    for bad in ([True] * 8, STAYS.numpy(), True):
        yield refused(function, "points", "type", bad, f"got {type(bad).__name__}", "a bool tensor")
    yield refused(function, "points", "dtype", STAYS.int(), "got torch.int32", "torch.bool")
    for bad in (STAYS[:1], STAYS[:, 1:], STAYS[0, 1:], STAYS.expand(3, 2, 8)):
        came = f"got {tuple(bad.shape)}"
        yield refused(function, "points", "shape", bad, came, "expected shape (8,) or (2, 8)")
    yield refused(function, "points", "shape", STAYS, "got (2, 8)", "expected shape (2,)", unknown="rows")
