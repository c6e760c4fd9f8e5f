"""The sections of the benchmark: each measures, and says what to print, draw and record."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

from common import Table
from matplotlib.figure import Figure

from bench import goals, jacobians, operations, ours, plots, processes, sweeps
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
    tables: list[Table]
    record: Any
    figure: Figure | None = None


def _goals(plan: Plan) -> Report:
    """Three times the rounds of the others: these figures are compared with fixed numbers."""
    rows = goals.evaluate(plan.goals, 3 * plan.rounds, 3 * plan.patience, plan.shrink, plan.notes)
    return Report([plots.goals_table(rows, plan.shrink)], rows, plots.draw_goals(rows))


def _sweep(name: str, plan: Plan) -> Report:
    sweep = SWEEPS[name]
    rows = sweeps.run(sweep, plan.sizes, plan.rounds, plan.patience, plan.notes)
    return Report(
        plots.sweep_tables(sweep.title, rows), rows, plots.draw_sweep(sweep.title, sweep.axis, rows)
    )


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
            sweep = plots.SWEEPS[backward]
            rows += [
                {"contender": name, "queries": queries, "sweep": sweep, **timing.record()}
                for (name, _), timing in zip(tasks, timings, strict=True)
            ]
    cells: dict[str, dict[tuple[str, int], str]] = {}
    for row in rows:
        pair = f"{plots.number(1e6 * row['seconds_min'])} ({plots.number(1e6 * row['seconds_median'])})"
        cells.setdefault(row["contender"], {})[row["sweep"], row["queries"]] = pair
    columns = [(sweep, n) for sweep in plots.SWEEPS for n in (1, 200)]
    lines = [[name, *(found.get(column, "-") for column in columns)] for name, found in cells.items()]
    header = ["", *(f"{sweep}, {n} quer{'y' if n == 1 else 'ies'}" for sweep, n in columns)]
    return Report([Table("One call, 20 control points: us, min (median)", header, lines)], rows)


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
    lines = [[row["contender"], row["what"], f"{row['deviation']:.1e}"] for row in checks]
    agreement = Table(
        "Group operations: largest relative deviation from the reference", ("", "what", ""), lines
    )
    record = {"times": rows, "deviations": checks}
    return Report([agreement, plots.operations_table(rows)], record, plots.draw_operations(rows))


def _jacobians(plan: Plan) -> Report:
    orders = [k for k in (4, 5, 6) if k <= max(plan.sizes.orders)]
    rows = jacobians.evaluate(orders, plan.sizes.base // 10, plan.rounds, plan.patience, plan.notes)
    cells = {(row["group"], row["contender"], row["order"]): row for row in rows}
    names = list(dict.fromkeys((row["group"], row["contender"]) for row in rows))
    lines = [[f"{group}: {who}", *(plots.pair(cells[group, who, k]) for k in orders)] for group, who in names]
    for group in jacobians.GROUPS:
        quoted = [jacobians.QUOTED.get((group, k)) for k in orders]
        if any(quoted):
            lines.append(
                [f"{group}: C++, quoted, another machine", *("-" if x is None else x for x in quoted)]
            )
    title = (
        "Jacobians of value, velocity and acceleration by control points; orders: ns per query, min (median)"
    )
    apart = max((row["deviation"] for row in rows), default=0.0)
    agreement = Table("Jacobians: largest deviation from forward mode", ("deviation",), [[f"{apart:.1e}"]])
    return Report([agreement, Table(title, ["", *(f"{k}" for k in orders)], lines)], rows)


def _processes(plan: Plan) -> Report:
    rounds = min(plan.rounds, 5)
    samples = {"import beyond torch": processes.imports(rounds), **processes.first_calls(rounds)}
    rows = processes.summary(samples)
    lines = [
        [row["what"], f"{row['seconds_min']:.3f}", f"{row['seconds_median']:.3f}", row["runs"]]
        for row in rows
    ]
    return Report([Table("New processes: seconds", ("", "min", "median", "runs"), lines)], rows)


#: A new section is a function and a line here.
SECTIONS: dict[str, Callable[[Plan], Report]] = {
    "goals": _goals,
    **{name: partial(_sweep, name) for name in SWEEPS},
    "latency": _latency,
    "operations": _operations,
    "jacobians": _jacobians,
    "processes": _processes,
}
