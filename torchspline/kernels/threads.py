"""Running compiled loops on several threads: a pool of the library's own that survives forks.

Kernels release the interpreter lock, so plain threads are enough; unlike OpenMP's they can be made anew after a
`fork`, as `DataLoader` workers do.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait

import torch

#: Fewest queries worth a second thread: handing work over costs about as much as a few thousand of them.
SERIAL_BELOW = 8192


class _Pool:
    def __init__(self) -> None:
        self.executor: ThreadPoolExecutor | None = None
        self.size = 0

    def get(self, size: int) -> ThreadPoolExecutor:
        executor = self.executor
        if executor is None or self.size < size:
            # A smaller one is left to whoever is about to use it; its threads end when nobody holds it any more.
            executor = ThreadPoolExecutor(size, thread_name_prefix="torchspline")
            self.executor, self.size = executor, size
        return executor

    def forget(self) -> None:
        """The child of a fork has none of its parent's threads."""
        self.executor, self.size = None, 0


_pool = _Pool()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.forget)


def run(tasks: Sequence[Callable[[], None]]) -> None:
    """Run all tasks, at most `torch.get_num_threads()` at a time, the caller's thread included."""
    threads = min(torch.get_num_threads(), len(tasks))
    if threads <= 1:
        for task in tasks:
            task()
        return
    remaining = iter(tasks)  # next() on a list iterator is atomic under the interpreter lock

    def work() -> None:
        for task in remaining:
            task()

    others = [_pool.get(threads - 1).submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        wait(others)  # all of them, also after an error: they write to the caller's arrays
    for other in others:
        other.result()


def spans(count: int, parts: int, multiple: int) -> list[tuple[int, int]]:
    """`count` split into at most `parts` runs, their edges multiples of `multiple`."""
    size = -(-count // (parts * multiple)) * multiple if count else 1
    return [(a, min(a + size, count)) for a in range(0, count, size)]
