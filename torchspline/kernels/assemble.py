"""Normal equations from rows of Jacobians: plain loops over arrays, compiled when first used.

Queries come in runs that touch the same unknowns. Rows of a run are `[J | r]`: `splines` times k D columns in local
coordinates (see `linearize.py`), then columns of other unknowns, last the residual. The Gram matrix of a run is summed
first, moved from local coordinates to control points once, and then added to where its unknowns live. Without Numba
the same is done on whole arrays, at the end of this file.
"""

import inspect
from collections.abc import Callable
from functools import cache

import numpy as np

from torchspline.kernels.build import compiled
from torchspline.kernels.rowwise import Array

HEADER = '''"""Loops of torchspline/kernels/assemble.py."""

import numpy as np
from numba import njit

DEPTH = {DEPTH}
FEW = {FEW}

'''
_OPTIONS = 'nogil=True, error_model="numpy", fastmath={"contract", "nsz", "reassoc"}'
ENTRY = '@njit("{signature}", cache={cache}, ' + _OPTIONS + ")\n"
HELPER = f"@njit({_OPTIONS})\n"


#: Rows of a run that are multiplied at a time.
DEPTH = 128
#: Runs of fewer rows than this share of the columns are moved to control points before they are multiplied.
FEW = 1


def outer_products(lines, depth, gram):
    """`gram` += `lines[:, :depth] lines[:, :depth]^T`, four by four, lower half; sixteen sums stay in registers."""
    for a in range(0, lines.shape[0], 4):
        a0, a1, a2, a3 = lines[a], lines[a + 1], lines[a + 2], lines[a + 3]
        for b in range(0, a + 1, 4):
            b0, b1, b2, b3 = lines[b], lines[b + 1], lines[b + 2], lines[b + 3]
            s00 = s01 = s02 = s03 = s10 = s11 = s12 = s13 = 0.0
            s20 = s21 = s22 = s23 = s30 = s31 = s32 = s33 = 0.0
            for k in range(depth):
                x0, x1, x2, x3 = a0[k], a1[k], a2[k], a3[k]
                y0, y1, y2, y3 = b0[k], b1[k], b2[k], b3[k]
                s00, s01, s02, s03 = s00 + x0 * y0, s01 + x0 * y1, s02 + x0 * y2, s03 + x0 * y3
                s10, s11, s12, s13 = s10 + x1 * y0, s11 + x1 * y1, s12 + x1 * y2, s13 + x1 * y3
                s20, s21, s22, s23 = s20 + x2 * y0, s21 + x2 * y1, s22 + x2 * y2, s23 + x2 * y3
                s30, s31, s32, s33 = s30 + x3 * y0, s31 + x3 * y1, s32 + x3 * y2, s33 + x3 * y3
            g0, g1, g2, g3 = gram[a, b:], gram[a + 1, b:], gram[a + 2, b:], gram[a + 3, b:]
            g0[0], g0[1], g0[2], g0[3] = g0[0] + s00, g0[1] + s01, g0[2] + s02, g0[3] + s03
            g1[0], g1[1], g1[2], g1[3] = g1[0] + s10, g1[1] + s11, g1[2] + s12, g1[3] + s13
            g2[0], g2[1], g2[2], g2[3] = g2[0] + s20, g2[1] + s21, g2[2] + s22, g2[3] + s23
            g3[0], g3[1], g3[2], g3[3] = g3[0] + s30, g3[1] + s31, g3[2] + s32, g3[3] + s33


def run_gram(rows, begin, stop, bases, chain, order, size, lines, lined, gram, moved):
    """`gram` = sum of the outer products of the rows of queries `begin` to `stop`, in control points.

    Args:
        rows: (N, R, W). bases: first control point of each spline's part of the columns. chain: (M, 2, D, D) of the
            logarithms. order, size: k and D. lines, lined, gram, moved: from `workspace`.
    """
    width = rows.shape[2]
    gram[:] = 0.0
    depth = 0
    few = (stop - begin) * rows.shape[1] <= min(lines.shape[1], FEW * width) and len(bases) > 0
    for n in range(begin, stop):
        for r in range(rows.shape[1]):
            for a in range(width):
                lines[a, depth] = rows[n, r, a]
            depth += 1
            if depth == lines.shape[1] and not few:
                outer_products(lines, depth, gram)
                depth = 0
    if few:  # cheaper to move the rows than their products
        to_points(lines, bases, chain, order, size, lined, depth)
        outer_products(lined, depth, gram)
    else:
        outer_products(lines, depth, gram)
    for a in range(width):
        for b in range(a):
            gram[b, a] = gram[a, b]
    if len(bases) > 0 and not few:
        to_points(gram, bases, chain, order, size, moved, gram.shape[1])
        for a in range(width):
            for b in range(width):
                gram[a, b] = moved[b, a]
        to_points(gram, bases, chain, order, size, moved, gram.shape[1])
        gram[:] = moved


