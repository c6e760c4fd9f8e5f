"""Derivatives of splines computed with matrices that count what is done to them.

The product rule of earlier work ([S20] (30)-(32)) and the recursion ([S20] Theorems 5.2, 5.3, (46)); what they
compute is checked against finite differences, so the counts are those of programs that work. As in the paper,
scaling by a scalar, hat, vee, transposes, inverses, exponentials and adjoint matrices are free, and so are `d_j`
and the weights.
"""

import itertools
import operator
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache, partial, reduce

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import expm

Counts = dict[int, dict[str, Counter[str]]]  # by order, phase and kind


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

    def __matmul__(self, other: "Counted") -> "Counted":
        self.ledger.record("m-m" if other.array.ndim == 2 else "m-v")
        return Counted(self.array @ other.array, self.ledger)

    def __add__(self, other: "Counted") -> "Counted":
        self.ledger.record("add matrices" if self.array.ndim == 2 else "add vectors")
        return Counted(self.array + other.array, self.ledger)

    def __sub__(self, other: "Counted") -> "Counted":
        return self + -1.0 * other

    def __rmul__(self, factor: float) -> "Counted":
        return Counted(factor * self.array, self.ledger)


SO3 = np.cross(np.eye(3), np.eye(3)[:, None])  # SO3[i] @ x is the cross product of the i-th axis and x
SE3 = np.zeros((6, 4, 4))
SE3[[0, 1, 2], [0, 1, 2], 3] = 1.0
SE3[3:, :3, :3] = SO3

#: The generators of each group, orthogonal to each other.
GENERATORS = {"SO3": SO3, "SE3": SE3}


class Segment:
    """A segment of a spline of order k with random control points, at u: X_i, d_j, D_j = hat(d_j), A_j, weights."""

    def __init__(self, group: str, order: int, u: float, seed: int):
        self.ledger = Ledger()
        self.during = self.ledger.during
        self._counted = partial(Counted, ledger=self.ledger)
        self._generators = GENERATORS[group]
        self._dual = self._generators / np.square(self._generators).sum((1, 2), keepdims=True)

        random = np.random.default_rng(seed)
        start, *self.d = map(self._counted, random.normal(size=(order, len(self._generators))))
        cumulative = BSpline(np.arange(1 - order, order + 1), np.tril(np.ones((order, order))), order - 1)
        #: lambda_1 ... lambda_(k-1), [S20] (21), and their derivatives: one row each.
        # Not asked above the degree: SciPy 1.11 writes where it must not then.
        self.l = np.array([cumulative(u, nu)[1:] if nu < order else np.zeros(order - 1) for nu in range(3)])
        self.start = self._counted(expm(self.hat(start).array))
        self.D = [self.hat(d) for d in self.d]
        self.A = [self._counted(expm(l * D.array)) for l, D in zip(self.l[0], self.D, strict=True)]
        self.adjoint = [self._adjoint_inverse(A.array) for A in self.A]
        self.steps = range(order - 1)

    def hat(self, v: Counted) -> Counted:
        return self._counted(np.tensordot(v.array, self._generators, 1))

    def vee(self, V: Counted) -> Counted:
        return self._counted(np.tensordot(self._dual, V.array, 2))

    def _adjoint_inverse(self, A: np.ndarray) -> Counted:
        """The matrix of v -> vee(A^-1 hat(v) A)."""
        moved = np.linalg.inv(A) @ self._generators @ A
        return self._counted(np.einsum("iab,jab->ij", self._dual, moved))


def product(s: Segment, replaced: dict[int, Counted]) -> Counted:
    """A_1 ... A_(k-1) with some factors replaced."""
    with s.during("terms"):
        return reduce(operator.matmul, [replaced.get(j, A) for j, A in enumerate(s.A)])


def times_start(s: Segment, terms: Sequence[Counted]) -> Counted:
    with s.during("sum"):
        total = reduce(operator.add, terms)
    with s.during("X_i"):
        return s.start @ total


def rate(s: Segment, j: int) -> Counted:
    """A_j D_j, which is A_j' but for a scalar factor."""
    with s.during("rates"):
        return s.A[j] @ s.D[j]


def second_rate(s: Segment, j: int, AD: Counted) -> Counted:
    """A_j''."""
    with s.during("rates"):
        return s.l[1, j] ** 2 * (AD @ s.D[j]) + s.l[2, j] * AD


def product_rule_first(s: Segment) -> dict[int, Counted]:
    """X', [S20] (30), (31)."""
    return {1: times_start(s, [product(s, {j: s.l[1, j] * rate(s, j)}) for j in s.steps])}


