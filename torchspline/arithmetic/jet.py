"""Truncated power series as numbers: the arithmetic of a group run on them differentiates a curve by its parameter.

A jet x_0 + x_1 s + ... + x_n s^n stands for x(u + s). Its coefficients are numbers of any other kind (tensors, floats,
symbols), a float 0.0 among them is a known zero. So a curve that is written as group operations gives its velocity,
acceleration and jerk without a formula of its own, and stays differentiable in everything else.
"""

from types import SimpleNamespace
from typing import Any

from torchspline.arithmetic import scalar
from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.scalar import Scalar, namespace
from torchspline.arithmetic.vector import Vector, plus, times

_FACTORIAL = (1.0, 1.0, 2.0, 6.0)


class Jet:
    """Coefficients of s^0, s^1, ...; of two jets the shorter one says how far the result is known."""

    __slots__ = ("coefficients",)

    def __init__(self, *coefficients: Scalar):
        self.coefficients = coefficients

    @property
    def dtype(self) -> Any:
        """Chooses the length of polynomials, see `scalar.is_single`."""
        return getattr(self.coefficients[0], "dtype", None)

    def __add__(self, other: Scalar) -> "Jet":
        if isinstance(other, Jet):
            return Jet(*map(plus, *_pair(self, other)))
        return Jet(plus(self.coefficients[0], other), *self.coefficients[1:])

    __radd__ = __add__

    def __neg__(self) -> "Jet":
        return Jet(*(times(-1.0, c) for c in self.coefficients))

    def __sub__(self, other: Scalar) -> "Jet":
        return self + (-other)

    def __rsub__(self, other: Scalar) -> "Jet":
        return -self + other

    def __mul__(self, other: Scalar) -> "Jet":
        if not isinstance(other, Jet):
            return Jet(*(times(c, other) for c in self.coefficients))
        a, b = _pair(self, other)
        return Jet(*(_convolve(a, b, n, 0, n) for n in range(len(a))))

    __rmul__ = __mul__

    def __truediv__(self, other: Scalar) -> "Jet":
        return self * (1.0 / other)

    def __rtruediv__(self, other: Scalar) -> "Jet":
        """1/x from x y = 1, coefficient by coefficient."""
        reciprocal = 1.0 / self.coefficients[0]
        result: list[Scalar] = [reciprocal]
        for n in range(1, len(self.coefficients)):
            rest = _convolve(self.coefficients, (*result, 0.0), n, 1, n)
            result.append(times(times(-1.0, reciprocal), rest))
        return other * Jet(*result)

    def __lt__(self, other: Scalar) -> Any:
        return self.coefficients[0] < (other.coefficients[0] if isinstance(other, Jet) else other)

    def __gt__(self, other: Scalar) -> Any:
        return self.coefficients[0] > (other.coefficients[0] if isinstance(other, Jet) else other)

    def __eq__(self, other: object) -> Any:
        return self.coefficients[0] == other

    __hash__ = None  # type: ignore[assignment]


def _pair(a: Jet, b: Jet) -> tuple[tuple[Scalar, ...], tuple[Scalar, ...]]:
    known = min(len(a.coefficients), len(b.coefficients))
    return a.coefficients[:known], b.coefficients[:known]


def _convolve(a: tuple[Scalar, ...], b: tuple[Scalar, ...], n: int, first: int, last: int) -> Scalar:
    """Sum of a_i b_(n-i) from i = first to last."""
    total: Scalar = 0.0
    for i in range(first, last + 1):
        total = plus(total, times(a[i], b[n - i]))
    return total


def _sqrt(x: Jet) -> Jet:
    """From y y = x."""
    root = scalar.sqrt(x.coefficients[0])
    result: list[Scalar] = [root]
    for n in range(1, len(x.coefficients)):
        rest = times(-1.0, _convolve(tuple(result), tuple(result), n, 1, n - 1))
        result.append(times(plus(x.coefficients[n], rest), 0.5 / root))
    return Jet(*result)


def _sine_cosine(x: Jet) -> tuple[Jet, Jet]:
    """From s' = c x' and c' = -s x'."""
    s: list[Scalar] = [scalar.sin(x.coefficients[0])]
    c: list[Scalar] = [scalar.cos(x.coefficients[0])]
    slope = tuple(times(float(n), a) for n, a in enumerate(x.coefficients))
    for n in range(1, len(x.coefficients)):
        s_next = times(1.0 / n, _convolve(slope, (*c, 0.0), n, 1, n))
        c.append(times(-1.0 / n, _convolve(slope, (*s, 0.0), n, 1, n)))
        s.append(s_next)
    return Jet(*s), Jet(*c)


def _where(condition: Any, yes: Scalar, no: Scalar) -> Jet:
    size = len((yes if isinstance(yes, Jet) else no).coefficients)
    pairs = [x.coefficients if isinstance(x, Jet) else (x, *(0.0,) * (size - 1)) for x in (yes, no)]
    numbers = [c for coefficients in pairs for c in coefficients if not isinstance(c, float)]
    chosen = []
    for a, b in zip(*pairs, strict=False):
        if isinstance(a, float) and isinstance(b, float):
            if a == b:
                chosen.append(a)
                continue
            if numbers:  # of two constants `where` cannot choose: put a number where it does not show
                b = scalar.where(condition, numbers[0], b)
        chosen.append(scalar.where(condition, a, b))
    return Jet(*chosen)


_FUNCTIONS = SimpleNamespace(
    sqrt=_sqrt,
    sin=lambda x: _sine_cosine(x)[0],
    cos=lambda x: _sine_cosine(x)[1],
    where=_where,
)
namespace.register(Jet, lambda x: _FUNCTIONS)


def variable(u: Scalar, degree: int) -> Jet:
    """u + s, known up to s^degree."""
    return Jet(u, *((1.0,) if degree > 0 else ()), *(0.0,) * (degree - 1))


def constant(x: Scalar, degree: int) -> Jet:
    """x, known up to s^degree."""
    return Jet(x, *(0.0,) * degree)


def derivative(x: Scalar) -> Scalar:
    """dx/ds, known one degree less far."""
    if not isinstance(x, Jet):
        return 0.0
    return Jet(*(times(float(n), c) for n, c in enumerate(x.coefficients) if n > 0))


def values(v: Vector, order: int) -> Vector:
    """The derivatives of that order, at s = 0, of a vector of jets and constants."""

    def one(x: Scalar) -> Scalar:
        if isinstance(x, Jet):
            return times(_FACTORIAL[order], x.coefficients[order])
        return x if order == 0 else 0.0

    return tuple(map(one, v))


def rates(group: GroupArithmetic, stored: Vector, derivatives: int) -> list[Vector]:
    """Body velocity, acceleration and jerk of a curve that is given by its numbers, which need not be unit."""
    if derivatives == 0:
        return []
    velocity = group.extract(stored, tuple(map(derivative, stored)))
    return [values(velocity, r) for r in range(derivatives)]


def logarithmic_rates(group: GroupArithmetic, x: Vector, derivatives: int) -> list[Vector]:
    """The same of the curve Exp(x): its velocity is `J_r(x) x'`, [S20] (8)."""
    if derivatives == 0:
        return []
    velocity = group.right_jacobian(x, tuple(map(derivative, x)))
    return [values(velocity, r) for r in range(derivatives)]
