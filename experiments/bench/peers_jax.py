"""JAX as a contender: the textbook recursion on jaxlie's groups for one time, then `vmap` and `jit`."""

import os
from functools import cache
from typing import Any

import numpy as np

from bench.problems import DT, Problem, UnavailableError, peer
from bench.timing import Task
from torchspline.splines.basis import cumulative_matrix, derivative_matrix

# jaxlie keeps poses as [wxyz, xyz]; tangents are [v, omega] there, too.
TO_JAXLIE = {"SO3": [0, 1, 2, 3], "SE3": [3, 4, 5, 6, 0, 1, 2]}
FROM_JAXLIE = {"SO3": [0, 1, 2, 3], "SE3": [4, 5, 6, 0, 1, 2, 3]}
THREADS = 1  # JAX decides when it starts, once and for all


@cache
def start() -> Any:
    """JAX on the CPU, in float64 where asked, on one thread."""
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ["PJRT_NPROC"] = str(THREADS)
    jax = peer("jax")
    jax.config.update("jax_enable_x64", True)
    return jax


def spline(group: str, order: int, derivatives: int) -> Any:
    """One query of a spline: (control points, time) -> value and rates."""
    jax, jaxlie = start(), peer("jaxlie")
    jnp = jax.numpy
    Lie, exact = getattr(jaxlie, group), cumulative_matrix(order)
    rows = [np.array(derivative_matrix(exact, r), dtype=np.float64) for r in range(3)]

    def bracket(a: Any, b: Any) -> Any:
        if group == "SO3":
            return jnp.cross(a, b)
        (v, w), (x, y) = jnp.split(a, 2), jnp.split(b, 2)
        return jnp.concatenate([jnp.cross(w, x) + jnp.cross(v, y), jnp.cross(w, y)])

    def at(points: Any, t: Any) -> Any:
        s = t / DT
        segment = jnp.clip(jnp.floor(s), 0, len(points) - order).astype(int)
        u = (s - segment).astype(points.dtype)
        near = jax.lax.dynamic_slice_in_dim(points, segment, order)
        powers = jnp.stack([u**n for n in range(order)])
        weights = [row.astype(points.dtype) @ powers for row in rows]
        value = Lie(near[0])
        velocity = acceleration = jnp.zeros(Lie.tangent_dim, points.dtype)
        for j in range(1, order):
            d = (Lie(near[j - 1]).inverse() @ Lie(near[j])).log()
            A = Lie.exp(weights[0][j] * d)
            rate, back = weights[1][j] * d, A.inverse().adjoint()
            value = value @ A
            velocity = back @ velocity + rate
            acceleration = back @ acceleration + bracket(velocity, rate) + weights[2][j] * d
        return (value.parameters(), velocity / DT, acceleration / DT**2)[: derivatives + 1]

    return at


@cache
def compiled(group: str, order: int, derivatives: int, batched: bool, backward: bool) -> Any:
    """Of control points and times, and of cotangents if `backward`; JAX compiles it again for every shape."""
    jax = start()
    forward = jax.vmap(spline(group, order, derivatives), (None, 0))
    if batched:
        forward = jax.vmap(forward, (0, None))
    return jax.jit((lambda X, t, c: jax.vjp(forward, X, t)[1](c)) if backward else forward)


def textbook(problem: Problem) -> Task:
    jax = start()
    if problem.group not in TO_JAXLIE:
        raise UnavailableError("SO3 and SE3 only")
    if problem.threads != THREADS:
        raise UnavailableError(f"threads fixed at its start: {THREADS}")
    function = compiled(
        problem.group, problem.order, problem.derivatives, problem.batch > 0, problem.backward
    )
    to, back = TO_JAXLIE[problem.group], FROM_JAXLIE[problem.group]
    X = jax.numpy.asarray(problem.control_points()[..., to].numpy())
    t = jax.numpy.asarray(problem.times().numpy())
    if not problem.backward:
        return Task(
            lambda: jax.block_until_ready(function(X, t)),
            problem.total,
            problem.threads,
            read=lambda x: [np.asarray(x[0])[..., back], *map(np.asarray, x[1:])],
        )
    value, *rates = (jax.numpy.asarray(c.numpy()) for c in problem.cotangents())
    cotangents = (value[..., np.array(to)], *rates)
    return Task(
        lambda: jax.block_until_ready(function(X, t, cotangents)),
        problem.total,
        problem.threads,
        read=lambda x: [np.asarray(x[0])[..., back], np.asarray(x[1])],
    )
