"""Counts the operations of spline derivatives: [S20] Table 4, and the component arithmetic of this library.

The product rule of earlier work ([S20] (30)-(32)) and the recursion ([S20] Theorems 5.2, 5.3, (46)) run on
matrices that count what is done to them; what they compute is checked against finite differences, so the counts
are those of programs that work. As in the paper, scaling by a scalar, hat, vee, transposes, inverses, exponentials
and adjoint matrices are free, and so are `d_j` and the weights. Then the recurrences of
`torchspline.arithmetic` run on counting scalars.
"""

import functools
import itertools
import math
import operator
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import sympy
from common import Table, run, save, show
from matplotlib.figure import Figure
from scipy.interpolate import BSpline
from scipy.linalg import expm

from torchspline.arithmetic import recurrence, scalar
from torchspline.arithmetic.registry import arithmetic

K = sympy.Symbol("k", positive=True)

# ----------------------------------------------------------------------------------------- counting matrices


#: Kinds of operations, and the multiplications and additions of numbers in one of them for 3x3 matrices.
SCALAR_COST = {"m-m": 9 * (3 + 2), "m-v": 3 * (3 + 2), "add vectors": 3, "add matrices": 9}


class Ledger:
    """How many operations of each kind were made in each phase of an algorithm."""

    def __init__(self) -> None:
        self.counts: dict[str, Counter[str]] = {}
        self._phase = ""

    @contextmanager
    def during(self, phase: str) -> Iterator[None]:
        outer, self._phase = self._phase, phase
        self.counts.setdefault(phase, Counter())
        yield
        self._phase = outer

    def record(self, kind: str) -> None:
        self.counts[self._phase][kind] += 1


class Counted:
    """A matrix or vector which enters products, sums and differences into a ledger; scaling is free."""

    def __init__(self, array: np.ndarray, ledger: Ledger):
        self.array, self.ledger = array, ledger

    def _new(self, array: np.ndarray) -> "Counted":
        return Counted(array, self.ledger)

    def __matmul__(self, other: "Counted") -> "Counted":
        self.ledger.record("m-m" if other.array.ndim == 2 else "m-v")
        return self._new(self.array @ other.array)

    def _sum(self, array: np.ndarray) -> "Counted":
        self.ledger.record("add matrices" if array.ndim == 2 else "add vectors")
        return self._new(array)

    def __add__(self, other: "Counted") -> "Counted":
        return self._sum(self.array + other.array)

    def __sub__(self, other: "Counted") -> "Counted":
        return self._sum(self.array - other.array)

    def __rmul__(self, factor: float) -> "Counted":
        return self._new(factor * self.array)


# ------------------------------------------------------------------------------------- matrix groups, splines


