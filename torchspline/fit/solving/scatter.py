"""What each stretch of a trajectory would move unknowns by: how sure they are when errors are alike for a while."""

from collections.abc import Callable, Iterator
from functools import cached_property
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
#: Stretches whose steps are held at a time.
_PIECE = 64
#: Sets of errors that are drawn.
_DRAWS = 8


class Scatter:
    """How far the stretches of a trajectory pull unknowns apart.

    At the optimum x = -H^-1 g, and g is the sum of the gradients g_b of the stretches, which cancel there. How far they
    miss each other tells how sure x is, whatever correlation residuals have within a stretch: the covariance is
    `n/(n-1) sum_b (H^-1 g_b)(H^-1 g_b)^T` [Liang and Zeger 1986]. It knows nothing of errors that are alike in all.

    Args:
        seconds: length of a stretch.
    """

    def __init__(self, linearizer: Linearizer, state: State, factor: Factor, seconds: float):
        model = linearizer.model
        length = model.trajectory.segments * model.trajectory.spacing
        # Stretches much shorter than measurements are apart would say no more, and be too many to hold.
        self._count = max(round(min(length / seconds, model.trajectory.segments)), _FEWEST)
        self._factor, self._state = factor, state
        self._terms = linearizer.measured
        self._share = self._count / length
        self._banded, self._band, self._total = isinstance(factor, BandFactor), model.band, model.total
        self._gradients = self._summed([
            (columns, block, slopes[..., 0])
            for term in self._terms
            for columns, block, slopes in self._of_term(term, lambda rows: rows[..., -1:])
        ])  # fmt: skip

    # ------------------------------------------------------------------ unknowns that all stretches bear on

    @cached_property
    def _border(self) -> Array:
        """Steps (stretches, m) of the variables, which a banded factor has at hand."""
        assert isinstance(self._factor, BandFactor)
        return self._gradients.T @ self._factor.border_steps(np.arange(self._total))

    def variances(self, columns: Array) -> Array:
        """Of variables by their columns."""
        if self._banded:
            squares = np.square(self._border[:, columns - self._band]).sum(axis=0)
        else:
            squares = self._squares(self._gradients, columns)
        return squares * (self._count / (self._count - 1))

    # ------------------------------------------------------------------ unknowns of a few stretches

    def inflation(self, columns: Array, variances: Array) -> Array:
        """By what factors (D,) the errors of control points (M, D) of a spline scatter more than independent ones.

        A control point is a matter of few stretches, and what it takes up of their errors is not seen any more. So all
        control points are taken together, and compared with what independent errors would look like after a fit:
        these are drawn, the mean of some draws taken.

        Args:
            variances: (M, D), for independent errors; 0 of control points that stay.
        """
        there = variances > 0
        shares = np.where(there, 1.0 / np.where(there, variances, 1.0), 0.0)
        at = np.where(there, columns, 0)
        found = (self._squares(self._gradients, at) * shares).sum(axis=0)
        expected = sum((self._squares(x, at) * shares).sum(axis=0) for x in self._drawn) / len(self._drawn)
        ratio = np.divide(found, expected, out=np.ones_like(found), where=expected > 0)
        return np.sqrt(np.maximum(ratio, 1.0))

    @cached_property
    def _drawn(self) -> list[Any]:
        """Gradients of the stretches for independent errors of standard deviation 1."""
        right = np.zeros((self._total, _DRAWS))
        generator = np.random.default_rng(0)
        for term in self._terms:
            for columns, _, slopes in self._of_term(term, lambda rows: _draw(generator, rows)):
                np.add.at(right, columns, slopes)
        steps = np.append(
            self._factor.solve(right), np.zeros((1, _DRAWS)), axis=0
        )  # column -1: those that stay
        generator = np.random.default_rng(0)  # the same errors again, less what the solution makes of them
        parts = [
            part
            for term in self._terms
            for part in self._of_term(term, lambda rows: _draw(generator, rows), steps)
        ]
        return [self._summed([(i, j, x[..., d]) for i, j, x in parts]) for d in range(_DRAWS)]

    # ------------------------------------------------------------------ gradients

    def _squares(self, gradients: Any, columns: Array) -> Array:
        """Of the steps of unknowns, summed over the stretches."""
        squares = np.zeros(columns.shape)
        for begin in range(0, self._count, _PIECE):
            some = gradients[:, begin : begin + _PIECE].toarray()
            squares += np.square(self._factor.solve(some)[columns]).sum(axis=-1)
        return squares

    def _summed(self, parts: list[tuple[Array, Array, Array]]) -> Any:
        """A sparse matrix (unknowns, stretches) of what was found by `_of_term`."""
        from scipy.sparse import coo_matrix

        i, j, value = (np.concatenate(x) for x in zip(*parts, strict=True))
        return coo_matrix((value, (i, j)), (self._total, self._count)).tocsc()

    def _of_term(
        self, term: Term, errors: Callable[[Array], Array], steps: Array | None = None
    ) -> Iterator[tuple[Array, Array, Array]]:
        """What the measurements of a term add to the gradients: unknowns, stretches, and numbers (..., draws).

        Args:
            errors: of the rows (N, R, C + 1) of a chunk, weighted, (N, R, draws).
            steps: (unknowns + 1, draws) of a solution whose part of the errors is taken off.
        """
        chain = self._state.chain
        assert chain is not None
        for part, _, rows, _ in term.chunks(self._state):
            left = errors(rows.rows)
            if steps is not None:
                local = steps[rows.columns]
                _to_local(local, rows.bases, chain, rows.span)
                each = np.repeat(local, np.diff(rows.starts), axis=0)
                left = left - np.einsum("nrc,ncd->nrd", rows.rows[..., :-1], each)
            slopes = np.einsum("nrc,nrd->ncd", rows.rows[..., :-1], left)
            slopes = np.add.reduceat(slopes, rows.starts[:-1], axis=0)
            _to_points(slopes, rows.bases, chain, rows.span)
            at = term.tau[0][part.start + rows.starts[:-1]]
            block = np.clip((at * self._share).astype(np.int64), 0, self._count - 1)
            there = rows.columns >= 0
            yield rows.columns[there], np.broadcast_to(block[:, None], there.shape)[there], slopes[there]


