"""`torchspline bench`."""

import platform
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch

from torchspline.cli.report import Report
from torchspline.fit import fit_poses
from torchspline.groups import SE3, SO3
from torchspline.imu import measure
from torchspline.splines import BSpline, SplitBSpline

EXAMPLES = """
torchspline bench
torchspline bench --queries 10000 --threads 1 --json
"""


def bench(queries: int = 100_000, repeats: int = 5, threads: int | None = None, seed: int = 0) -> Report:
    """How long the main calls take on this machine: the shortest of some runs, compilation apart.

    Splines of order 4 with 1000 control points, float64, times in order.

    Args:
        queries: how many times a spline is asked for.
        repeats: runs of each call.
        threads: of PyTorch and the compiled loops; by default as many as PyTorch takes.
        seed: of the random control points.
    """
    for name, x in (
        ("queries", queries),
        ("repeats", repeats),
        ("threads", 1 if threads is None else threads),
    ):
        if x < 1:
            raise ValueError(f"{name}: expected a whole number of at least 1, got {x}")
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads or before)
        return _measured(queries, repeats, seed)
    finally:
        torch.set_num_threads(before)


def _measured(queries: int, repeats: int, seed: int) -> Report:
    from rich.console import Console
    from rich.progress import track

    calls = _calls(queries, seed)
    values: dict[str, Any] = {
        "machine": platform.machine(),
        "processor": platform.processor() or platform.machine(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "queries": queries,
        "calls": {},
    }
    rows = []
    console = Console(stderr=True)
    for name, (call, unit, count) in track(
        calls.items(), "timing", console=console, transient=True, disable=not console.is_terminal
    ):
        began = time.perf_counter()
        call()
        first = time.perf_counter() - began
        best = min(_seconds(call) for _ in range(repeats))
        values["calls"][name] = {
            "first_s": first,
            "best_s": best,
            "count": count,
            "ns_each": 1e9 * best / count,
        }
        rows.append((name, f"{1e9 * best / count:.4g}  (first call {first:.3g} s)", f"ns a {unit}"))
    title = f"torchspline, {values['threads']} threads, torch {torch.__version__}, {values['processor']}"
    notes = [
        "other programs that run meanwhile make these longer; first calls compile unless kept from before"
    ]
    return Report(title, values, rows, notes)


def _calls(queries: int, seed: int) -> dict[str, tuple[Callable[[], Any], str, int]]:
    generator = torch.Generator().manual_seed(seed)
    turns = 0.3 * torch.randn(1000, 3, generator=generator, dtype=torch.float64)
    places = torch.randn(1000, 3, generator=generator, dtype=torch.float64).cumsum(0)
    points = torch.cat([places, SO3.exp(turns)], -1)
    splines = {
        "SO3": BSpline(points[:, 3:], group=SO3, order=4, dt=0.1),
        "SE3": BSpline(points, group=SE3, order=4, dt=0.1),
        "R3xSO3": SplitBSpline(points, order=4, dt=0.1),
    }
    first, last = splines["SE3"].domain
    t = torch.linspace(first, last, queries, dtype=torch.float64)

    def forward(spline: BSpline) -> Any:
        with torch.no_grad():
            return spline.evaluate(t, derivatives=2)

    def both(spline: BSpline) -> None:
        state = spline.evaluate(t, derivatives=2)
        assert state.velocity is not None
        assert state.acceleration is not None
        (state.value.sum() + state.velocity.sum() + state.acceleration.sum()).backward()

    def inertial() -> Any:
        with torch.no_grad():
            return measure(splines["R3xSO3"], t)

    calls: dict[str, tuple[Callable[[], Any], str, int]] = {}
    for name, spline in splines.items():
        calls[f"{name}: value, velocity, acceleration"] = (partial(forward, spline), "query", queries)
        calls[f"{name}: the same and all gradients"] = (partial(both, spline), "query", queries)
    calls["IMU readings"] = (inertial, "reading", queries)
    few = torch.arange(0, 1200, dtype=torch.float64) / 120
    with torch.no_grad():
        poses = splines["R3xSO3"](few)
    calls["fit of 10 s of poses at 120 Hz"] = (
        (lambda: fit_poses(few, poses, dt=0.1, order=4, progress=False)), "pose", len(few),
    )  # fmt: skip
    return calls


def _seconds(call: Callable[[], Any]) -> float:
    began = time.perf_counter()
    call()
    return time.perf_counter() - began