def skew(w: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def unskew(W: np.ndarray) -> np.ndarray:
    return np.array([W[2, 1], W[0, 2], W[1, 0]])


class SO3Matrices:
    tangent_size = 3
    hat = staticmethod(skew)
    vee = staticmethod(unskew)

    @staticmethod
    def adjoint_inverse(A: np.ndarray) -> np.ndarray:
        return A.T


class SE3Matrices:
    tangent_size = 6

    @staticmethod
    def hat(v: np.ndarray) -> np.ndarray:
        return np.block([[skew(v[3:]), v[:3, None]], [np.zeros((1, 4))]])

    @staticmethod
    def vee(V: np.ndarray) -> np.ndarray:
        return np.concatenate([V[:3, 3], unskew(V[:3, :3])])

    @staticmethod
    def adjoint_inverse(A: np.ndarray) -> np.ndarray:
        R = A[:3, :3]
        return np.block([[R.T, -R.T @ skew(A[:3, 3])], [np.zeros((3, 3)), R.T]])


MATRIX_GROUPS = {"SO3": SO3Matrices, "SE3": SE3Matrices}


class Segment:
    """One segment of a spline of order k with random control points: X_i, d_1 ... d_(k-1) and the weights."""

    def __init__(self, group: str, order: int, seed: int):
        random = np.random.default_rng(seed)
        self.group = MATRIX_GROUPS[group]
        self.start = expm(self.group.hat(random.normal(size=self.group.tangent_size)))
        self.d = random.normal(size=(order - 1, self.group.tangent_size))
        cumulative = np.tril(np.ones((order, order)))
        self._weights = BSpline(np.arange(1 - order, order + 1), cumulative, order - 1)

    def weights(self, u: float) -> np.ndarray:
        """lambda_1 ... lambda_(k-1), [S20] (21), and their derivatives: one row each."""
        return np.array([self._weights(u, nu)[1:] for nu in range(3)])

    def factors(self, u: float) -> list[np.ndarray]:
        """A_1 ... A_(k-1), [S20] (25)."""
        return [expm(l * self.group.hat(d)) for l, d in zip(self.weights(u)[0], self.d, strict=True)]

    def value(self, u: float) -> np.ndarray:
        """X(u), [S20] (26)."""
        return functools.reduce(operator.matmul, self.factors(u), self.start)

    def finite_differences(self, u: float, h: float = 2e-3) -> tuple[np.ndarray, np.ndarray]:
        """First and second derivative of `value`, by central differences of order six."""
        first = np.array([-1, 9, -45, 0, 45, -9, 1]) / (60 * h)
        second = np.array([2, -27, 270, -490, 270, -27, 2]) / (180 * h**2)
        values = np.array([self.value(u + i * h) for i in range(-3, 4)])
        return np.tensordot(first, values, 1), np.tensordot(second, values, 1)


class Counting:
    """A segment at u, in counted matrices."""

    def __init__(self, segment: Segment, u: float):
        self.ledger = Ledger()
        self.during = self.ledger.during
        self.group = segment.group
        self.l = segment.weights(u)
        self.start = self._counted(segment.start)
        self.d = [self._counted(d) for d in segment.d]
        self.D = [self.hat(d) for d in self.d]
        self.A = [self._counted(A) for A in segment.factors(u)]
        self.adjoint = [self._counted(self.group.adjoint_inverse(A.array)) for A in self.A]
        self.steps = range(len(self.d))

    def _counted(self, array: np.ndarray) -> Counted:
        return Counted(array, self.ledger)

    def hat(self, v: Counted) -> Counted:
        return self._counted(self.group.hat(v.array))

    def vee(self, V: Counted) -> Counted:
        return self._counted(self.group.vee(V.array))

    def zero(self) -> Counted:
        return self._counted(np.zeros(self.group.tangent_size))


# ------------------------------------------------------------------------------------------------ algorithms


def _product(factors: Sequence[Counted]) -> Counted:
    return functools.reduce(operator.matmul, factors)


def product_rule_first(s: Counting) -> Counted:
    """X', [S20] (30), (31)."""
    terms = []
    for j in s.steps:
        with s.during("rates"):
            rate = s.l[1, j] * (s.A[j] @ s.D[j])
        with s.during("terms"):
            terms.append(_product([*s.A[:j], rate, *s.A[j + 1 :]]))
    return _times_start(s, terms)


def product_rule_second(s: Counting, shared: bool = False, ordered: bool = False) -> Counted:
    """X'', the product rule applied to [S20] (30): a term for each pair of factors and for each factor.

    Args:
        shared: A_j D_j and the derivatives of A_j are computed once, not in every term again.
        ordered: a term for (j, l) and another one for (l, j), instead of twice the same term.
    """

    def once(f: Callable[[int], Counted]) -> Callable[[int], Counted]:
        return functools.cache(f) if shared else f

    @once
    def moved(j: int) -> Counted:
        with s.during("rates"):
            return s.A[j] @ s.D[j]

    @once
    def second(j: int) -> Counted:
        AD = moved(j)
        with s.during("rates"):
            return s.l[1, j] ** 2 * (AD @ s.D[j]) + s.l[2, j] * AD

    def replaced(new: dict[int, Counted]) -> Counted:
        with s.during("terms"):
            return _product([new.get(i, A) for i, A in enumerate(s.A)])

    terms = [replaced({j: second(j)}) for j in s.steps]
    for j in s.steps:
        for m in s.steps:
            if m != j if ordered else m > j:
                pair = {i: s.l[1, i] * moved(i) for i in (j, m)}
                terms.append((1.0 if ordered else 2.0) * replaced(pair))
    return _times_start(s, terms)


def _times_start(s: Counting, terms: Sequence[Counted]) -> Counted:
    with s.during("sum"):
        total = functools.reduce(operator.add, terms)
    with s.during("X_i"):
        return s.start @ total


def product_rule_recursive(s: Counting) -> tuple[Counted, Counted]:
    """X' and X'' by the product rule applied to X^(j) = X^(j-1) A_j, [S20] (28): linear without any theory."""
    X, X1, X2 = s.start, 0.0 * s.start, 0.0 * s.start
    for j in s.steps:
        with s.during("rates"):
            AD = s.A[j] @ s.D[j]
            A1, A2 = s.l[1, j] * AD, s.l[1, j] ** 2 * (AD @ s.D[j]) + s.l[2, j] * AD
        with s.during("steps"):
            X2 = X2 @ s.A[j] + 2.0 * (X1 @ A1) + X @ A2
            X1 = X1 @ s.A[j] + X @ A1
        with s.during("X"):
            X = X @ s.A[j]
    return X1, X2


def velocities(s: Counting) -> list[Counted]:
    """omega^(2) ... omega^(k), [S20] (34)."""
    w, found = s.zero(), []
    for j in s.steps:
        with s.during("velocity" if j else "velocity from zero"):
            w = s.adjoint[j] @ w + s.l[1, j] * s.d[j]
        found.append(w)
    return found


def value(s: Counting) -> Counted:
    """X, [S20] (26)."""
    with s.during("X"):
        return _product([s.start, *s.A])


def recursion_first(s: Counting) -> Counted:
    """X', [S20] Theorem 5.2."""
    X, w = value(s), velocities(s)[-1]
    with s.during("result"):
        return X @ s.hat(w)


def recursion_second(s: Counting, cross: bool = False) -> Counted:
    """X'', [S20] Theorem 5.3; with `cross` the bracket is a cross product, (46), a matrix-vector product w^ d."""
    X, ws, a = value(s), velocities(s), s.zero()
    for j, w in enumerate(ws):
        with s.during("bracket"):
            bracket = s.hat(w) @ s.d[j] if cross else _commutator(s, s.hat(w), s.D[j])
        with s.during("acceleration"):
            a = s.l[1, j] * bracket + s.adjoint[j] @ a + s.l[2, j] * s.d[j]
    with s.during("result"):
        W = s.hat(ws[-1])
        return X @ (W @ W + s.hat(a))


def _commutator(s: Counting, V: Counted, W: Counted) -> Counted:
    """(V W - W V)_v; corrects [S20] (6)."""
    VW, WV = V @ W, W @ V
    with s.during("difference in the bracket"):
        return s.vee(VW - WV)


class Algorithm(NamedTuple):
    run: Callable[[Counting], Counted | tuple[Counted, Counted]]
    derivatives: tuple[int, ...]
    groups: tuple[str, ...] = ("SO3", "SE3")


ALGORITHMS = {
    "product rule, X'": Algorithm(product_rule_first, (1,)),
    "product rule, X''": Algorithm(product_rule_second, (2,)),
    "product rule, X'', A_j' shared": Algorithm(partial(product_rule_second, shared=True), (2,)),
    "product rule, X'', ordered pairs": Algorithm(partial(product_rule_second, ordered=True), (2,)),
    "product rule, recursive": Algorithm(product_rule_recursive, (1, 2)),
    "recursion, X'": Algorithm(recursion_first, (1,)),
    "recursion, X''": Algorithm(recursion_second, (2,)),
    "recursion, X'', SO(3)": Algorithm(partial(recursion_second, cross=True), (2,), ("SO3",)),
}

Counts = dict[int, dict[str, Counter[str]]]  # order, phase, kind


def count_matrices(orders: Sequence[int], u: float, seed: int) -> tuple[dict[str, Counts], float]:
    """Counts of every algorithm at every order, the same for every group; largest error against differences."""
    counts: dict[str, Counts] = {name: {} for name in ALGORITHMS}
    worst = 0.0
    for group, order in itertools.product(MATRIX_GROUPS, orders):
        segment = Segment(group, order, seed)
        expected = segment.finite_differences(u)
        for name, algorithm in ALGORITHMS.items():
            if group not in algorithm.groups:
                continue
            s = Counting(segment, u)
            result = algorithm.run(s)
            results = result if isinstance(result, tuple) else (result,)
            for r, found in zip(algorithm.derivatives, results, strict=True):
                error = np.abs(found.array - expected[r - 1]).max()
                worst = max(worst, float(error / (1.0 + np.abs(expected[r - 1]).max())))
            if counts[name].setdefault(order, s.ledger.counts) != s.ledger.counts:
                raise AssertionError(f"{name}: the count depends on the group")
    if worst > 1e-8:
        raise AssertionError(f"derivatives differ from finite differences by {worst:.1e}")
    return counts, worst


# -------------------------------------------------------------------------------------------- [S20] Table 4


class Cell(NamedTuple):
    """What Table 4 says of one kind of operation: its formula, its number at k = 4, the formula of the text."""

    column: str
    kind: str
    table: str
    at_4: int
    text: str | None = None
    why: str = ""  # it differs from the count of the formulas as written


BASELINE_1, OURS_1 = "X' baseline", "X' ours"
BASELINE_2, ANY_2, SO3_2 = "X'' baseline", "X'' ours, any L", "X'' ours, SO(3)"
_KNOWN = "The table takes the velocities as known, from X', and counts what X'' adds to them"
TABLE_4 = (
    Cell(BASELINE_1, "m-m", "(k-1)**2 + 1", 10, "(k-1)**2 + 1"),
    Cell(BASELINE_1, "m-v", "0", 0),
    Cell(BASELINE_1, "add", "k-2", 2),
    Cell(OURS_1, "m-m", "1", 1, "1"),
    Cell(OURS_1, "m-v", "k-1", 3, "k-1"),
    Cell(OURS_1, "add", "k-1", 3, "k-1"),
    Cell(
        *(BASELINE_2, "m-m", "k**2*(k-1)/2", 24, "k*(k-1) + k*(k-1)*(k-2)/2"),
        why="(39) is k products for each of k(k-1)/2 terms. It leaves out the product by X_i, which the cell of X' "
        "includes, and computes each A_j' anew in every term; with A_j' shared the count is smaller and still cubic.",
    ),
    Cell(BASELINE_2, "m-v", "0", 0),
    Cell(
        *(BASELINE_2, "add", "k**2*(k-1)/2", 24),
        why="No convention can reach it: T terms take T-1 additions, there are k(k-1)/2 of them, or (k-1)² where the "
        "order of a pair matters, and one addition more for each A_j'', so additions stay quadratic. The cell repeats "
        "the one of the products.",
    ),
    Cell(ANY_2, "m-m", "2*k", 8, "2*k"),
    Cell(ANY_2, "m-v", "k-1", 3, "k-1", f"{_KNOWN}; so does the text. (34) needs k-1 more."),
    Cell(
        *(ANY_2, "add", "3*k-2", 10, "3*(k-1) + 1"),
        why=f"{_KNOWN}: two additions of vectors and the difference in the bracket for each step, and one sum of "
        "matrices. The text's `3(k-1) vector additions and one matrix addition` is, word for word, the count with "
        "velocities and with that difference free, which disagrees with its k-1 matrix-vector products.",
    ),
    Cell(SO3_2, "m-m", "2", 2, "2"),
    Cell(
        *(SO3_2, "m-v", "2*(k-1)", 6, "3*(k-1)"),
        why=f"{_KNOWN}; the text includes them. A cross product is a matrix-vector product in both.",
    ),
    Cell(
        *(SO3_2, "add", "2*k-1", 7, "3*(k-1)"),
        why=f"{_KNOWN}; the text includes them, and mentions no sum of matrices for (40).",
    ),
)


class Convention(NamedTuple):
    """What is counted: an algorithm without some of its phases."""

    name: str
    algorithm: str
    without: tuple[str, ...] = ()


_W = ("velocity from zero", "velocity")
#: The first convention of each column is the formulas as written, with X known where they start from X.
CONVENTIONS = {
    BASELINE_1: (
        Convention("as written", "product rule, X'"),
        Convention("product by X_i left out", "product rule, X'", ("X_i",)),
    ),
    OURS_1: (
        Convention("X known", "recursion, X'", ("X",)),
        Convention("X included", "recursion, X'"),
        Convention("X known, first step, from zero, left out", "recursion, X'", ("X", "velocity from zero")),
    ),
    BASELINE_2: (
        Convention("as written, each term on its own", "product rule, X''"),
        Convention("each term on its own, product by X_i left out", "product rule, X''", ("X_i",)),
        Convention("A_j' and A_j'' shared", "product rule, X'', A_j' shared"),
        Convention("each ordered pair of factors on its own", "product rule, X'', ordered pairs"),
    ),
    ANY_2: (
        Convention("X known", "recursion, X''", ("X",)),
        Convention("X included", "recursion, X''"),
        Convention("X, velocities known", "recursion, X''", ("X", *_W)),
        Convention(
            "X known, difference in the bracket free", "recursion, X''", ("X", "difference in the bracket")
        ),
    ),
    SO3_2: (
        Convention("X known", "recursion, X'', SO(3)", ("X",)),
        Convention("X included", "recursion, X'', SO(3)"),
        Convention("X, velocities known", "recursion, X'', SO(3)", ("X", *_W)),
        Convention("X known, (40) left out", "recursion, X'', SO(3)", ("X", "result")),
    ),
    "not in the table": (Convention("X' and X'', X included", "product rule, recursive"),),
}


def closed_form(counts: dict[int, int]) -> sympy.Expr:
    """The polynomial in k that the counts follow; needs more orders than the polynomial has coefficients."""
    polynomial = sympy.interpolate(list(counts.items()), K)
    if sympy.degree(polynomial, K) > len(counts) - 2:
        raise AssertionError(f"no polynomial of low degree explains {counts}: more orders are needed")
    candidates = (sympy.factor(polynomial - rest) + rest for rest in (0, 1))
    return min(candidates, key=sympy.count_ops)


def pretty(formula: object) -> str:
    text = "-" if formula is None else str(formula)
    return text.replace("**2", "²").replace("**3", "³").replace("*", "").replace(" ", "")


def totals(convention: Convention, counts: dict[str, Counts]) -> dict[str, dict[int, int]]:
    """By kind and order: the operations that a convention counts."""
    sums: dict[str, dict[int, int]] = {kind: {} for kind in (*SCALAR_COST, "add", "scalar")}
    for order, phases in counts[convention.algorithm].items():
        kept = sum((c for phase, c in phases.items() if phase not in convention.without), Counter())
        for kind in SCALAR_COST:
            sums[kind][order] = kept[kind]
        sums["add"][order] = kept["add vectors"] + kept["add matrices"]
        sums["scalar"][order] = sum(cost * kept[kind] for kind, cost in SCALAR_COST.items())
    return sums


def follows(formula: str | None, counts: dict[int, int]) -> bool:
    return formula is not None and all(sympy.sympify(formula).subs("k", k) == n for k, n in counts.items())


def compare(counts: dict[str, Counts]) -> list[dict[str, Any]]:
    """Every cell of Table 4 against what was counted, and the conventions that explain the table and the text."""
    cells = []
    for cell in TABLE_4:
        found = {c.name: totals(c, counts)[cell.kind] for c in CONVENTIONS[cell.column]}
        counted = next(iter(found.values()))
        found_cell = {
            "counted": counted,
            "counted_form": str(closed_form(counted)),
            "table_agrees": follows(cell.table, counted),
            "text_agrees": None if cell.text is None else follows(cell.text, counted),
            "table_by": [name for name, c in found.items() if follows(cell.table, c)],
            "text_by": [name for name, c in found.items() if follows(cell.text, c)],
        }
        cells.append(cell._asdict() | found_cell)
    return cells


def differs(cell: dict[str, Any]) -> bool:
    return not cell["table_agrees"] or cell["text_agrees"] is False


def matrix_tables(counts: dict[str, Counts], cells: list[dict[str, Any]]) -> list[Table]:
    def formulas(c: dict[str, Any]) -> list[str]:
        return [c["column"], c["kind"], *(pretty(c[name]) for name in ("table", "text", "counted_form"))]

    def names(c: dict[str, Any], by: str) -> str:
        return "any" if len(c[by]) == len(CONVENTIONS[c["column"]]) else "; ".join(c[by])

    comparison, disagreements, forms = [], [], []
    for c in cells:
        at_4 = (c["at_4"], c["counted"].get(4, "-"))
        agrees = "yes" if c["table_agrees"] else "NO"
        comparison.append((*formulas(c), *at_4, agrees, names(c, "table_by") or "none"))
        if differs(c):
            disagreements.append((*formulas(c), names(c, "text_by") or "-", c["why"]))
    for convention in itertools.chain(*CONVENTIONS.values()):
        found = totals(convention, counts).values()
        forms.append((convention.algorithm, convention.name, *(pretty(closed_form(c)) for c in found)))
    heading = ("column", "kind", "table", "text", "counted")
    return [
        Table(
            "[S20] Table 4 and what was counted",
            (*heading, "table, k=4", "counted, k=4", "same", "the table counts"),
            comparison,
        ),
        Table("Where table, text and count differ", (*heading, "the text counts", "why"), disagreements),
        Table(
            "All that was counted ('scalar': for 3x3 matrices, without exponentials)",
            ("algorithm", "what counts", *SCALAR_COST, "all additions", "scalar"),
            forms,
        ),
    ]


# ------------------------------------------------------------------------------------ component arithmetic

SCALAR_KINDS = ("multiply", "add", "negate", "divide", "select", "sqrt", "sin", "cos")


class CountingScalar:
    """A number that counts what is done to it; subtractions are additions, comparisons are free."""

    def __init__(self, value: float, counts: Counter[str]):
        self.value, self.counts = value, counts

    def made(self, kind: str, value: float) -> "CountingScalar":
        self.counts[kind] += 1
        return CountingScalar(value, self.counts)

    def __neg__(self) -> "CountingScalar":
        return self.made("negate", -self.value)

    def __gt__(self, other: Any) -> bool:
        return self.value > _value(other)


def _value(x: Any) -> float:
    return x.value if isinstance(x, CountingScalar) else x


def _count_operator(name: str, kind: str) -> None:
    operation = getattr(operator, name)

    def direct(self: CountingScalar, other: Any) -> CountingScalar:
        return self.made(kind, operation(self.value, _value(other)))

    def reflected(self: CountingScalar, other: Any) -> CountingScalar:
        return self.made(kind, operation(other, self.value))

    setattr(CountingScalar, f"__{name}__", direct)
    setattr(CountingScalar, f"__r{name}__", reflected)


def _select(condition: bool, yes: Any, no: Any) -> CountingScalar:
    counting = yes if isinstance(yes, CountingScalar) else no
    return counting.made("select", _value(yes if condition else no))


def _counting_function(name: str) -> Callable[[CountingScalar], CountingScalar]:
    return lambda x: x.made(name, getattr(math, name)(x.value))


for _name, _kind in {"add": "add", "sub": "add", "mul": "multiply", "truediv": "divide"}.items():
    _count_operator(_name, _kind)

_COUNTING = SimpleNamespace(
    where=_select,
    **{name: _counting_function(name) for name in ("sqrt", "sin", "cos")},
)
scalar.namespace.register(CountingScalar, lambda x: _COUNTING)


def sweeps(
    name: str, order: int, derivatives: int, short: bool, seed: int, number: Callable[[float], Any]
) -> Iterator[list[Any]]:
    """All that the forward sweep of a random product finds, and then all that the reverse sweep finds."""
    group, random = arithmetic(name), np.random.default_rng(seed)
    start = group.exp(tuple(random.normal(size=group.tangent_size).tolist()))
    shapes = (
        (order - 1, group.tangent_size),
        (derivatives + 1, order - 1),
        (derivatives + 1, group.tangent_size),
    )
    d, l, g = ([tuple(map(number, row)) for row in random.uniform(-1, 1, shape).tolist()] for shape in shapes)
    value, trace = recurrence.forward(group, tuple(map(number, start)), d, l, derivatives, short)
    yield [*value, *itertools.chain(*trace[-1].rates)]
    start_g, steps_g, weights_g = recurrence.reverse(group, d, l, trace, g[0], g[1:], short)
    yield [*start_g, *itertools.chain(*steps_g, *weights_g)]


def count_components(
    name: str, order: int, derivatives: int, short: bool, seed: int
) -> dict[str, Counter[str]]:
    """Operations of the forward and of the reverse sweep, which find what they find on plain floats."""
    counts: Counter[str] = Counter()
    by_sweep = {}
    counting = sweeps(name, order, derivatives, short, seed, lambda x: CountingScalar(x, counts))
    plain = sweeps(name, order, derivatives, short, seed, float)
    for sweep, found, expected in zip(("forward", "reverse"), counting, plain, strict=True):
        by_sweep[sweep] = Counter(counts)
        counts.clear()
        if [_value(x) for x in found] != expected:
            raise AssertionError(f"{name}, order {order}, {sweep}: counting changes the result")
    return by_sweep


def scalar_rows(
    groups: Sequence[str], orders: Sequence[int], derivatives: Sequence[int], short: bool, seed: int
) -> list[dict[str, Any]]:
    """Operations by kind and order, for every group, number of derivatives and sweep; all linear in k."""
    rows = []
    for name, r in itertools.product(groups, derivatives):
        counted = {order: count_components(name, order, r, short, seed) for order in orders}
        for sweep in ("forward", "reverse"):
            counts = {kind: {order: c[sweep][kind] for order, c in counted.items()} for kind in SCALAR_KINDS}
            counts["all"] = {order: c[sweep].total() for order, c in counted.items()}
            forms = {kind: sympy.expand(closed_form(c)) for kind, c in counts.items()}
            if any(sympy.degree(form, K) > 1 for form in forms.values()):
                raise AssertionError(f"{name}, {r} derivatives, {sweep}: not linear in k: {forms}")
            formulas = {kind: str(form) for kind, form in forms.items()}
            key = {"group": name, "derivatives": r, "sweep": sweep}
            rows.append(key | {"counts": counts, "forms": formulas})
    return rows


def scalar_table(rows: list[dict[str, Any]], order: int) -> Table:
    kinds = [kind for kind in SCALAR_KINDS if any(any(r["counts"][kind].values()) for r in rows)]
    cells = []
    for r in rows:
        numbers = (r["counts"][kind][order] for kind in (*kinds, "all"))
        cells.append((r["group"], r["derivatives"], r["sweep"], *numbers, pretty(r["forms"]["all"])))
    header = ("group", "derivatives", "sweep", *kinds, "all", "all, any k")
    return Table(
        f"Scalar operations of the component arithmetic, k = {order} (reverse: beyond the forward sweep)",
        header,
        cells,
    )


# -------------------------------------------------------------------------------------------------- figure

STYLES = {
    "product rule, X''": "C3o-",
    "product rule, X'": "C1s-",
    "product rule, recursive": "C4v--",
    "recursion, X''": "C0o-",
    "recursion, X'', SO(3)": "C9^-",
    "recursion, X'": "C2s-",
}


def draw(counts: dict[str, Counts], rows: list[dict[str, Any]]) -> Figure:
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, style in STYLES.items():
        scalars = totals(Convention("all", name), counts)["scalar"]
        left.plot(list(scalars), list(scalars.values()), style[2:], color=style[:2], label=name)
    left.set(title="SO(3) as 3x3 matrices (recursion: with X)", ylabel="scalar operations")

    derivatives = min(2, max(r["derivatives"] for r in rows))
    chosen = [r for r in rows if r["derivatives"] == derivatives]
    groups = list(dict.fromkeys(r["group"] for r in chosen))
    for r in chosen:
        scalars, color = r["counts"]["all"], f"C{groups.index(r['group'])}"
        style = {"forward": "o-", "reverse": "s--"}[r["sweep"]]
        label = f"{r['group']}, {r['sweep']}"
        right.plot(list(scalars), list(scalars.values()), style, color=color, label=label)
    right.set(title=f"Component arithmetic, {derivatives} derivatives", ylabel="scalar operations")
    for axes in (left, right):
        axes.set(xlabel="order k of the spline", yscale="log", xticks=sorted(scalars))
        axes.grid(True, which="both", alpha=0.25)
        axes.legend(
            fontsize=8, loc="upper left" if axes is left else "lower right", ncols=1 + (axes is right)
        )
    return figure


def experiment(
    out: Path, orders: list[int], groups: list[str], derivatives: list[int], short: bool, u: float, seed: int
) -> dict[str, Any]:
    """Counts matrix operations ([S20] Table 4) and scalar operations of spline derivatives, by order.

    Args:
        orders: orders k of the splines, five or more, so that a cubic count shows as one.
        groups: groups whose component arithmetic is counted.
        derivatives: numbers of derivatives, 0 to 3.
        short: whether steps promise a rotation of at most pi, as those of B-splines do.
        u: where in the segment the derivatives are taken, inside (0, 1).
        seed: of the random control points.
    """
    counts, worst = count_matrices(orders, u, seed)
    cells = compare(counts)
    rows = scalar_rows(groups, orders, derivatives, short, seed)
    show(out, [*matrix_tables(counts, cells), scalar_table(rows, 4 if 4 in orders else orders[0])])
    print(f"largest relative difference between the derivatives and finite differences: {worst:.1e}")
    save(draw(counts, rows), out / "complexity.png")
    return {
        "table_4": cells,
        "disagreements": [f"{c['column']}, {c['kind']}" for c in cells if differs(c)],
        "matrix_operations": counts,
        "scalar_operations": rows,
        "largest_difference": worst,
    }


if __name__ == "__main__":
    run(experiment, smoke={"orders": [2, 3, 4, 5, 6], "groups": ["SO3", "R3"], "derivatives": [0, 2]})
