"""The recurrences of `torchspline.arithmetic` on numbers that count what is done to them."""

import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import sympy

from counting.conventions import K, closed_form
from torchspline.arithmetic import recurrence, scalar
from torchspline.arithmetic.registry import arithmetic

KINDS = ("multiply", "add", "negate", "divide", "select", "sqrt", "sin", "cos")


class CountingScalar:
    """A number that counts what is done to it; subtractions are additions, comparisons are free."""

    def __init__(self, value: float, counts: Counter[str]):
        self.value, self.counts = value, counts

    def made(self, kind: str, value: float) -> "CountingScalar":
        self.counts[kind] += 1
        return CountingScalar(value, self.counts)

    def __add__(self, other: Any) -> "CountingScalar":
        return self.made("add", self.value + plain(other))

    def __sub__(self, other: Any) -> "CountingScalar":
        return self.made("add", self.value - plain(other))

    def __rsub__(self, other: float) -> "CountingScalar":
        return self.made("add", other - self.value)

    def __mul__(self, other: Any) -> "CountingScalar":
        return self.made("multiply", self.value * plain(other))

    def __truediv__(self, other: Any) -> "CountingScalar":
        return self.made("divide", self.value / plain(other))

    def __rtruediv__(self, other: float) -> "CountingScalar":
        return self.made("divide", other / self.value)

    def __neg__(self) -> "CountingScalar":
        return self.made("negate", -self.value)

    def __gt__(self, other: Any) -> bool:
        return self.value > plain(other)

    __radd__, __rmul__ = __add__, __mul__


def plain(x: Any) -> float:
    return x.value if isinstance(x, CountingScalar) else x


def select(condition: bool, yes: Any, no: Any) -> CountingScalar:
    counting = yes if isinstance(yes, CountingScalar) else no
    return counting.made("select", plain(yes if condition else no))


FUNCTIONS = SimpleNamespace(
    sqrt=lambda x: x.made("sqrt", math.sqrt(x.value)),
    sin=lambda x: x.made("sin", math.sin(x.value)),
    cos=lambda x: x.made("cos", math.cos(x.value)),
    where=select,
)
scalar.namespace.register(CountingScalar, lambda x: FUNCTIONS)


def count_components(
    name: str, order: int, derivatives: int, short: bool, seed: int
) -> dict[str, Counter[str]]:
    """Operations of the forward and of the reverse sweep, which find what they find on plain floats."""
    group, random = arithmetic(name), np.random.default_rng(seed)
    size, rows = group.tangent_size, derivatives + 1
    start = group.exp(tuple(random.normal(size=size).tolist()))
    steps, weights, cotangents = (
        random.uniform(-1, 1, shape).tolist()
        for shape in ((order - 1, size), (rows, order - 1), (rows, size))
    )
    counts: Counter[str] = Counter()

    def sweeps(number: Callable[[float], Any]) -> tuple[list[Any], Counter[str]]:
        """All that both sweeps find, and the count after the forward sweep."""
        inputs = [start], steps, weights, cotangents
        (X,), d, l, g = ([tuple(map(number, row)) for row in rows] for rows in inputs)
        value, trace = recurrence.forward(group, X, d, l, derivatives, short)
        after_forward = counts.copy()
        start_g, steps_g, weights_g = recurrence.reverse(group, d, l, trace, g[0], g[1:], short)
        return [*itertools.chain(value, *trace[-1].rates, start_g, *steps_g, *weights_g)], after_forward

    found, forward = sweeps(lambda x: CountingScalar(x, counts))
    if [plain(x) for x in found] != sweeps(float)[0]:
        raise AssertionError(f"{name}, order {order}: counting changes the result")
    return {"forward": forward, "reverse": counts - forward}


def scalar_rows(
    groups: Sequence[str], orders: Sequence[int], derivatives: Sequence[int], short: bool, seed: int
) -> list[dict[str, Any]]:
    """Operations by kind and order, for every group, number of derivatives and sweep; all linear in k."""
    rows = []
    for name, r in itertools.product(groups, derivatives):
        counted = {order: count_components(name, order, r, short, seed) for order in orders}
        for sweep in ("forward", "reverse"):
            counts = {kind: {order: c[sweep][kind] for order, c in counted.items()} for kind in KINDS}
            counts["all"] = {order: c[sweep].total() for order, c in counted.items()}
            forms = {kind: sympy.expand(closed_form(c)) for kind, c in counts.items()}
            if any(sympy.degree(form, K) > 1 for form in forms.values()):
                raise AssertionError(f"{name}, {r} derivatives, {sweep}: not linear in k: {forms}")
            formulas = {kind: str(form) for kind, form in forms.items()}
            rows.append(
                {"group": name, "derivatives": r, "sweep": sweep, "counts": counts, "forms": formulas}
            )
    return rows