def workspace(width, like):
    """Room for `run_gram`: the lines of some rows, twice, and two square matrices, a multiple of four wide."""
    padded = (width + 3) // 4 * 4
    square, oblong = (padded, padded), (padded, DEPTH)
    return (
        np.zeros(oblong, like.dtype),
        np.zeros(oblong, like.dtype),
        np.zeros(square, like.dtype),
        np.zeros(square, like.dtype),
    )


def to_points(local, bases, chain, order, size, moved, width):
    """`moved` = T^T `local`, of the first `width` columns; T leads from control points to local coordinates.

    Logarithm j moves with its two points. Six rows are added at a time: the loop over columns is short, and starting it
    costs more than a few products.
    """
    for a in range(local.shape[0]):
        for b in range(width):
            moved[a, b] = local[a, b]
    for s in range(len(bases)):
        offset = s * order * size
        for j in range(order):
            here, after = offset + j * size, offset + min(j + 1, order - 1) * size
            ending = chain[bases[s] + max(j - 1, 0), 1]  # of the logarithm that ends at point j
            starting = chain[bases[s] + min(j, order - 2), 0]  # of the one that starts there
            for c in range(size):
                line = moved[here + c]
                for b in range(width):
                    line[b] = 0.0
                for e in range(0, size, 3):
                    e1, e2 = min(e + 1, size - 1), min(e + 2, size - 1)
                    f0, f1, f2 = ending[e, c], ending[e1, c], ending[e2, c]
                    g0, g1, g2 = starting[e, c], starting[e1, c], starting[e2, c]
                    if j == 0:  # the point itself comes first among local coordinates
                        f0, f1, f2 = 1.0 * (e == c), 1.0 * (e1 == c), 1.0 * (e2 == c)
                    if j == order - 1:
                        g0, g1, g2 = 0.0, 0.0, 0.0
                    if e + 1 >= size:
                        f1, g1 = 0.0, 0.0
                    if e + 2 >= size:
                        f2, g2 = 0.0, 0.0
                    x0, x1, x2 = local[here + e], local[here + e1], local[here + e2]
                    y0, y1, y2 = local[after + e], local[after + e1], local[after + e2]
                    for b in range(width):
                        line[b] += (f0 * x0[b] + f1 * x1[b] + f2 * x2[b]) + (
                            g0 * y0[b] + g1 * y1[b] + g2 * y2[b]
                        )


def to_band(rows, starts, bases, chain, order, size, columns, band, border, corner, right):
    """Add `J^T J` and `J^T r` of all runs to a matrix that is a band with a border.

    Args:
        starts: (runs + 1,) first query of each run, and their number. bases: (runs, splines).
        columns: (runs, W - 1) unknowns of the columns, ascending where it matters to nobody; -1: left out.
        band: (n, width), `band[j, i] = A[i + j, j]`. border: (n, m). corner: (m, m), lower half. right: (n + m,).
    Returns:
        How many products fell outside the band.
    """
    width = rows.shape[2]
    lines, lined, gram, moved = workspace(width, rows)
    n, reach, outside = band.shape[0], band.shape[1], 0
    for run in range(len(starts) - 1):
        run_gram(
            rows, starts[run], starts[run + 1], bases[run], chain, order, size, lines, lined, gram, moved
        )
        for a in range(width - 1):
            i = columns[run, a]
            if i < 0:
                continue
            right[i] += gram[a, width - 1]
            for b in range(width - 1):
                j = columns[run, b]
                if j < 0 or j > i:
                    continue
                if i < n:
                    if i - j < reach:
                        band[j, i - j] += gram[a, b]
                    elif gram[a, b] != 0.0:
                        outside += 1
                elif j < n:
                    border[j, i - n] += gram[a, b]
                else:
                    corner[i - n, j - n] += gram[a, b]
    return outside


def to_blocks(rows, starts, bases, chain, order, size, columns, blocks, right):
    """The same for a sparse matrix: `blocks[run]` (W - 1, W - 1) of `J^T J`, and `right` as above."""
    width = rows.shape[2]
    lines, lined, gram, moved = workspace(width, rows)
    for run in range(len(starts) - 1):
        run_gram(
            rows, starts[run], starts[run + 1], bases[run], chain, order, size, lines, lined, gram, moved
        )
        for a in range(width - 1):
            for b in range(width - 1):
                blocks[run, a, b] = gram[a, b]
            if columns[run, a] >= 0:
                right[columns[run, a]] += gram[a, width - 1]


