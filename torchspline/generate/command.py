"""`torchspline generate`."""

import json as text
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from torchspline.generate.processes import rank_and_world
from torchspline.generate.recipe import Recipe
from torchspline.generate.shards import write


def generate(
    recipe: Recipe,
    out: Path = Path("torchspline-generate"),
    seed: int = 0,
    items: int = 4096,
    items_per_shard: int = 256,
    json: bool = False,
) -> int:
    """Random motions and what IMUs read on them, as Parquet files; goes on where it was interrupted.

    Under torchrun every process writes its share. The files are the same whatever the number of processes.

    Args:
        recipe: motions and sensors, and what their parameters are drawn from.
        out: folder for the files; made if it is not there.
        seed: of all random numbers.
        items: how many.
        items_per_shard: items of a file.
        json: print one line of JSON instead of text.
    """
    rank, world = rank_and_world()
    began = time.perf_counter()
    with _progress_bar(rank == 0 and not json) as progress:
        done = write(recipe, out, seed, items, items_per_shard, progress)
    seconds = time.perf_counter() - began
    if json:
        report = {
            "command": "generate",
            "passed": True,
            **done._asdict(),
            "rank": rank,
            "world_size": world,
            "seconds": seconds,
            "folder": str(out),
        }
        print(text.dumps(report), flush=True)
    else:
        process = f"process {rank} of {world}: " if world > 1 else ""
        rate = done.items * recipe.samples / seconds
        print(
            f"{process}{done.items} items in {done.shards} shards written to {out} "
            f"({rate:.3g} readings a second), {done.kept} shards were there",
            flush=True,
        )
    return 0


@contextmanager
def _progress_bar(shown: bool) -> Iterator[Callable[[int, int], None]]:
    """A function that is told the items done and all items; silent where standard error is not a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not (shown and console.is_terminal):
        yield lambda done, total: None
        return
    columns = (TextColumn("items"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
