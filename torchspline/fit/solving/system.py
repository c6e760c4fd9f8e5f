"""Normal equations of a step: a band with a border in LAPACK storage, or a sparse matrix where the band breaks.

With n columns of splines and m of variables, symmetric parts by their lower halves:

| symbol | what | in `BandSystem` |
|---|---|---|
| `A` (n, n) | the part of the splines | `band[j, d]` is the element (j + d, j) |
| `B` (n, m) | its coupling to the border of variables | `border` |
| `C` (m, m) | the border's own part | `corner` |
| `J^T r` (n + m,) | the gradient of the cost; a step solves for minus this | `right` |
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchspline.fit.solving.model import Model, State
from torchspline.kernels.assemble import add_to_band, add_to_blocks
from torchspline.kernels.band import inverse_band

Array = NDArray[Any]


#: Rows of a piece in `_inner`; columns of a sparse system's inverse at a time.
_PIECE, _COLUMNS = 256, 256


class Rows(NamedTuple):
    """What a chunk adds to the normal equations, see `kernels/assemble.py`.

    Rows come in runs that touch the same unknowns.
    """

    #: (N, R, W): `[J | r]` of each measurement, the trajectory's part in local coordinates.
    rows: Array
    #: (runs + 1,): where each run begins among the N.
    starts: Array
    #: (runs, splines): the first control point that a run touches.
    bases: Array
    #: (runs, W - 1): columns of the unknowns; -1 for those that stay.
    columns: Array
    #: Control points that a row's local coordinates span.
    span: int

    def arguments(self, chain: Array) -> tuple[Any, ...]:
        """In the order in which `add_to_band` and `add_to_blocks` take them."""
        return self.rows, self.starts, self.bases, chain, self.span, chain.shape[-1], self.columns


class SingularError(Exception):
    """A matrix that should have been positive definite was not."""


class Factor(ABC):
    """Of a damped system."""

    @abstractmethod
    def solve(self, right: Array) -> Array:
        """For right sides `(total,)` or `(total, C)`."""

    @abstractmethod
    def inverse(self, i: Array, j: Array) -> Array:
        """Elements of the inverse at columns `i`, `j` of one shape, tied together by measurements or of the border."""

    @abstractmethod
    def diagonal(self) -> Array:
        """Of the inverse."""

    @abstractmethod
    def trace(self, other: "System") -> float:
        """Of the inverse times the `J^T J` of some of the same measurements."""


class System(ABC):
    """`J^T J` and `J^T r`, added up chunk by chunk."""

    def __init__(self, model: Model, fused: bool):
        self.model, self.fused = model, fused
        #: Half the sum of squares.
        self.cost = 0.0
        self.right = np.zeros(model.total)

    @abstractmethod
    def add(self, rows: Rows, chain: Array) -> None:
        """The rows of a chunk."""

    def add_all(self, chunks: Iterable[tuple[float, Rows, Array]], state: State) -> None:
        """Cost and rows of all chunks of a term; residuals come along."""
        assert state.chain is not None
        for cost, rows, _ in chunks:
            self.cost += cost
            self.add(rows, state.chain)

    @abstractmethod
    def add_dense(self, columns: Array, matrix: Array, right: Array) -> None:
        """A term that is known as `J^T J` `(n, n)` and `J^T r` of the given columns; -1 is left out."""

    @abstractmethod
    def diagonal(self) -> Array:
        """Of `J^T J`."""

    @abstractmethod
    def factor(self, damping: Array) -> Factor:
        """Of `J^T J` + diag(damping).

        Raises:
            SingularError: it is not positive definite.
        """

    @abstractmethod
    def multiply(self, x: Array) -> Array:
        """`J^T J x`."""


class BandSystem(System):
    """Cost of a solution is linear in the length of the trajectory.

    Args:
        width: how far apart columns of splines may be that a measurement ties together, plus one.
    """

    def __init__(self, model: Model, fused: bool, width: int):
        super().__init__(model, fused)
        n, m = model.band, model.total - model.band
        self.band = np.zeros((n, min(width, max(n, 1))))
        self.border, self.corner = np.zeros((n, m)), np.zeros((m, m))

    def add(self, rows: Rows, chain: Array) -> None:
        outside = add_to_band(
            self.fused, *rows.arguments(chain),
            self.band, self.border, self.corner, self.right,
        )  # fmt: skip
        if outside:
            raise AssertionError(f"{outside} products outside a band of {self.band.shape[1]}")

    def add_dense(self, columns: Array, matrix: Array, right: Array) -> None:
        keep = columns >= 0
        columns, matrix, right = columns[keep], matrix[np.ix_(keep, keep)], right[keep]
        np.add.at(self.right, columns, right)
        i, j = (x.reshape(-1) for x in np.meshgrid(columns, columns, indexing="ij"))
        value, n = matrix.reshape(-1), len(self.band)
        inner, mixed, outer = (i < n) & (j <= i), (i >= n) & (j < n), (i >= n) & (j >= n) & (j <= i)
        np.add.at(self.band, (j[inner], (i - j)[inner]), value[inner])
        np.add.at(self.border, (j[mixed], i[mixed] - n), value[mixed])
        np.add.at(self.corner, (i[outer] - n, j[outer] - n), value[outer])

    def diagonal(self) -> Array:
        return np.concatenate([self.band[:, 0], np.diagonal(self.corner)])

    def factor(self, damping: Array) -> "BandFactor":
        return BandFactor(self, damping)

    def multiply(self, x: Array) -> Array:
        n = len(self.band)
        y, result = x[:n], np.zeros_like(x)
        for d in range(self.band.shape[1]):
            part = self.band[: n - d, d]
            result[d:n] += part * y[: n - d]
            if d:
                result[: n - d] += part * y[d:]
        corner = self.corner + np.tril(self.corner, -1).T
        result[:n] += self.border @ x[n:]
        result[n:] = self.border.T @ y + corner @ x[n:]
        return result


class BandFactor(Factor):
    """A banded Cholesky factor and, for the border, that of the Schur complement `C - B^T A^-1 B`."""

    def __init__(self, system: BandSystem, damping: Array):
        from scipy.linalg import lapack  # as long to import as the rest of the library

        n, m = len(system.band), len(system.corner)
        self.n, self._lapack, self._fused = n, lapack, system.fused
        self.damped = system.band.copy()
        self.damped[:, 0] += damping[:n]
        self.chol = self.damped.T
        if n:
            self.chol, info = lapack.dpbtrf(self.damped.T, lower=1, overwrite_ab=1)
            if info:
                raise SingularError
        self.border = system.border
        self.inverse_border = self._band_solve(system.border)
        complement = system.corner + np.diag(damping[n:]) - np.tril(_inner(self.border, self.inverse_border))
        self.corner = complement
        if m:
            self.corner, info = lapack.dpotrf(complement, lower=1)
            if info:
                raise SingularError

    def _band_solve(self, right: Array) -> Array:
        if self.n == 0 or right.size == 0:
            return right
        return self._lapack.dpbtrs(self.chol, right, lower=1)[0]

    def solve(self, right: Array) -> Array:
        n = self.n
        inner = self._band_solve(right[:n])
        if len(right) == n:
            return inner
        outer = right[n:] - _inner(self.border, inner)
        outer = self._lapack.dpotrs(self.corner, outer, lower=1)[0]
        return np.concatenate([inner - self.inverse_border @ outer, outer])

    def inverse(self, i: Array, j: Array) -> Array:
        """The band's own inverse, corrected for the border."""
        n, follow = self.n, self._follow
        result = np.einsum("...a,ab,...b->...", follow[i], self._inverse_corner, follow[j])
        inner = (i < n) & (j < n)
        result[inner] += self._band_inverse(i[inner], j[inner])
        return result

    def trace(self, other: System) -> float:
        assert isinstance(other, BandSystem)
        width = min(other.band.shape[1], self._inverse.shape[1])
        if other.band[:, width:].any():
            raise ValueError("these columns are too far apart for elements of the inverse to be known")
        corner = other.corner + np.tril(other.corner, -1).T
        total = float(np.einsum("ab,ab->", self._inverse_corner, corner))
        total += 2.0 * float(np.einsum("nm,nm->", self._inverse_border, other.border))
        below = float(np.einsum("nd,nd->", self._whole_inverse[:, 1:width], other.band[:, 1:width]))
        return total + 2.0 * below + float(np.einsum("n,n->", self._whole_inverse[:, 0], other.band[:, 0]))

    def border_steps(self, columns: Array) -> Array:
        """Rows `(..., m)` of the inverse at `columns`: how the border moves with a gradient there."""
        return self._follow[columns] @ self._inverse_corner

    def diagonal(self) -> Array:
        """Of the inverse."""
        return np.concatenate([self._whole_inverse[:, 0], np.diagonal(self._inverse_corner)])

    def _band_inverse(self, i: Array, j: Array) -> Array:
        first, apart = np.minimum(i, j), np.abs(i - j)
        if len(apart) and int(apart.max()) >= self._inverse.shape[1]:
            raise ValueError("these columns are too far apart for elements of the inverse to be known")
        return self._inverse[first, apart]

    @cached_property
    def _inverse(self) -> Array:
        """`[j, d]`: element `(j + d, j)` of the inverse of the band alone."""
        return inverse_band(self._fused, self.chol.T)

    @cached_property
    def _whole_inverse(self) -> Array:
        """The same of the inverse of all."""
        n, follow, result = self.n, self._follow[: self.n], self._inverse.copy()
        for d in range(min(result.shape[1], n)):
            result[: n - d, d] += np.einsum("na,na->n", self._inverse_border[d:], follow[: n - d])
        return result

    @cached_property
    def _inverse_border(self) -> Array:
        """The part of the inverse between band and border."""
        return self._follow[: self.n] @ self._inverse_corner

    @cached_property
    def _inverse_corner(self) -> Array:
        """The border's part of the inverse."""
        identity = np.eye(len(self.corner))
        return self._lapack.dpotrs(self.corner, identity, lower=1)[0] if len(identity) else identity

    @cached_property
    def _follow(self) -> Array:
        """Rows of [-A^-1 B; 1]: how all columns follow those of the border."""
        return np.concatenate([-self.inverse_border, np.eye(len(self.corner))])