def product_rule_second(s: Segment, shared: bool = False, ordered: bool = False) -> dict[int, Counted]:
    """X'', the product rule applied to [S20] (30): a term for each factor and for each pair of factors.

    Args:
        shared: A_j D_j is computed once, not in every term again.
        ordered: a term for (j, l) and another one for (l, j), instead of twice the same term.
    """
    AD = cache(partial(rate, s)) if shared else partial(rate, s)
    terms = [product(s, {j: second_rate(s, j, AD(j))}) for j in s.steps]
    pairs, factor = (itertools.permutations, 1.0) if ordered else (itertools.combinations, 2.0)
    for pair in pairs(s.steps, 2):
        terms.append(factor * product(s, {j: s.l[1, j] * AD(j) for j in pair}))
    return {2: times_start(s, terms)}


def product_rule_recursive(s: Segment) -> dict[int, Counted]:
    """X' and X'' by the product rule applied to X^(j) = X^(j-1) A_j, [S20] (28): linear without any theory."""
    X, X1, X2 = s.start, 0.0 * s.start, 0.0 * s.start
    for j, A in enumerate(s.A):
        AD = rate(s, j)
        A1, A2 = s.l[1, j] * AD, second_rate(s, j, AD)
        with s.during("steps"):
            X2 = X2 @ A + 2.0 * (X1 @ A1) + X @ A2
            X1 = X1 @ A + X @ A1
        with s.during("X"):
            X = X @ A
    return {1: X1, 2: X2}


def value(s: Segment) -> Counted:
    """X, [S20] (26)."""
    with s.during("X"):
        return reduce(operator.matmul, s.A, s.start)


def velocities(s: Segment) -> list[Counted]:
    """omega^(2) ... omega^(k), [S20] (34)."""
    w, found = 0.0 * s.d[0], []
    for j in s.steps:
        with s.during("velocity" if j else "velocity from zero"):
            w = s.adjoint[j] @ w + s.l[1, j] * s.d[j]
        found.append(w)
    return found


def recursion_first(s: Segment) -> dict[int, Counted]:
    """X', [S20] Theorem 5.2."""
    X, w = value(s), velocities(s)[-1]
    with s.during("result"):
        return {1: X @ s.hat(w)}


def recursion_second(s: Segment, cross: bool = False) -> dict[int, Counted]:
    """X'', [S20] Theorem 5.3; with `cross` the bracket is a cross product, (46), a matrix-vector product w^ d."""
    X, ws, a = value(s), velocities(s), 0.0 * s.d[0]
    for j, w in enumerate(ws):
        with s.during("bracket"):
            W = s.hat(w)
            bracket = W @ s.d[j] if cross else commutator(s, W, s.D[j])
        with s.during("acceleration"):
            a = s.l[1, j] * bracket + s.adjoint[j] @ a + s.l[2, j] * s.d[j]
    with s.during("result"):
        return {2: X @ (W @ W + s.hat(a))}


def commutator(s: Segment, V: Counted, W: Counted) -> Counted:
    """(V W - W V)_v; corrects [S20] (6)."""
    VW, WV = V @ W, W @ V
    with s.during("difference in the bracket"):
        return s.vee(VW - WV)


#: Each finds derivatives of X, by their number.
ALGORITHMS = {
    "product rule, X'": product_rule_first,
    "product rule, X''": product_rule_second,
    "product rule, X'', A_j' shared": partial(product_rule_second, shared=True),
    "product rule, X'', ordered pairs": partial(product_rule_second, ordered=True),
    "product rule, recursive": product_rule_recursive,
    "recursion, X'": recursion_first,
    "recursion, X''": recursion_second,
    "recursion, X'', SO(3)": partial(recursion_second, cross=True),
}
ONLY_SO3 = "recursion, X'', SO(3)"


def finite_differences(group: str, order: int, u: float, seed: int, h: float = 2e-3) -> dict[int, np.ndarray]:
    """First and second derivative of `value`, by central differences of order six."""
    first = np.array([-1, 9, -45, 0, 45, -9, 1]) / (60 * h)
    second = np.array([2, -27, 270, -490, 270, -27, 2]) / (180 * h**2)
    values = np.array([value(Segment(group, order, u + i * h, seed)).array for i in range(-3, 4)])
    return {1: np.tensordot(first, values, 1), 2: np.tensordot(second, values, 1)}


def count_matrices(orders: Sequence[int], u: float, seed: int) -> tuple[dict[str, Counts], float]:
    """Counts of every algorithm at every order, the same for every group; largest error against differences."""
    counts: dict[str, Counts] = {name: {} for name in ALGORITHMS}
    worst = 0.0
    for group, order in itertools.product(GENERATORS, orders):
        expected = finite_differences(group, order, u, seed)
        for name, algorithm in ALGORITHMS.items():
            if name == ONLY_SO3 and group != "SO3":
                continue
            s = Segment(group, order, u, seed)
            for r, found in algorithm(s).items():
                error = np.abs(found.array - expected[r]).max() / (1.0 + np.abs(expected[r]).max())
                worst = max(worst, float(error))
            if counts[name].setdefault(order, s.ledger.counts) != s.ledger.counts:
                raise AssertionError(f"{name}: the count depends on the group")
    if worst > 1e-8:
        raise AssertionError(f"derivatives differ from finite differences by {worst:.1e}")
    return counts, worst
