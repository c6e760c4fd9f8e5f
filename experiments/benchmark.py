"""Times this library against its goals and against others: one run, interleaved rounds, minimum and median.

Peers are optional, `pip install -c constraints.txt -e '.[bench]'`; what is missing is named and left out. Every
contender that computes the same thing is compared with the reference before anything is timed.

`benchmark.md` among the results has the tables and the machine. On a quiet machine `--publish true` also keeps the
figures in `benchmark.json` beside this file, of which `benchmark.md` and the page of the documentation are made.
"""

import importlib.metadata
import time
from pathlib import Path
from typing import Any

from bench import contenders, document
from bench.problems import PEERS
from bench.sections import SECTIONS, Plan
from bench.sweeps import Sizes
from common import machine, run, save, show, versions


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
    publish: bool,
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
        publish: whether the figures join `benchmark.json` beside this file, and the page of the documentation is
            written anew from it. A run of some sections replaces those, and the page says so.
    """
    unknown = set(sections) - set(SECTIONS)
    if unknown:
        raise SystemExit(f"sections: {', '.join(sorted(unknown))} not among {', '.join(SECTIONS)}")
    if publish and shrink > 1:
        raise SystemExit(f"publish: expected the whole work, got shrink {shrink}; leave one of them out")
    plan = Plan(Sizes(queries, points, orders, batches, base), goals, operations, rounds, patience, shrink)
    seconds, started = {}, time.perf_counter()
    deviations = contenders.verify(verify, plan.notes)
    reports = {}
    for name in sections:
        seconds[name], reports[name] = -time.perf_counter(), SECTIONS[name](plan)
        seconds[name] += time.perf_counter()
        print(f"{name}: {seconds[name]:.0f} s", flush=True)
    seconds["verify"] = time.perf_counter() - started - sum(seconds.values())
    peers = {name: version(module) for module, name in PEERS.items()}
    figures = {
        "deviations": deviations,
        **{name: report.record for name, report in reports.items()},
        "section_seconds": seconds,
        "notes": sorted(plan.notes),
        "peers": peers,
    }
    measured: document.Run = {
        "figures": figures, "versions": versions(), "machine": machine(), "config": {"shrink": shrink},
    }  # fmt: skip
    show(out, [table for tables in document.tables_of(measured).values() for table in tables])
    (out / "benchmark.md").write_text(document.document([measured]), encoding="utf-8")
    if publish:
        document.publish(measured)
    for name, report in reports.items():
        if report.figure is not None:
            save(report.figure, out / f"{name}.png")
    return figures


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
            "publish": False,
        },
    )
