"""Many rows of a Jacobian that depend on the same few numbers, made few: the triangular factor of their Gram matrix.

Least squares sees rows `[J | r]` only through `J^T J` and `J^T r`. So the rows `S = L^T` of the Cholesky factor,
`J^T J = L L^T`, with residuals `e = L^-1 J^T r` do instead of thousands: same normal equations, up to the constant part
of the cost. All corners of an image become as many rows as a pose has numbers.
"""

import inspect
from collections.abc import Callable
from functools import cache

import numpy as np

from torchspline.kernels.assemble import DEPTH, ENTRY, HEADER, HELPER, outer_products
from torchspline.kernels.build import compiled
from torchspline.kernels.rowwise import Array

#: A pivot that is this small against its diagonal is rounding: the rows do not determine that combination.
LEAST_PIVOT = 1e-13


def to_triangles(rows, starts, weight, begin, stop, out):
    """Blocks `begin` to `stop`: rows `starts[i]` to `starts[i + 1]` become `out[i]`.

    Args:
        rows: (N, R, W), the residual last. starts: (blocks + 1,). weight: (N,), what each square counts.
        out: (blocks, W - 1, W).
    """
    count, width = rows.shape[1], rows.shape[2]
    padded = (width + 3) // 4 * 4
    lines, gram = np.zeros((padded, DEPTH)), np.zeros((padded, padded))
    for block in range(begin, stop):
        gram[:] = 0.0
        depth = 0
        for n in range(starts[block], starts[block + 1]):
            root = np.sqrt(weight[n])
            for r in range(count):
                for a in range(width):
                    lines[a, depth] = root * rows[n, r, a]
                depth += 1
                if depth == DEPTH:
                    outer_products(lines, depth, gram)
                    depth = 0
        outer_products(lines, depth, gram)
        triangle = out[block]
        triangle[:] = 0.0
        for a in range(width - 1):
            pivot = gram[a, a]
            for k in range(a):
                pivot -= triangle[k, a] * triangle[k, a]
            if not pivot > LEAST_PIVOT * gram[a, a]:
                continue
            scale = 1.0 / np.sqrt(pivot)
            for b in range(a, width):
                value = gram[b, a]
                for k in range(a):
                    value -= triangle[k, a] * triangle[k, b]
                triangle[a, b] = value * scale


_SIGNATURE = "void(float64[:, :, ::1], int64[::1], float64[::1], int64, int64, float64[:, :, ::1])"


@cache
def _compiled() -> Callable:
    helper, loop = (inspect.getsource(f) for f in (outer_products, to_triangles))
    header = HEADER.replace("{DEPTH}", str(DEPTH)).replace("{FEW}", "0").replace("assemble.py", "gram.py")
    header = header.rstrip() + f"\nLEAST_PIVOT = {LEAST_PIVOT}\n\n"
    return compiled("to_triangles", f"{header}\n{HELPER}{helper}\n\n{ENTRY}{loop}", _SIGNATURE)


def triangles(fused: bool, rows: Array, starts: Array, weight: Array) -> Array:
    """`(blocks, W - 1, W)` of rows `(N, R, W)`; combinations that they leave open have rows of zeros."""
    blocks, width = len(starts) - 1, rows.shape[2]
    out = np.zeros((blocks, width - 1, width))
    if fused:
        _compiled()(rows, starts, weight, 0, blocks, out)
    elif len(rows):
        _reference(rows, starts, weight, out)
    return out


def _reference(rows: Array, starts: Array, weight: Array, out: Array) -> None:
    """The same on whole arrays."""
    own = np.einsum("nra,nrb,n->nab", rows, rows, weight)
    gram = np.zeros((len(out), *own.shape[1:]))
    np.add.at(gram, np.repeat(np.arange(len(out)), np.diff(starts)), own)
    for a in range(out.shape[1]):
        done = out[:, :a, a]
        pivot = gram[:, a, a] - np.square(done).sum(axis=1)
        keep = pivot > LEAST_PIVOT * gram[:, a, a]
        line = gram[:, a, a:] - np.einsum("nk,nkb->nb", done, out[:, :a, a:])
        out[keep, a, a:] = line[keep] / np.sqrt(pivot[keep])[:, None]
