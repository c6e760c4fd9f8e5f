"""What every experiment shares: the command line, the record of a run, tables and figures.

An experiment is one file, `experiments/NAME.py`, with a function whose parameters are its options:

    def experiment(out: Path, orders: list[int], seed: int) -> dict: ...

    if __name__ == "__main__":
        run(experiment, smoke={"orders": [2, 3]})

The options take their values from `configs/NAME.yaml`, then from `--config FILE`, then from the command line;
`--smoke` has the last word and replaces those named in `smoke`. The function returns the figures to record.
"""

import importlib.metadata
import inspect
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jsonargparse import ArgumentParser
from matplotlib.figure import Figure
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

ROOT = Path(__file__).resolve().parent.parent
RECORDED_VERSIONS = ("torchspline", "torch", "numpy", "scipy", "numba")
WIDTH = 180  # characters, of what is printed to a file


class Table(NamedTuple):
    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[Any]]


def run(experiment: Callable[..., dict[str, Any]], smoke: Mapping[str, Any]) -> None:
    """Reads the options of `experiment` from its configuration and the command line, runs and records it."""
    stem = Path(inspect.getfile(experiment)).stem
    parser = ArgumentParser(
        prog=f"{stem}.py",
        description=(inspect.getdoc(experiment) or "").partition("\n\n")[0],
        default_config_files=[str(ROOT / "configs" / f"{stem}.yaml")],
    )
    parser.add_argument("--config", action="config", help="YAML file with options")
    parser.add_argument(
        "--smoke", action="store_true", help=f"little work, to see that it runs: {dict(smoke)}"
    )
    parser.add_argument("--out", type=Path, default=ROOT / "results" / stem, help="folder for the results")
    options_of = parser.add_function_arguments(experiment, skip={"out"})
    parsed = parser.parse_args()
    options = {name: parsed[name] for name in options_of}
    if parsed.smoke:
        options.update(smoke)

    out = parsed.out
    out.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    figures = experiment(out=out, **options)
    write_results(out, figures, options, options.get("seed"), started)


def write_results(
    out: Path, figures: Mapping[str, Any], config: Mapping[str, Any], seed: int | None, started: float
) -> Path:
    """Writes `results.json`: the figures and what they were obtained with.

    Args:
        started: `time.perf_counter()` of the beginning.
    """
    record = {
        "figures": figures,
        "config": config,
        "seed": seed,
        "versions": versions(),
        "machine": machine(),
        "wall_time_s": time.perf_counter() - started,
    }
    path = out / "results.json"
    path.write_text(json.dumps(record, indent=2, default=_plain) + "\n", encoding="utf-8")
    return path


def versions() -> dict[str, str | None]:
    """Versions of what the figures depend on; None for a package which is not installed."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for name in RECORDED_VERSIONS:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def machine() -> dict[str, Any]:
    """The kind of machine: no names of hosts or users."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "system": platform.system(),
        "architecture": platform.machine(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "usable_cores": usable,
        "torch_threads": torch.get_num_threads(),
        "accelerator": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _plain(value: Any) -> Any:
    """Arrays and tensors as lists, whatever JSON does not know as text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def show(out: Path, tables: Sequence[Table]) -> Path:
    """Writes the tables to `table.md` and prints them."""
    path = out / "table.md"
    path.write_text("\n".join(map(markdown, tables)), encoding="utf-8")
    console = Console(width=None if sys.stdout.isatty() else WIDTH)
    for table in tables:
        printed = RichTable(title=escape(table.title), title_justify="left", box=box.SIMPLE_HEAD)
        for name in table.header:
            printed.add_column(escape(name), overflow="fold")
        for row in table.rows:
            printed.add_row(*(escape(str(cell)) for cell in row))
        console.print(printed)
    return path


def markdown(table: Table) -> str:
    """A table as Markdown."""

    def line(cells: Sequence[Any]) -> str:
        return "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"

    rule = "|" + "---|" * len(table.header)
    return "\n".join([f"## {table.title}", "", line(table.header), rule, *map(line, table.rows), ""])


def save(figure: Figure, path: Path) -> Path:
    """Writes a figure (made without pyplot, so no display is needed) as a PNG."""
    figure.savefig(path, dpi=150, bbox_inches="tight")
    return path
