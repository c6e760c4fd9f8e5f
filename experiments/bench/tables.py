"""Tables of what was measured, from its record alone: the same from a run and from `benchmark.json`."""

from collections.abc import Callable, Sequence
from typing import Any

from common import Table

from bench.contenders import CONTENDERS
from bench.sweeps import SWEEPS as PLACES

SWEEPS = ("forward", "forward + backward")

Rows = Sequence[dict[str, Any]]


def number(x: float) -> str:
    return f"{x:.3g}" if x < 100 or x >= 1e6 else f"{x:.0f}"


def pair(row: dict[str, Any], what: str = "ns_per_query", scale: float = 1.0) -> str:
    return f"{number(scale * row[f'{what}_min'])} ({number(scale * row[f'{what}_median'])})"


def agreement(rows: Rows) -> list[Table]:
    """How far contenders are from the reference."""
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
    return [Table(title, ("", "group", "", "deviation"), lines)]


def goals(rows: Rows, shrink: int = 1) -> list[Table]:
    lines = []
    for row in rows:
        sign = "≥" if row["at_least"] else "≤"
        goal = "-" if row["bound"] is None else f"{sign} {row['bound']:g}"
        found = (number(row["min"]), number(row["median"]))
        lines.append([row["goal"], row["unit"], *found, goal, row["met"] or "-"])
    less = f"; HERE {shrink} TIMES LESS" if shrink > 1 else ""
    title = (
        "Goals (one thread, float64, order 4, sorted times, 1000 control points, value and two derivatives, 1e5 "
        f"queries; group operations 1e6, 2 threads, with backward{less})"
    )
    return [Table(title, ("", "unit", "min", "median", "goal", "met"), lines)]


def sweep(title: str, rows: Rows) -> list[Table]:
    tables = []
    for which in SWEEPS:
        here = [row for row in rows if row["sweep"] == which]
        places = list(dict.fromkeys(row["x"] for row in here))
        cells = {(row["contender"], row["x"]): row for row in here}
        names = [c.name for c in CONTENDERS if any(row["contender"] == c.name for row in here)]
        lines = []
        for name in names:
            found = (cells.get((name, x)) for x in places)
            lines.append([name, *("-" if row is None else pair(row) for row in found)])
        header = ["", *(x if isinstance(x, str) else f"{x:,}" for x in places)]
        tables.append(Table(f"{title}; {which}: ns per query, min (median)", header, lines))
    return tables


def latency(rows: Rows) -> list[Table]:
    cells: dict[str, dict[tuple[str, int], str]] = {}
    for row in rows:
        cells.setdefault(row["contender"], {})[row["sweep"], row["queries"]] = pair(row, "seconds", 1e6)
    columns = list(dict.fromkeys((row["sweep"], row["queries"]) for row in rows))
    lines = [[name, *(found.get(column, "-") for column in columns)] for name, found in cells.items()]
    header = ["", *(f"{sweep}, {n} quer{'y' if n == 1 else 'ies'}" for sweep, n in columns)]
    return [Table("One call, 20 control points: us, min (median)", header, lines)]


def operations(record: dict[str, Rows]) -> list[Table]:
    checks = [[row["contender"], row["what"], f"{row['deviation']:.1e}"] for row in record["deviations"]]
    times = [
        [row["operation"], row["threads"], row["contender"], pair(row), f"{row['busy']:.2f}"]
        for row in record["times"]
    ]
    return [
        Table("Group operations: largest relative deviation from the reference", ("", "what", ""), checks),
        Table(
            "Group operations, forward + backward: ns each, min (median)",
            ("operation", "threads", "", "ns", "processor time / time"),
            times,
        ),
    ]


def jacobians(rows: Rows) -> list[Table]:
    orders = list(dict.fromkeys(row["order"] for row in rows))
    cells = {(row["group"], row["contender"], row["order"]): row for row in rows}
    names = list(dict.fromkeys((row["group"], row["contender"]) for row in rows))
    lines = [[f"{group}: {who}", *(pair(cells[group, who, k]) for k in orders)] for group, who in names]
    quoted = {(row["group"], row["order"]): row["quoted_ns"] for row in rows}
    for group in dict.fromkeys(row["group"] for row in rows):
        found = [quoted[group, k] for k in orders]
        if any(found):
            lines.append(
                [f"{group}: C++, quoted, another machine", *("-" if x is None else x for x in found)]
            )
    title = (
        "Jacobians of value, velocity and acceleration by control points; orders: ns per query, min (median)"
    )
    apart = max((row["deviation"] for row in rows), default=0.0)
    return [
        Table("Jacobians: largest deviation from forward mode", ("deviation",), [[f"{apart:.1e}"]]),
        Table(title, ["", *(f"{k}" for k in orders)], lines),
    ]


def processes(rows: Rows) -> list[Table]:
    lines = [
        [row["what"], f"{row['seconds_min']:.3f}", f"{row['seconds_median']:.3f}", row["runs"]]
        for row in rows
    ]
    return [Table("New processes: seconds", ("", "min", "median", "runs"), lines)]


def notes(found: Sequence[str]) -> list[Table]:
    return [Table("Who did not take part everywhere", ("",), [[note] for note in sorted(found)])]


def _sweep(name: str) -> Callable[[Rows], list[Table]]:
    return lambda rows: sweep(PLACES[name].title, rows)


#: The tables of each section, from its record.
TABLES: dict[str, Callable[[Any], list[Table]]] = {
    "goals": goals,
    **{name: _sweep(name) for name in PLACES},
    "latency": latency,
    "operations": operations,
    "jacobians": jacobians,
    "processes": processes,
}