def to_each_point(rows, base, chain, start, order, size, out):
    """Rows (N, R, k D) of Jacobians in local coordinates to `out` (N, k, R, D), of control points.

    Args:
        chain: (M, 2, D, D) of the logarithms; start: (M, D, D), how a control point itself counts.
    """
    for n in range(rows.shape[0]):
        for j in range(order):
            own = start[base[n]] if j == 0 else chain[base[n] + j - 1, 1]
            after = chain[base[n] + min(j, order - 2), 0]
            for r in range(rows.shape[1]):
                here = rows[n, r, j * size :]
                then = rows[n, r, min(j + 1, order - 1) * size :]
                line = out[n, j, r]
                for c in range(size):
                    total = 0.0
                    for e in range(size):
                        total += here[e] * own[e, c]
                    if j < order - 1:
                        for e in range(size):
                            total += then[e] * after[e, c]
                    line[c] = total


_R, _I = "float64[:, :, ::1]", "int64[:, ::1]"
_C = "float64[:, :, :, ::1]"
_COMMON = f"{_R}, int64[::1], {_I}, {_C}, int64, int64, {_I}"
_SIGNATURES = {
    "to_band": f"int64({_COMMON}, float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[::1])",
    "to_blocks": f"void({_COMMON}, {_R}, float64[::1])",
    "to_each_point": f"void({_R}, int64[::1], {_C}, {_R}, int64, int64, {_C})",
}


@cache
def fast(loop: Callable) -> Callable:
    """The compiled form of one of the loops above."""
    name = loop.__name__
    helpers = [HELPER + inspect.getsource(f) for f in (outer_products, to_points, workspace, run_gram)]
    source = HEADER.replace("{DEPTH}", str(DEPTH)).replace("{FEW}", str(FEW)) + "\n\n".join(
        [*helpers, ENTRY + inspect.getsource(loop)]
    )
    return compiled(name, source, _SIGNATURES[name])


def add_to_band(fused: bool, *arguments: Array | int) -> int:
    """`to_band`, compiled if `fused`, else on whole arrays."""
    return (fast(to_band) if fused else _to_band)(*arguments)


def add_to_blocks(fused: bool, *arguments: Array | int) -> None:
    """`to_blocks`, compiled if `fused`, else on whole arrays."""
    (fast(to_blocks) if fused else _to_blocks)(*arguments)


# ---------------------------------------------------------------------- the reference


def _grams(rows, starts, bases, chain, order, size):
    """The Gram matrices (runs, W, W) of all runs, in control points."""
    grams = np.add.reduceat(np.einsum("nra,nrb->nab", rows, rows), starts[:-1])
    local = np.broadcast_to(np.eye(grams.shape[1]), grams.shape).copy()
    for s in range(bases.shape[1]):
        for j in range(1, order):
            here, before = ((s * order + i) * size for i in (j, j - 1))
            pair = chain[bases[:, s] + j - 1]
            local[:, here : here + size, before : before + size] = pair[:, 0]
            local[:, here : here + size, here : here + size] = pair[:, 1]
    return local.transpose(0, 2, 1) @ grams @ local


def _to_band(rows, starts, bases, chain, order, size, columns, band, border, corner, right):
    if len(rows) == 0:
        return 0
    grams, n, count = _grams(rows, starts, bases, chain, order, size), len(band), columns.shape[1]
    there = columns >= 0
    np.add.at(right, columns[there], grams[:, :-1, -1][there])
    i, j = np.repeat(columns, count, axis=1).reshape(-1), np.tile(columns, (1, count)).reshape(-1)
    value = grams[:, :-1, :-1].reshape(-1)
    keep = (j >= 0) & (j <= i)
    i, j, value = i[keep], j[keep], value[keep]
    near = (i < n) & (i - j < band.shape[1])
    np.add.at(band, (j[near], (i - j)[near]), value[near])
    mixed, outer = (i >= n) & (j < n), (i >= n) & (j >= n)
    np.add.at(border, (j[mixed], i[mixed] - n), value[mixed])
    np.add.at(corner, (i[outer] - n, j[outer] - n), value[outer])
    return int(((i < n) & ~near & (value != 0.0)).sum())


def _to_blocks(rows, starts, bases, chain, order, size, columns, blocks, right):
    if len(rows) == 0:
        return
    grams = _grams(rows, starts, bases, chain, order, size)
    blocks[:] = grams[:, :-1, :-1]
    there = columns >= 0
    np.add.at(right, columns[there], grams[:, :-1, -1][there])
