"""The page of the benchmark, `benchmark.md`, from the runs in `benchmark.json`, and how a run joins them."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from common import Table, markdown

from bench import tables
from bench.tables import TABLES

PAGE = Path(__file__).resolve().parent.parent / "benchmark.md"
RECORD = PAGE.with_suffix(".json")

#: What a run leaves: `figures` (of each section by its name, `deviations`, `notes`, `peers`), `versions`, `machine`
#: and `config`, as in its results.json.
Run = Mapping[str, Any]


def tables_of(run: Run) -> dict[str, list[Table]]:
    """All tables of a run, by section."""
    figures = run["figures"]
    found: dict[str, list[Table]] = {}
    if figures["deviations"]:
        found["deviations"] = tables.agreement(figures["deviations"])
    for name, make in TABLES.items():
        if name == "goals" and name in figures:
            found[name] = tables.goals(figures[name], run["config"]["shrink"])
        elif name in figures:
            found[name] = make(figures[name])
    if figures["notes"]:
        found["notes"] = tables.notes(figures["notes"])
    return found


def document(runs: Sequence[Run]) -> str:
    """The page: what ran where, and all tables. Sections of later runs replace those of the first and say so."""
    first, *later = runs
    found = {name: (0, run) for name, run in tables_of(first).items()}
    for number, run in enumerate(later, 1):
        found |= {name: (number, x) for name, x in tables_of(run).items() if name in TABLES}
    order = ["deviations", *TABLES, "notes"]
    parts = []
    for name in sorted(found, key=order.index):
        number, made = found[name]
        for table in made:
            title, rest = markdown(table).split("\n", 1)
            parts.append(
                f"{title}\n\n{_later(runs[number], first)}\n{rest}" if number else f"{title}\n{rest}"
            )
    return (
        "# Benchmark\n\n"
        "Written by `python experiments/benchmark.py`. All contenders took turns in one process; a contender that "
        "computes the same thing was compared with the reference first.\n\n"
        f"Machine: {_machine(first)}; one thread unless said.\nSoftware: {_software(first)}.\n\n"
        + "\n".join(parts)
    )


def join(runs: Sequence[Run], run: Run) -> list[Run]:
    """A run with all sections replaces those before, one with some of them joins them and replaces those sections."""
    if set(TABLES) <= set(run["figures"]) or not runs:
        return [run]
    new = set(TABLES) & set(run["figures"])
    first, *later = runs
    kept = [x for x in later if not set(TABLES) & set(x["figures"]) <= new]
    return [first, *kept, run]


def publish(run: Run, record: Path = RECORD, page: Path = PAGE) -> None:
    """Puts a run among those of the record, and writes the page anew."""
    before = json.loads(record.read_text(encoding="utf-8"))["runs"] if record.exists() else []
    runs = join(before, _rounded(run))
    record.write_text(_json({"runs": runs}) + "\n", encoding="utf-8")
    page.write_text(document(runs), encoding="utf-8")


def _machine(run: Run) -> str:
    here = run["machine"]
    return f"{here['processor']}, {here['usable_cores']} cores, {here['system']} ({here['architecture']})"


def _software(run: Run) -> str:
    known = {**run["versions"], **run["figures"]["peers"]}
    return ", ".join(f"{name} {number}" for name, number in known.items() if number is not None)


def _later(run: Run, first: Run) -> str:
    same = [what(run) == what(first) for what in (_machine, _software)]
    if all(same):
        return "From a later run, with the same machine and software."
    return f"From a later run: {_machine(run)}; {_software(run)}."


def _rounded(x: Any) -> Any:
    """Numbers to six digits: the page shows no more."""
    if isinstance(x, float):
        return float(f"{x:.6g}")
    if isinstance(x, Mapping):
        return {key: _rounded(value) for key, value in x.items()}
    return [_rounded(value) for value in x] if isinstance(x, (list, tuple)) else x


def _json(x: Any, indent: str = "") -> str:
    """JSON with a line for each row, so that differences of two runs can be read."""
    deeper = indent + " "
    if isinstance(x, Mapping) and any(isinstance(y, (Mapping, list)) for y in x.values()):
        inner = [f"{deeper}{json.dumps(key)}: {_json(value, deeper)}" for key, value in x.items()]
        if "deviation" not in x:
            return "{\n" + ",\n".join(inner) + "\n" + indent + "}"
    if isinstance(x, list) and any(isinstance(y, Mapping) for y in x):
        return "[\n" + ",\n".join(deeper + _json(value, deeper) for value in x) + "\n" + indent + "]"
    return json.dumps(x)
