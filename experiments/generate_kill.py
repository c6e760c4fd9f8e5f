"""`torchspline generate`, killed at random moments until it is done: the data set is that of an undisturbed run.

Every run is ended by SIGKILL, which no process can catch, some time after it began to write. What two processes under
`torchrun` write until they are killed, and a single one then finishes, is compared, too.
"""

import contextlib
import hashlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

from common import ROOT, Table, run, save, show
from matplotlib.figure import Figure

from torchspline.generate import read

CONFIG = ROOT / "configs" / "generate.yaml"
#: Shorter than the configuration has them, so that there are many shards to be killed in.
SHORT = ["--recipe.duration", "2.0"]


class Run(NamedTuple):
    """One attempt: its length in s, and what lay in the folder after it."""

    seconds: float
    shards: int
    leftovers: int


def command(out: Path, items: int, items_per_shard: int, seed: int) -> list[str]:
    numbers = {"items": items, "items_per_shard": items_per_shard, "seed": seed}
    options = [word for name, x in numbers.items() for word in (f"--{name}", str(x))]
    return ["-m", "torchspline.cli", "generate", "--config", str(CONFIG), "--out", str(out), *SHORT, *options]


def hashes(folder: Path) -> dict[str, str]:
    """Of every file, hidden ones included."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def killed(arguments: list[str], out: Path, wait: float) -> Run:
    """A run that is killed `wait` s after its first shard, with all processes that it started."""
    before, began = shards(out), time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    while shards(out) == before and process.poll() is None:
        time.sleep(0.002)
    time.sleep(wait)
    family = [process.pid, *descendants(process.pid)]
    for member in family:
        with contextlib.suppress(ProcessLookupError):  # one that is done already
            os.kill(member, signal.SIGKILL)
    process.wait()
    while any(Path(f"/proc/{member}").exists() for member in family):
        time.sleep(0.002)
    seconds = time.perf_counter() - began
    return Run(seconds, shards(out), len(list(out.glob(".*"))))


def descendants(pid: int) -> list[int]:
    """Processes that a process has started, and those that they have: torchrun's are in groups of their own."""
    children: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            number, _, rest = stat.read_text().partition(" ")
            children.setdefault(int(rest.rpartition(")")[2].split()[1]), []).append(int(number))
    found = list(children.get(pid, []))
    for child in found:
        found += children.get(child, [])
    return found


def shards(out: Path) -> int:
    return len(list(out.glob("*.parquet")))


def finish(arguments: list[str]) -> None:
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)


def experiment(
    out: Path, kills: int, items: int, items_per_shard: int, longest: float, seed: int
) -> dict[str, Any]:
    """Kill `torchspline generate` again and again and compare what it makes with an undisturbed run.

    Args:
        out: folder for the results.
        kills: how often.
        items: of the data set.
        items_per_shard: of a file.
        longest: time between the first shard of a run and its end, s.
        seed: of the data and of the moments.
    """
    chance = random.Random(seed)
    with tempfile.TemporaryDirectory() as scratch:
        whole, torn, shared = (Path(scratch) / name for name in ("whole", "torn", "shared"))
        finish(command(whole, items, items_per_shard, seed))
        wanted = hashes(whole)
        runs: list[Run] = []
        while len(runs) < kills:
            if shards(torn) == shards(whole):  # done before it was killed often enough: lose some of it again
                for path in chance.sample(sorted(torn.glob("*.parquet")), shards(whole) // 2):
                    path.unlink()
            arguments = command(torn, items, items_per_shard, seed)
            runs.append(killed(arguments, torn, chance.uniform(0.0, longest)))
        finish(command(torn, items, items_per_shard, seed))
        launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
        together = [*launcher, *command(shared, items, items_per_shard, seed)]
        both = killed(together, shared, chance.uniform(0.0, longest))
        finish(command(shared, items, items_per_shard, seed))
        same = {
            "killed": hashes(torn) == wanted,
            "two processes killed, finished by one": hashes(shared) == wanted,
        }
        indices = [item["index"].item() for item in map(read(torn).__getitem__, range(items))]
    complete = indices == list(range(items))
    caught = sum(1 for a in runs if a.leftovers)
    rows = [
        ["kills", kills],
        ["of these in the middle of writing a file", caught],
        ["shards", len(wanted) - 1],
        ["items missing or duplicate", 0 if complete else "some"],
        ["killed, equal to the undisturbed run byte for byte", "yes" if same["killed"] else "NO"],
        [
            "two processes killed once, finished by one: equal as well",
            "yes" if same["two processes killed, finished by one"] else "NO",
        ],
    ]
    show(out, [Table(f"generate, killed {kills} times", ["", "result"], rows)])
    save(_figure(runs, len(wanted) - 1), out / "generate_kill.png")
    if not (complete and all(same.values())):
        raise RuntimeError(f"data sets differ: {same}, complete: {complete}")
    return {
        "kills": kills,
        "kills_while_writing": caught,
        "shards_after_each_kill": [a.shards for a in runs],
        "seconds_of_each_run": [a.seconds for a in runs],
        "shards_after_killing_two_processes": both.shards,
        "identical": same,
        "complete": complete,
    }


def _figure(runs: list[Run], total: int) -> Figure:
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    axes.step(range(1, len(runs) + 1), [a.shards for a in runs], where="mid", label="complete shards")
    torn = [(i + 1, a.shards) for i, a in enumerate(runs) if a.leftovers]
    axes.plot([x for x, _ in torn], [y for _, y in torn], "C3x", label="killed while writing a file")
    axes.axhline(total, color="0.6", linewidth=1, label="all of them")
    axes.set(
        xlabel="kill",
        ylabel="shards",
        title="a data set that is generated by processes that are killed",
        ylim=0,
    )
    axes.legend()
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.grid(alpha=0.3)
    return figure


if __name__ == "__main__":
    run(experiment, smoke={"kills": 1, "items": 512, "longest": 0.2})
