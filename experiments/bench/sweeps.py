"""Sweeps: all contenders while one thing about the problem changes."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from bench.contenders import CONTENDERS, FUSED, Contender
from bench.problems import Problem, UnavailableError
from bench.timing import Task, measure, prepared

OVERHEAD = 0.02  # seconds; a shorter call need not grow with the number of queries
BATCH_POINTS = 32  # control points of each trajectory of a batch


class Sizes(NamedTuple):
    """The options of the sweeps, see `experiment` in benchmark.py."""

    queries: list[int]
    points: list[int]
    orders: list[int]
    batches: list[int]
    base: int


class Sweep(NamedTuple):
    """`problems` pairs what stands on the axis (a number, or words) with a problem, backward not yet decided."""

    title: str
    axis: str
    problems: Callable[[Sizes], Sequence[tuple[int | str, Problem]]]


def _settings(sizes: Sizes) -> list[tuple[str, Problem]]:
    plain = Problem(sizes.base)
    return [
        ("float64, sorted, 1 thread", plain),
        ("float32", replace(plain, dtype="float32")),
        ("unsorted", replace(plain, ordered=False)),
        ("2 threads", replace(plain, threads=2)),
        ("unsorted, 2 threads", replace(plain, ordered=False, threads=2)),
    ]


def _batches(sizes: Sizes) -> list[tuple[int, Problem]]:
    return [(b, Problem(max(1, sizes.base // b), points=BATCH_POINTS, batch=b)) for b in sizes.batches]


#: SO(3), order 4, 1000 control points, float64, sorted, one thread, value and two derivatives, unless said. A new
#: sweep is a line here.
SWEEPS = {
    "queries": Sweep("SO(3), by the number of queries", "queries", lambda s: [(n, Problem(n)) for n in s.queries]),
    "points": Sweep(
        "SO(3), by the number of control points",
        "control points",
        lambda s: [(m, Problem(s.base, points=m)) for m in s.points],
    ),
    "orders": Sweep(
        "SO(3), by the order of the spline", "order", lambda s: [(k, Problem(s.base, order=k)) for k in s.orders]
    ),
    "batch": Sweep(
        f"SO(3), the same number of queries on batches of trajectories, {BATCH_POINTS} control points each",
        "trajectories",
        _batches,
    ),
    "settings": Sweep("SO(3), by precision, order of the times and threads", "setting", _settings),
    "groups": Sweep(
        "By group", "group", lambda s: [(g, Problem(s.base, group=g)) for g in ("SO3", "SE3", "R3xSO3", "R3")]
    ),
}  # fmt: skip


def run(sweep: Sweep, sizes: Sizes, rounds: int, patience: float, notes: set[str]) -> list[dict[str, Any]]:
    """Measures a sweep: at each of its places all contenders in interleaved rounds, forward, then with backward.

    A contender stays away where, going by its last time and the number of queries, one call would take longer than
    five times the `patience`.
    """
    rows = []
    for backward in (False, True):
        last: dict[str, tuple[float, int]] = {}
        for x, problem in sweep.problems(sizes):
            problem = replace(problem, backward=backward)
            candidates = ((c.name, partial(_prepare, c, problem, last, patience)) for c in CONTENDERS)
            tasks = prepared(candidates, notes)
            timings = measure([task for _, task in tasks], rounds, patience)
            for (name, _), timing in zip(tasks, timings, strict=True):
                last[name] = timing.least, problem.total
                sweep_of = "forward + backward" if backward else "forward"
                rows.append({"contender": name, "x": x, "sweep": sweep_of, **timing.record()})
    return rows


def _prepare(
    contender: Contender, problem: Problem, last: dict[str, tuple[float, int]], patience: float
) -> Task:
    if problem.total > contender.most:
        raise UnavailableError(f"at most {contender.most:.0e} queries")
    seconds, total = last.get(contender.name, (0.0, problem.total))
    predicted = seconds * max(1.0, problem.total / total)
    if contender.name != FUSED and seconds > OVERHEAD and predicted > 5 * patience:
        raise UnavailableError("left out where a call would take too long")
    return contender.prepare(problem)
