"""Who takes part, and whether all compute the same thing."""

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from bench import ours, peers_jax, peers_numpy, peers_pypose
from bench.problems import DT, Problem
from bench.timing import Task, prepared
from torchspline import Group, use_kernels
from torchspline.functional import bspline

Array = NDArray[Any]


class Contender(NamedTuple):
    """`prepare` makes the task of a problem or raises `UnavailableError`; it sees no more than `most` queries."""

    name: str
    prepare: Callable[[Problem], Task]
    most: int


#: What a call has to write, at the speed of memory: the floor of every plot.
LIMIT = "bandwidth limit (fill_ of the outputs)"
FUSED = "torchspline"

#: A new contender is a function and a line here.
CONTENDERS = (
    Contender(FUSED, partial(ours.function, kernels="fused"), 10**8),
    Contender("torchspline, eager reference", partial(ours.function, kernels="reference"), 10**6),
    Contender("JAX, jit + vmap (jaxlie)", peers_jax.textbook, 10**6),
    Contender("NumPy recursion", peers_numpy.recursion, 10**6),
    Contender("SciPy RotationSpline", peers_numpy.rotation_spline, 10**6),
    Contender("PyPose, cubic by hand", peers_pypose.cubic, 10**6),
    Contender("PyPose bspline (SE(3), pose only)", peers_pypose.grid, 10**6),
    Contender("allocate and fill_ the outputs", ours.allocate_and_fill, 10**8),
    Contender(LIMIT, ours.fill, 10**8),
)


def deviation(found: Array, expected: Array) -> float:
    """Largest difference, relative to the largest number expected."""
    if found.shape != expected.shape:
        return float("inf")
    return float(np.abs(found - expected).max() / max(np.abs(expected).max(), 1e-300))


def without_radial(gradient: Array, points: Array, group: Group) -> Array:
    """The gradient less its components along quaternions: only these depend on who normalises where."""
    result = gradient.copy()
    for start, stop in group.arithmetic.sign_blocks:
        q, g = points[..., start:stop], result[..., start:stop]
        g -= (g * q).sum(-1, keepdims=True) * q / (q * q).sum(-1, keepdims=True)
    return result


def reference(problem: Problem, times: torch.Tensor | None) -> list[Array]:
    """The reference in float64, from the control points as `problem.dtype` rounds them."""
    X = problem.control_points().double().requires_grad_(problem.backward)
    t = (problem.times() if times is None else times).requires_grad_(problem.backward)
    with use_kernels("reference"):
        options = {"group": Group(problem.group), "order": problem.order, "dt": DT}
        outputs = ours.fields(bspline(X, t, derivatives=problem.derivatives, **options))
        if problem.backward:
            outputs = torch.autograd.grad(outputs, (X, t), [c.double() for c in problem.cotangents()])
    return ours.arrays(outputs)


def deviations(problem: Problem, task: Task) -> list[float]:
    """Of value and derivatives (as many as there are), or of the gradients of control points and times."""
    assert task.read is not None
    found = task.read(task.run())
    if problem.backward:
        group, points = Group(problem.group), problem.control_points().double().numpy()
        found = [without_radial(found[0], points, group), *found[1:]]
    expected = reference(problem, task.times)
    return [deviation(np.asarray(a, dtype=np.float64), b) for a, b in zip(found, expected, strict=False)]


def verify(groups: list[str], notes: set[str]) -> list[dict[str, Any]]:
    """How far results and gradients of all contenders are from the reference, on a small problem."""
    rows = []
    for group, backward in product(groups, (False, True)):
        problem = Problem(199, points=20, group=group, backward=backward)
        what = ("control points", "times") if backward else ("value", "velocity", "acceleration")
        for name, task in prepared(((c.name, partial(c.prepare, problem)) for c in CONTENDERS), notes):
            # One contender works on SE(3) whatever it is asked for.
            if task.read is not None and (task.times is None or group == "SE3"):
                found = dict(zip(what, deviations(problem, task), strict=False))
                kind = "gradients" if backward else "results"
                rows.append({"contender": name, "group": group, "what": kind, "deviation": found})
    return rows
