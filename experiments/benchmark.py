"""Times this library against its goals and against others: one run, interleaved rounds, minimum and median.

Peers are optional, `pip install -c constraints.txt -e '.[bench]'`; what is missing is named and left out. Every
contender that computes the same thing is compared with the reference before anything is timed.

`benchmark.md` among the results has the tables and the machine; a copy of a quiet run lies beside this file.
"""

import importlib.metadata
import time
from pathlib import Path
from typing import Any

from bench import contenders
from bench.problems import PEERS
from bench.sections import SECTIONS, Plan
from bench.sweeps import Sizes
from common import Table, machine, run, save, show, versions


def agreement(rows: list[dict[str, Any]]) -> Table:
    lines = [
        [
            row["contender"],
            row["group"],
            row["what"],
            ", ".join(f"{name} {x:.1e}" for name, x in row["deviation"].items()),
        ]
        for row in rows
    ]
    title = (
        "Largest deviation from the reference, relative to the largest number (gradients across quaternions)"
    )
    return Table(title, ("", "group", "", "deviation"), lines)


def experiment(
    out: Path,
    sections: list[str],
    goals: list[str],
    operations: list[str],
    queries: list[int],
    points: list[int],
    orders: list[int],
    batches: list[int],
    base: int,
    rounds: int,
    patience: float,
    shrink: int,
    verify: list[str],
) -> dict[str, Any]:
    """Times this library against its goals and against others.

    Args:
        sections: which of goals, queries, points, orders, batch, settings, groups, latency, operations, jacobians,
            processes.
        goals: parts of the names of the goals to measure; none for all of them.
        operations: group operations of the section of that name, such as "SO3 exp".
        queries, points, orders, batches: sizes of the sweep of that name.
        base: queries of a call where something else changes.
        rounds: measurements of everything.
        patience: seconds for one contender at one size, over all rounds.
        shrink: how many times less to do for goals and group operations.
        verify: groups on which results and gradients of all contenders are compared first.
    """
    unknown = set(sections) - set(SECTIONS)
    if unknown:
        raise SystemExit(f"sections: {', '.join(sorted(unknown))} not among {', '.join(SECTIONS)}")
    plan = Plan(Sizes(queries, points, orders, batches, base), goals, operations, rounds, patience, shrink)
    seconds, started = {}, time.perf_counter()
    deviations = contenders.verify(verify, plan.notes)
    reports = {}
    for name in sections:
        seconds[name], reports[name] = -time.perf_counter(), SECTIONS[name](plan)
        seconds[name] += time.perf_counter()
        print(f"{name}: {seconds[name]:.0f} s", flush=True)
    seconds["verify"] = time.perf_counter() - started - sum(seconds.values())
    tables = [agreement(deviations)] if deviations else []
    tables += [table for report in reports.values() for table in report.tables]
    if plan.notes:
        tables.append(
            Table("Who did not take part everywhere", ("",), [[note] for note in sorted(plan.notes)])
        )
    peers = {name: version(module) for module, name in PEERS.items()}
    write_document(out, show(out, tables), peers)
    for name, report in reports.items():
        if report.figure is not None:
            save(report.figure, out / f"{name}.png")
    return {
        "deviations": deviations,
        **{name: report.record for name, report in reports.items()},
        "section_seconds": seconds,
        "notes": sorted(plan.notes),
        "peers": peers,
    }


def write_document(out: Path, tables: Path, peers: dict[str, str | None]) -> Path:
    """`benchmark.md`: what ran where, and all tables."""
    here = machine()
    known = {**versions(), **peers}
    software = ", ".join(f"{name} {number}" for name, number in known.items() if number is not None)
    heading = (
        "# Benchmark\n\n"
        "Written by `python experiments/benchmark.py`. All contenders took turns in one process; a contender that "
        "computes the same thing was compared with the reference first.\n\n"
        f"Machine: {here['processor']}, {here['usable_cores']} cores, {here['system']} ({here['architecture']}); one "
        f"thread unless said.\nSoftware: {software}.\n\n"
    )
    path = out / "benchmark.md"
    path.write_text(heading + tables.read_text(encoding="utf-8"), encoding="utf-8")
    return path


def version(module: str) -> str | None:
    try:
        return importlib.metadata.version(module)
    except importlib.metadata.PackageNotFoundError:
        return None


if __name__ == "__main__":
    run(
        experiment,
        smoke={
            "sections": ["goals", "queries", "operations", "jacobians"],
            "goals": ["SO(3), 1e5", "module call", "quaternion"],
            "operations": ["SO3 compose"],
            "queries": [10, 1000],
            "orders": [4],
            "base": 1000,
            "rounds": 2,
            "patience": 0.1,
            "shrink": 100,
            "verify": ["SO3"],
        },
    )
