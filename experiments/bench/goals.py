"""The goals of this library, and what is measured of each."""

import statistics
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from bench import operations, ours, processes
from bench.contenders import deviations
from bench.operations import Operation
from bench.problems import Problem, UnavailableError
from bench.timing import Task, measure, prepared

HUNDRED_THOUSAND, MILLION = 100_000, 1_000_000


class Goal(NamedTuple):
    """Something timed against a bound: `make(shrink)` prepares it with `shrink` times less to do.

    `bound` None: measured because another goal is about it.
    """

    name: str
    make: Callable[[int], Task]
    bound: float | None
    unit: str = "ns per query"


class Fact(NamedTuple):
    """Any other goal: `samples(rounds, shrink, timed)`, with the seconds a round of the timed goals by name.

    `needs`: the timed goals among them.
    """

    name: str
    samples: Callable[[int, int, dict[str, list[float]]], list[float]]
    bound: float
    unit: str
    at_least: bool = False
    needs: tuple[str, ...] = ()


SCALE = {"ns per query": 1e9, "ns each": 1e9, "us": 1e6}


def _spline(
    name: str, bound: float | None, make: Callable[..., Task] = ours.function, **problem: Any
) -> Goal:
    whole = Problem(**{"queries": HUNDRED_THOUSAND, **problem})

    def task(shrink: int) -> Task:
        return make(replace(whole, queries=max(1, whole.queries // shrink)), "fused")

    return Goal(name, task, bound)


def _call(name: str, bound: float, **problem: Any) -> Goal:
    """One call as such, however few queries: its time is not divided by them."""
    whole = Problem(queries=200, **problem)
    return Goal(name, lambda _: ours.module(whole, "fused")._replace(count=1), bound, "us")


def _operation(name: str, bound: float, group: str, operation: str) -> Goal:
    whole = Operation(group, operation, MILLION, threads=2)
    return Goal(
        name, lambda shrink: operations.fused(replace(whole, count=whole.count // shrink)), bound, "ns each"
    )


ONE, TWO = "SO(3), 1e6 queries", "SO(3), 1e6 queries, 2 threads"


def _speedup(_rounds: int, _shrink: int, timed: dict[str, list[float]]) -> list[float]:
    return [one / two for one, two in zip(timed[ONE], timed[TWO], strict=False)]


def _worst_deviation(dtype: str) -> Callable[..., list[float]]:
    def samples(_rounds: int, shrink: int, _timed: dict[str, list[float]]) -> list[float]:
        worst = 0.0
        for group, order in (("SO3", 4), ("SO3", 6), ("SE3", 4), ("R3xSO3", 4)):
            for backward in (False, True):
                problem = Problem(20_000 // shrink, group=group, order=order, dtype=dtype, backward=backward)
                worst = max(worst, *deviations(problem, ours.function(problem, "fused")))
        return [worst]

    return samples


#: One thread, float64, order 4, sorted times, 1000 control points, value and two derivatives, unless the name says
#: otherwise. A new goal is a line here.
GOALS: tuple[Goal | Fact, ...] = (
    _spline("SO(3), 1e5 queries", 13),
    _spline(ONE, 18, queries=MILLION),
    _spline(TWO, None, queries=MILLION, threads=2),
    Fact("SO(3), 1e6 queries: 2 threads against 1", _speedup, 1.8, "times", True, (ONE, TWO)),
    _spline("SO(3), float32, 1e5 queries", 9, dtype="float32"),
    _spline("SO(3), float32, 1e6 queries", 12, dtype="float32", queries=MILLION),
    _spline("SO(3), order 6", 20, order=6),
    _spline("SO(3), with backward", 42, backward=True),
    _spline("SO(3), order 6, with backward", 64, order=6, backward=True),
    _spline("SE(3)", 35, group="SE3"),
    _spline("SE(3), with backward", 110, group="SE3", backward=True),
    _spline("split pose, kinematics", 25, ours.kinematics, group="R3xSO3"),
    _call("module call, 200 queries", 50),
    _call("module call, 200 queries, with backward", 150, backward=True),
    _operation("quaternion product", 20, "SO3", "compose"),
    _operation("SO(3) exp", 32, "SO3", "exp"),
    _operation("SO(3) log", 27, "SO3", "log"),
    _operation("SE(3) exp", 60, "SE3", "exp"),
    _operation("SE(3) log", 60, "SE3", "log"),
    _operation("SE(3) compose", 50, "SE3", "compose"),
    Fact("import beyond torch", lambda rounds, *_: processes.imports(min(rounds, 5)), 0.3, "s"),
    Fact(
        "first call in a new process, cached kernels",
        lambda rounds, *_: processes.first_calls(min(rounds, 5))["first forward, cached"],
        0.5,
        "s",
    ),
    Fact("fused against reference, float64", _worst_deviation("float64"), 1e-13, "relative"),
    Fact("fused against reference, float32", _worst_deviation("float32"), 1e-5, "relative"),
)


def chosen(names: list[str]) -> list[Goal | Fact]:
    """The goals whose name contains one of `names` (none: all), and what they need."""
    found = [goal for goal in GOALS if not names or any(name in goal.name for name in names)]
    needed = {name for goal in found if isinstance(goal, Fact) for name in goal.needs}
    return [goal for goal in GOALS if goal in found or goal.name in needed]


def evaluate(
    names: list[str], rounds: int, patience: float, shrink: int, notes: set[str]
) -> list[dict[str, Any]]:
    """Measures the goals named: all timed ones in one set of interleaved rounds."""
    goals = chosen(names)
    candidates = ((goal.name, partial(goal.make, shrink)) for goal in goals if isinstance(goal, Goal))
    tasks = dict(prepared(candidates, notes))
    timings = dict(zip(tasks, measure(list(tasks.values()), rounds, patience), strict=True))
    seconds = {name: timing.rounds for name, timing in timings.items()}
    rows = []
    for goal in goals:
        if isinstance(goal, Goal):
            if goal.name not in timings:
                continue
            timing = timings[goal.name]
            samples = [SCALE[goal.unit] * s / timing.count for s in timing.rounds]
            extra = {"busy": timing.busy}
        else:
            if not all(name in seconds for name in goal.needs):
                continue
            try:
                samples, extra = goal.samples(rounds, shrink, seconds), {}
            except (UnavailableError, RuntimeError) as reason:
                notes.add(f"{goal.name}: {reason}")
                continue
        rows.append(_row(goal, samples) | extra)
    return rows


def _row(goal: Goal | Fact, samples: list[float]) -> dict[str, Any]:
    at_least = isinstance(goal, Fact) and goal.at_least
    median = statistics.median(samples)
    best = max(samples) if at_least else min(samples)
    met = None
    if goal.bound is not None:
        reached = [x >= goal.bound if at_least else x <= goal.bound for x in (median, best)]
        met = "yes" if reached[0] else "best only" if reached[1] else "no"
    return {
        "goal": goal.name,
        "unit": goal.unit,
        "min": min(samples),
        "median": median,
        "bound": goal.bound,
        "at_least": at_least,
        "met": met,
        "rounds": len(samples),
    }