def _inner(a: Array, b: Array) -> Array:
    """`a^T b` of tall matrices `(n, m)` and `(n, ...)`, in pieces that a BLAS does not give to several threads.

    The product takes a millisecond; waiting for a thread that another process keeps off its core takes hundreds.
    """
    right = b.reshape(len(b), int(np.prod(b.shape[1:])))  # -1 cannot be told where there are no rows
    pieces, rest = divmod(len(a), _PIECE)
    whole = pieces * _PIECE
    first, second = (x[:whole].reshape(pieces, _PIECE, x.shape[1]) for x in (a, right))
    total = (first.transpose(0, 2, 1) @ second).sum(axis=0)
    if rest:
        total = total + a[whole:].T @ right[whole:]
    return total.reshape(a.shape[1], *b.shape[1:])


class SparseSystem(System):
    """For distant relative poses and maps of landmarks, whose coupling fits no band."""

    def __init__(self, model: Model, fused: bool):
        super().__init__(model, fused)
        self._parts: list[tuple[Array, Array, Array]] = []
        self._matrix: Any = None

    def add(self, rows: Rows, chain: Array) -> None:
        size = rows.columns.shape[1]
        blocks = np.empty((len(rows.columns), size, size))
        add_to_blocks(self.fused, *rows.arguments(chain), blocks, self.right)
        i = np.repeat(rows.columns, size, axis=1).reshape(-1)
        j = np.tile(rows.columns, (1, size)).reshape(-1)
        self._keep(i, j, blocks.reshape(-1))

    def add_dense(self, columns: Array, matrix: Array, right: Array) -> None:
        keep = columns >= 0
        np.add.at(self.right, columns[keep], right[keep])
        i, j = np.meshgrid(columns, columns, indexing="ij")
        self._keep(i.reshape(-1), j.reshape(-1), matrix.reshape(-1))

    def _keep(self, i: Array, j: Array, value: Array) -> None:
        there = (i >= 0) & (j >= 0)
        self._parts.append((i[there], j[there], value[there]))

    def matrix(self) -> Any:
        """`J^T J` as a SciPy matrix of compressed columns."""
        if self._matrix is None:
            from scipy.sparse import coo_matrix

            i, j, value = (np.concatenate(x) for x in zip(*self._parts, strict=True))
            total = self.model.total
            self._matrix = coo_matrix((value, (i, j)), shape=(total, total)).tocsc()
        return self._matrix

    def diagonal(self) -> Array:
        return self.matrix().diagonal()

    def factor(self, damping: Array) -> "SparseFactor":
        return SparseFactor(self.matrix(), damping)

    def multiply(self, x: Array) -> Array:
        return self.matrix() @ x


