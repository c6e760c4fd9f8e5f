"""Levenberg-Marquardt on a problem's unknowns: Marquardt's scaling, damping by gain ratio [Nielsen 1999]."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchspline import checks
from torchspline.fit.solving.model import Model, State
from torchspline.fit.solving.system import Factor, SingularError, System
from torchspline.kernels.mode import RefusedError

Array = NDArray[Any]
#: Damping is a share of the diagonal, which is taken to be at least this share of its largest element.
LEAST_DIAGONAL = 1e-12
MOST_DAMPING = 1e12
#: Shares of the cost below which its differences are noise.
ROUNDING = 1e-11


@dataclass(frozen=True)
class Options:
    """When to stop and how to start.

    Args:
        iterations: at most so many steps are tried.
        cost: stop when a step lowers the cost by less than this share.
        gradient: stop when no unknown, moved by itself, could come nearer by more than this many of its own standard
            deviations (measurements weighted as given).
        damping: what to start from, as a share of the diagonal.
    """

    iterations: int = 50
    cost: float = 1e-9
    gradient: float = 1e-8
    damping: float = 1e-5

    @classmethod
    def checked(
        cls, max_iterations: int, cost_tolerance: float, gradient_tolerance: float, damping: float
    ) -> "Options":
        """From what a caller chose, by the caller's names."""
        checks.whole("max_iterations", max_iterations, least=0)
        for name, x in (("cost_tolerance", cost_tolerance), ("gradient_tolerance", gradient_tolerance)):
            if checks.finite_number(name, x) < 0:
                raise ValueError(f"{name}: expected a number that is not negative, got {x}")
        checks.positive("damping", damping)
        return cls(max_iterations, cost_tolerance, gradient_tolerance, damping)


@dataclass
class Trace:
    """What happened."""

    cost: list[float] = field(default_factory=list)
    damping: list[float] = field(default_factory=list)
    evaluations: int = 0
    reason: str = ""
    converged: bool = False
    seconds: dict[str, float] = field(default_factory=lambda: {"linearize": 0.0, "solve": 0.0, "update": 0.0})

    def spend(self, phase: str, since: float) -> float:
        """Book the time since `since` and return the time now."""
        now = perf_counter()
        self.seconds[phase] += now - since
        return now


def minimise(
    model: Model,
    state: State,
    linearize: Callable[[State], System],
    options: Options,
    progress: Callable[[Trace], None],
) -> tuple[State, System, Trace]:
    """Unknowns of least cost, the normal equations there, and how it went."""
    trace, clock = Trace(), perf_counter()
    system = linearize(state)
    clock = trace.spend("linearize", clock)
    trace.evaluations, damping, growth = 1, options.damping, 2.0
    trace.cost.append(system.cost)
    trace.damping.append(damping)
    if not math.isfinite(system.cost):
        raise ValueError(
            "solve: the cost is not finite where the solution starts; check measurements and start values"
        )
    for _ in range(options.iterations):
        progress(trace)
        if _stationary(system, options.gradient):
            trace.reason, trace.converged = "no unknown could come nearer: the gradient is zero", True
            return state, system, trace
        scale = system.diagonal()
        scale = np.maximum(scale, LEAST_DIAGONAL * scale.max(initial=0.0))
        scale[scale == 0.0] = 1.0
        step = _step(system, damping * scale)
        clock = trace.spend("solve", clock)
        gain, candidate, fresh = -1.0, state, system
        if step is not None:
            expected = 0.5 * float(step @ (damping * scale * step - system.right))
            try:
                candidate = model.moved(state, step)
                clock = trace.spend("update", clock)
                fresh = linearize(candidate)
                gain = _gain(system, fresh, expected)
            except RefusedError:  # so far away that control points are no numbers any more
                gain = -1.0
            clock = trace.spend("linearize", clock)
            trace.evaluations += 1
            # A step that is short because of much damping proves nothing.
            near = damping <= 1.0 and expected <= max(options.cost, ROUNDING) * system.cost
            if gain <= 0 and near:
                trace.reason, trace.converged = "no step lowers the cost any more", True
                return state, system, trace
        if gain > 0:
            fall = (system.cost - fresh.cost) / max(system.cost, 1e-300)
            state, system = candidate, fresh
            damping, growth = max(damping * max(1 / 10, 1 - (2 * gain - 1) ** 3), 1e-15), 2.0
            trace.cost.append(system.cost)
            trace.damping.append(damping)
            if fall < options.cost:
                trace.reason, trace.converged = f"the cost fell by less than {options.cost:g} of itself", True
                return state, system, trace
        else:
            damping, growth = damping * growth, 2 * growth
            if damping > MOST_DAMPING:
                trace.reason = "no step lowers the cost, however small"
                return state, system, trace
    trace.reason = f"reached {options.iterations} iterations"
    return state, system, trace


def _gain(before: System, after: System, expected: float) -> float:
    """The fall of the cost as a share of what was expected.

    Where that is lost in the rounding of the cost, a smaller gradient tells a better place.
    """
    if not math.isfinite(after.cost) or not expected > 0:
        return -1.0
    if expected > ROUNDING * before.cost:
        return (before.cost - after.cost) / expected
    return 1.0 if _slope(after) < _slope(before) else -1.0


def _slope(system: System) -> float:
    """Squared gradient, every unknown in its own standard deviations."""
    diagonal = system.diagonal()
    there = diagonal > 0
    return float(np.square(system.right[there]) @ (1.0 / diagonal[there]))


def _step(system: System, damping: Array) -> Array | None:
    try:
        factor: Factor = system.factor(damping)
    except SingularError:
        return None
    step = -factor.solve(system.right)
    return step if np.isfinite(step).all() else None


def _stationary(system: System, tolerance: float) -> bool:
    """Whether every unknown, the others held, is within so many of its standard deviations of its optimum."""
    diagonal = system.diagonal()
    moved = np.abs(system.right) > tolerance * np.sqrt(np.maximum(diagonal, 0.0))
    return not bool((moved & (diagonal > 0)).any())
