"""The sections of the benchmark: each measures, and says what to record and draw."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from bench import goals, jacobians, operations, ours, plots, processes, sweeps, tables
from bench.contenders import CONTENDERS
from bench.operations import LIBRARIES, OPERATIONS, Operation
from bench.problems import Problem
from bench.sweeps import SWEEPS, Sizes
from bench.timing import measure, prepared


@dataclass(frozen=True)
class Plan:
    """Options of the run, see `experiment` in benchmark.py; `notes` collects what did not take part, and why."""

    sizes: Sizes
    goals: list[str]
    operations: list[str]
    rounds: int
    patience: float
    shrink: int
    notes: set[str] = field(default_factory=set)


class Report(NamedTuple):
    record: Any
    figure: Figure | None = None


def _goals(plan: Plan) -> Report:
    """Three times the rounds of the others: these figures are compared with fixed numbers."""
    rows = goals.evaluate(plan.goals, 3 * plan.rounds, 3 * plan.patience, plan.shrink, plan.notes)
    return Report(rows, plots.draw_goals(rows))


def _sweep(name: str, plan: Plan) -> Report:
    sweep = SWEEPS[name]
    rows = sweeps.run(sweep, plan.sizes, plan.rounds, plan.patience, plan.notes)
    return Report(rows, plots.draw_sweep(sweep.title, sweep.axis, rows))


def _latency(plan: Plan) -> Report:
    """One call with few queries: the function, the module, and everybody else."""
    rows = []
    for backward in (False, True):
        for queries in (1, 200):
            problem = Problem(queries, points=20, backward=backward)
            modules = [
                (f"torchspline module, {mode}", partial(ours.module, kernels=mode))
                for mode in ("fused", "reference")
            ]
            candidates = [*modules, *((c.name, c.prepare) for c in CONTENDERS)]
            tasks = prepared(((name, partial(prepare, problem)) for name, prepare in candidates), plan.notes)
            timings = measure([task for _, task in tasks], plan.rounds, plan.patience)
            sweep = tables.SWEEPS[backward]
            rows += [
                {"contender": name, "queries": queries, "sweep": sweep, **timing.record()}
                for (name, _), timing in zip(tasks, timings, strict=True)
            ]
    return Report(rows)


def _operations(plan: Plan) -> Report:
    rows = []
    chosen = [(group, name) for group, name in OPERATIONS if f"{group} {name}" in plan.operations]
    for group, name in chosen:
        for threads in (1, 2):
            operation = Operation(group, name, 1_000_000 // plan.shrink, threads=threads)
            tasks = prepared(((x.name, partial(x.prepare, operation)) for x in LIBRARIES), plan.notes)
            timings = measure([task for _, task in tasks], plan.rounds, plan.patience)
            rows += [
                {"operation": f"{group} {name}", "threads": threads, "contender": who, **timing.record()}
                for (who, _), timing in zip(tasks, timings, strict=True)
            ]
    checks = operations.verify(chosen, plan.notes)
    return Report({"times": rows, "deviations": checks}, plots.draw_operations(rows))


def _jacobians(plan: Plan) -> Report:
    orders = [k for k in (4, 5, 6) if k <= max(plan.sizes.orders)]
    rows = jacobians.evaluate(orders, plan.sizes.base // 10, plan.rounds, plan.patience, plan.notes)
    return Report(rows)


def _processes(plan: Plan) -> Report:
    rounds = min(plan.rounds, 5)
    samples = {"import beyond torch": processes.imports(rounds), **processes.first_calls(rounds)}
    return Report(processes.summary(samples))


#: A new section is a function and a line here, and its tables a line in `tables.TABLES`.
SECTIONS: dict[str, Callable[[Plan], Report]] = {
    "goals": _goals,
    **{name: partial(_sweep, name) for name in SWEEPS},
    "latency": _latency,
    "operations": _operations,
    "jacobians": _jacobians,
    "processes": _processes,
}
