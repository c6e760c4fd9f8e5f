"""What each stretch of a trajectory would move variables by: how sure they are when errors are alike for a while."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchspline.fit.solving.linearizer import Linearizer
from torchspline.fit.solving.model import State
from torchspline.fit.solving.system import BandFactor, Factor
from torchspline.fit.solving.terms import Term

Array = NDArray[Any]
#: Fewest stretches whose scatter says anything.
_FEWEST = 6


def scatter(linearizer: Linearizer, state: State, factor: Factor, seconds: float) -> Array:
    """Rows `(stretches, border)` whose squares sum up to variances of the variables.

    At the optimum x = -H^-1 g, and g is the sum of the gradients g_b of the stretches, which cancel there. How far they
    miss each other tells how sure x is, whatever correlation residuals have within a stretch: the covariance is
    `n/(n-1) sum_b (H^-1 g_b)(H^-1 g_b)^T` [Liang and Zeger 1986]. It knows nothing of errors that are alike in all.

    Raises:
        ValueError: the equations are no band with a border.
    """
    if not isinstance(factor, BandFactor):
        raise ValueError(
            "stretch: expected unknowns in a band with a narrow border, got too many variables; use None"
        )
    model = linearizer.model
    length = model.trajectory.segments * model.trajectory.spacing
    # Stretches much shorter than measurements are apart would say no more, and be too many to hold.
    count = max(round(min(length / seconds, model.trajectory.segments)), _FEWEST)
    pulls = np.zeros((count, model.total - model.band))
    for term in linearizer.measured:
        _add_pulls(term, state, factor, length, pulls)
    return pulls * np.sqrt(count / (count - 1))


def _add_pulls(term: Term, state: State, factor: BandFactor, length: float, pulls: Array) -> None:
    """Of the measurements of one term."""
    assert state.chain is not None
    for part, _, rows, _ in term.chunks(state):
        slopes = np.einsum("nrc,nr->nc", rows.rows[..., :-1], rows.rows[..., -1])
        slopes = np.add.reduceat(slopes, rows.starts[:-1], axis=0)
        _to_points(slopes, rows.bases, state.chain, rows.span)
        there = rows.columns >= 0
        steps = factor.border_steps(np.where(there, rows.columns, 0))
        own = np.einsum("rc,rcm->rm", np.where(there, slopes, 0.0), steps)
        at = term.tau[0][part.start + rows.starts[:-1]]
        block = np.clip((at / length * len(pulls)).astype(np.int64), 0, len(pulls) - 1)
        np.add.at(pulls, block, own)


def _to_points(slopes: Array, bases: Array, chain: Array, order: int) -> None:
    """Gradients (runs, C) by local coordinates of splines become those by control points, in place."""
    size = chain.shape[-1]
    for s in range(bases.shape[1]):
        for j in range(1, order):
            here = slice((s * order + j) * size, (s * order + j + 1) * size)
            before = slice(here.start - size, here.start)
            pair, g = chain[bases[:, s] + j - 1], slopes[:, here].copy()
            slopes[:, before] += np.einsum("re,rec->rc", g, pair[:, 0])
            slopes[:, here] = np.einsum("re,rec->rc", g, pair[:, 1])
