"""How fast IMUs are simulated with every effect on: over lengths of items and processes, and what each effect costs.

Every item has a motion, calibration, clock, mounting and random numbers of its own, so that it comes out the same in
whichever batch and process it is made; that is checked before anything is timed. Times are minima over rounds in turns.
"""

import multiprocessing
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from common import Table, run, save, show
from matplotlib.figure import Figure
from simulation.load import EFFECTS, NOISES, Load, make_load

#: Samples a second of the goal.
GOAL = 5e6


def clocked(call: Callable[[], object]) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def best(loads: dict[Any, Load], rounds: int) -> dict[Any, float]:
    """Samples a second of each load on one thread, the minimum time over rounds in turns."""
    for load in loads.values():
        load.simulate()
    seconds = {key: float("inf") for key in loads}
    for _ in range(rounds):
        for key, load in loads.items():
            seconds[key] = min(seconds[key], clocked(load.simulate))
    return {key: loads[key].samples / s for key, s in seconds.items()}


def check(samples: int, rate: float, seed: int) -> None:
    """An item is bit for bit the same in any batch."""
    whole = make_load([0, 1, 2, 3], samples, rate, seed).simulate()
    part = make_load([2], samples, rate, seed).simulate()
    for name, a, b in zip(whole._fields, whole, part, strict=True):
        if not torch.equal(a if name == "t" else a[2:3], b):
            raise AssertionError(f"item 2 is another one alone than in a batch: {name}")


def _worker(
    ready: Any, rank: int, batch: int, samples: int, rate: float, seed: int, rounds: int, out: Any
) -> None:
    """Simulates items of its own in step with the others; sends begin and end of every round."""
    torch.set_num_threads(1)
    load = make_load(list(range(rank * batch, (rank + 1) * batch)), samples, rate, seed)
    load.simulate()
    spans = []
    for _ in range(rounds):
        ready.wait()
        begin = time.monotonic()  # one clock for all processes
        load.simulate()
        load.simulate()
        spans.append((begin, time.monotonic()))
    out.put(spans)


def in_processes(count: int, batch: int, samples: int, rate: float, seed: int, rounds: int) -> float:
    """Samples a second of `count` processes together, in the best round."""
    context = multiprocessing.get_context("spawn")
    ready, out = context.Barrier(count), context.Queue()
    arguments = (batch, samples, rate, seed, rounds, out)
    workers = [context.Process(target=_worker, args=(ready, rank, *arguments)) for rank in range(count)]
    for worker in workers:
        worker.start()
    spans = [out.get(timeout=300) for _ in workers]
    for worker in workers:
        worker.join()
    walls = [
        max(end for _, end in turn) - min(begin for begin, _ in turn) for turn in zip(*spans, strict=True)
    ]
    return 2 * count * batch * samples / min(walls)


def in_threads(count: int, load: Load, rounds: int) -> float:
    """Samples a second of one process with `count` threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        return best({0: load}, rounds)[0]
    finally:
        torch.set_num_threads(before)


def draw(figures: dict[str, Any]) -> Figure:
    figure = Figure(figsize=(13, 4.2), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    lengths = {int(n): x / 1e6 for n, x in figures["samples per item"].items()}
    left.semilogx(lengths.keys(), lengths.values(), "C0o-", label="every effect")
    left.set(xlabel="samples of an item (as many in all in every batch)", title="One thread", ylim=(0, None))
    left.set_ylabel("million IMU samples a second")
    for kind, style in (("processes", "C0o-"), ("threads", "C1s--")):
        counts = {int(n): x / 1e6 for n, x in figures[kind].items()}
        middle.plot(counts.keys(), counts.values(), style, label=kind)
    fewest, top = (pick(figures["processes"], key=int) for pick in (min, max))
    one, top = figures["processes"][fewest] / 1e6 / int(fewest), int(top)
    middle.plot([1, top], [one, one * top], "0.6", ls=":", label="linear")
    middle.axhline(GOAL / 1e6, color="C3", lw=1, label="goal, 2 cores")
    middle.set(xlabel="processes or threads", title="Every effect", ylim=(0, None), xticks=range(1, top + 1))
    middle.legend(fontsize=8)
    costs = figures["nanoseconds of an effect"]
    right.barh(list(costs), list(costs.values()), color="C0")
    right.invert_yaxis()
    right.set(
        xlabel="ns a sample: with every effect, less without this one",
        title="What an effect costs, one thread",
    )
    return figure


def experiment(
    out: Path,
    batch: int,
    samples: int,
    lengths: list[int],
    processes: list[int],
    rate: float,
    effects: list[str],
    rounds: int,
    seed: int,
) -> dict[str, Any]:
    """How fast IMUs are simulated with every effect on.

    Args:
        batch, samples: items at a time, and samples of each, where neither is varied. lengths: samples of an item, in
            batches of as many samples in all. processes: how many, and how many threads. rate: Hz.
        effects: whose cost is measured; none for all of them. rounds: measurements of everything.
    """
    torch.set_num_threads(1)
    check(min(samples, 500), rate, seed)

    def load(count: int = samples, **options: Any) -> Load:
        return make_load(list(range(max(1, batch * samples // count))), count, rate, seed, **options)

    by_length = best({n: load(n) for n in lengths}, rounds)
    effects = effects or [*EFFECTS, *NOISES]
    loads = {name: load(without=name) for name in effects}
    loads |= {"all": load(), "ideal": load(without="everything"), "flicker": load(flicker=True)}
    loads["float64"] = load(single=False)
    rates = best(loads, rounds)
    costs = {name: 1e9 / rates["all"] - 1e9 / rates[name] for name in effects}
    together = {n: in_processes(n, batch, samples, rate, seed, 3 * rounds) for n in processes}
    threads = {n: in_threads(n, load(), rounds) for n in processes}
    figures = {
        "samples per item": by_length,
        "processes": together,
        "threads": threads,
        "samples a second, one thread": rates,
        "nanoseconds of an effect": dict(sorted(costs.items(), key=lambda item: -item[1])),
        "goal": GOAL,
        "goal met": max(together.values()) >= GOAL,
        "load of the machine": os.getloadavg() if hasattr(os, "getloadavg") else None,
    }
    variants = {
        "every effect": "all",
        "the same in float64": "float64",
        "and flicker noise": "flicker",
        "ideal": "ideal",
    }
    million = "million samples/s"
    show(
        out,
        [
            Table(
                "Processes of one thread, every effect",
                ("processes", million),
                [(n, f"{x / 1e6:.2f}") for n, x in together.items()],
            ),
            Table(
                "Threads of one process, every effect",
                ("threads", million),
                [(n, f"{x / 1e6:.2f}") for n, x in threads.items()],
            ),
            Table(
                "Samples of an item, one thread",
                ("samples", million),
                [(n, f"{x / 1e6:.2f}") for n, x in by_length.items()],
            ),
            Table(
                "One thread",
                ("what", million, "ns a sample"),
                [
                    (name, f"{rates[key] / 1e6:.2f}", f"{1e9 / rates[key]:.0f}")
                    for name, key in variants.items()
                ],
            ),
            Table(
                "Cost of an effect",
                ("effect", "ns a sample"),
                [(n, f"{x:.0f}") for n, x in figures["nanoseconds of an effect"].items()],
            ),
        ],
    )
    save(draw(figures), out / "sensor_simulation.png")
    return figures


if __name__ == "__main__":
    run(
        experiment,
        smoke={
            "batch": 2,
            "samples": 400,
            "lengths": [100, 400],
            "processes": [1, 2],
            "effects": ["averaging"],
            "rounds": 1,
        },
    )
