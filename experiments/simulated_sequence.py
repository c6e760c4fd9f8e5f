"""Solves the simulated sequences of [S20] 6.1 and shows how the cost of a step grows with the number of control points.

Beside the library's solution stands one whose derivatives come from the product rule and whose Jacobians come from
automatic differentiation (`simulated/baseline.py`), and what an established C++ stack took for the same files.
"""

from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from common import ROOT, Table, run, save, show
from matplotlib.figure import Figure
from simulated.baseline import baseline
from simulated.sequences import Sequence, make_sequence, read_sequence

from torchspline.fit.solving.linearizer import Linearizer
from torchspline.fit.solving.solver import Options, minimise
from torchspline.fit.solving.terms import Term

#: Milliseconds of the C++ stack, (analytic, automatic) Jacobians, from the README of the recordings.
ESTABLISHED: dict[tuple[str, int, str], tuple[float | None, float]] = {
    ("SO3", 4, "vel"): (16, 31), ("SO3", 4, "acc"): (17, 32),
    ("SO3", 5, "vel"): (21, 46), ("SO3", 5, "acc"): (22, 48),
    ("SO3", 6, "vel"): (28, 66), ("SO3", 6, "acc"): (29, 70),
    ("SE3", 4, "vel"): (None, 117), ("SE3", 4, "acc"): (None, 124),
    ("SE3", 5, "vel"): (None, 188), ("SE3", 5, "acc"): (None, 205),
    ("SE3", 6, "vel"): (None, 278), ("SE3", 6, "acc"): (None, 309),
}  # fmt: skip
#: Milliseconds to reach, by group and order.
GOALS = {"SO3": {4: 3, 5: 4, 6: 5}, "SE3": {4: 10, 5: 14, 6: 18}}


def solve(sequence: Sequence, repeats: int) -> dict[str, Any]:
    """The best of several solutions, from making the problem to the result; compiling is not counted."""
    best: dict[str, Any] = {}
    for _ in range(repeats + 1):
        spline = sequence.spline()
        begin = perf_counter()
        result = sequence.problem(spline).solve()
        milliseconds = 1e3 * (perf_counter() - begin)
        if not best or milliseconds < best["milliseconds"]:
            phases = {phase: 1e3 * s for phase, s in result.seconds.items()}
            best = {
                "milliseconds": milliseconds,
                "evaluations": result.evaluations,
                "cost": result.cost,
                "phases": phases,
            }
    return best


def solve_baseline(sequence: Sequence) -> dict[str, Any]:
    """The same by product rule and automatic differentiation, once."""
    spline = sequence.spline()
    with torch.no_grad():
        linearizer = sequence.problem(spline).prepare()
        terms = [term for term in linearizer.terms if isinstance(term, Term)]
        slow = Linearizer(linearizer.model, baseline(linearizer.model, terms, ["value", sequence.kind]))
        begin = perf_counter()
        model = linearizer.model
        _, _, trace = minimise(model, model.state(), slow, Options(), lambda trace: None)
    return {
        "milliseconds": 1e3 * (perf_counter() - begin),
        "evaluations": trace.evaluations,
        "cost": trace.cost,
    }


def step_times(group: str, sizes: list[int], seed: int) -> list[float]:
    """Milliseconds of one iteration (linearise, factor, solve, move) by number of control points."""
    times = []
    for size in sizes:
        sequence = make_sequence(group, 4, "vel", seed, points=size - 4)
        with torch.no_grad():
            linearizer = sequence.problem(sequence.spline()).prepare()
            model = linearizer.model
            state, best = model.state(), float("inf")
            for _ in range(2):
                begin = perf_counter()
                minimise(model, state, linearizer, Options(iterations=1), lambda trace: None)
                best = min(best, perf_counter() - begin)
        times.append(1e3 * best / 2)  # the first linearisation and one step with another
    return times


def experiment(
    out: Path,
    data: str,
    groups: list[str],
    orders: list[int],
    repeats: int,
    with_baseline: bool,
    sizes: list[int],
    seed: int,
) -> dict[str, Any]:
    """Solves the simulated sequences of [S20] 6.1.

    Args:
        data: folder of the twelve files, seen from the project; where it is missing problems like them are made.
        groups, orders: which of them.
        repeats: solutions of which the fastest counts.
        with_baseline: whether to solve by product rule and automatic differentiation, too.
        sizes: numbers of control points for the cost of a step.
    """
    torch.set_num_threads(1)
    folder = ROOT / data
    recorded = folder.is_dir()
    rows, figures = [], []
    for group in groups:
        for order in orders:
            for kind in ("vel", "acc"):
                make = (read_sequence, folder) if recorded else None
                sequence = (
                    make[0](make[1], group, order, kind) if make else make_sequence(group, order, kind, seed)
                )
                ours = solve(sequence, repeats)
                slow = solve_baseline(sequence) if with_baseline else None
                analytic, automatic = ESTABLISHED[group, order, kind]
                rows.append((
                    group, order, kind, ours["evaluations"], f"{ours['cost'][-1]:.1e}", f"{ours['milliseconds']:.2f}",
                    GOALS[group][order], f"{slow['milliseconds']:.0f}" if slow else "-",
                    f"{slow['cost'][-1]:.1e}" if slow else "-", analytic or "-", automatic,
                ))  # fmt: skip
                figures.append({"group": group, "order": order, "kind": kind, "ours": ours, "baseline": slow})
    header = (
        "group", "k", "measured", "evaluations", "final cost", "ours, ms", "goal, ms", "product rule, ms", "its cost",
        "C++ analytic, ms", "C++ automatic, ms",
    )  # fmt: skip
    title = "Simulated sequences of [S20] 6.1" + (
        "" if recorded else f" ({data} is missing: problems made alike)"
    )
    steps = {group: step_times(group, sizes, seed) for group in groups}
    scaling = Table(
        "One Levenberg-Marquardt iteration, k = 4, 20 velocities a knot interval, ms",
        ("control points", *groups),
        [(size, *(f"{steps[g][i]:.3g}" for g in groups)) for i, size in enumerate(sizes)],
    )
    show(out, [Table(title, header, rows), scaling])
    figure = Figure(figsize=(6, 4))
    axes = figure.subplots()
    for group, times in steps.items():
        axes.loglog(sizes, times, "o-", label=group)
    linear = [steps[groups[0]][-1] * size / sizes[-1] for size in sizes]
    axes.loglog(sizes, linear, "k:", label="linear")
    axes.set(
        xlabel="control points",
        ylabel="one iteration [ms]",
        title="Cost of an iteration, order 4, one thread",
    )
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    save(figure, out / "scaling.png")
    return {"sequences": figures, "sizes": sizes, "step_milliseconds": steps, "recorded": recorded}


if __name__ == "__main__":
    run(
        experiment,
        smoke={"groups": ["SO3"], "orders": [4], "repeats": 1, "sizes": [100, 400], "with_baseline": True},
    )
