"""A progress bar for solutions that take long."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from torchspline.fit.solving.solver import Trace


@contextmanager
def progress_bar(shown: bool, iterations: int, what: str = "fitting") -> Iterator[Callable[[Trace], None]]:
    """A function to call before each iteration; on standard error, silent where that is not a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    if not (shown and console.is_terminal):
        yield lambda trace: None
        return
    columns = (TextColumn(what), BarColumn(), TextColumn("cost {task.fields[cost]:.6g}"))
    with Progress(*columns, TimeElapsedColumn(), console=console, transient=True) as bar:
        task = bar.add_task("", total=iterations, cost=float("nan"))
        yield lambda trace: bar.update(task, completed=len(trace.cost) - 1, cost=trace.cost[-1])