class SparseFactor(Factor):
    """An LU factorisation, which SciPy has where it has no sparse Cholesky; elements of the inverse by solving."""

    def __init__(self, matrix: Any, damping: Array):
        from scipy.sparse import diags
        from scipy.sparse.linalg import splu

        damped = (matrix + diags(damping)).tocsc()
        try:
            # Positive definite: symmetric ordering, no pivoting.
            self._lu = splu(
                damped, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
        except RuntimeError:
            raise SingularError from None
        if not (self._lu.U.diagonal() > 0).all():
            raise SingularError

    def solve(self, right: Array) -> Array:
        return self._lu.solve(right)

    def inverse(self, i: Array, j: Array) -> Array:
        needed, which = np.unique(j, return_inverse=True)
        which = which.reshape(-1)
        order, rows = np.argsort(which, kind="stable"), i.reshape(-1)
        result = np.empty(len(rows))
        # Some columns at a time: all of them would be a dense matrix of all unknowns.
        for begin in range(0, len(needed), _COLUMNS):
            columns = needed[begin : begin + _COLUMNS]
            unit = np.zeros((self._lu.shape[0], len(columns)))
            unit[columns, np.arange(len(columns))] = 1.0
            first, stop = np.searchsorted(which, [begin, begin + len(columns)], sorter=order)
            here = order[first:stop]
            result[here] = self._lu.solve(unit)[rows[here], which[here] - begin]
        return result.reshape(j.shape)

    def diagonal(self) -> Array:
        columns = np.arange(self._lu.shape[0])
        return self.inverse(columns, columns)

    def trace(self, other: System) -> float:
        assert isinstance(other, SparseSystem)
        matrix = other.matrix().tocoo()
        return float(self.inverse(matrix.row, matrix.col) @ matrix.data)
