"""Timing closures against each other: interleaved rounds, so that a slow moment of the machine hits everyone."""

import gc
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bench.problems import UnavailableError
from torchspline import use_kernels

BLOCK = 0.02  # seconds that a measurement lasts at least


class Task(NamedTuple):
    """One contender at one problem: `call()` does all of it, outputs allocated inside.

    Args:
        count: queries that a call answers.
        threads: of PyTorch.
        kernels: mode of this library.
        read: what a call returned as arrays [value, rates ...], or [gradients of control points, of times], in this
            library's layout, up to components of gradients along quaternions; None: not comparable.
        times: what the queries are if the contender chooses them itself.
    """

    call: Callable[[], Any]
    count: int = 1
    threads: int = 1
    kernels: str = "auto"
    read: Callable[[Any], list[Any]] | None = None
    times: Tensor | None = None

    def run(self) -> Any:
        """One call under its settings."""
        torch.set_num_threads(self.threads)
        with use_kernels(self.kernels):
            return self.call()


def prepared(candidates: Iterable[tuple[str, Callable[[], Task]]], notes: set[str]) -> list[tuple[str, Task]]:
    """The tasks of those that can take part; the reasons of the others become notes."""
    tasks = []
    for name, prepare in candidates:
        try:
            tasks.append((name, prepare()))
        except UnavailableError as reason:
            notes.add(f"{name}: {reason}")
    return tasks


class Timing(NamedTuple):
    """Seconds a call, one number a round; `busy` is processor time by wall time (above 1: more than one thread)."""

    rounds: list[float]
    count: int
    busy: float

    @property
    def least(self) -> float:
        return min(self.rounds)

    @property
    def median(self) -> float:
        return statistics.median(self.rounds)

    def record(self) -> dict[str, Any]:
        return {
            "seconds_min": self.least,
            "seconds_median": self.median,
            "ns_per_query_min": 1e9 * self.least / self.count,
            "ns_per_query_median": 1e9 * self.median / self.count,
            "rounds": len(self.rounds),
            "queries": self.count,
            "busy": self.busy,
        }


def measure(tasks: Sequence[Task], rounds: int, patience: float) -> list[Timing]:
    """Times all tasks, in turns: every round measures each of them once, every other round in reverse order.

    A measurement repeats the call until 20 ms have passed; one call is enough if it takes longer. The first call of
    all, which may compile, does not count. A task leaves after the round in which it has used up `patience` seconds.
    """
    threads = torch.get_num_threads()
    samples: list[list[float]] = [[] for _ in tasks]
    busy: list[list[float]] = [[] for _ in tasks]
    used = [0.0] * len(tasks)
    collecting = gc.isenabled()
    try:
        for task in tasks:
            task.run()
        gc.collect()
        gc.disable()
        for number in range(rounds):
            for i in range(len(tasks)) if number % 2 == 0 else reversed(range(len(tasks))):
                if used[i] < patience:
                    seconds, share, spent = _block(
                        tasks[i], settle=bool(samples[i]) and samples[i][-1] < BLOCK
                    )
                    samples[i].append(seconds)
                    busy[i].append(share)
                    used[i] += spent
            gc.collect()
    finally:
        torch.set_num_threads(threads)
        if collecting:
            gc.enable()
    return [
        Timing(s, task.count, statistics.median(b)) for task, s, b in zip(tasks, samples, busy, strict=True)
    ]


def _block(task: Task, settle: bool) -> tuple[float, float, float]:
    """Seconds a call, processor time by wall time, seconds spent; `settle`: with a call before, to fill the caches."""
    torch.set_num_threads(task.threads)
    with use_kernels(task.kernels):
        call, clock = task.call, time.perf_counter
        entered = clock()
        if settle:
            call()
        calls, processor, start = 0, time.process_time(), clock()
        while True:
            call()
            calls += 1
            elapsed = clock() - start
            if elapsed >= BLOCK:
                break
        processor = time.process_time() - processor
    return elapsed / calls, processor / elapsed, clock() - entered
