"""Bad arguments of least squares: residuals, losses, unknowns, problems and their results."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from error_arguments import (
    F64,
    I64,
    INF,
    NAN,
    POSE,
    Case,
    Q,
    T,
    V,
    accept,
    changed,
    groups,
    numbers,
    refused,
    tensor,
    times,
    wholes,
)  # fmt: skip
from fit_cases import sample

from torchspline import R3, SE3, SO3, BSpline, Rn, fit
from torchspline.fit.losses import Loss
from torchspline.fit.residuals import RESIDUALS
from torchspline.fit.residuals.motion import MotionResidual

SPLINE = BSpline(POSE[0], group=SE3, dt=0.1)
TURNING = BSpline(Q[0], group=SO3, dt=0.1)
NANOSECONDS = BSpline(POSE[0], group=SE3, dt_ns=10**8)
TIMES = torch.linspace(0.0, 0.5, 8, dtype=F64)
NUMBER = fit.Variable("number", torch.zeros(1, dtype=F64))
BIAS = fit.Variable("bias", torch.zeros(3, dtype=F64))
MAP = fit.Variable("map", V[0])
INDEX = torch.arange(8)
SIGHTS = {"t": TIMES, "measured": V[0], "landmark": MAP}
OTHERS = {"sigma": None, "covariance": None, "information": None, "loss": None, "clock": None}


def arguments(name: str) -> dict[str, Any]:
    """A residual with every argument given as a known value."""
    kind = RESIDUALS[name]
    given = sample(kind, SE3, count=8)
    return {
        "t": TIMES if kind.moments == 1 else torch.stack([TIMES, TIMES.flip(0)]),
        "measured": given["measured"],
        **{slot: given[slot][0] for slot in kind.slots},
        **OTHERS,
    }


def bound(name: str) -> Callable[..., None]:
    return lambda **k: RESIDUALS[name](**k).bind(SE3)


def point() -> fit.Residual:
    return fit.Point(**SIGHTS)


def add(residual: Any, trajectory: BSpline = SPLINE, landmark: Any = None) -> None:
    """To a fresh problem, with an index or without."""
    fit.Problem(trajectory).add(residual, **({} if landmark is None else {"landmark": landmark}))


def with_point(method: str) -> Callable[..., Any]:
    """A method of a problem that has a residual."""

    def call(**k: Any) -> Any:
        problem = fit.Problem(SPLINE)
        problem.add(point(), landmark=INDEX)
        problem.add(fit.Gyroscope(TIMES, V[0], bias=BIAS))
        if k.get("unknown") == "map":
            k["unknown"] = MAP
        return getattr(problem, method)(**k)

    return call


def of_result(method: str) -> Callable[..., Any]:
    """A method of the solution of a problem with a bias."""

    def call(**k: Any) -> Any:
        spline = BSpline(POSE[0], group=SE3, dt=0.1)
        problem = fit.Problem(spline)
        times = torch.linspace(0.0, 0.5, 40, dtype=F64)
        problem.add(fit.Pose(times, spline(times).detach()))
        problem.add(fit.Gyroscope(TIMES, V[0], bias=BIAS))
        return getattr(problem.solve(max_iterations=1), method)(**k)

    return call


def solve(**k: Any) -> Any:
    problem = fit.Problem(BSpline(POSE[0], group=SE3, dt=0.1))
    problem.add(fit.Pose(TIMES, POSE[1]))
    return problem.solve(**k)


FUNCTIONS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    **{name: (bound(name), arguments(name)) for name in RESIDUALS},
    **{name: (getattr(fit, name), {"scale": 2.0}) for name in ("Huber", "Cauchy", "GemanMcClure")},
    "Variable": (fit.Variable, {"name": "pose", "value": POSE[0, 0], "group": SE3, "sphere": False}),
    "Clock": (
        fit.Clock,
        {"offset": NUMBER, "skew": NUMBER, "mid": 0.5, "delay": NUMBER, "late": torch.zeros(8)},
    ),
    "smoothness": (fit.smoothness, {"trajectory": SPLINE, "derivative": 2, "sigma": 0.1, "nodes": None}),
    "Problem": (fit.Problem, {"trajectory": SPLINE}),
    "Problem.add": (add, {"residual": point(), "landmark": INDEX}),
    "Problem.add_prior": (with_point("add_prior"), {"variable": BIAS, "sigma": 0.1}),
    "Result.covariance": (of_result("covariance"), {"variable": BIAS}),
    "Result.standard_deviation": (of_result("standard_deviation"), {"variable": BIAS}),
    "Result.trajectory_covariance": (of_result("trajectory_covariance"), {"t": T, "derivatives": 0}),
    "Problem.freeze": (with_point("freeze"), {"unknown": SPLINE, "points": torch.ones(8, dtype=torch.bool)}),
    "Problem.release": (with_point("release"), {"unknown": SPLINE}),
    "Problem.solve": (solve, {"max_iterations": 1}),
}
accept(FUNCTIONS)

_LOSSES = " ".join(loss.__name__ for loss in Loss.__subclasses__())
_SOLVING = "Problem.add_prior Problem.freeze Problem.release Problem.solve Result.covariance Result.standard_deviation"
_NUMBERS = f"{_LOSSES} Problem.release Problem.solve Result.covariance Result.standard_deviation"
_WITHOUT_QUATERNIONS = " ".join(
    name
    for name, kind in RESIDUALS.items()
    if name != "StateValue"
    and not kind.measured_signs
    and all(slot.group is None for slot in kind.slots.values())
)

#: What is made and handed out.
RESULTS = {"Result"}
UNTRIED = {
    "Problem.prepare": "no arguments",
    "Residual.bind": "tried through Problem.add, which calls it",
    **{
        getattr(kind, method).__qualname__: "called by the solver, on numbers that were checked"
        for kinds, methods in (
            (RESIDUALS.values(), ("evaluate", "reverse")),
            (MotionResidual.__subclasses__(), ("error", "error_reverse")),
            (Loss.__subclasses__(), ("rho", "weight")),
            ((fit.Variable,), ("basis", "points", "retract")),
        )
        for kind in kinds
        for method in methods
    },
}
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE: dict[str, dict[str, str]] = {
    "shape": {"no tensor": _NUMBERS},
    "dtype": {"no tensor": f"Problem {_NUMBERS}"},
    "device": {
        "measurements are copied to the CPU": f"{' '.join(RESIDUALS)} Variable Clock smoothness Problem.add",
        "no tensor that stays": f"{_LOSSES} {_SOLVING}",
    },
    "nan": {
        "checked when the residual was made": "Problem.add",
        "no numbers that can be one": "Problem.freeze Problem.release Result.covariance Result.standard_deviation",
    },
    "zero quaternion": {
        "no quaternion in it": f"{_WITHOUT_QUATERNIONS} {_LOSSES} Clock",
        "checked when residual and trajectory were made": f"smoothness Problem.add {_SOLVING} "
        "Result.trajectory_covariance",
    },
    "count": {
        "any number of measurements, unknowns and control points": f"{_LOSSES} Variable Clock smoothness Problem "
        f"Problem.add Result.trajectory_covariance {_SOLVING}",
    },
    "time": {
        "no trajectory to lie on before Problem.add": f"{' '.join(RESIDUALS)} {_LOSSES} Variable Clock",
        "times come with residuals": f"smoothness Problem {_SOLVING}",
    },
}


def cases() -> Iterator[Case]:
    for name in RESIDUALS:
        yield from residual(name)
    for name in ("Huber", "Cauchy", "GemanMcClure"):
        yield from numbers(name, "scale", 0.0, -1.0)
    yield from variables()
    yield from clocks()
    yield from smooth()
    yield from problems()


def residual(function: str) -> Iterator[Case]:
    kind, good = RESIDUALS[function], arguments(function)
    rows, _ = kind.sizes(SE3.arithmetic)
    t, measured = good["t"], good["measured"]

    def case(argument: str, category: str, bad: Any, came: str, expected: str, named: str = "") -> Case:
        return refused(function, argument, category, bad, came, expected, named)

    for bad in (t.tolist(), t.numpy(), None):
        yield case("t", "type", bad, f"got {type(bad).__name__}", "a torch.Tensor")
    for dtype in (torch.float32, torch.int32, torch.bool):
        yield case("t", "dtype", t.to(dtype), f"got {dtype}", "float64 seconds or int64")
    for bad in (t[None], t[0]):
        shape = "(N,)" if kind.moments == 1 else "(2, N)"
        yield case("t", "shape", bad, f"got {tuple(bad.shape)}", f"expected shape {shape}")
    for number in (NAN, INF):
        yield case("t", "nan", changed(t, (..., 3), number), f"got {number}", "finite numbers")
    signs = kind.measured_signs or (SE3.arithmetic.sign_blocks if function == "StateValue" else ())
    yield from tensor(function, "measured", "", slice(*signs[0]) if signs else None)
    yield case("measured", "count", measured[:-1], f"got {tuple(measured[:-1].shape)}", "N = 8 times")

    yield from weights(function, rows, 8)
    yield case("loss", "type", "huber", "got str", "expected a robust loss")
    yield case("clock", "type", NUMBER, "got Variable", "expected a torchspline.fit.Clock")
    late = fit.Clock(delay=NUMBER, late=torch.zeros(7))
    yield case("clock", "shape", late, "got (7,)", "expected late of shape (8,)")
    whole = {"t": (t * 1e9).to(I64), "clock": fit.Clock(NUMBER, mid=0.5)}
    yield Case(function, "clock", "dtype", whole, "got 0.5", "a whole number of nanoseconds", "clock")
    if kind.derivatives == 3:
        yield case("clock", "option", fit.Clock(NUMBER), "got unknowns of time", "expected none")

    yield case("speed", "type", V[0], f"{function} takes no such argument", "it takes", "speed")
    for slot, (size, group, _) in kind.slots.items():
        x = good[slot]
        for bad in (x.tolist(), None, 1.0):
            yield case(slot, "type", bad, f"got {type(bad).__name__}", "a Variable, a BSpline or a tensor")
        yield case(slot, "dtype", x.to(I64), "got torch.int64", "torch.float64")
        for bad in (x[:-1], x.expand(7, size), torch.zeros((), dtype=F64)):
            yield case(slot, "shape", bad, f"got {tuple(bad.shape)}", f"({size},) or (8, {size})")
        yield case(slot, "nan", changed(x, 1, NAN), "got nan at index (1,)", "finite")
        yield case(slot, "option", fit.Variable("v", torch.ones(5)), "'v', R5", "expected a Variable of")
        other = BSpline(torch.zeros(8, 5), group=Rn(5), dt=0.1)
        yield case(slot, "option", other, "in R5 of shape (8, 5)", f"expected a spline in R{size}")
        if group is not None:
            start = size - 4
            zero = changed(x, slice(start, None), 0.0)
            yield case(slot, "zero quaternion", zero, "got length 0 at index ()", "expected quaternions")
            free = fit.Variable("v", torch.ones(size))
            yield case(slot, "option", free, f"'v', R{size}", f"expected a Variable of {group}")


def weights(function: str, rows: int, count: int) -> Iterator[Case]:
    """What standard deviations, covariances and information are tried with."""

    def case(argument: str, category: str, bad: Any, came: str, expected: str) -> Case:
        cleared = {"sigma": None, argument: bad}
        return Case(function, argument, category, cleared, came, expected, argument)

    for bad in ("1", True, 1j, [0.1]):
        yield case("sigma", "type", bad, f"got {type(bad).__name__}", "expected a number")
    for number in (0.0, -1.0, NAN, INF):
        yield case("sigma", "nan", number, f"got {number}", "above zero")
    yield case("sigma", "nan", torch.tensor(NAN), "got nan", "finite")
    yield case("sigma", "option", torch.zeros(rows), "expected standard deviations above zero", "leave")
    yield case("sigma", "dtype", torch.ones(rows, dtype=I64), "got torch.int64", "torch.float64")
    yield case("sigma", "shape", torch.ones(8), "got (8,)", f"({rows},), ({count}, 1) or ({count}, {rows})")
    one = torch.eye(rows, dtype=F64)
    for name in ("covariance", "information"):
        yield case(name, "type", 0.1, "got float", "a torch.Tensor")
        yield case(name, "dtype", one.to(I64), "got torch.int64", "torch.float64")
        yield case(name, "shape", one[0], f"got ({rows},)", f"({rows}, {rows}) or ({count}, {rows}, {rows})")
        yield case(name, "nan", changed(one, (0, 0), NAN), "got nan at index (0, 0)", "finite")
        yield case(name, "option", changed(one, (0, 1), 0.5), "expected symmetric", "matrices")
        yield case(
            name, "option", changed(one, (1, 1), -1.0), "the one at index 0 is not", "positive definite"
        )
        if count > 1:
            bad = changed(one.repeat(count, 1, 1), (2, 1, 1), -1.0)
            yield case(name, "option", bad, "the one at index 2 is not", "positive definite")
        both = "sigma, covariance, information"
        yield refused(function, name, "option", one, "got several", "expected one of them", both, sigma=1.0)


def priors() -> Iterator[Case]:
    function = "Problem.add_prior"
    for bad in (None, "bias", SPLINE, BIAS.value):
        yield refused(
            function, "variable", "type", bad, f"got {type(bad).__name__}", "torchspline.fit.Variable"
        )
    twin = fit.Variable("bias", torch.zeros(3))
    yield refused(function, "variable", "option", twin, "two called 'bias'", "one unknown of each name")
    yield from weights(function, 3, 1)
    every = "sigma, covariance, information"
    yield refused(function, "sigma", "option", None, "got none", "expected one of them", every)
    few = fit.Variable("few", torch.ones(3, 3))
    each = torch.ones(3, 3)
    yield refused(function, "sigma", "shape", each, "got shape (3, 3)", "one for all", variable=few)
    many = torch.eye(3).repeat(3, 1, 1)
    for name in ("covariance", "information"):
        wrong = {"variable": few, "sigma": None, name: many}
        yield Case(function, name, "shape", wrong, "got shape (3, 3, 3)", "one for all", name)


def covariances() -> Iterator[Case]:
    for function in ("Result.covariance", "Result.standard_deviation"):
        for bad in (None, "bias", SPLINE):
            if bad is SPLINE and function.endswith("deviation"):
                yield refused(function, "variable", "option", bad, "BSpline(SE3", "that were solved for")
                continue
            yield refused(function, "variable", "type", bad, f"got {type(bad).__name__}", "fit.Variable")
        yield refused(
            function, "variable", "option", MAP, "map is not among", "unknowns that were solved for"
        )
    function = "Result.trajectory_covariance"
    yield from (case for case in times(function) if case.category != "batch")
    yield refused(function, "t", "shape", T[None], "got (1, 3)", "expected shape (N,)")
    for bad in (4, -1, True, 1.0, None):
        yield refused(function, "derivatives", "option", bad, f"got {bad!r}", "from 0 to 3")
    yield refused(
        function, "stretch", "option", 0.2, "got 0.2", "at most the knot spacing of the spline, 0.1 s"
    )
    for number in (0.0, -1.0, NAN):
        yield refused(function, "stretch", "option", number, f"got {number}", "above zero")


def variables() -> Iterator[Case]:
    yield refused("Variable", "name", "type", 5, "got int", "expected a name")
    yield from tensor("Variable", "value", "", slice(3, 7))
    empty = {"group": None, "value": torch.zeros(2, 0)}
    yield Case("Variable", "value", "shape", empty, "got (2, 0)", "expected shape (n,) or (L, n)", "value")
    for case in groups("Variable"):
        if case.changes["group"] is not None:
            yield case
    yield refused("Variable", "sphere", "option", True, "got (7,), group SE3", "three numbers and no group")
    zero = {"group": None, "sphere": True, "value": torch.zeros(3, dtype=F64)}
    yield Case("Variable", "value", "option", zero, "got 0", "expected a length above zero", "value")


def clocks() -> Iterator[Case]:
    for name in ("offset", "skew", "delay"):
        for bad in (0.0, "offset", torch.zeros(1)):
            yield refused(
                "Clock", name, "type", bad, f"got {type(bad).__name__}", "a torchspline.fit.Variable"
            )
        for bad in (BIAS, fit.Variable("many", torch.zeros(4, 2))):
            yield refused("Clock", name, "shape", bad, f"got Variable('{bad.name}'", "shape (1,)")
    for case in numbers("Clock", "mid"):
        if case.changes["mid"] is not None:
            yield case
    late = torch.zeros(8)
    yield refused("Clock", "late", "type", late.tolist(), "got list", "a torch.Tensor")
    yield refused("Clock", "late", "dtype", late.to(I64), "got torch.int64", "torch.float32")
    yield refused("Clock", "late", "shape", late[None], "got (1, 8)", "expected shape (N,)")
    yield refused("Clock", "late", "nan", late * NAN, "got nan", "finite")
    yield refused("Clock", "late", "option", None, "got None", "delay and late together")
    yield refused("Clock", "delay", "option", None, "got None", "delay and late together")


def smooth() -> Iterator[Case]:
    function = "smoothness"
    yield refused(function, "trajectory", "type", POSE, "got Tensor", "expected a BSpline")
    yield from wholes(function, "derivative", 1)
    yield refused(function, "derivative", "option", 4, "got 4", "at most 3")
    for case in wholes(function, "nodes", 1):
        if case.changes["nodes"] is not None:
            yield case
    for bad in (None, "a", True, 1j):
        yield refused(function, "sigma", "type", bad, f"got {type(bad).__name__}", "expected a number")
    for bad in (NAN, INF, 0.0, -1.0):
        yield refused(function, "sigma", "nan", bad, f"got {bad}", "above zero")
    yield refused(function, "sigma", "nan", torch.full((6,), NAN), "got nan", "finite")
    yield refused(function, "sigma", "dtype", torch.ones(6, dtype=I64), "got torch.int64", "torch.float64")
    yield refused(function, "sigma", "shape", torch.ones(3), "got (3,)", "a number or shape (6,)")


def spoilt(value: float) -> BSpline:
    spline = BSpline(POSE[0], group=SE3, dt=0.1)
    with torch.no_grad():
        spline.control_points[2, 3:] = value
    return spline


def problems() -> Iterator[Case]:
    for bad in (POSE, None, SPLINE.mounted(POSE[0, 0])):
        yield refused("Problem", "trajectory", "type", bad, f"got {type(bad).__name__}", "expected a BSpline")
    batch = BSpline(POSE, group=SE3, dt=0.1)
    yield refused("Problem", "trajectory", "shape", batch, "(2, 8, 7)", "without a batch")
    elsewhere = BSpline(POSE[0].to("meta"), group=SE3, dt=0.1)
    yield refused("Problem", "trajectory", "device", elsewhere, "meta", "CPU")
    yield refused("Problem", "trajectory", "nan", spoilt(NAN), "got nan", "finite")
    yield refused("Problem", "trajectory", "zero quaternion", spoilt(0.0), "got length 0", "quaternions")

    function, gyroscope = "Problem.add", fit.Gyroscope(TIMES, V[0])

    def case(category: str, changes: dict[str, Any], came: str, expected: str, named: str) -> Case:
        return Case(function, "residual", category, {"landmark": None, **changes}, came, expected, named)

    for bad in (V, None, fit.Gyroscope):
        yield refused(function, "residual", "type", bad, f"got {type(bad).__name__}", "expected a residual")
    for bad in (INDEX.tolist(), INDEX.numpy(), 5):
        yield refused(function, "landmark", "type", bad, f"got {type(bad).__name__}", "an int64 index")
    yield refused(function, "landmark", "dtype", INDEX.int(), "got torch.int32", "torch.int64")
    yield refused(function, "landmark", "shape", INDEX[:-1], "got (7,)", "shape (8,)")
    yield refused(function, "landmark", "option", None, "got none", "expected landmark=index")
    for bad in (INDEX - 1, INDEX + 1):
        came = f"got {bad.min()} to {bad.max()}"
        yield refused(function, "landmark", "option", bad, came, "indices from 0 to 7")
    for wrong in (fit.Point(TIMES, V[0], landmark=BIAS), fit.Point(TIMES, V[0], landmark=V[0, 0]), gyroscope):
        changes = {"residual": wrong, "landmark": INDEX}
        yield case("option", changes, "got ", "only with a Variable of several", "landmark")
    plane = BSpline(torch.zeros(8, 2), group=Rn(2), dt=0.1)
    yield case("option", {"trajectory": TURNING}, "got SO3", "a trajectory in R3xSO3, SE3", "Point")
    wrong = {"trajectory": plane, "residual": gyroscope}
    yield case("option", wrong, "got R2", "a trajectory in SO3, R3xSO3, SE3", "Gyroscope")
    for bad in (TIMES + 0.01, TIMES - 0.01):
        first = bad[(bad < 0) | (bad > 0.5)][0].item()
        yield case("time", {"residual": fit.Gyroscope(bad, V[0])}, f"the first {first!r}", "[0.0, 0.5]", "t")
    short = BSpline(V[0], group=R3, dt=0.05)
    biased = fit.Gyroscope(TIMES, V[0], bias=short)
    yield case("time", {"residual": biased}, "of its spline", "covers them", "bias")
    wrong = {"trajectory": NANOSECONDS, "residual": gyroscope}
    yield case("dtype", wrong, "torch.float64 times", "int64 nanoseconds", "t")
    whole = fit.Gyroscope((TIMES * 1e9).to(I64), V[0])
    yield case("dtype", {"residual": whole}, "torch.int64 times", "float64 seconds", "t")
    mixed = fit.Gyroscope(TIMES, V[0], bias=BSpline(V[0], group=R3, dt_ns=10**8))
    yield case("dtype", {"residual": mixed}, "nanoseconds", "the trajectory's kind of time", "bias")
    batch = fit.Gyroscope(
        TIMES, V[0], bias=fit.Variable("twin", torch.zeros(3)), scaling=fit.Variable("twin", torch.ones(9))
    )
    yield case("option", {"residual": batch}, "two called 'twin'", "one unknown of each name", "variable")
    several = fit.Gyroscope(TIMES, V[0], bias=BSpline(V[:2], group=R3, dt=0.5))
    yield case(
        "shape", {"residual": several}, "got control points of shape (2, 8, 3)", "without a batch", "spline"
    )
    clock = fit.Clock(offset=fit.Variable("late", torch.zeros(2, 1)))
    several = fit.Gyroscope(TIMES, V[0], clock=clock)
    yield case("shape", {"residual": several}, "got Variable('late'", "for BatchProblem", "clock")
    states = fit.StateVelocity(TIMES, V[0])
    yield case("shape", {"residual": states}, "got (8, 3)", "expected shape (8, 6)", "measured")

    yield from priors()
    yield from covariances()
    for name in ("Problem.freeze", "Problem.release"):
        for bad in (None, "bias", fit.Variable("bias", torch.zeros(3)), TURNING):
            yield refused(name, "unknown", "option", bad, "got ", "an unknown of a residual that was added")
    function, points = "Problem.freeze", torch.ones(8, dtype=torch.bool)
    for bad in ([True] * 8, points.numpy(), True):
        yield refused(function, "points", "type", bad, f"got {type(bad).__name__}", "a bool tensor")
    for bad in (points.int(), points.double()):
        yield refused(function, "points", "dtype", bad, f"got {bad.dtype}", "torch.bool")
    for bad in (points[:-1], points[None], points[0]):
        yield refused(function, "points", "shape", bad, f"got {tuple(bad.shape)}", "expected shape (8,)")
    yield refused(function, "points", "option", points, "got Variable('map'", "expected None", unknown="map")

    function = "Problem.solve"
    yield from wholes(function, "max_iterations", 0)
    for name in ("cost_tolerance", "gradient_tolerance"):
        yield from numbers(function, name, -1.0)
    yield from numbers(function, "damping", 0.0, -math.pi)
    yield refused(function, "differentiable", "option", True, "none of the measurements", "requires grad")
