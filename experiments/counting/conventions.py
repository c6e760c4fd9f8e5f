"""Formulas in the order k for what was counted, and the cells of [S20] Table 4 that they agree with or not."""

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import sympy

from counting.matrices import Counts

K = sympy.Symbol("k", positive=True)

#: Kinds of operations, and the multiplications and additions of numbers in one of them for 3x3 matrices.
SCALAR_COST = {"m-m": 9 * (3 + 2), "m-v": 3 * (3 + 2), "add vectors": 3, "add matrices": 9}

BASELINE_1, OURS_1 = "X' baseline", "X' ours"
BASELINE_2, ANY_2, SO3_2 = "X'' baseline", "X'' ours, any L", "X'' ours, SO(3)"


class Cell(NamedTuple):
    """What Table 4 says of one kind of operation: its formula, its number at k = 4, the formula of the text."""

    column: str
    kind: str
    table: str
    at_4: int
    text: str | None = None


TABLE_4 = (
    Cell(BASELINE_1, "m-m", "(k-1)**2 + 1", 10, "(k-1)**2 + 1"),
    Cell(BASELINE_1, "m-v", "0", 0),
    Cell(BASELINE_1, "add", "k-2", 2),
    Cell(OURS_1, "m-m", "1", 1, "1"),
    Cell(OURS_1, "m-v", "k-1", 3, "k-1"),
    Cell(OURS_1, "add", "k-1", 3, "k-1"),
    Cell(BASELINE_2, "m-m", "k**2*(k-1)/2", 24, "k*(k-1) + k*(k-1)*(k-2)/2"),
    Cell(BASELINE_2, "m-v", "0", 0),
    Cell(BASELINE_2, "add", "k**2*(k-1)/2", 24),
    Cell(ANY_2, "m-m", "2*k", 8, "2*k"),
    Cell(ANY_2, "m-v", "k-1", 3, "k-1"),
    Cell(ANY_2, "add", "3*k-2", 10, "3*(k-1) + 1"),
    Cell(SO3_2, "m-m", "2", 2, "2"),
    Cell(SO3_2, "m-v", "2*(k-1)", 6, "3*(k-1)"),
    Cell(SO3_2, "add", "2*k-1", 7, "3*(k-1)"),
)

_KNOWN = "The table takes the velocities as known, from X', and counts what X'' adds to them"
#: Why table or text differ from the count of the formulas as written.
WHY = {
    (BASELINE_2, "m-m"): (
        "(39) is k products for each of k(k-1)/2 terms. It leaves out the product by X_i, which the cell of X' "
        "includes, and computes each A_j' anew in every term; with A_j' shared the count is smaller and still cubic."
    ),
    (BASELINE_2, "add"): (
        "No convention can reach it: T terms take T-1 additions, there are k(k-1)/2 of them, or (k-1)² where the "
        "order of a pair matters, and one addition more for each A_j'', so additions stay quadratic. The cell repeats "
        "the one of the products."
    ),
    (ANY_2, "m-v"): f"{_KNOWN}; so does the text. (34) needs k-1 more.",
    (ANY_2, "add"): (
        f"{_KNOWN}: two additions of vectors and the difference in the bracket for each step, and one sum of "
        "matrices. The text's `3(k-1) vector additions and one matrix addition` is, word for word, the count with "
        "velocities and with that difference free, which disagrees with its k-1 matrix-vector products."
    ),
    (SO3_2, "m-v"): f"{_KNOWN}; the text includes them. A cross product is a matrix-vector product in both.",
    (SO3_2, "add"): f"{_KNOWN}; the text includes them, and mentions no sum of matrices for (40).",
}

_W = ("velocity from zero", "velocity")
_ANY, _SO3 = "recursion, X''", "recursion, X'', SO(3)"
#: By column: what may be counted, as an algorithm and those of its phases that are left out. The first of each
#: column is the formulas as written, with X known where they start from X.
CONVENTIONS: dict[str, dict[str, tuple[str, tuple[str, ...]]]] = {
    BASELINE_1: {
        "as written": ("product rule, X'", ()),
        "product by X_i left out": ("product rule, X'", ("X_i",)),
    },
    OURS_1: {
        "X known": ("recursion, X'", ("X",)),
        "X included": ("recursion, X'", ()),
        "X known, first step, from zero, left out": ("recursion, X'", ("X", "velocity from zero")),
    },
    BASELINE_2: {
        "as written, each term on its own": ("product rule, X''", ()),
        "each term on its own, product by X_i left out": ("product rule, X''", ("X_i",)),
        "A_j' and A_j'' shared": ("product rule, X'', A_j' shared", ()),
        "each ordered pair of factors on its own": ("product rule, X'', ordered pairs", ()),
    },
    ANY_2: {
        "X known": (_ANY, ("X",)),
        "X included": (_ANY, ()),
        "X, velocities known": (_ANY, ("X", *_W)),
        "X known, difference in the bracket free": (_ANY, ("X", "difference in the bracket")),
    },
    SO3_2: {
        "X known": (_SO3, ("X",)),
        "X included": (_SO3, ()),
        "X, velocities known": (_SO3, ("X", *_W)),
        "X known, (40) left out": (_SO3, ("X", "result")),
    },
    "not in the table": {"X' and X'', X included": ("product rule, recursive", ())},
}


def totals(counts: Counts, without: Sequence[str] = ()) -> dict[str, dict[int, int]]:
    """By kind and order: the operations of an algorithm, without some of its phases."""
    sums: dict[str, dict[int, int]] = {kind: {} for kind in (*SCALAR_COST, "add", "scalar")}
    for order, phases in counts.items():
        kept = sum((c for phase, c in phases.items() if phase not in without), Counter())
        for kind in SCALAR_COST:
            sums[kind][order] = kept[kind]
        sums["add"][order] = kept["add vectors"] + kept["add matrices"]
        sums["scalar"][order] = sum(cost * kept[kind] for kind, cost in SCALAR_COST.items())
    return sums


def closed_form(counts: dict[int, int]) -> sympy.Expr:
    """The polynomial in k that the counts follow; needs more orders than the polynomial has coefficients."""
    polynomial = sympy.interpolate(list(counts.items()), K)
    if sympy.degree(polynomial, K) > len(counts) - 2:
        raise AssertionError(f"no polynomial of low degree explains {counts}: more orders are needed")
    candidates = (sympy.factor(polynomial - rest) + rest for rest in (0, 1))
    return min(candidates, key=sympy.count_ops)


def follows(formula: str | None, counts: dict[int, int]) -> bool:
    return formula is not None and all(sympy.sympify(formula).subs("k", k) == n for k, n in counts.items())


def compare(counts: dict[str, Counts]) -> list[dict[str, Any]]:
    """Every cell of Table 4 against what was counted, and the conventions that explain the table and the text."""
    cells = []
    for cell in TABLE_4:
        conventions = CONVENTIONS[cell.column].items()
        found = {name: totals(counts[by], without)[cell.kind] for name, (by, without) in conventions}
        as_written = next(iter(found.values()))
        comparison = {
            "why": WHY.get((cell.column, cell.kind), ""),
            "counted": as_written,
            "counted_form": str(closed_form(as_written)),
            "table_agrees": follows(cell.table, as_written),
            "text_agrees": None if cell.text is None else follows(cell.text, as_written),
            "table_by": [name for name, c in found.items() if follows(cell.table, c)],
            "text_by": [name for name, c in found.items() if follows(cell.text, c)],
        }
        cells.append(cell._asdict() | comparison)
    return cells


def differs(cell: dict[str, Any]) -> bool:
    return not cell["table_agrees"] or cell["text_agrees"] is False