def _draw(generator: np.random.Generator, rows: Array) -> Array:
    """Errors (N, R, draws) of standard deviation 1; none where a measurement has no weight."""
    there = np.any(rows[..., :-1], axis=-1, keepdims=True)
    return generator.standard_normal((*rows.shape[:2], _DRAWS)) * there


def _to_local(steps: Array, bases: Array, chain: Array, order: int) -> None:
    """Steps (runs, C, draws) of control points become those of local coordinates of splines, in place."""
    size = chain.shape[-1]
    for s in range(bases.shape[1]):
        for j in range(order - 1, 0, -1):
            here = slice((s * order + j) * size, (s * order + j + 1) * size)
            before = slice(here.start - size, here.start)
            pair = chain[bases[:, s] + j - 1]
            steps[:, here] = pair[:, 0] @ steps[:, before] + pair[:, 1] @ steps[:, here]


def _to_points(slopes: Array, bases: Array, chain: Array, order: int) -> None:
    """Gradients (runs, C, draws) by local coordinates of splines become those by control points, in place."""
    size = chain.shape[-1]
    for s in range(bases.shape[1]):
        for j in range(1, order):
            here = slice((s * order + j) * size, (s * order + j + 1) * size)
            before = slice(here.start - size, here.start)
            pair, g = chain[bases[:, s] + j - 1], slopes[:, here].copy()
            slopes[:, before] += pair[:, 0].swapaxes(1, 2) @ g
            slopes[:, here] = pair[:, 1].swapaxes(1, 2) @ g
