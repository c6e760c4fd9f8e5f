"""Gives damaged files to every reader of the library: none may crash, hang or fill the memory.

Valid files are cut, flipped, rewritten, encoded anew and packed into bombs (`fuzzing.mutate`), and each reader meets
them in a process of its own, under limits (`fuzzing.watch`). A reader may read what it is given, or refuse it with
ValueError, TypeError or OSError in one line that names the file; anything else is a finding, and the status is 1.
"""

import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
from common import Table, run, save, show
from fuzzing.mutate import prepare
from fuzzing.readers import readers
from fuzzing.watch import Outcome, watch
from matplotlib.figure import Figure

_KINDS = ("crash", "hang", "memory", "message")


def draw(outcomes: dict[str, Outcome]) -> Figure:
    figure = Figure(figsize=(9, 0.35 * len(outcomes) + 1.2), layout="constrained")
    axes = figure.subplots()
    names = list(outcomes)
    read = [x.read for x in outcomes.values()]
    refused = [x.refused for x in outcomes.values()]
    found = [len(x.findings) for x in outcomes.values()]
    axes.barh(names, read, color="C0", label="read")
    axes.barh(names, refused, left=read, color="C7", label="refused")
    left = [a + b for a, b in zip(read, refused, strict=True)]
    axes.barh(names, found, left=left, color="C3", label="crash, hang, memory, message")
    axes.invert_yaxis()
    axes.set_xlabel("damaged files")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3)
    return figure


def experiment(
    out: Path, count: int, only: list[str], time_limit: float, memory_limit_mib: int, seed: int
) -> dict[str, Any]:
    """Gives damaged files to every reader of the library: none may crash, hang or fill the memory.

    Args:
        out: where the results go.
        count: damaged files for each reader.
        only: readers whose names contain one of these; all if there are none.
        time_limit: for one file, s.
        memory_limit_mib: by how much a reader's process may grow, MiB.
        seed: of the damage.
    """
    torch.set_num_threads(1)
    prepare()
    outcomes: dict[str, Outcome] = {}
    for name, (read, samples) in readers(seed).items():
        if only and not any(word in name for word in only):
            continue
        with tempfile.TemporaryDirectory() as folder:
            outcomes[name] = watch(
                name, read, samples, Path(folder), count, seed, time_limit, memory_limit_mib * 2**20
            )
        print(f"{name}: {len(outcomes[name].findings)} findings", file=sys.stderr)
    rows = [
        (
            name,
            count,
            x.read,
            x.refused,
            *(sum(f.kind == kind for f in x.findings) for kind in _KINDS),
            f"{x.slowest:.2f}",
            f"{x.grown / 2**20:.0f}",
        )
        for name, x in outcomes.items()
    ]
    header = ("reader", "files", "read", "refused", *_KINDS, "slowest [s]", "grown by [MiB]")
    show(out, [Table("Damaged files, and what readers made of them", header, rows)])
    save(draw(outcomes), out / "readers.png")
    findings = {name: [f._asdict() for f in x.findings] for name, x in outcomes.items() if x.findings}
    for name, found in findings.items():
        for finding in found[:10]:
            print(f"{name}, file {finding['index']}: {finding['kind']}: {finding['detail']}", file=sys.stderr)
    if findings:
        sys.exit(1)
    return {name: {**x._asdict(), "files": count} for name, x in outcomes.items()}


if __name__ == "__main__":
    run(experiment, smoke={"count": 60})
