"""Forgetting unknowns without losing what was measured of them: the Schur complement of the normal equations."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchspline.fit.solving.linearizer import CostTerm
from torchspline.fit.solving.model import Model, State
from torchspline.fit.solving.system import BandSystem

Array = NDArray[Any]


def normal_equations(model: Model, terms: Sequence[CostTerm], state: State) -> tuple[Array, Array]:
    """`J^T J` (total, total) and `J^T r` (total,) of a few unknowns, dense."""
    system = BandSystem(model, model.trajectory.local.fused, model.band)
    for term in terms:
        term.add_to(system, state)
    n, total = model.band, model.total
    H = np.zeros((total, total))
    row, below = np.meshgrid(np.arange(n), np.arange(system.band.shape[1]), indexing="ij")
    inside = row + below < n
    H[(row + below)[inside], row[inside]] = system.band[inside]
    H[n:, :n], H[n:, n:] = system.border.T, np.tril(system.corner)
    return H + np.tril(H, -1).T, system.right


def marginalised(H: Array, g: Array, keep: Array) -> tuple[Array, Array, float]:
    """`H_kk - H_kd H_dd^-1 H_dk` and `g_k - H_kd H_dd^-1 g_d`: the Gaussian `1/2 x^T H x + g^T x` of the rest.

    Args:
        keep: which unknowns stay, in the order in which they come back, (K,) int64.
    Returns:
        Information (K, K), slope (K,), and the constant that makes its least cost 0. Directions of the others that
        nothing determines are left out.
    """
    drop = np.setdiff1d(np.arange(len(g)), keep)
    coupling = H[np.ix_(keep, drop)]
    carried = coupling @ _inverse(H[np.ix_(drop, drop)])
    information = H[np.ix_(keep, keep)] - carried @ coupling.T
    slope = g[keep] - carried @ g[drop]
    information = 0.5 * (information + information.T)
    # Half the square of the slope in the metric of the inverse: what was dropped then costs nothing at its optimum,
    # and the sum stays the cost of what is in sight.
    return information, slope, 0.5 * float(slope @ _inverse(information) @ slope)


def random_walk(H: Array, g: Array, walking: Array, variance: Array) -> tuple[Array, Array, Array]:
    """Unknowns that step on: new ones appended, `variance` (W,) away from the old ones in columns `walking` (W,).

    Returns:
        H and g with W more unknowns, and the columns of these.
    """
    n, w = len(g), len(walking)
    larger = np.zeros((n + w, n + w))
    larger[:n, :n] = H
    new = n + np.arange(w)
    for i, j, sign in ((walking, walking, 1), (new, new, 1), (walking, new, -1), (new, walking, -1)):
        larger[i, j] += sign / variance
    return larger, np.append(g, np.zeros(w)), new


def _inverse(A: Array) -> Array:
    """Pseudo-inverse of a matrix that is positive semidefinite up to rounding, whatever the units of its rows."""
    diagonal = np.diagonal(A)
    scale = np.where(diagonal > 0, 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(scale[:, None] * A * scale)
    least = 8 * len(A) * np.finfo(np.float64).eps * values.max(initial=0.0)
    vectors = scale[:, None] * vectors[:, values > least]
    return (vectors / values[values > least]) @ vectors.T
